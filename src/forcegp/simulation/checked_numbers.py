"""Checks of the numbers in a scenario's configuration, with messages for people. Loads no library."""

from __future__ import annotations

from typing import Any

from forcegp.errors import InvalidInput

Range = tuple[str, float, float]
"""What is allowed in words, the least and the largest value."""

POSITIVE: Range = ("finite and > 0", 1e-12, 1e9)
NOT_NEGATIVE: Range = ("finite and >= 0", 0.0, 1e9)
FINITE: Range = ("finite", -1e9, 1e9)


def checked_numbers(name: str, value: Any, allowed: Range, length: int | None) -> float | tuple[float, ...]:
    """The value as float, or as a tuple of `length` floats. Raises InvalidInput naming the field and its range."""
    words, lower, upper = allowed
    values = tuple(value) if isinstance(value, tuple | list) else (value,)
    if len(values) != (length or 1) or isinstance(value, tuple | list) != (length is not None):
        raise InvalidInput(
            f"{name} is {value!r}; it must be {f'{length} numbers' if length else 'one number'}, {words}."
        )
    for number in values:
        valid = isinstance(number, int | float) and not isinstance(number, bool)
        if not valid or not lower <= number <= upper:  # NaN fails every comparison
            raise InvalidInput(f"{name} is {value!r}; it must be {words}.")
    return tuple(float(number) for number in values) if length else float(values[0])


def require_integer(name: str, value: Any, lower: int, upper: int) -> None:
    """Raise InvalidInput naming the field for anything else than an integer in the range."""
    if isinstance(value, bool) or not isinstance(value, int) or not lower <= value <= upper:
        raise InvalidInput(f"{name} is {value!r}; it must be an integer from {lower} to {upper}.")


def require_choice(name: str, value: Any, choices: tuple[str, ...]) -> None:
    """Raise InvalidInput naming the field for anything but one of the choices."""
    if value not in choices:
        raise InvalidInput(f"{name} is {value!r}; it must be one of {', '.join(choices)}.")
