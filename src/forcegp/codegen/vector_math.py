"""The functions of mathematics on vectors of doubles, as C for any processor: within three units of the last place.

exp, sine, cosine: Cody & Waite, "Software Manual for the Elementary Functions" (1980): an argument less a multiple of
log(2) or pi / 2, in parts, and a Taylor polynomial. log: the series of atanh (Muller, "Elementary Functions", 2016,
ch. 5). tanh and asinh from expm1 and log1p, so that nothing cancels near 0. What is rare, and arguments beyond the
range of these, take libm, lane by lane.
"""

from math import factorial

from forcegp.codegen.c_text import c_text, filled

LANE_BY_LANE = ("tan", "asin", "acos", "atan", "sinh", "cosh", "erf")


def _horner(coefficients: list[float], variable: str) -> str:
    """A polynomial, the highest power first."""
    text = f"R({coefficients[0].hex()})"
    for value in coefficients[1:]:
        text = f"({text} * {variable} + {value.hex()})"
    return text


_EXPM1 = _horner([1.0 / factorial(n) for n in range(14, 0, -1)], "r")
_SIN = _horner([(-1.0) ** n / factorial(2 * n + 1) for n in range(7, -1, -1)], "z")
_COS = _horner([(-1.0) ** n / factorial(2 * n) for n in range(8, -1, -1)], "z")
_ATANH = _horner([2.0 / (2 * n + 1) for n in range(11, 0, -1)], "z")


def lane_functions(lanes: int) -> str:
    """The type `real` of that many doubles, and functions on it."""
    words = {"LANES": lanes, "EXPM1": _EXPM1, "SIN": _SIN, "COS": _COS, "ATANH": _ATANH}
    by_lane = (f"INLINE real r_{name}(real x) {{ return by_lane({name}, x); }}\n" for name in LANE_BY_LANE)
    return filled(c_text(__name__, "lanes.h"), words) + "".join(by_lane)
