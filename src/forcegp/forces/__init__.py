"""Everything that acts on the joints: laws that are known but for a few numbers, and forces that nobody modelled."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)  # each name is imported at its first use
