"""How values show themselves: a few facts as text, and as a table in a notebook."""

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from html import escape
from math import isfinite

WIDTH = 100  # longest text that stands on one line
TOLD = 0.1  # of a number: half widths of intervals from which on they stand beside it


class Summary:
    """`repr` and a notebook's table of a class, from `facts`; dataclasses need `repr=False`."""

    @abstractmethod
    def facts(self) -> Mapping[str, object]:
        """What the value is, by name: at most nine short entries, and nothing that takes long to compute."""

    def __repr__(self) -> str:
        entries = [f"{name}: {value}" for name, value in self.facts().items()]
        line = f"{type(self).__name__}({', '.join(entries)})"
        return line if len(line) <= WIDTH else f"{type(self).__name__}(\n  " + "\n  ".join(entries) + "\n)"

    def _repr_html_(self) -> str:
        cells = {escape(name): escape(str(value)) for name, value in self.facts().items()}
        rows = "".join(f"<tr><th>{name}</th><td>{value}</td></tr>" for name, value in cells.items())
        return f"<table><caption>{escape(type(self).__name__)}</caption>{rows}</table>"


def listed(names: Iterable[object], most: int = 4) -> str:
    """`a, b, c, d and 3 more`; `none` of nothing."""
    texts = list(map(str, names))
    return ", ".join(texts[:most]) + (f" and {len(texts) - most} more" if len(texts) > most else "") or "none"


def in_digits(value: float, count: int = 3) -> str:
    """So many digits, before the point all: `0.05`, `6640`."""
    return f"{float(f'{value:.{count}g}'):.12g}"


def rounded(values: Iterable[float]) -> str:
    """Three digits of each: `0.05, 0.051, 0.048`."""
    return listed(map(in_digits, values), most=7)


def within(value: float, half: float) -> str:
    """Three digits, and the half width of an interval of more than a tenth of it: `0.05`, `0.05 ± 0.01`."""
    return in_digits(value) + f" ± {in_digits(half, 1)}" * (half > TOLD * abs(value))


def plain(values: Iterable[float]) -> list[float | None]:
    """Numbers for JSON, which has no NaN."""
    return [float(value) if isfinite(value) else None for value in values]
