"""Checks of one log and its robot: what would spoil a model, how bad it is, and what to do."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)  # each name is imported at its first use
