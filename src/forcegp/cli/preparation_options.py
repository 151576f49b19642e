"""`--cutoff`, `--differentiate`, `--delay`, `--every`, `--trim`: how a command prepares a raw log."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from typing_extensions import override
from tyro.conf import arg

import forcegp
from forcegp.cli.command import Command
from forcegp.errors import InvalidInput


@dataclass(frozen=True, kw_only=True)
class CutoffOptions(Command):
    """What every command asks that filters a log."""

    cutoff: Annotated[str, arg(metavar="HZ|auto|none")] = "none"
    """Low-pass filter q and u without delay, and compute v and a anew. auto: where the spectrum shows that motion ends
    and noise begins."""
    differentiate: Annotated[Literal["q", "v"], arg(metavar="q|v")] = "q"
    """q: v and a from filtered positions. v: a from filtered velocities. Only with --cutoff."""

    def _preparation(self) -> forcegp.Preparation:
        """The preparation that the options describe. Raises InvalidInput, naming the option, for what is no number."""
        if self.cutoff in ("none", "auto"):
            cutoff = None if self.cutoff == "none" else "auto"
        else:
            cutoff = _number("--cutoff", self.cutoff, "a frequency in Hz, auto or none")
        return forcegp.Preparation(cutoff=cutoff, differentiate=self.differentiate)


@dataclass(frozen=True, kw_only=True)
class PreparationOptions(CutoffOptions):
    """What every command asks that makes rows to learn from out of a raw log."""

    delay: Annotated[str, arg(metavar="S|auto")] = "0"
    """How much later than it acts u was logged, in s: one number, or one per joint with commas. auto: estimated for all
    joints together, which needs the robot."""
    every: Annotated[int, arg(metavar="N")] = 1
    """Keep every N-th row, after the filter."""
    trim: Annotated[float, arg(metavar="S")] = 0.0
    """Drop so many seconds at both ends of each episode, after the filter."""

    @override
    def _preparation(self) -> forcegp.Preparation:
        delay: float | tuple[float, ...] | Literal["auto"]
        if self.delay == "auto":
            delay = "auto"
        else:
            allowed = "seconds, one per joint with commas, or auto"
            each = tuple(_number("--delay", word, allowed) for word in self.delay.split(","))
            delay = each[0] if len(each) == 1 else each
        return replace(super()._preparation(), delay=delay, every=self.every, trim=self.trim)


def _number(option: str, word: str, allowed: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise InvalidInput(f"{option} is {word!r}; give {allowed}.") from None
