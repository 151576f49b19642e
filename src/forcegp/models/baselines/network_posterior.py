"""What networks share: checks of their arguments, standardised inputs, and a posterior with a diagonal covariance."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.data import Dataset
from forcegp.errors import InvalidInput
from forcegp.inference import Engine, OptimizationResult
from forcegp.models.prediction import Inputs, Positions, Prediction, Rows
from forcegp.models.protocol import Model, Posterior
from forcegp.models.search import (
    check_search_numbers,
    check_system_and_noise,
    described_rows,
    resolved_noise,
    training_rows,
)
from forcegp.models.training_data import ACCELERATION, Noise, Standardization, TrainingData


class NetworkModel(Model):
    """A network from (q, v, u) to the acceleration. Subclasses are frozen dataclasses with `system` and `noise`.

    Training weighs all rows alike: of data that state the noise of every row, a network takes only the level, its root
    mean square over the training rows.
    """

    noise: Noise | None
    name: ClassVar[str]
    objective: ClassVar[str]

    def __post_init__(self) -> None:
        check_system_and_noise(self)
        if self.noise is not None and (self.noise.learn or self.noise.force is not None):
            raise InvalidInput(
                "a network takes known noise of the acceleration only; without it, it estimates noise from residuals"
            )

    @abstractmethod
    def moments(self, posterior: "NetworkPosterior", x: Float[Tensor, "rows inputs"]) -> tuple[Rows, Rows, Rows]:
        """Mean, its variance, and the variance of data about it, at standardised inputs."""

    @override
    def condition(
        self,
        training: TrainingData,
        parameters: Mapping[str, Tensor],
        result: OptimizationResult,
        settings: Mapping[str, Any],
        engine: Engine | None = None,
        solution: Tensor | None = None,
    ) -> "NetworkPosterior":
        return NetworkPosterior(self, training, dict(parameters), result, dict(settings))

    def prepared(self, dataset: Dataset, points: int | None, seed: int) -> tuple[Dataset, TrainingData]:
        """The rows to train on, as a Dataset and as tensors."""
        rows = training_rows(self.system.robot.joint_names, dataset, points)
        check_search_numbers(1, seed)
        return rows, TrainingData.of(rows, self.system.robot.device)

    def trained(
        self, rows: Dataset, dataset: Dataset, training: TrainingData, seed: int, result: OptimizationResult
    ) -> "NetworkPosterior":
        """The posterior of a training, whose settings hold every field that is a plain number."""
        estimated = self.noise is None and rows.noise_std is None
        noise = None if estimated else resolved_noise(self.noise, rows)
        settings = described_rows(rows, dataset) | {"seed": seed, "noise": None if noise is None else noise.to_dict()}
        settings |= {name: value for name, value in vars(self).items() if name not in ("system", "noise")}
        fitted = replace(self, noise=noise)  # type: ignore[type-var]  # every network is a dataclass
        return fitted.condition(training, result.parameters, result, settings)


@dataclass(frozen=True, eq=False, repr=False)
class NetworkPosterior(Posterior):
    """A trained network or ensemble; made by its `fit` or by `load_posterior`.

    The network sees how far measurements scatter about its mean, and cannot separate noise from its own error. Where
    the noise is known (`model.noise`, given or stated by the Dataset) the noise covariance is that, and what the
    scatter exceeds it by counts to the covariance of the acceleration; where it is not known, all of the scatter is
    noise.
    """

    model: NetworkModel
    data: TrainingData
    parameters: Mapping[str, Tensor]
    result: OptimizationResult
    settings: Mapping[str, Any]
    predicts_forces: ClassVar[bool] = False

    @property
    @override
    def training(self) -> TrainingData:
        return self.data

    @property
    @override
    def description(self) -> str:
        return self.model.name

    @property
    @override
    def objective(self) -> str:
        return self.model.objective

    @cached_property
    def standardization(self) -> Standardization:
        """Of the inputs and of the accelerations, from the training points."""
        return Standardization.of([inputs(self.training.q, self.training.v, self.training.u), self.training.a])

    @cached_property
    def _known_variance(self) -> Tensor | None:
        if self.model.noise is None:
            return None
        parameters = self.model.noise.parameters(self.system.robot.nv)
        return (2.0 * parameters[ACCELERATION]).exp().to(self.training.a)

    @cached_property
    def _estimated_noise(self) -> Tensor:
        with torch.no_grad():
            _, _, scatter = self._moments(self.training.q, self.training.v, self.training.u)
        return scatter.mean(0).sqrt()

    @property
    @override
    def noise_std(self) -> Float[Tensor, "nv"]:
        return self._estimated_noise if self._known_variance is None else self._known_variance.sqrt()

    @cached_property
    @override
    def negative_log_likelihood(self) -> float:
        with torch.no_grad():
            prediction = self.predict(self.training.q, self.training.v, self.training.u)
        variance = prediction.measurement.variance
        squared = (self.training.a - prediction.mean).square()
        return float(0.5 * (squared / variance + variance.log() + math.log(2.0 * math.pi)).sum())

    @override
    def predict_rows(self, q: Positions, v: Rows, u: Inputs, covariance: bool) -> Prediction:
        mean, variance, scatter = self._moments(q, v, u)
        noise = scatter
        if self._known_variance is not None:
            variance = variance + (scatter - self._known_variance).clamp_min(0.0)
            noise = self._known_variance.expand_as(mean)
        return Prediction.of_accelerations(mean, variance if covariance else None, noise)

    def _moments(self, q: Tensor, v: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        shift, scale = self.standardization.shift[0], self.standardization.scale[0]
        return self.model.moments(self, (inputs(q, v, u) - shift) / scale)


def inputs(q: Positions, v: Rows, u: Inputs) -> Float[Tensor, "rows d"]:
    """What a network sees of a state."""
    return torch.cat([q, v, u], dim=-1)
