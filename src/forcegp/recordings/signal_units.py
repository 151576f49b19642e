"""Units in which logs are written, and what one of each is in SI."""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from jaxtyping import Float

from forcegp.errors import InvalidInput


@dataclass(frozen=True)
class LogUnit:
    """`numerator / denominator` is one unit in SI; both are kept, for x / 1000 rounds once and x * 0.001 twice."""

    name: str
    si: str
    numerator: float = 1.0
    denominator: float = 1.0

    def in_si(self, values: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
        """The values in the SI unit; those that are in it already come out as they are."""
        if self.numerator != 1.0:
            values = values * self.numerator
        return values / self.denominator if self.denominator != 1.0 else values


def _units(si: str, **factors: Fraction | int | float) -> dict[str, LogUnit]:
    made = {}
    for name, factor in factors.items():
        name = name.replace("_per_", "/").replace("squared", "^2")
        if isinstance(factor, Fraction):
            made[name] = LogUnit(name, si, float(factor.numerator), float(factor.denominator))
        else:
            made[name] = LogUnit(name, si, float(factor))
    return made


_MILLI, _MICRO, _NANO = Fraction(1, 1000), Fraction(1, 10**6), Fraction(1, 10**9)
_DEGREE, _TURN = math.pi / 180.0, 2.0 * math.pi

UNITS: dict[str, dict[str, LogUnit]] = {
    "time": _units("s", s=1, ms=_MILLI, us=_MICRO, ns=_NANO, min=60),
    "q": _units("rad", rad=1, mrad=_MILLI, deg=_DEGREE, rev=_TURN)
    | _units("m", m=1, cm=Fraction(1, 100), mm=_MILLI, um=_MICRO),
    "v": _units("rad/s", rad_per_s=1, mrad_per_s=_MILLI, deg_per_s=_DEGREE, rev_per_s=_TURN, rpm=_TURN / 60.0)
    | _units("m/s", m_per_s=1, cm_per_s=Fraction(1, 100), mm_per_s=_MILLI),
    "u": _units("Nm", Nm=1, mNm=_MILLI, uNm=_MICRO, kNm=1000, Ncm=Fraction(1, 100))
    | _units("N", N=1, mN=_MILLI, kN=1000),
    "a": _units("rad/s^2", rad_per_ssquared=1, deg_per_ssquared=_DEGREE)
    | _units("m/s^2", m_per_ssquared=1, mm_per_ssquared=_MILLI),
}
"""By quantity and name: what `ColumnMapping.unit` accepts."""


def log_unit(quantity: str, name: str) -> LogUnit:
    """The unit of that name. Raises InvalidInput listing those of the quantity."""
    units = UNITS[quantity]
    spelled = name.strip().replace("**", "^").replace("²", "^2").replace("µ", "u").replace("·", "").replace("°", "deg")
    if spelled in units:
        return units[spelled]
    lower = {known.lower(): known for known in units}
    close = lower.get(spelled.lower()) or next(iter(difflib.get_close_matches(spelled, units, n=1)), None)
    hint = f"; did you mean {close}?" if close else "."
    raise InvalidInput(f"{quantity} has no unit {name!r}{hint} Known: {', '.join(units)}.")
