"""Models side by side on rows that none of them has seen: splits, scores, paired tests and one page of results."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)  # each name is imported at its first use
