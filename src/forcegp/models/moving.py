"""A fitted model on another device: the same rows and parameters, conditioned there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    from forcegp.models.protocol import Posterior


def moved(posterior: Posterior, device: torch.device | str) -> Posterior:
    """`Posterior.to`."""
    model = replace(posterior.model, system=posterior.model.system.to(device))
    at: torch.device = model.system.robot.device
    result = replace(
        posterior.result,
        parameters=_all_on(posterior.result.parameters, at),
        iterates=tuple(_all_on(point, at) for point in posterior.result.iterates),
    )
    solution = None if posterior.solution is None else posterior.solution.to(at)
    there: Any = model.condition(
        posterior.training.to(at), _all_on(posterior.parameters, at), result, posterior.settings, solution
    )
    identification = getattr(posterior, "identification", None)
    if identification is not None:
        there = replace(there, identification=identification)
    return there if posterior.target is None else there.with_system(posterior.target.to(device))


def _all_on(tensors: Mapping[str, Tensor], device: torch.device) -> dict[str, Tensor]:
    return {name: value.to(device) for name, value in tensors.items()}
