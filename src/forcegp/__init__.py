"""Probabilistic forward dynamics of robots: Gaussian processes on the forces that nobody modelled.

The public API is listed, by theme, in `__init__.pyi`. Names are imported at first use: `import forcegp` costs nothing.
"""

import lazy_loader as lazy

_imported, __dir__, __all__ = lazy.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """Import a public name at its first use (PEP 562)."""
    if name == "__version__":
        from importlib import metadata  # 30 ms that only this needs

        return metadata.version("forcegp")
    if name not in __all__:
        raise AttributeError(f"module 'forcegp' has no attribute {name!r}; it has {', '.join(__all__)}")
    return _imported(name)
