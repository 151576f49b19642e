"""`Fitted`: what a fit has found, which rows it knows, and how well it predicts those that are left out."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.evidence.likelihood import MarginalLikelihood
from forcegp.evidence.training_data import TrainingData
from forcegp.forces import IndependentAccelerations, JointAccelerations, JointForces
from forcegp.inference import (
    Engine,
    Exact,
    InducingPosterior,
    LatentKernels,
    LatentPosterior,
    OptimizationResult,
)
from forcegp.model import Model
from forcegp.noise import ACCELERATION
from forcegp.posterior.estimates import Estimates
from forcegp.posterior.motion_intervals import MotionIntervals
from forcegp.summary import Summary, rounded

AnyFitted = TypeVar("AnyFitted", bound="Fitted")  # beartype cannot check Self where a module is hooked


@dataclass(frozen=True, eq=False, repr=False)
class Fitted(Summary):
    """a = M^-1 Q_b + H (Q_K + B f) + noise, f ~ GP (Rath et al. 2021, eqs. 6-7), conditioned on a log by `forcegp.fit`.

    `trained` is the model with the numbers that were found, `hyperparameters` those of kernels and noise by name,
    `estimates` those of laws and bodies; `settings` is the resolved configuration (JSON values; `points`, `seed`,
    `data`); `result` the history of the search.
    """

    trained: Model
    likelihood: MarginalLikelihood
    hyperparameters: Mapping[str, Tensor]
    result: OptimizationResult
    settings: Mapping[str, Any]
    latent: LatentPosterior
    """The posterior of the latent functions."""
    engine: Engine
    """What computed `latent`."""
    estimates: Estimates = field(default_factory=Estimates)
    target: Model | None = None
    """The model that predictions are for, where it is not the one that was trained (`with_model`)."""

    @property
    def model(self) -> Model:
        """What predictions are for: robot, contacts and forces."""
        return self.trained if self.target is None else self.target

    @property
    def parameters(self) -> Estimates:
        """Numbers of laws and bodies that the fit estimated, with intervals, and whether the log decides them."""
        return self.estimates

    @classmethod
    def conditioned(
        cls: type[AnyFitted],
        model: Model,
        training: TrainingData,
        hyperparameters: Mapping[str, Tensor],
        result: OptimizationResult,
        settings: Mapping[str, Any],
        engine: Engine | None = None,
        solution: Tensor | None = None,
        estimates: Estimates | None = None,
    ) -> AnyFitted:
        """The posterior at given hyper-parameters, without a search; `solution` is what its `engine` had found."""
        likelihood = MarginalLikelihood(model, replace(training, correlated_rows=settings.get("correlated_rows", 1.0)))
        engine = engine or Exact()
        # now: a failure belongs to the fit, not to the first prediction
        latent = likelihood.condition(likelihood.kernels, hyperparameters, engine, start=solution)
        found = dict(hyperparameters), result, dict(settings), latent, engine, estimates or Estimates()
        return cls(model, likelihood, *found)

    @property
    def kernels(self) -> LatentKernels:
        """Of the latent functions, at their start values."""
        return self.likelihood.kernels

    @property
    def training(self) -> TrainingData:
        """The rows that the model was trained on."""
        return self.likelihood.training

    @property
    def noise_std(self) -> Float[Tensor, "nv"]:
        """Standard deviation of the acceleration noise per joint, given, learned or estimated."""
        return self.hyperparameters[ACCELERATION].exp()

    @property
    def solution(self) -> Tensor | None:
        """What conditioning on these rows again can begin from, stored with the model; None where it is cheap."""
        return self.engine.solution(self.latent)

    @cached_property
    def negative_log_likelihood(self) -> float:
        """-log p(a | q, v, u) of the training data in nats, without hyperpriors; of inducing points the bound."""
        with torch.no_grad():
            if isinstance(self.latent, InducingPosterior):
                return float(self.likelihood.bound(self.kernels, self.hyperparameters, self.latent.features))
            return float(self.likelihood(self.kernels, self.hyperparameters))

    @override
    def facts(self) -> dict[str, object]:
        """Model, robot, training rows, and how the search ended."""
        rows, result = self.training, self.result
        return {
            "model": self.description,
            "robot": f"{self.model.robot.name!r}, {self.model.robot.nv} joints, {len(self.model.contacts)} contacts",
            "learned from": f"{len(rows)} {'rows' if rows.weights is None else 'windows'}",
            "noise std": rounded(self.noise_std.tolist()),
            "search": f"{'converged' if result.converged else 'not converged'}, {result.status}",
        }

    @property
    def description(self) -> str:
        """What kind of model it is, in a few words, for titles and tables."""
        forces = self.trained.unknown
        mean = "zero mean" if self.carries_known_forces else "analytical mean"
        if not forces.terms:
            return "identified model" if self.estimates else "analytical model"
        if self.is_black_box:
            return "independent GP"
        if isinstance(forces.terms[0], JointAccelerations):
            return f"unconstrained accelerations, {mean}"
        names = list(forces.term_names)
        shown = "" if names == [JointForces().title] else f"{' + '.join(names)}, "
        return f"{shown}{mean}"

    @property
    def is_black_box(self) -> bool:
        """Whether it learned accelerations, whatever the forces are, and predicts nothing else."""
        return any(isinstance(force, IndependentAccelerations) for force in self.trained.unknown_forces)

    @property
    def carries_known_forces(self) -> bool:
        """Whether the predicted `unknown_force` holds the known forces, too."""
        return self.trained.carries_known_forces

    @property
    def motion_intervals(self) -> MotionIntervals | None:
        """Widths of the intervals of motions, where they were `calibrated`; a rollout has them."""
        stored = self.settings.get("motion_intervals")
        found = None if stored is None else MotionIntervals.from_dict(stored)
        # widths of motions that an observer's columns were part of are not those of motions without
        return None if found is None or found.inputs not in ((), self.model.inputs) else found

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The joints in the order of every last dimension."""
        return self.model.robot.joint_names

    @property
    def latent_names(self) -> tuple[str, ...]:
        """The processes that the prior is made of."""
        return self.trained.unknown.latent_names(self.trained.robot)

    @property
    def widening(self) -> float:
        """How many times as wide intervals are as at known hyper-parameters (`fit/widening.py`); 1.0 does without."""
        return float(self.settings.get("widening", 1.0))
