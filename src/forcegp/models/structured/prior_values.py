"""Whether a prior, perhaps of one's own, gives what `ForcePrior` asks for: checked before the search is paid."""

from __future__ import annotations

from typing import Any, get_args

import torch
from gpytorch.kernels import Kernel
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.mechanics import ConstrainedDynamics
from forcegp.priors import ForcePrior
from forcegp.priors.force_prior import Scaling


def checked_values(prior: ForcePrior, dynamics: ConstrainedDynamics) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Mixing (N, nv, C) and features (N, d) of every latent at N states. Raises InvalidInput for anything else."""
    robot, own = dynamics.state.robot, type(prior).__name__
    names = prior.latent_names(robot)
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise InvalidInput(f"{own}.latent_names gives {names!r}; it must give a tuple with a name per latent")
    rows, count = len(dynamics.state.q), len(names)
    B = _tensor(f"{own}.mixing", prior.mixing(dynamics), (rows, robot.nv, count), "(rows, nv, latents)")
    features = _one_per_latent(f"{own}.features", prior.features(dynamics), names)
    for name, z in zip(names, features, strict=True):
        _tensor(f"{own}.features of {name!r}", z, (rows, None), "(rows, features); one feature is z[..., None]")
    ways = get_args(Scaling)
    for name, given, z in zip(
        names, _one_per_latent(f"{own}.scalings", prior.scalings(robot), names), features, strict=True
    ):
        each = (given,) * z.shape[-1] if isinstance(given, str) else tuple(given)
        if len(each) != z.shape[-1] or not set(each) <= set(ways):
            allowed = ", ".join(map(repr, ways))
            raise InvalidInput(f"{own}.scalings of {name!r} is {given!r}; give one of {allowed}, or one per feature")
    return B, features


def checked_kernels(prior: ForcePrior, kernels: Any, latents: int) -> tuple[Kernel, ...]:
    """One GPyTorch kernel per latent. Raises InvalidInput for anything else; that they are float64 is checked later."""
    if not isinstance(kernels, list | tuple) or not all(isinstance(kernel, Kernel) for kernel in kernels):
        raise InvalidInput(f"{type(prior).__name__}.kernels must give a tuple of GPyTorch kernels, one per latent")
    if len(kernels) != latents:
        raise InvalidInput(f"{type(prior).__name__}.kernels gives {len(kernels)} kernels for {latents} latents")
    return tuple(kernels)


def _one_per_latent(what: str, given: Any, names: Any) -> tuple[Any, ...]:
    if not isinstance(given, list | tuple):
        raise InvalidInput(f"{what} gives a {type(given).__name__}; it must give a tuple with an entry per latent")
    if len(given) != len(names):
        raise InvalidInput(f"{what} gives {len(given)} entries for {len(names)} latents ({', '.join(names)})")
    return tuple(given)


def _differ(wanted: int | None, size: int) -> bool:
    return wanted not in (None, size)


def _tensor(what: str, given: Any, shape: tuple[int | None, ...], wanted: str) -> Tensor:
    if not isinstance(given, Tensor):
        raise InvalidInput(f"{what} is a {type(given).__name__}; it must be a float64 tensor {wanted}")
    if len(given.shape) != len(shape) or any(map(_differ, shape, given.shape)):
        sizes = ", ".join("any" if size is None else str(size) for size in shape)
        raise InvalidInput(f"{what} has shape {tuple(given.shape)}; it must be ({sizes}), that is {wanted}")
    if given.dtype != torch.float64:
        raise InvalidInput(f"{what} is {given.dtype}; it must be float64: compute it from the state, or call .double()")
    if given.requires_grad:
        raise InvalidInput(f"{what} requires gradients, but only kernels are learned: detach the tensors that it holds")
    lost = ~torch.isfinite(given).flatten(1).all(1)
    if bool(lost.any()):
        raise InvalidInput(f"{what} is not finite at training row {int(lost.nonzero()[0])}; mend it there")
    return given
