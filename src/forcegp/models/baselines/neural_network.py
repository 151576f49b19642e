"""`NeuralNetwork`: one small network from (q, v, u) to the acceleration; the paper's baseline for many points."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int
from threadpoolctl import threadpool_limits
from torch import Tensor
from torch.nn import functional
from typing_extensions import override

from forcegp.data import Dataset
from forcegp.errors import FitError, InvalidInput
from forcegp.inference import OptimizationResult
from forcegp.mechanics import MechanicalSystem
from forcegp.models.baselines.network_posterior import NetworkModel, NetworkPosterior, inputs
from forcegp.models.prediction import Rows
from forcegp.models.search import FitProgress
from forcegp.models.training_data import Noise, Standardization, TrainingData

SMALLEST_VARIANCE = 1e-6
"""Of a standardised output: keeps the logarithm of the predicted variance finite."""


@dataclass(frozen=True)
class ResidualLayers:
    """`depth` residual layers h + W f(h) between a linear input and a linear output layer f(h); no normalisation.

    Identity shortcuts after He et al. (2016), "Identity mappings in deep residual networks", with one linear map per
    block. `activation` is f, `first` the name of the input layer, and `outputs` the numbers that belong to every joint.
    """

    width: int = 128
    depth: int = 3
    activation: Callable[[Tensor], Tensor] = functional.silu
    first: str = "input"
    outputs: int = 2

    def shapes(self, members: int, inputs: int, joints: int) -> dict[str, tuple[int, ...]]:
        """`<layer>.weight` (members, in, out) and `<layer>.bias` (members, 1, out)."""
        blocks = {f"block{k}": (self.width, self.width) for k in range(self.depth)}
        layers = {self.first: (inputs, self.width), **blocks, "output": (self.width, self.outputs * joints)}
        return {
            f"{name}.{part}": (members, before if part == "weight" else 1, after)
            for name, (before, after) in layers.items()
            for part in ("weight", "bias")
        }

    def __call__(
        self, weights: Mapping[str, Tensor], x: Float[Tensor, "#members rows inputs"]
    ) -> Float[Tensor, "members rows outputs"]:
        """The outputs of every member."""
        h = _linear(weights, self.first, x)
        for block in range(self.depth):
            h = h + _linear(weights, f"block{block}", self.activation(h))
        return _linear(weights, "output", self.activation(h))


def sigmoid_layer(width: int) -> ResidualLayers:
    """One hidden layer with sigmoid activation: inputs - `width` - outputs, as in Rath et al. (2021), section 5."""
    return ResidualLayers(width, 0, torch.sigmoid, "hidden", 1)


def mean_and_variance(outputs: Float[Tensor, "*batch outputs"]) -> tuple[Tensor, Tensor]:
    """Of every joint, the variance positive."""
    mean, spread = outputs.chunk(2, dim=-1)
    return mean, functional.softplus(spread) + SMALLEST_VARIANCE


def initial_weights(shapes: Mapping[str, tuple[int, ...]], generator: torch.Generator) -> dict[str, Tensor]:
    """Uniform in +-1/sqrt(inputs of the layer), as torch.nn.Linear has it, drawn from `generator` alone."""
    weights: dict[str, Tensor] = {}
    for name, shape in shapes.items():
        layer = name.rsplit(".", 1)[0]
        bound = 1.0 / math.sqrt(shapes[f"{layer}.weight"][1])
        weights[name] = (2.0 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1.0) * bound
    return weights


def check_numbers(counts: Mapping[str, object], rate: object) -> None:
    """Raises InvalidInput naming the first count that is not a whole number above 0, or a rate that is not above 0."""
    for name, value in counts.items():
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value < 2**31:
            raise InvalidInput(f"{name}={value!r} must be a whole number above 0 (and below 2**31)")
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not 0.0 < rate < math.inf:
        raise InvalidInput(f"rate={rate!r} must be above 0 and finite")


def _linear(weights: Mapping[str, Tensor], layer: str, x: Tensor) -> Tensor:
    weight, bias = weights[f"{layer}.weight"], weights[f"{layer}.bias"]
    return torch.baddbmm(bias, x.expand(len(weight), -1, -1), weight)


BLOCKS = 20
"""Stretches of time that a recording is cut into; a share of them is held out."""


class Batches:
    """Batches of row numbers, for several members at once: each goes through its own rows in its own random order."""

    def __init__(self, rows: Sequence[Int[Tensor, " rows"]], size: int, generator: torch.Generator) -> None:
        self.rows = list(rows)
        self.size = min(size, *(len(each) for each in rows)) if len(rows) > 1 else min(size, len(rows[0]))
        self.generator = generator
        self.orders = [each[:0] for each in self.rows]

    def draw(self) -> Int[Tensor, "members size"]:
        """The next batch of every member; the rest of a pass that fills no batch is left out."""
        chosen = []
        for member, rows in enumerate(self.rows):
            if len(self.orders[member]) < self.size:
                self.orders[member] = rows[torch.randperm(len(rows), generator=self.generator)]
            chosen.append(self.orders[member][: self.size])
            self.orders[member] = self.orders[member][self.size :]
        return torch.stack(chosen)


def held_out_rows(
    rows: Dataset, members: int, share: float, seed: int
) -> tuple[list[Int[Tensor, " train"]], list[Int[Tensor, " held"]]]:
    """Rows to train on and rows held out, for every member: other stretches of time, of about `share` of the rows.

    Neighbours in time are nearly equal, so single rows that are held out would be known by heart. Lengths are equal
    for all members.
    """
    order = np.lexsort((rows.time, rows.episode))
    blocks = np.array_split(order, min(BLOCKS, len(order) // 2))
    count = max(1, round(share * len(blocks)))
    training, held_out = [], []
    for member in range(members):
        chosen = set(np.random.default_rng((seed, member)).permutation(len(blocks))[:count].tolist())
        held_out.append(np.concatenate([block for k, block in enumerate(blocks) if k in chosen]))
        training.append(np.concatenate([block for k, block in enumerate(blocks) if k not in chosen]))
    return _equal_lengths(training), _equal_lengths(held_out)


def _equal_lengths(parts: Sequence[np.ndarray]) -> list[Tensor]:
    shortest = min(len(part) for part in parts)  # blocks differ by one row
    return [torch.tensor(part[:shortest]) for part in parts]


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
        columns = [inputs(training.q, training.v, training.u)]
        (x,) = Standardization.of(columns)(columns)
        generator = torch.Generator().manual_seed(seed)
        start_time = time.process_time()
        layer = sigmoid_layer(self.width)
        shapes = layer.shapes(1, x.shape[-1], training.a.shape[-1])
        weights = {name: value.to(x).requires_grad_() for name, value in initial_weights(shapes, generator).items()}
        with threadpool_limits(1):  # products this small do not gain from threads, and lose where cores are shared
            history = self._descend(weights, x, training.a, generator, progress)
        parameters = {name: value.detach() for name, value in weights.items()}
        with torch.no_grad():
            residual = training.a - layer(parameters, x[None])[0]
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
        return self.trained(rows, dataset, training, seed, result)

    def _descend(
        self, weights: dict[str, Tensor], x: Tensor, a: Tensor, generator: torch.Generator, progress: FitProgress | None
    ) -> tuple[float, ...]:
        """Adam in place; the mean loss between any two reports."""
        layer = sigmoid_layer(self.width)
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
        return sigmoid_layer(self.width).shapes(1, sum(self.system.sizes), nv) | {RESIDUAL: (nv,)}

    @override
    def moments(self, posterior: NetworkPosterior, x: Float[Tensor, "rows inputs"]) -> tuple[Rows, Rows, Rows]:
        mean = sigmoid_layer(self.width)(posterior.parameters, x[None])[0]
        return mean, torch.zeros_like(mean), posterior.parameters[RESIDUAL].square().expand_as(mean)
