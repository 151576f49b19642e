"""What a cause of misfits is: the words of its doubt, its cost, and the log that it would leave."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from forcegp.checks.torques import Change, Comparison
from forcegp.data import Dataset
from forcegp.data.units import UNITS
from forcegp.doubts import Level
from forcegp.model import Model

SIGN, NUMBER = 0.5, 1.0
"""What a turned sign, or a free number, must gain at least: it is subtracted from the logarithm of what remains."""


PREFIXES = ("m", 1e3), ("k", 1e-3)  # of units of torques: how many are one Nm or N
LIKE, CLOSE = np.log(1.5), 0.07
"""Of the logarithm of a factor: how far that of a unit may be, and of one that is near others."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cause:
    """One cause, as its doubt will say it. `number` tells causes that only fit exactly from mistakes of a kind."""

    about: str
    what: str
    do: str = ""
    joints: tuple[int, ...] = ()
    numbers: dict[str, Any] = field(default_factory=dict)
    correction: dict[str, Any] = field(default_factory=dict)
    cost: float = NUMBER
    number: bool = False
    level: Level = "wrong"


Candidate = tuple[Cause, Comparison]
URDF = "Correct the URDF; or let forcegp fit --forces bodies estimate it from this log."


def like_units(factor: float, si: Sequence[str]) -> tuple[tuple[str, ...], float]:
    """The units of torques (Nm, N) times this factor, and what it would be exactly; none, and itself, where it is none.

    `si` are those of the joints.
    """
    si = tuple(dict.fromkeys(si))
    for prefix, size in PREFIXES:
        if abs(np.log(factor / size)) < LIKE:
            return tuple(prefix + unit for unit in si), size
    for unit in UNITS["u"].values():
        if si == (unit.si,) and unit.per_si != 1.0 and abs(np.log(factor / unit.per_si)) < CLOSE:
            return (unit.name,), unit.per_si
    return (), factor


def number(about: str, what: str, joint: int, value: float, cost: float = NUMBER, **more: Any) -> Cause:
    """A number of the robot that is another."""
    told = {"do": URDF, "joints": (joint,), "numbers": {"value": value}, "level": "look"} | more
    return Cause(about=about, what=what, cost=cost, number=True, **told)


_alone = lru_cache(maxsize=4)(Model)  # of a robot: one check asks for it thousands of times


def changed(signals: str = "", order: np.ndarray | None = None, factor: np.ndarray | float = 1.0) -> Change:
    """Signals of every joint from another column, times a factor; without forces, truth and metadata."""

    def change(dataset: Dataset) -> Dataset:
        places = np.arange(dataset.nv) if order is None else order
        columns = {name: getattr(dataset, name)[:, places] * factor for name in signals}
        return replace(dataset, **columns, model=_alone(dataset.model.robot), noise_std=None, truth={}, metadata={})

    return change
