"""`StructuredPosterior`: what a fitted structured model knows, as a value that predicts, and saves and loads itself."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.inference import LatentKernels, LatentPosterior, OptimizationResult
from forcegp.mechanics import AffineMap, ConstrainedDynamics, MechanicalSystem
from forcegp.models.marginal_likelihood import MarginalLikelihood, inertials_of
from forcegp.models.noise import ACCELERATION, Noise
from forcegp.models.prediction import Gaussian, Prediction

if TYPE_CHECKING:
    from forcegp.models.structured_gp import StructuredGP

ROWS_PER_BLOCK = 4096
"""States that are predicted at once; bounds the memory of long recordings."""

Array = Tensor | np.ndarray | Sequence[Any]


@dataclass(frozen=True, eq=False)
class StructuredPosterior:
    """A `StructuredGP` conditioned on training data; made by `StructuredGP.fit` or `load_posterior`.

    `result` holds the history of the optimisation, `settings` the resolved configuration of the fit (plain JSON
    values).
    """

    model: StructuredGP
    likelihood: MarginalLikelihood
    kernels: LatentKernels
    parameters: Mapping[str, Tensor]
    result: OptimizationResult
    settings: Mapping[str, Any]

    @cached_property
    def latent(self) -> LatentPosterior:
        """The posterior of the latent functions."""
        return self.likelihood.condition(self.kernels, self.parameters)

    @property
    def system(self) -> MechanicalSystem:
        """The robot, contacts and known forces of the model."""
        return self.model.system

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The joints in the order of every last dimension."""
        return self.system.robot.joint_names

    def predict(self, q: Array, v: Array, u: Array, *, covariance: bool = True) -> Prediction:
        """Distribution of the acceleration and of the forces behind it.

        States (..., nv) are in rad, rad/s and Nm (m, m/s and N for prismatic joints). Arrays, lists and tensors are
        taken; results are float64 tensors. With `covariance=False` only means are computed, much faster. Differentiable
        in q, v and u where these are tensors that require gradients.
        Raises InvalidInput for wrong shapes or values that are not finite.
        """
        nv = self.system.robot.nv
        device = self.system.robot.device
        states = _broadcast(_tensor("q", q, nv, device), _tensor("v", v, nv, device), _tensor("u", u, nv, device))
        batch = states[0].shape[:-1]
        flat = [x.reshape(-1, nv) for x in states]
        rows = flat[0].shape[0]
        blocks = [
            self._predict_rows([x[start : start + ROWS_PER_BLOCK] for x in flat], covariance)
            for start in range(0, max(rows, 1), ROWS_PER_BLOCK)
        ]
        return _join(blocks, batch)

    def _predict_rows(self, states: Sequence[Tensor], covariance: bool) -> Prediction:
        q, v, u = states
        dynamics = self.system.dynamics(q, v, u, inertials_of(self.parameters) or None)
        known = self.model.mean == "analytical"
        features = self.likelihood.standardization(self.model.prior.features(dynamics))
        B = self.model.prior.mixing(dynamics)
        rows, latents = len(q), B.shape[-1]
        mean = self.latent.mean(features) if latents else q.new_zeros(rows, 0)
        cov = None
        if covariance:
            cov = self.latent.covariance(features) if latents else q.new_zeros(rows, 0, 0)

        def through(affine: AffineMap) -> Gaussian:
            W = affine.matrix @ B
            value = affine.offset + (W @ mean[..., None])[..., 0]
            return Gaussian(value, None if cov is None else _symmetric(W @ cov @ W.mT))

        acceleration = through(dynamics.acceleration_map(known))
        return Prediction(
            acceleration.mean,
            acceleration.covariance,
            multiplier=through(dynamics.multiplier_map(known)),
            contact_force=through(dynamics.contact_force_map(known)),
            unknown_force=through(_identity_map(dynamics)),
            noise_covariance=_noise_covariance(self.parameters, dynamics),
        )

    @cached_property
    def negative_log_likelihood(self) -> float:
        """-log p(a | q, v, u) of the training data at the fitted parameters, in nats, without any hyperprior."""
        with torch.no_grad():
            return float(self.likelihood(self.kernels, self.parameters))

    @property
    def noise_std(self) -> Float[Tensor, "nv"]:
        """Standard deviation of the acceleration noise per joint, given or learned."""
        return self.parameters[ACCELERATION].exp()

    def with_settings(self, **settings: Any) -> StructuredPosterior:
        """The same posterior with more entries in `settings`."""
        changed = copy.copy(self)
        object.__setattr__(changed, "settings", {**self.settings, **settings})
        return changed


def _tensor(name: str, values: Array, nv: int, device: torch.device) -> Tensor:
    if isinstance(values, Tensor):
        tensor = values.to(torch.float64)
    else:
        try:
            tensor = torch.tensor(np.array(values, dtype=np.float64), device=device)  # a copy: datasets are read-only
        except (TypeError, ValueError) as error:
            raise InvalidInput(f"{name} cannot be read as numbers: {error}") from None
    if tensor.dim() == 0 or tensor.shape[-1] != nv:
        raise InvalidInput(
            f"{name} has shape {tuple(tensor.shape)}; its last dimension must be {nv}, one value per joint."
        )
    if not bool(torch.isfinite(tensor).all()):
        raise InvalidInput(f"{name} has values that are not finite; drop or repair those rows.")
    return tensor


def _broadcast(q: Tensor, v: Tensor, u: Tensor) -> list[Tensor]:
    try:
        return list(torch.broadcast_tensors(q, v, u))
    except RuntimeError:
        shapes = f"q {tuple(q.shape)}, v {tuple(v.shape)}, u {tuple(u.shape)}"
        raise InvalidInput(f"the shapes do not broadcast: {shapes}; give one row of q, v and u per state.") from None


def _identity_map(dynamics: ConstrainedDynamics) -> AffineMap:
    nv = dynamics.state.u.shape[-1]
    identity = torch.eye(nv, dtype=dynamics.state.u.dtype, device=dynamics.state.u.device)
    return AffineMap(torch.zeros_like(dynamics.state.u), identity.expand_as(dynamics.H))


def _noise_covariance(parameters: Mapping[str, Tensor], dynamics: ConstrainedDynamics) -> Tensor:
    noise = Noise.covariance(parameters, dynamics.H)
    return torch.diag_embed(noise).expand_as(dynamics.H) if noise.dim() == 2 else noise


def _symmetric(matrix: Tensor) -> Tensor:
    return 0.5 * (matrix + matrix.mT)


def _join(blocks: Sequence[Prediction], batch: torch.Size) -> Prediction:
    """One prediction from blocks of rows, with the caller's batch dimensions."""

    def join(parts: Sequence[Tensor | None]) -> Tensor | None:
        if any(part is None for part in parts):
            return None
        rows = torch.cat([part for part in parts if part is not None])
        return rows.reshape(*batch, *rows.shape[1:])

    def gaussian(name: str) -> Gaussian:
        parts = [getattr(block, name) for block in blocks]
        mean = join([part.mean for part in parts])
        assert mean is not None
        return Gaussian(mean, join([part.covariance for part in parts]))

    acceleration = gaussian("acceleration")
    noise = join([block.noise_covariance for block in blocks])
    assert noise is not None
    return Prediction(
        acceleration.mean,
        acceleration.covariance,
        gaussian("multiplier"),
        gaussian("contact_force"),
        gaussian("unknown_force"),
        noise,
    )
