"""`Doubt`: what speaks against a log, a contact, a model or its scores, and what to do about it."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from html import escape
from typing import Any, Literal

from forcegp.errors import DataWarning

Level = Literal["ok", "look", "wrong"]
LEVELS: tuple[Level, ...] = ("ok", "look", "wrong")
"""From harmless to spoiling every result."""
Correction = Mapping[str, Mapping[str, tuple[Any, ...]]]


@dataclass(frozen=True, kw_only=True)
class Doubt:
    """One thing that was looked at.

    level: ok; look, a person should judge; wrong, results would be wrong. about: what was looked at, in few words.
    what: what was seen, with joint, row, time and numbers. do: what to do about it, beside the `command`.
    joints: names of the joints concerned; numbers: the numbers of `what`, for programs.
    correction: what an import has to state, for `ColumnMapping.corrected_by`: unit, sign, order and mix by signal,
    orientation of q and axes of v and a; and of the robot gravity in the axes of its base.
    """

    level: Level
    about: str
    what: str
    do: str = ""
    joints: tuple[str, ...] = ()
    numbers: Mapping[str, Any] = field(default_factory=dict)
    correction: Correction = field(default_factory=dict)

    @property
    def command(self) -> str:
        """The `forcegp import` that states the correction; empty where options cannot."""
        each = [("orientation", own[0]) for own in self.correction.get("orientation", {}).values()]
        stated = ((name, self.correction.get(name)) for name in ("axes", "unit", "sign"))
        flags = [f"--{name} {text}" for name, text in (*each, *((n, stated_as(x)) for n, x in stated if x))]
        for name in ("gravity",):  # with "=", because a number may be negative
            numbers = (",".join(f"{x:g}" for x in own) for own in self.correction.get(name, {}).values())
            flags += [f"--{name}={text}" for text in numbers]
        return " ".join(["forcegp import", *flags]) if flags else ""

    @property
    def advice(self) -> str:
        """The command, and what else to do."""
        if not self.command:
            return self.do
        return f"{self.command}; or {self.do[0].lower()}{self.do[1:]}" if self.do else f"{self.command}."

    def __str__(self) -> str:
        return f"{self.what} {self.advice}".strip()

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        correction = {name: {key: list(x) for key, x in each.items()} for name, each in self.correction.items()}
        plain = {"do": self.advice, "command": self.command, "joints": list(self.joints), "numbers": dict(self.numbers)}
        return {**vars(self), **plain, "correction": correction}


wrong, look, ok = partial(Doubt, level="wrong"), partial(Doubt, level="look"), partial(Doubt, level="ok")


class Doubts(tuple[Doubt, ...]):
    """Doubts in one list, worst first, as terminal, reports and notebooks show them."""

    def __new__(cls, doubts: Iterable[Doubt] = ()) -> "Doubts":
        """Sorted by level; the order of those of one level stays."""
        return super().__new__(cls, sorted(doubts, key=lambda doubt: -LEVELS.index(doubt.level)))

    @property
    def level(self) -> Level:
        """That of the worst; ok if there are none."""
        return self[0].level if self else "ok"

    def of(self, *subjects: str) -> "Doubts":
        """Those about these subjects."""
        return Doubts(doubt for doubt in self if doubt.about in subjects)

    def at(self, level: Level) -> "Doubts":
        """Those of one level."""
        return Doubts(doubt for doubt in self if doubt.level == level)

    @property
    def subjects(self) -> str:
        """What they are about, each once."""
        return ", ".join(dict.fromkeys(doubt.about for doubt in self))

    def in_one_line(self, most: int = 3) -> str:
        """What was seen of the worst, and the subjects of the others."""
        shown = [f"{doubt.about}: {doubt.what.rstrip('.')}" for doubt in self[:most]]
        return "; ".join([*shown, *([f"further {Doubts(self[most:]).subjects}"] if self[most:] else [])])

    def __str__(self) -> str:
        return "\n".join(f"{doubt.level} {doubt.about}: {doubt}" for doubt in self)

    def _repr_html_(self) -> str:
        cells = ((doubt.level, doubt.about, doubt.what, doubt.advice) for doubt in self)
        rows = "".join(f"<tr>{''.join(f'<td>{escape(text)}</td>' for text in each)}</tr>" for each in cells)
        return f"<table>{rows}</table>"

    def warn(self, kind: type[UserWarning] = DataWarning, stacklevel: int = 2) -> None:
        """One warning each; `stacklevel` as in `warnings.warn`, of the caller."""
        for doubt in self:
            warnings.warn(str(doubt), kind, stacklevel=stacklevel + 1)


def stated_as(values: Mapping[str, Sequence[str | float]]) -> str:
    """`q=deg,m,time=ms`, as options state it: once what all joints share."""
    texts = {name: [x if isinstance(x, str) else f"{x:g}" for x in own] for name, own in values.items()}
    return ",".join(f"{name}={','.join(own[:1] if len({*own}) == 1 else own)}" for name, own in texts.items())


def listed(names: tuple[str, ...] | list[str]) -> str:
    """`a, b and c`."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
