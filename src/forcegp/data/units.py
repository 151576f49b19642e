"""Units that logs are in."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from forcegp.data.imu import STANDARD


@dataclass(frozen=True)
class LogUnit:
    """One unit in SI is so many of these: whole thousandths are divided once, and come out to the last bit."""

    name: str
    si: str
    per_si: float = 1.0

    def in_si(self, values: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
        """The values in the SI unit; those that are in it already come out as they are."""
        return values / self.per_si if self.per_si != 1.0 else values


def _units(si: str, per_si: Mapping[str, float]) -> dict[str, LogUnit]:
    return {name: LogUnit(name, si, float(number)) for name, number in per_si.items()}


_DEGREES, _TURNS = 180.0 / math.pi, 0.5 / math.pi  # in a radian
_POUND, _INCH = 4.4482216152605, 0.0254  # N and m
ONE = LogUnit("1", "1")  # of parts of a quaternion, of shares of a thrust and of switches
UNITS: dict[str, dict[str, LogUnit]] = {
    "time": _units("s", {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9, "min": 1 / 60}),
    "q": _units("rad", {"rad": 1, "mrad": 1e3, "deg": _DEGREES, "rev": _TURNS})
    | _units("m", {"m": 1, "cm": 100, "mm": 1e3, "um": 1e6})
    | {"1": ONE},
    "v": _units("rad/s", {"rad/s": 1, "mrad/s": 1e3, "deg/s": _DEGREES, "rev/s": _TURNS, "rpm": 60 * _TURNS})
    | _units("m/s", {"m/s": 1, "cm/s": 100, "mm/s": 1e3}),
    "u": _units("Nm", {"Nm": 1, "mNm": 1e3, "uNm": 1e6, "kNm": 1e-3, "Ncm": 100, "kgfcm": 100 / STANDARD})
    | _units("Nm", {"lbfin": 1 / (_POUND * _INCH), "ozfin": 16 / (_POUND * _INCH)})
    | _units("N", {"N": 1, "mN": 1e3, "kN": 1e-3, "kgf": 1 / STANDARD, "lbf": 1 / _POUND})
    | {"1": ONE}
    | _units("rad/s", {"rad/s": 1, "rev/s": _TURNS, "rpm": 60 * _TURNS}),
    "a": _units("rad/s^2", {"rad/s^2": 1, "deg/s^2": _DEGREES}) | _units("m/s^2", {"m/s^2": 1, "mm/s^2": 1e3}),
    "force": _units("N", {"N": 1, "mN": 1e3, "kN": 1e-3, "kgf": 1 / STANDARD, "lbf": 1 / _POUND}),
    "torque": _units("Nm", {"Nm": 1, "mNm": 1e3, "kNm": 1e-3, "Ncm": 100}) | _units("N", {"N": 1}),
    "imu": _units("m/s^2", {"m/s^2": 1, "mm/s^2": 1e3, "g": 1 / STANDARD}),
}
"""By quantity and name: what `ColumnMapping.unit` accepts."""
