"""Latents of one input as C functions of a program: what `KernelSum` is for the others, at a cost that no N changes."""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from forcegp.codegen.graph import Graph
from forcegp.errors import InvalidInput
from forcegp.inference.one_input_functions import OneInputFunctions, drawn_form, markov_functions, one_input_form
from forcegp.inference.pathwise import draw_functions
from forcegp.inference.posterior import LatentPosterior
from forcegp.inference.prepared_kernels import PADDING, CompressedCovariance, KernelSum, kernel_sums

FEW_CENTERS = 128
"""Kernels without an exact form in pieces are summed over so few centres as fast as a table is looked up."""


@dataclass(frozen=True, eq=False)
class OneInputCall:
    """One latent by the pieces of its mean; `summed` is the same latent as a sum, of which its prior variance is taken.

    `roots` are the functions of the compressed covariance, filled up to whole vectors.
    """

    summed: KernelSum
    functions: OneInputFunctions
    roots: OneInputFunctions | None = None

    @property
    def name(self) -> str:
        """Of the C function."""
        return self.summed.name

    @property
    def latents(self) -> tuple[int, ...]:
        """Its number."""
        return self.summed.latents

    @property
    def operands(self) -> list[int]:
        """As many as `given` returns."""
        return [0]

    def given(self, graph: Graph, z: Sequence[int]) -> list[int]:
        """The feature itself."""
        return list(z)

    def variance(self, graph: Graph, z: Sequence[int]) -> list[int]:
        """Its prior variance at the feature z."""
        return self.summed.variance(graph, z)

    def call(self, graph: Graph, z: Sequence[int], slopes: bool) -> list[int]:
        """The node of E f at the feature z."""
        return graph.call(self.name + ("_slopes" if slopes else ""), z, 1, {(0, 0): 1} if slopes else None)

    def table(self) -> np.ndarray:
        """Of the mean."""
        return self.functions.table()

    def root_table(self) -> np.ndarray:
        """Of the roots."""
        assert self.roots is not None, "asked for with a compressed covariance only"
        return self.roots.table()

    def c_source(self, lanes: int, slopes: bool) -> str:
        """`NAME(table, live, z, f)`, or NAME_slopes with the derivative after the value."""
        name = self.name + ("_slopes" if slopes else "")
        pieces, called = _once(self.functions, "pieces", 1)
        call = f"(void)live; {called}(t, z[0], f, {'f + 1' if slopes else '0'});"
        return f"{pieces}static APART void {name}(const double *t, long live, const real *z, real *f) {{ {call} }}"

    def roots_source(self, lanes: int, rank: int) -> str:
        """`NAME_roots(t, F, z, P)`: P (rank) from the table F, for one state."""
        assert self.roots is not None, "asked for with a compressed covariance only"
        pieces, called = _once(self.roots, "roots", lanes)
        head = f"static void {self.name}_roots(const double *t, const double *F, const double *z, double *P)"
        return f"{pieces}{head} {{ (void)t; {called}(F, z[0], P, 0); }}"


LatentCall = KernelSum | OneInputCall


def latent_calls(latent: LatentPosterior, compressed: CompressedCovariance | None) -> tuple[LatentCall, ...]:
    """The processes as C functions, in the form that suits each. Raises InvalidInput for an untraceable kernel."""
    found: list[LatentCall] = []
    sums = kernel_sums(latent)
    factors = [None] * len(sums) if compressed is None else compressed.factors
    for part, F in zip(sums, factors, strict=True):
        rank = 0 if F is None else F.shape[-1]
        roots = None if F is None else torch.nn.functional.pad(F, (0, -rank % PADDING))
        index, functions = part.latents[0], None
        if part.features == 1 and len(part.latents) == 1:
            kernel, centers = latent.kernels[index], latent.features[index].detach()
            functions = markov_functions(kernel, centers[:, 0], latent.weights[index].detach()[:, None])
            if functions is None and len(centers) > FEW_CENTERS:
                functions = one_input_form(latent, index)
        if functions is None:
            found.append(replace(part, roots=roots))
            continue
        of_roots = None if roots is None else one_input_form(latent, index, roots[0])
        if roots is not None and of_roots is None:
            found.append(replace(part, roots=roots))
            continue
        found.append(OneInputCall(part, functions, of_roots))
    return tuple(found)


def refreshed_calls(calls: Sequence[LatentCall], latent: LatentPosterior) -> tuple[LatentCall, ...]:
    """The same C functions with the tables of another posterior with the same kernels. Raises InvalidInput if none."""
    found: list[LatentCall] = []
    for part in calls:
        index = part.latents[0]
        if isinstance(part, OneInputCall) and (form := one_input_form(latent, index)) is not None:
            found.append(replace(part, functions=form))
        elif isinstance(part, KernelSum) and part.level == (0.0,):  # else its program holds sums of the weights
            found.append(replace(part, centers=latent.features[index], weights=latent.weights[index].detach()[None]))
    if [part.c_source(1, True) for part in found] != [part.c_source(1, True) for part in calls]:
        raise InvalidInput(
            "the predictor's programs hold numbers of the posterior, as of squared exponential kernels of latents with "
            "the same features; make a new one by posterior.predictor()."
        )
    return tuple(found)


def drawn_calls(
    latent: LatentPosterior, calls: Sequence[LatentCall], samples: int, seed: int, widening: float
) -> list[tuple[LatentCall, ...]] | None:
    """The functions that `draw_functions` draws, in the forms that `calls` have; None where one has no such form."""
    drawn = draw_functions(latent, samples, seed, widening)
    forms = []
    for part in calls:
        index = part.latents[0]
        form = drawn_form(drawn, latent, index) if latent.features[index].shape[-1] == 1 else None
        if form is None:
            return None
        forms.append((part.summed if isinstance(part, OneInputCall) else part, form))
    return [tuple(OneInputCall(summed, form.only(r)) for summed, form in forms) for r in range(samples)]


def _once(functions: OneInputFunctions, purpose: str, lanes: int) -> tuple[str, str]:
    """The C text, which is skipped where it stands already, and the name of its function."""
    text = functions.c_source("NAME").replace("static void", "static APART void", 1)
    if purpose == "roots" and lanes > 1:  # one state is a double
        text = re.sub(r"AT\((\w+), k\)", r"\1", re.sub(r"\breal\b", "double", text))
        text = re.sub(r"\br_(exp|tanh|asinh|sqrt)\b", r"\1", text.replace("LANES", "1"))
    name = f"{purpose}_{hashlib.sha256(text.encode()).hexdigest()[:8]}"
    return f"#ifndef {name}_\n#define {name}_\n{text.replace('NAME', name)}#endif\n", name
