"""What rows of a log say about the numbers and functions of a model: residuals, directions and noise."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)  # each name is imported at its first use
