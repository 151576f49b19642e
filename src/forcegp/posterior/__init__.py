"""What a fit has found, as a value that predicts, rolls out, updates, compiles and can be stored."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)  # each name is imported at its first use
