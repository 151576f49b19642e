"""Small networks of several members at once: weights (members, in, out), so that one product trains all of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from forcegp.errors import InvalidInput

SMALLEST_VARIANCE = 1e-6
"""Of a standardised output: keeps the logarithm of the predicted variance finite."""


@dataclass(frozen=True)
class SigmoidLayer:
    """One hidden layer with sigmoid activation: inputs - `width` - outputs, as in Rath et al. (2021), section 5."""

    width: int = 80

    def shapes(self, members: int, inputs: int, outputs: int) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the weights and biases."""
        return layer_shapes(members, {"hidden": (inputs, self.width), "output": (self.width, outputs)})

    def __call__(
        self, weights: Mapping[str, Tensor], x: Float[Tensor, "#members rows inputs"]
    ) -> Float[Tensor, "members rows outputs"]:
        """The output of every member."""
        return _linear(weights, "output", torch.sigmoid(_linear(weights, "hidden", x)))


@dataclass(frozen=True)
class ResidualLayers:
    """`depth` residual layers h + W silu(h) between a linear input and a linear output layer; no normalisation.

    Identity shortcuts after He et al. (2016), "Identity mappings in deep residual networks", with one linear map per
    block. The outputs are a mean and a positive variance for every joint.
    """

    width: int = 128
    depth: int = 3

    def shapes(self, members: int, inputs: int, outputs: int) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the weights and biases; `outputs` counts the means."""
        blocks = {f"block{k}": (self.width, self.width) for k in range(self.depth)}
        return layer_shapes(members, {"input": (inputs, self.width), **blocks, "output": (self.width, 2 * outputs)})

    def __call__(
        self, weights: Mapping[str, Tensor], x: Float[Tensor, "#members rows inputs"]
    ) -> tuple[Float[Tensor, "members rows outputs"], Float[Tensor, "members rows outputs"]]:
        """Mean and variance of every member."""
        h = _linear(weights, "input", x)
        for block in range(self.depth):
            h = h + _linear(weights, f"block{block}", functional.silu(h))
        mean, spread = _linear(weights, "output", functional.silu(h)).chunk(2, dim=-1)
        return mean, functional.softplus(spread) + SMALLEST_VARIANCE


def layer_shapes(members: int, layers: Mapping[str, tuple[int, int]]) -> dict[str, tuple[int, ...]]:
    """`<layer>.weight` (members, in, out) and `<layer>.bias` (members, 1, out)."""
    shapes: dict[str, tuple[int, ...]] = {}
    for name, (inputs, outputs) in layers.items():
        shapes[f"{name}.weight"] = (members, inputs, outputs)
        shapes[f"{name}.bias"] = (members, 1, outputs)
    return shapes


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
