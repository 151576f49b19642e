"""What a predictor needs of a state before Gaussian processes come in, by torch or from a tape."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.codegen.tape_machine import TapeMachine
from forcegp.codegen.tape_tracing import trace
from forcegp.errors import InvalidInput

TermsFunction = Callable[[Tensor, Tensor, Tensor], list[Tensor]]
"""States (n, nv) -> the entries of `PredictorTerms` as one list."""


class PredictorTerms(NamedTuple):
    """At n states: a = offset + W f, (n, nv) and (n, nv, C); what the kernels need; the prepared features if asked for.

    Their derivatives in [q, v, u] have one dimension (3 nv) more.
    """

    offset: Tensor
    W: Tensor
    inputs: list[Tensor]
    features: list[Tensor]

    @classmethod
    def of(cls, parts: Sequence[Tensor], groups: int) -> PredictorTerms:
        """From one list."""
        return cls(parts[0], parts[1], list(parts[2 : 2 + groups]), list(parts[2 + groups :]))


class EagerTerms:
    """The terms as torch computes them, operation by operation, on any device."""

    def __init__(self, function: TermsFunction, nv: int, groups: int) -> None:
        self.function, self.nv, self.groups = function, nv, groups

    def __call__(self, x: Tensor) -> PredictorTerms:
        """At rows [q, v, u]."""
        return PredictorTerms.of(self.function(*x.split(self.nv, dim=-1)), self.groups)

    def with_jacobians(self, x: Tensor) -> tuple[PredictorTerms, PredictorTerms]:
        """The terms and their derivatives."""

        def one(row: Tensor) -> list[Tensor]:
            return [part[0] for part in self.function(*row[None].split(self.nv, dim=-1))]

        slopes = torch.func.vmap(torch.func.jacrev(one))(x)
        return self(x), PredictorTerms.of(slopes, self.groups)


class TapedTerms:
    """The same terms from a tape, on the CPU.

    Raises InvalidInput for a system on another device and for operations that a tape cannot hold, CompilerError
    without a C++ compiler.
    """

    def __init__(self, function: TermsFunction, examples: Sequence[Tensor], groups: int) -> None:
        if examples[0].device.type != "cpu":
            raise InvalidInput(
                f"a compiled predictor runs on the CPU, and the model is on {examples[0].device}; give compile=False, "
                "or a model on the CPU."
            )
        self.groups = groups
        program, shapes = trace(function, examples)
        self.machine = TapeMachine(program)
        self.shapes = [shape[1:] for shape in shapes]
        self.sizes = [shape.numel() for shape in self.shapes]

    def __call__(self, x: Tensor) -> PredictorTerms:
        """At rows [q, v, u]."""
        return self._split(self.machine(x), ())

    def with_jacobians(self, x: Tensor) -> tuple[PredictorTerms, PredictorTerms]:
        """The terms and their derivatives."""
        values, slopes = self.machine.with_jacobian(x)
        return self._split(values, ()), self._split(slopes, x.shape[1:])

    def _split(self, joined: Tensor, trailing: Sequence[int]) -> PredictorTerms:
        parts = torch.split_with_sizes(joined, self.sizes, 1)
        return PredictorTerms.of(
            [
                part if len(shape) == 1 else part.reshape(len(joined), *shape, *trailing)
                for part, shape in zip(parts, self.shapes, strict=True)
            ],
            self.groups,
        )
