"""`NetworkEnsemble`: several residual networks that predict a mean and a variance, and differ where data are few."""

import time
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from threadpoolctl import threadpool_limits
from torch import Tensor
from typing_extensions import override

from forcegp.data import Dataset
from forcegp.errors import FitError, InvalidInput
from forcegp.inference import OptimizationResult
from forcegp.mechanics import MechanicalSystem
from forcegp.models.baselines.network_posterior import NetworkModel, NetworkPosterior, inputs
from forcegp.models.baselines.neural_network import (
    Batches,
    ResidualLayers,
    check_numbers,
    held_out_rows,
    initial_weights,
    mean_and_variance,
)
from forcegp.models.prediction import Rows
from forcegp.models.search import FitProgress
from forcegp.models.training_data import Noise, Standardization, TrainingData

FEWEST_ROWS = 10
"""Fewer rows cannot be trained on and held out."""

CHECKS = 60
"""How often a full-length fit looks at the rows held out."""


@dataclass(frozen=True, eq=False)
class NetworkEnsemble(NetworkModel):
    """a = network_k(q, v, u) + noise(q, v, u), k = 1 ... members: a deep ensemble (Lakshminarayanan et al. 2017).

    Every member predicts mean and variance of standardised accelerations and is trained from its own random weights,
    in its own order of rows, on the beta-NLL of Seitzer et al. (2022) by AdamW with a rate that falls as a cosine. Each
    holds out its own stretches of time, and keeps the weights that were best there. The variance of a measurement is
    the mean of the members' variances plus the variance of their means.

    Parameters
    ----------
    system: what the robot is; contacts are those that predictions are checked on.
    noise: standard deviation of the measured acceleration if it is known; None takes `dataset.noise_std`, and where
        the Dataset does not state it either, the members' variances count as noise. Rows that differ in noise weigh
        alike.
    members, width, depth: networks, units of a layer, residual layers.
    steps, batch, rate, weight_decay: AdamW steps at most, rows of each, its first rate and weight decay.
    beta: 0 is the plain Gaussian likelihood, 1 weighs all errors equally; 0.5 as Seitzer et al. advise.
    held_out: share of the rows held out by every member.
    """

    name: ClassVar[str] = "network ensemble"
    objective: ClassVar[str] = "held-out negative log likelihood of standardised data [nats]"

    system: MechanicalSystem
    noise: Noise | None = None
    members: int = 5
    width: int = 128
    depth: int = 3
    steps: int = 3000
    batch: int = 256
    rate: float = 3e-3
    weight_decay: float = 1e-3
    beta: float = 0.5
    held_out: float = 0.1

    @override
    def __post_init__(self) -> None:
        super().__post_init__()
        names = ("members", "width", "depth", "steps", "batch")
        check_numbers({name: getattr(self, name) for name in names}, self.rate)
        if not (0.0 <= self.beta <= 1.0 and 0.0 < self.held_out < 0.5 and self.weight_decay >= 0.0):
            raise InvalidInput(
                f"beta={self.beta}, held_out={self.held_out} and weight_decay={self.weight_decay} must be from 0 to 1, "
                "between 0 and 0.5, and at least 0"
            )

    @property
    def layers(self) -> ResidualLayers:
        """What one member computes."""
        return ResidualLayers(self.width, self.depth)

    @override
    def fit(
        self, dataset: Dataset, *, points: int | None = None, seed: int = 0, progress: FitProgress | None = None
    ) -> NetworkPosterior:
        rows, training = self.prepared(dataset, points, seed)
        if len(rows) < FEWEST_ROWS:
            raise InvalidInput(f"an ensemble that holds rows out needs {FEWEST_ROWS} rows; there are {len(rows)}")
        start_time = time.process_time()
        with threadpool_limits(1):  # products this small do not gain from threads, and lose where cores are shared
            search = _Training(self, training, rows, seed)
            search.run(progress)
        steps = search.best_step.tolist()
        result = OptimizationResult(
            search.best,
            value=float(search.best_loss.mean()),
            history=tuple(search.history),
            status=f"the held-out rows of the members were predicted best at steps {min(steps)} to {max(steps)} of "
            f"{search.step}",
            converged=True,
            evaluations=search.step,
            cpu_seconds=time.process_time() - start_time,
        )
        return self.trained(rows, dataset, training, seed, result)

    @override
    def parameter_shapes(self, training: TrainingData) -> dict[str, tuple[int, ...]]:
        return self.layers.shapes(self.members, sum(self.system.sizes), self.system.robot.nv)

    @override
    def moments(self, posterior: NetworkPosterior, x: Float[Tensor, "rows inputs"]) -> tuple[Rows, Rows, Rows]:
        means, variances = mean_and_variance(self.layers(posterior.parameters, x[None]))
        shift, scale = posterior.standardization.shift[1], posterior.standardization.scale[1]
        mean = means.mean(0)
        spread = (means - mean).square().mean(0)
        return shift + scale * mean, scale.square() * spread, scale.square() * variances.mean(0)


