"""How good are models: one table of scores, paired differences, figures. Matplotlib is imported when one is drawn."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)  # each name is imported at its first use
