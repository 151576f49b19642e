"""What people look at: one HTML file with the robot in motion, and the same live in a browser."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)  # each name is imported at its first use