class _Training:
    """One training of all members together, as (members, rows, ...) tensors."""

    def __init__(self, model: NetworkEnsemble, training: TrainingData, rows: Dataset, seed: int) -> None:
        columns = [inputs(training.q, training.v, training.u), training.a]
        self.x, self.y = Standardization.of(columns)(columns)
        self.model = model
        generator = torch.Generator().manual_seed(seed)
        weights = initial_weights(model.parameter_shapes(training), generator)
        self.weights = {name: value.to(self.x).requires_grad_() for name, value in weights.items()}
        train, held_out = held_out_rows(rows, model.members, model.held_out, seed)
        self.batches = Batches(train, model.batch, generator)
        self.held_out = torch.stack(held_out).to(self.x.device)
        self.best = {name: value.detach().clone() for name, value in self.weights.items()}
        self.best_loss = torch.full((model.members,), torch.inf, dtype=torch.float64)
        self.best_step = torch.zeros(model.members, dtype=torch.int64)
        self.history: list[float] = []
        self.step = 0

    def run(self, progress: FitProgress | None) -> None:
        """Descend until the steps are used up, or no member has improved on its held-out rows for a third of them."""
        steps = self.model.steps
        optimizer = torch.optim.AdamW(
            list(self.weights.values()), lr=self.model.rate, weight_decay=self.model.weight_decay
        )
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        every = max(1, steps // CHECKS)
        while self.step < steps:
            self.step += 1
            optimizer.zero_grad()
            self._loss(self.batches.draw().to(self.x.device), self.model.beta).sum().backward()
            optimizer.step()
            schedule.step()
            if self.step % every == 0 or self.step == steps:
                self._check()
                if progress is not None:
                    progress(0, self.step, self.history[-1])
                if self.step - int(self.best_step.max()) > steps // 3:
                    return

    def _loss(self, chosen: Tensor, beta: float) -> Float[Tensor, " members"]:
        """Seitzer et al. (2022), eq. 5: NLL times variance^beta as a constant, mean over rows, less log(2 pi)/2."""
        mean, variance = mean_and_variance(self.model.layers(self.weights, self.x[chosen]))
        loss = 0.5 * ((self.y[chosen] - mean).square() / variance + variance.log())
        return (loss * variance.detach() ** beta).mean(dim=(1, 2)) if beta else loss.mean(dim=(1, 2))

    def _check(self) -> None:
        with torch.no_grad():
            loss = self._loss(self.held_out, 0.0).cpu()
        if not bool(torch.isfinite(loss).all()):
            raise FitError(f"the loss of a network is not finite at step {self.step}; check the data, or lower rate")
        better = loss < self.best_loss
        self.best_loss = torch.where(better, loss, self.best_loss)
        self.best_step[better] = self.step
        for name, value in self.weights.items():
            here = better.to(value.device)
            self.best[name][here] = value.detach()[here]
        self.history.append(float(loss.mean()))
