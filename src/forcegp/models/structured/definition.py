"""What a structured model is: a system, a prior on the unknown force, the mean and the noise."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import get_args

from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, usable_arguments
from forcegp.inference import ProblemSize
from forcegp.mechanics import MechanicalSystem
from forcegp.models.fit_arguments import check_system_and_noise
from forcegp.models.noise import Noise
from forcegp.models.protocol import Model
from forcegp.models.structured.marginal_likelihood import MarginalLikelihood, Mean
from forcegp.models.training_data import TrainingData
from forcegp.priors import ForcePrior, JointForces


@dataclass(frozen=True, eq=False)
class StructuredModel(Model):
    """The fields of a `StructuredGP`, checked, and the likelihood that they define."""

    system: MechanicalSystem
    prior: ForcePrior = field(default_factory=JointForces)
    mean: Mean = "analytical"
    noise: Noise | None = None

    @usable_arguments("StructuredModel")
    def __post_init__(self) -> None:
        check_system_and_noise(self)
        if not isinstance(self.prior, ForcePrior):
            raise InvalidInput(f"prior is a {type(self.prior).__name__}; give a ForcePrior, for example JointForces()")
        if self.mean not in get_args(Mean):
            raise InvalidInput(f"mean is {self.mean!r}; allowed: {', '.join(map(repr, get_args(Mean)))}")
        self.prior.check(self.system)

    def likelihood(self, training: TrainingData) -> MarginalLikelihood:
        """That of these rows or windows."""
        return MarginalLikelihood(self.system, self.prior, self.mean, training)

    def problem_size(self, rows: int) -> ProblemSize:
        """Of the posterior of so many rows, without computing anything; contacts count as independent."""
        nv, latents = self.system.robot.nv, len(self.prior.latent_names(self.system.robot))
        return ProblemSize(rows, nv, min(latents, nv - len(self.system.contacts)), latents, 0)

    @property
    def known_noise(self) -> Noise:
        """The noise of a model that a fit has resolved."""
        assert self.noise is not None, "a fitted model has its noise"
        return self.noise

    @property
    def split_noise(self) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Noise parameters that are learned, and those that stay."""
        parameters = self.known_noise.parameters(self.system.robot.nv, self.system.robot.device)
        return (parameters, {}) if self.known_noise.learn else ({}, parameters)

    @override
    def parameter_shapes(self, training: TrainingData) -> dict[str, tuple[int, ...]]:
        noise = (self.noise or Noise()).parameters(self.system.robot.nv)
        named = self.likelihood(training).kernels().initial_parameters() | noise
        return {name: tuple(value.shape) for name, value in named.items()}
