"""How sure the data make an optimum: the curvature of the objective there, by differences of exact gradients.

With the Hessian in blocks of physical (p) and all other free parameters (k), the information about the physical ones is
the Schur complement H_pp - H_pk H_kk^-1 H_kp: the curvature after the others have followed, and the inverse of their
block of H^-1 (Laplace's approximation; Rasmussen & Williams 2006, section 3.4). It means that only at an optimum. How
far that is, is the Newton decrement (Boyd & Vandenberghe 2004, section 9.5.1),

    sqrt(g^T S^-1 g),    g = g_p - H_pk H_kk^-1 g_k,    S = H_pp - H_pk H_kk^-1 H_kp,

the length in standard errors of the step that Newton's method would still make in the physical parameters.

Curvatures of H_kk below `FLAT` are raised to it, which is a prior of standard deviation 32 on logarithms: left out,
they would count as known, and standard errors would be too small.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import NumericalWarning

CENTRAL_STEP = 1e-3
"""For the parameters asked about: of the size of a thousandth of a standard deviation, where units are whitened."""

FORWARD_STEP = 1e-3
"""For all others, logarithms: one evaluation each, since a relative error of a thousandth of H_kk changes nothing."""

FLAT = 1e-3
"""Least curvature that any direction of the other parameters counts with, in nats per squared unit."""

SADDLE = -0.1
"""Curvature in the other parameters below which the search has not ended at a minimum; above it may be rounding."""

NEGATIVE = -0.01
"""The same for the physical parameters, as a fraction of the largest curvature before the others follow
(at least 1)."""

NO_INFORMATION = 1e-4
"""Curvature below which a physical direction counts with this much in the decrement; such directions are not known."""

LARGEST_DECREMENT = 0.1
"""Standard errors that estimates may be away from the optimum before a warning."""

Report = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Curvature:
    """Information S (k, k) about the physical parameters, and whether it was taken at an optimum.

    `decrement` is in standard errors; `lowest` and `lowest_other` are the smallest curvatures in the physical
    parameters (after the others have followed) and in the others, `tolerated` what rounding may make of zero in the
    first.
    """

    information: Float[Tensor, "k k"]
    decrement: float
    lowest: float
    lowest_other: float
    tolerated: float

    @classmethod
    def unknown(cls, like: Float[Tensor, "k"]) -> Curvature:
        """No information about parameters of this shape, and no optimum."""
        return cls(like.new_zeros(len(like), len(like)), float("inf"), 0.0, 0.0, 0.0)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Why this is not the curvature at a minimum; empty where it is."""
        out = []
        if self.decrement > LARGEST_DECREMENT:
            out.append(f"a Newton step would still move the estimates by {self.decrement:.2g} standard errors")
        if self.lowest < self.tolerated:
            out.append(f"the curvature in the physical parameters falls to {self.lowest:.2g}")
        if self.lowest_other < SADDLE:
            out.append(f"the curvature in the kernel and noise parameters falls to {self.lowest_other:.2g}")
        return tuple(out)


def curvature_about(
    name: str,
    objective: Callable[[Mapping[str, Tensor]], Tensor],
    parameters: Mapping[str, Tensor],
    progress: Report | None = None,
) -> Curvature:
    """Schur complement of the Hessian at `parameters` onto those called `name` (k,), symmetric.

    Costs 2 k + 1 evaluations, and one more for each other number. `progress(done, of)` is called after every one.
    Warns NumericalWarning where `parameters` are not a minimum.
    """
    others = {key: value.detach() for key, value in parameters.items() if key != name}
    shapes = [(key, value.shape, value.numel()) for key, value in others.items()]
    flat = torch.cat([value.reshape(-1) for value in others.values()]) if others else torch.zeros(0).double()
    asked = parameters[name].detach()
    total, done = 2 * len(asked) + 1 + len(flat), 0

    def gradients(at: Tensor, rest: Tensor, want: bool = True) -> tuple[Tensor, Tensor]:
        nonlocal done
        at, rest = at.clone().requires_grad_(want), rest.clone().requires_grad_()
        pieces = rest.split([size for *_, size in shapes]) if shapes else ()
        named = {key: piece.reshape(shape) for (key, shape, _), piece in zip(shapes, pieces, strict=True)}
        wanted = ([at] if want else []) + ([rest] if shapes else [])
        with torch.enable_grad():
            found = torch.autograd.grad(objective({**named, name: at}), wanted, allow_unused=True)
        full = [torch.zeros_like(x) if g is None else g for x, g in zip(wanted, found, strict=True)]
        done += 1
        if progress is not None:
            progress(done, total)
        return full[0], full[-1] if shapes else rest.detach()

    columns = []
    for step in CENTRAL_STEP * torch.eye(len(asked), dtype=asked.dtype, device=asked.device):
        above, below = gradients(asked + step, flat), gradients(asked - step, flat)
        columns.append([(high - low) / (2.0 * CENTRAL_STEP) for high, low in zip(above, below, strict=True)])
    H_pp = torch.stack([own for own, _ in columns])
    slope, here = gradients(asked, flat)
    information, lowest_other = 0.5 * (H_pp + H_pp.mT), float("inf")
    tolerated = NEGATIVE * max(1.0, float(information.diagonal().max()))
    if shapes:
        H_pk = torch.stack([other for _, other in columns])
        steps = FORWARD_STEP * torch.eye(len(flat), dtype=flat.dtype, device=flat.device)
        H_kk = torch.stack([(gradients(asked, flat + step, False)[1] - here) / FORWARD_STEP for step in steps])
        values, vectors = torch.linalg.eigh(0.5 * (H_kk + H_kk.mT))
        lowest_other = float(values[0])
        scaled = vectors / values.clamp_min(FLAT).sqrt()
        half = H_pk @ scaled
        information, slope = information - half @ half.mT, slope - half @ (scaled.mT @ here)
    values, vectors = torch.linalg.eigh(information)
    decrement = float(torch.linalg.vector_norm(vectors.mT @ slope / values.clamp_min(NO_INFORMATION).sqrt()))
    found = Curvature(information, decrement, float(values[0]), lowest_other, tolerated)
    if found.doubts:
        warnings.warn(
            f"the search has not ended at a minimum ({'; '.join(found.doubts)}), so estimates and standard errors are "
            "rough: search longer, by more `iterations` of the options, or keep the `hyperprior`",
            NumericalWarning,
            stacklevel=2,
        )
    return found
