"""What a rollout integrates: the mean acceleration of a fitted model, or those of functions drawn from it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.inference.pathwise import StackedFunctions, draw_functions
from forcegp.mechanics import Baumgarte, MechanicalSystem
from forcegp.models.marginal_likelihood import inertials_of

if TYPE_CHECKING:
    from forcegp.models.independent_posterior import IndependentPosterior
    from forcegp.models.protocol import Posterior
    from forcegp.models.structured_posterior import StructuredPosterior

AccelerationFunction = Callable[[Tensor, Tensor, Tensor], Tensor]
"""(q, v, u) -> a, all of one shape."""


class AccelerationModel(ABC):
    """Accelerations of a fitted model under the stabilisation of one rollout."""

    system: MechanicalSystem
    baumgarte: Baumgarte | None

    @abstractmethod
    def mean(self) -> AccelerationFunction:
        """The mean acceleration, at states (n, nv)."""

    @abstractmethod
    def sampled(self, samples: int, seed: int) -> AccelerationFunction:
        """The accelerations of `samples` functions drawn from the model, each at states of its own (samples, n, nv).

        Raises InvalidInput for models from which none can be drawn.
        """


class StructuredAccelerations(AccelerationModel):
    """a = offset + H B f of a structured model, with f the mean or drawn functions of its Gaussian processes."""

    def __init__(self, posterior: StructuredPosterior, baumgarte: Baumgarte | None) -> None:
        if baumgarte is not None and not posterior.system.contacts:
            raise InvalidInput("baumgarte was given, but the model's system has no contacts; give baumgarte=None.")
        self.posterior = posterior
        self.baumgarte = baumgarte
        self.system = replace(posterior.system, baumgarte=baumgarte)

    @cached_property
    def _inertials(self) -> dict[str, Tensor] | None:
        return inertials_of(self.posterior.parameters) or None

    @override
    def mean(self) -> AccelerationFunction:
        return self._through(StackedFunctions.mean_of(self.posterior.latent))

    @override
    def sampled(self, samples: int, seed: int) -> AccelerationFunction:
        if not len(self.posterior.kernels.kernels):  # no unknown force: all functions are the same
            return self.mean()
        return self._through(draw_functions(self.posterior.latent, samples, seed))

    def _through(self, functions: Callable[[list[Tensor]], Tensor]) -> AccelerationFunction:
        model, standardize = self.posterior.model, self.posterior.likelihood.standardization

        def acceleration(q: Tensor, v: Tensor, u: Tensor) -> Tensor:
            dynamics = self.system.dynamics(q, v, u, self._inertials)
            affine, _ = self.posterior.acceleration_map(dynamics)
            mixing = model.prior.mixing(dynamics)
            if not mixing.shape[-1]:
                return affine.offset
            latents = functions(standardize(model.prior.features(dynamics)))
            return affine((mixing @ latents[..., None])[..., 0])

        return acceleration


class PredictedAccelerations(AccelerationModel):
    """Whatever `predict` says: for models whose acceleration knows no constraint, and therefore no stabilisation."""

    def __init__(self, posterior: Posterior, baumgarte: Baumgarte | None) -> None:
        if baumgarte is not None:
            raise InvalidInput(
                f"baumgarte was given, but a {type(posterior).__name__} does not know the constraint, so there is "
                "nothing to stabilise; give baumgarte=None, and integrator='projected' to stay on the surface."
            )
        self.posterior = posterior
        self.baumgarte = None
        self.system = posterior.system

    @override
    def mean(self) -> AccelerationFunction:
        return lambda q, v, u: self.posterior.predict(q, v, u, covariance=False).mean

    @override
    def sampled(self, samples: int, seed: int) -> AccelerationFunction:
        raise InvalidInput(
            f"no functions can be drawn from a {type(self.posterior).__name__}; give samples=0, or use a StructuredGP."
        )


class IndependentAccelerations(PredictedAccelerations):
    """One Gaussian process per joint acceleration, each of which functions can be drawn from."""

    def __init__(self, posterior: IndependentPosterior, baumgarte: Baumgarte | None) -> None:
        super().__init__(posterior, baumgarte)
        self.latents, self.features = posterior.latents, posterior.likelihood.features

    @override
    def mean(self) -> AccelerationFunction:
        return self._through([StackedFunctions.mean_of(latent) for latent in self.latents])

    @override
    def sampled(self, samples: int, seed: int) -> AccelerationFunction:
        seeds = np.random.SeedSequence(seed).generate_state(len(self.latents))  # joints are independent
        return self._through(
            [draw_functions(latent, samples, int(own)) for latent, own in zip(self.latents, seeds, strict=True)]
        )

    def _through(self, functions: Sequence[Callable[[list[Tensor]], Tensor]]) -> AccelerationFunction:
        def acceleration(q: Tensor, v: Tensor, u: Tensor) -> Tensor:
            z = self.features(*(x.reshape(-1, x.shape[-1]) for x in (q, v, u)))
            points = [z.reshape(*q.shape[:-1], -1)]
            return torch.cat([function(points) for function in functions], dim=-1)

        return acceleration
