"""How sure the data make an optimum: the curvature of the objective there, by differences of exact gradients.

With the Hessian in blocks of physical (p) and all other free parameters (k), the information about the physical ones is
the Schur complement H_pp - H_pk H_kk^-1 H_kp: the curvature after the others have followed, and the inverse of their
block of H^-1 (Laplace's approximation; Rasmussen & Williams 2006, section 3.4).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import NumericalWarning

CENTRAL_STEP = 1e-3
"""For the parameters asked about: of the size of a thousandth of a standard deviation, where units are whitened."""

FORWARD_STEP = 1e-3
"""For all others, logarithms: one evaluation each, since a relative error of a thousandth of H_kk changes nothing."""

FLAT = 1e-3
"""Curvature in nats per squared unit below which a direction of the other parameters counts as without influence."""

SADDLE = -0.1
"""Curvature below which the search has not ended at a minimum."""

Report = Callable[[int, int], None]


def information_about(
    name: str,
    objective: Callable[[Mapping[str, Tensor]], Tensor],
    parameters: Mapping[str, Tensor],
    progress: Report | None = None,
) -> Float[Tensor, "k k"]:
    """Schur complement of the Hessian at `parameters` onto those called `name` (k,), symmetric.

    Costs 2 k + 1 evaluations, and one more for each other number. `progress(done, of)` is called after every one.
    Warns NumericalWarning where the other parameters are not at a minimum.
    """
    others = {key: value.detach() for key, value in parameters.items() if key != name}
    shapes = [(key, value.shape, value.numel()) for key, value in others.items()]
    flat = torch.cat([value.reshape(-1) for value in others.values()]) if others else torch.zeros(0).double()
    asked = parameters[name].detach()
    total, done = 2 * len(asked) + (1 + len(flat) if shapes else 0), 0

    def gradients(at: Tensor, rest: Tensor, want: bool) -> tuple[Tensor, Tensor]:
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
        above, below = gradients(asked + step, flat, True), gradients(asked - step, flat, True)
        columns.append([(high - low) / (2.0 * CENTRAL_STEP) for high, low in zip(above, below, strict=True)])
    H_pp = torch.stack([own for own, _ in columns])
    if not shapes:
        return 0.5 * (H_pp + H_pp.mT)
    H_pk = torch.stack([other for _, other in columns])
    _, here = gradients(asked, flat, False)
    steps = FORWARD_STEP * torch.eye(len(flat), dtype=flat.dtype, device=flat.device)
    H_kk = torch.stack([(gradients(asked, flat + step, False)[1] - here) / FORWARD_STEP for step in steps])
    values, vectors = torch.linalg.eigh(0.5 * (H_kk + H_kk.mT))
    if float(values[0]) < SADDLE:
        warnings.warn(
            f"the curvature of the objective in the kernel and noise parameters falls to {float(values[0]):.2g}: the "
            "search has not ended at a minimum, so standard errors are rough; raise `iterations` or keep the "
            "hyperprior",
            NumericalWarning,
            stacklevel=2,
        )
    kept = values > FLAT
    half = (H_pk @ vectors[:, kept]) / values[kept].sqrt()
    schur = H_pp - half @ half.mT
    return 0.5 * (schur + schur.mT)
