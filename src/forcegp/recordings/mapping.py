"""`ColumnMapping`: which columns are the time, positions, velocities and forces, in which units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

from forcegp.errors import InvalidInput, usable_arguments
from forcegp.recordings.signal_units import UNITS, log_unit

SIGNALS = ("q", "v", "u", "a")
Factors = Mapping[str, tuple[float, ...]]


@dataclass(frozen=True, kw_only=True)
class ColumnMapping:
    """What the columns of a log mean. A value in SI is `sign * scale * unit * (combination of columns) + offset`.

    Fields
    ------
    time, step: a column or combination that is the time, or the time in s between two rows; one of both.
    q, v, u, a: per signal, its columns: patterns (`pos{1..7}`), names of vectors, combinations (`theta2 - theta1`), or
        one constant. None: v and a are differentiated, the others are looked for by the names of the joints.
    joints: their names, in the order of the columns.
    unit: by signal and "time", one unit for all joints or one for each. Default: SI.
    sign, scale, offset: by signal, one number for all joints or one for each; offset in SI, added last.
    episode: a column that numbers the episodes.
    episodes: a pattern (`piece*`) for arrays or groups of the file, each of which is an episode.
    headerless: for text without header, the columns of each file in their order.
    delimiter: for text, if it cannot be detected.
    side_by_side: the files given are one recording, not one each.

    Raises InvalidInput for units that do not exist and numbers that make no sense.
    """

    __no_type_check__: ClassVar[bool] = True

    time: str | None = None
    step: float | None = None
    q: tuple[str, ...] | None = None
    v: tuple[str, ...] | None = None
    u: tuple[str, ...] | None = None
    a: tuple[str, ...] | None = None
    joints: tuple[str, ...] = ()
    unit: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    sign: Factors = field(default_factory=dict)
    scale: Factors = field(default_factory=dict)
    offset: Factors = field(default_factory=dict)
    episode: str | None = None
    episodes: str | None = None
    headerless: tuple[int, ...] = ()
    delimiter: str | None = None
    side_by_side: bool = False

    @usable_arguments("ColumnMapping")
    def __post_init__(self) -> None:
        if self.time is not None and self.step is not None:
            raise InvalidInput("give a column for the time or the step between rows, not both.")
        if self.step is not None and not 0.0 < self.step < float("inf"):
            raise InvalidInput(f"step is {self.step} s; it must be positive and finite.")
        if len(set(self.joints)) < len(self.joints) or not all(self.joints):
            raise InvalidInput(f"joints are {', '.join(self.joints)}; every joint needs a name of its own.")
        for quantity, names in self.unit.items():
            if quantity not in UNITS:
                raise InvalidInput(f"unit names {quantity!r}; it has {', '.join(UNITS)}.")
            for name in names:
                log_unit(quantity, name)
        for what in ("sign", "scale", "offset"):
            for signal, numbers in getattr(self, what).items():
                self._check_numbers(what, signal, numbers)
        if any(columns < 1 for columns in self.headerless):
            raise InvalidInput(f"headerless is {self.headerless}; a row has at least one number.")

    def _check_numbers(self, what: str, signal: str, numbers: tuple[float, ...]) -> None:
        if signal not in SIGNALS:
            raise InvalidInput(f"{what} names {signal!r}; it has {', '.join(SIGNALS)}.")
        for number in numbers:
            if not abs(number) < float("inf") or (what == "sign" and number not in (1.0, -1.0)):
                raise InvalidInput(
                    f"{what} of {signal} is {number}; give {'1 or -1' if what == 'sign' else 'a number'}."
                )
            if what == "scale" and number == 0.0:
                raise InvalidInput(f"scale of {signal} is 0, which would erase it.")

    def changed_by(self, other: ColumnMapping) -> ColumnMapping:
        """The mapping with everything that the other one states; time and step take each other's place."""
        stated = {
            item.name: getattr(other, item.name)
            for item in fields(other)
            if getattr(other, item.name) not in (None, (), {}, False)
        }
        for name in ("unit", "sign", "scale", "offset"):
            if name in stated:
                stated[name] = {**getattr(self, name), **stated[name]}
        if {"time", "step"} & stated.keys():
            stated = {"time": None, "step": None} | stated
        return replace(self, **stated)

    def plain(self) -> dict[str, Any]:
        """What is stated, as JSON and YAML hold it: a list of one is written as its only entry."""
        found: dict[str, Any] = {}
        for item in fields(self):
            value = getattr(self, item.name)
            if value in (None, (), {}, False):
                continue
            if isinstance(value, Mapping):
                value = {name: _shortened(entry) for name, entry in value.items()}
            found[item.name] = list(value) if item.name == "joints" else _shortened(value)
        return found


def _shortened(value: Any) -> Any:
    if not isinstance(value, tuple):
        return value
    alone = len(value) == 1 and "," not in str(value[0])  # a text with a comma would be read as a list
    return value[0] if alone else list(value)
