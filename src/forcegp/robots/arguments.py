"""Checks of what callers pass in: type, shape, dtype, device, and batches that broadcast."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput, UnknownJoint, unknown_name_message
from forcegp.robots.real_numbers import real_array, real_tensor

Vector = Sequence[float | int] | np.ndarray | Tensor
Inertials = Mapping[str, Tensor]
JointValues = Float[Tensor, "*#batch nv"]
"""One value per joint, float64 (..., nv); the batch dimensions of several arguments broadcast."""


def checked_tensor(name: str, value: object, size: int, meaning: str, device: torch.device) -> Tensor:
    """The tensor in float64; :class:`~forcegp.errors.InvalidInput` unless it is real (..., size) on ``device``."""
    if not isinstance(value, Tensor):
        raise InvalidInput(
            f"{name} is a {type(value).__name__}; give a tensor: torch.as_tensor({name}, dtype=torch.float64)."
        )
    if value.dim() == 0 or value.shape[-1] != size:
        raise InvalidInput(f"{name} has shape {tuple(value.shape)}; its last dimension must be {size} ({meaning}).")
    if value.device != device:
        raise InvalidInput(
            f"{name} is on {value.device} but the robot on {device}; use robot.to({str(value.device)!r}) "
            f"or {name}.to({str(device)!r})."
        )
    return real_tensor(name, value, device)


def check_mapping(inertials: object) -> None:
    """:class:`~forcegp.errors.InvalidInput` unless inertials are given by link name."""
    if not isinstance(inertials, Mapping):
        raise InvalidInput(
            f"inertials is a {type(inertials).__name__}; give a mapping from link names to tensors (..., 10)."
        )


def broadcast_batch(shapes: Mapping[str, torch.Size]) -> torch.Size:
    """Common batch shape; :class:`~forcegp.errors.InvalidInput` where there is none."""
    different = {shape for shape in shapes.values() if shape}
    if len(different) <= 1:  # the usual case; torch's function imports for a quarter of a second at first
        return next(iter(different), torch.Size())
    try:
        return torch.broadcast_shapes(*shapes.values())
    except RuntimeError:
        listed = ", ".join(f"{name} {tuple(shape)}" for name, shape in shapes.items())
        raise InvalidInput(
            f"batch shapes do not broadcast: {listed}; make them equal, or 1 where one value serves all."
        ) from None


def finite_vector(name: str, values: Vector, size: int) -> np.ndarray:
    """``size`` finite numbers as an array."""
    try:
        plain = values.detach().cpu().numpy() if isinstance(values, Tensor) else values
        array = real_array(name, plain).astype(np.float64)
    except InvalidInput:  # text, of which every letter could be a digit
        raise InvalidInput(f"{name} is {values!r}; give {size} finite numbers.") from None
    if array.shape != (size,) or not np.isfinite(array).all():
        raise InvalidInput(f"{name} is {values!r}; give {size} finite numbers.")
    return array


def checked_point(point: Vector, device: torch.device) -> Tensor:
    """A point (..., 3) in m as a float64 tensor on ``device``; :class:`~forcegp.errors.InvalidInput` for others."""
    if not isinstance(point, Tensor):
        point = torch.as_tensor(finite_vector("point", point, 3), device=device)
    return checked_tensor("point", point, 3, "x, y, z in m", device)


def armature_values(
    given: Vector | Mapping[str, float | int] | None, joints: tuple[str, ...], robot: str
) -> np.ndarray:
    """Rotor inertia per joint (kg m^2 or kg), given in joint order or by joint name; 0 where it is not given."""
    if given is None:
        return np.zeros(len(joints))
    if isinstance(given, Mapping):
        unknown = next((name for name in given if name not in joints), None)
        if unknown is not None:
            raise UnknownJoint(unknown_name_message("joint", unknown, robot, joints))
        given = [given.get(name, 0.0) for name in joints]
    values = finite_vector("armature", given, len(joints))
    if (values < 0.0).any():
        joint = joints[int(np.argmin(values))]
        raise InvalidInput(f"armature of joint {joint!r} is {values.min():g}; a rotor inertia cannot be negative.")
    return values


def locked_positions(locked: Mapping[str, float | int]) -> dict[str, float]:
    """Positions (rad or m) of locked joints as floats."""
    out = {}
    for name, position in locked.items():
        try:
            out[name] = float(position)
        except (TypeError, ValueError):
            out[name] = np.nan
        if not np.isfinite(out[name]):
            raise InvalidInput(f"locked[{name!r}] is {position!r}; give a finite position in rad or m.")
    return out
