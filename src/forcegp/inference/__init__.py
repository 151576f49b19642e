"""Gaussian-process inference, exact by deflation, and for many rows by inducing points; it knows nothing of robots."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)  # each name is imported at its first use
