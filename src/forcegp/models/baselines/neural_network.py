"""`NeuralNetwork`: one small network from (q, v, u) to the acceleration; the paper's baseline for many points."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float
from threadpoolctl import threadpool_limits
from torch import Tensor
from typing_extensions import override

from forcegp.data import Dataset
from forcegp.errors import FitError
from forcegp.inference import OptimizationResult
from forcegp.mechanics import MechanicalSystem
from forcegp.models.baselines.network_layers import SigmoidLayer, check_numbers, initial_weights
from forcegp.models.baselines.network_posterior import NetworkModel, NetworkPosterior, fit_settings, inputs
from forcegp.models.baselines.network_training import Batches
from forcegp.models.noise import Noise
from forcegp.models.prediction import Rows
from forcegp.models.search import FitProgress
from forcegp.models.training_data import Standardization, TrainingData

RESIDUAL = "residual.std"
REPORTS = 200
"""How often a fit reports and notes its loss."""


@dataclass(frozen=True, eq=False)
class NeuralNetwork(NetworkModel):
    """a = network(q, v, u) + noise: inputs - 80 - nv with sigmoid activation, as in Rath et al. (2021), section 5.

    Trained by Adam with a constant rate on the mean squared error of the accelerations themselves (not standardised,
    as in the paper; inputs are). It gives no distribution of its own: its scatter is the root mean square of its
    *training* residuals, one number per joint wherever the robot is, and so too small where it has learned few points
    by heart.

    Parameters
    ----------
    system: what the robot is; contacts are those that predictions are checked on.
    noise: standard deviation of the measured acceleration if it is known; None takes `dataset.noise_std`, and where
        the Dataset does not state it either, all of the residual counts as noise. Rows that differ in noise weigh
        alike.
    width: hidden units.
    steps, batch, rate: Adam steps, rows of each, and its rate.
    """

    name: ClassVar[str] = "neural network"
    objective: ClassVar[str] = "mean squared error in training [(rad/s²)² or (m/s²)²]"

    system: MechanicalSystem
    noise: Noise | None = None
    width: int = 80
    steps: int = 5000
    batch: int = 1000
    rate: float = 0.01

    @override
    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers({"width": self.width, "steps": self.steps, "batch": self.batch}, self.rate)

    @override
    def fit(
        self, dataset: Dataset, *, points: int | None = None, seed: int = 0, progress: FitProgress | None = None
    ) -> NetworkPosterior:
        rows, training = self.prepared(dataset, points, seed)
        (x,) = _standardized(training)
        generator = torch.Generator().manual_seed(seed)
        start_time = time.process_time()
        shapes = SigmoidLayer(self.width).shapes(1, x.shape[-1], training.a.shape[-1])
        weights = {name: value.to(x).requires_grad_() for name, value in initial_weights(shapes, generator).items()}
        with threadpool_limits(1):  # products this small do not gain from threads, and lose where cores are shared
            history = self._descend(weights, x, training.a, generator, progress)
        parameters = {name: value.detach() for name, value in weights.items()}
        with torch.no_grad():
            residual = training.a - SigmoidLayer(self.width)(parameters, x[None])[0]
            parameters[RESIDUAL] = residual.square().mean(0).sqrt()
        result = OptimizationResult(
            parameters,
            value=float(residual.square().mean()),
            history=history,
            status=f"ended after {self.steps} steps of a constant rate, which do not show whether it has converged",
            converged=False,
            evaluations=self.steps,
            cpu_seconds=time.process_time() - start_time,
        )
        fitted = replace(self, noise=self.resolved_noise(rows))
        numbers = {name: getattr(self, name) for name in ("width", "steps", "batch", "rate")}
        return fitted.condition(
            training, parameters, result, fit_settings(rows, dataset, seed, fitted.noise, **numbers)
        )

    def _descend(
        self, weights: dict[str, Tensor], x: Tensor, a: Tensor, generator: torch.Generator, progress: FitProgress | None
    ) -> tuple[float, ...]:
        """Adam in place; the mean loss between any two reports."""
        layer = SigmoidLayer(self.width)
        optimizer = torch.optim.Adam(list(weights.values()), lr=self.rate)
        batches = Batches([torch.arange(len(x))], self.batch, generator)
        every = max(1, self.steps // REPORTS)
        history, losses = [], torch.zeros((), dtype=torch.float64)
        for step in range(1, self.steps + 1):
            chosen = batches.draw()[0].to(x.device)
            loss = (layer(weights, x[chosen][None])[0] - a[chosen]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses = losses + loss.detach().cpu()
            if step % every == 0:
                history.append(float(losses) / every)
                losses = torch.zeros((), dtype=torch.float64)
                if not torch.isfinite(torch.tensor(history[-1])):
                    raise FitError(f"the network's loss is not finite at step {step}; check the data, or lower rate")
                if progress is not None:
                    progress(0, step, history[-1])
        return tuple(history)

    @override
    def parameter_shapes(self, training: TrainingData) -> dict[str, tuple[int, ...]]:
        nv = self.system.robot.nv
        return SigmoidLayer(self.width).shapes(1, 3 * nv, nv) | {RESIDUAL: (nv,)}

    @override
    def moments(self, posterior: NetworkPosterior, x: Float[Tensor, "rows inputs"]) -> tuple[Rows, Rows, Rows]:
        mean = SigmoidLayer(self.width)(posterior.parameters, x[None])[0]
        return mean, torch.zeros_like(mean), posterior.parameters[RESIDUAL].square().expand_as(mean)


def _standardized(training: TrainingData) -> list[Tensor]:
    columns = [inputs(training.q, training.v, training.u)]
    return Standardization.of(columns)(columns)
