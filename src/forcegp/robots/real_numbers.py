"""Numbers that users hand over, read once and by one rule.

Real numbers of any precision are taken and computed with in float64, which changes none of them. What would be read as
other numbers than were meant is refused: text, dates, booleans, complex numbers, masked entries.
"""

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from forcegp.errors import ForceGPError, InvalidInput

LARGEST = 2**63 - 1
"""Of the integers that every library takes."""


def real_array(name: str, given: Any, kinds: str = "fiu", error: type[ForceGPError] = InvalidInput) -> np.ndarray:
    """`given` as an array of real numbers, or of integers with `kinds` "iu", not necessarily copied."""
    kind = "real numbers" if "f" in kinds else "integers"
    if np.ma.is_masked(given):
        where = np.argwhere(np.ma.getmaskarray(given))
        raise error(
            f"{name} has {len(where)} masked values, the first at {tuple(where[0].tolist())}; a mask would be lost: "
            "drop these rows, or fill them with numbers that were measured."
        )
    try:
        values = np.asarray(given)
    except (TypeError, ValueError, RuntimeError) as cause:  # ragged lists, tensors that require a gradient
        raise error(f"{name} is not an array of {kind}: {cause}") from cause
    if values.dtype.kind not in kinds:
        raise error(f"{name} must be an array of {kind}; given: {values.dtype} of shape {values.shape}.")
    return values


def real_tensor(name: str, given: Any, device: torch.device) -> Tensor:
    """`given` in float64: a tensor where it is, with its graph, anything else as a copy on `device`.

    Raises InvalidInput for what is no real number.
    """
    if type(given) is Tensor and given.dtype is torch.float64 and given.layout is torch.strided:
        return given
    if not isinstance(given, Tensor):
        return torch.tensor(real_array(name, given).astype(np.float64), device=device)
    if given.layout != torch.strided or given.dtype == torch.bool or given.is_complex():
        raise InvalidInput(f"{name} must be a tensor of real numbers; given: {given.dtype}, {given.layout}.")
    return given.to(torch.float64)  # itself where it is


def require_finite(name: str, values: Tensor) -> None:
    """Raise InvalidInput for numbers that are not finite, and inside `vmap`, where no number can be looked at."""
    try:
        # the sum takes half as long, and is finite where all numbers are, unless they are very large
        finite = math.isfinite(float(values.detach().sum())) or bool(torch.isfinite(values.detach()).all())
    except RuntimeError:
        raise InvalidInput(
            f"{name} comes from torch.func.vmap, inside which numbers cannot be checked; batch dimensions lead, so "
            "call this once without vmap, with all states as rows (n, nv)."
        ) from None
    if not finite:
        raise InvalidInput(f"{name} has values that are not finite; drop or repair those rows.")


def whole_number(name: str, given: Any, least: int, most: int = LARGEST, why: str = "") -> int:
    """`given` as an int within these limits, of which `why` explains the upper one.

    Raises InvalidInput for anything else, booleans, text and 1.0 included.
    """
    try:
        value = operator.index(given)
    except TypeError:
        value = least - 1
    if isinstance(given, bool | np.bool_) or not least <= value <= most:
        allowed = f"an integer of at least {least}" if most == LARGEST else f"an integer from {least} to {most}"
        raise InvalidInput(f"`{name}={given!r}` must be {allowed}{why and f', {why}'}")
    return value
