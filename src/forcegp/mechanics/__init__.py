"""What is known about the mechanics: surfaces, contacts, known forces, and Gauss' principle that joins them."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)  # each name is imported at its first use
