"""Latents with one input as functions in pieces, whose cost does not depend on the number of training points.

A sum of Matern kernels of smoothness n - 1/2 is, between neighbouring centres, e^-u and e^-v times polynomials of
degree n - 1, with u and v the scaled distances from the centres on both sides, for it is Markov. The same holds for
envelopes e(s) e(s') times a Matern of a monotone curve of s; products phi(s) phi(s') need no centres at all. So the
friction kernel and Materns have an exact form, which two passes over the sorted centres prepare; others get a table.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import torch
from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.inference.kernel_matrices import PointMap
from forcegp.inference.kernel_terms import kernel_terms
from forcegp.inference.pathwise import ComposedSamples, FunctionSamples
from forcegp.inference.piecewise_tables import CURVES, TOLERANCE, OneInputFunctions, Side, cubic_table, value_and_slope
from forcegp.inference.posterior import BLOCK_BYTES, LatentPosterior

MATERN = {0.5: (1.0,), 1.5: (1.0, 1.0), 2.5: (1.0, 1.0, 1.0 / 3.0)}
"""Smoothness nu -> p with k = sum_a p_a u^a e^-u, u = sqrt(2 nu) r (Rasmussen & Williams 2006, eq. 4.17)."""

MARGIN = 0.25
"""How far a table reaches beyond the centres on both sides, as a fraction of their range."""

FAR = 1e30
"""Where tanh(s / w) is 1, and s times the derivative of asinh(s / w), for any width w."""

Column = tuple[float, tuple[str, float] | None]
"""An amplitude times a curve of rate * s, by its name and rate; None: times 1."""


def one_input_form(
    latent: LatentPosterior,
    index: int,
    coefficients: Float[Tensor, "N R"] | None = None,
    *,
    smooth: bool = False,
    tolerance: float = TOLERANCE,
) -> OneInputFunctions | None:
    """sum_j k(z, z_j) c_jr of one latent in the form that suits its kernel; without coefficients, its posterior mean.

    A table is at most `tolerance` of the largest value from the sum and reaches `MARGIN` beyond the centres; `smooth`
    asks for one where the exact form has kinks. None for several inputs and where `MOST_INTERVALS` do not suffice.
    """
    centers = latent.features[index].detach()
    if centers.shape[-1] != 1:
        return None
    weights = latent.weights[index].detach()[:, None] if coefficients is None else coefficients.detach()
    exact = markov_functions(latent.kernels[index], centers[:, 0], weights)
    if exact is not None and not smooth:
        return exact
    kernel, height = latent.kernels.dense[index], max(1, BLOCK_BYTES // (8 * len(centers)))

    def kernel_sum(s: Tensor) -> Tensor:
        return torch.cat([kernel.cross(part[:, None], centers) @ weights for part in s.split(height)])

    return cubic_table(exact.values if exact else kernel_sum, *_range(centers), tolerance, centers.unique())


def drawn_form(
    drawn: FunctionSamples | ComposedSamples, latent: LatentPosterior, index: int, tolerance: float = TOLERANCE
) -> OneInputFunctions | None:
    """S functions of one latent, drawn from its posterior, as a cubic table; None as in `one_input_form`.

    Those of a Matern of smoothness 1/2 have cosines of any frequency and need a larger `tolerance`.
    """
    z = latent.features[index].detach()
    if z.shape[-1] != 1:
        return None
    return cubic_table(lambda s: drawn.one(index, s[:, None]).mT, *_range(z), tolerance, z.unique())


def _range(centers: Tensor) -> tuple[float, float]:
    low, high = float(centers.min()), float(centers.max())
    margin = MARGIN * (high - low or max(1.0, abs(low)))
    return low - margin, high + margin


def markov_functions(
    kernel: Kernel, centers: Float[Tensor, " N"], coefficients: Float[Tensor, "N R"]
) -> OneInputFunctions | None:
    """sum_j k(s, s_j) c_jr exactly; None where the kernel is not made of `CURVES` and Materns of them."""
    try:
        terms = kernel_terms(kernel)
    except InvalidInput:
        return None
    knots, place = torch.unique(centers, return_inverse=True)
    curves: dict[tuple[str, float], int] = {}
    constants: dict[tuple[int, ...], Tensor] = {}
    sides, rates, starts, polynomials = [], [], [], []
    for term in terms:
        columns = [_columns(points, centers) for points in (*term.features, *(f.embedding for f in term.factors))]
        if not all(columns) or len(term.factors) > 1:
            return None
        for *factors, warp in product(*columns, *([] if term.factors else [[(1.0, None)]])):
            envelope = tuple(sorted(curves.setdefault(curve, len(curves)) for _, curve in factors if curve))
            scale = float(term.scale) * math.prod(amplitude for amplitude, _ in factors) ** 2
            shapes = (CURVES[curve[0]][0](centers * curve[1]) for _, curve in factors if curve)
            weights = coefficients * math.prod(shapes, start=scale * torch.ones_like(centers))[:, None]
            constant = constants.setdefault(envelope, torch.zeros_like(weights[0]))
            if not term.factors:
                constants[envelope] = constant + weights.sum(0)
                continue
            (amplitude, curve), polynomial = warp, MATERN.get(term.factors[0].shape)
            if curve is None or polynomial is None or term.factors[0].power > 0.0 or len(columns[-1]) > 1:
                return None
            side = Side(list(constants).index(envelope), curves.setdefault(curve, len(curves)), len(polynomial))
            y, rate = CURVES[curve[0]][0](knots * curve[1]), math.sqrt(2.0 * term.factors[0].shape) * abs(amplitude)
            at_knots = torch.zeros(len(knots), weights.shape[1]).to(weights).index_add_(0, place, weights).cpu().numpy()
            h = rate * y.diff().cpu().numpy()
            left, right = _one_side(at_knots, h, polynomial), _one_side(at_knots[::-1], h[::-1], polynomial)[::-1]
            outside = np.zeros_like(left[:1])
            polynomials += [np.concatenate([outside, left]), np.concatenate([right, outside])]
            starts += [torch.cat([y[:1], y]), torch.cat([y, y[-1:]])]
            sides, rates = [*sides, side, side], [*rates, rate, -rate]
    none = np.zeros((len(knots) + 1, coefficients.shape[1], 0))
    return OneInputFunctions(
        knots,
        torch.stack(starts, dim=-1) if starts else knots.new_zeros(len(knots) + 1, 0),
        torch.as_tensor(np.concatenate([none, *polynomials], axis=-1), device=knots.device),
        knots.new_tensor([rate for _, rate in curves] + rates),
        torch.stack(list(constants.values()), dim=-1),
        tuple(kind for kind, _ in curves),
        tuple(constants),
        tuple(sides),
    )


def _one_side(weights: np.ndarray, h: np.ndarray, polynomial: tuple[float, ...]) -> Float[np.ndarray, "K R n"]:
    """Coefficients of u^a in sum_j w_j p(u + D_j) e^-D_j over the centres up to each one, D_j away from it.

    From one centre to the next, h away, the binomial theorem shifts sum_j w_j D_j^k e^-D_j; all exponentials decay.
    """
    n = len(polynomial)
    shift, expand = np.zeros((len(h), n, n)), np.zeros((n, n))
    for k in range(n):
        for i in range(k + 1):
            shift[:, k, i] = np.exp(-h) * math.comb(k, i) * h ** (k - i)
            expand[i, k - i] = polynomial[k] * math.comb(k, i)
    sums = np.stack([weights, *[np.zeros_like(weights)] * (n - 1)], axis=1)
    for i in range(1, len(weights)):
        sums[i] += shift[i - 1] @ sums[i - 1]
    return np.moveaxis(expand @ sums, 1, 2)


def _columns(points: PointMap, centers: Float[Tensor, " N"]) -> list[Column]:
    """Each column of features or of an embedding as amplitude and curve; none if one of them is neither.

    Whatever its class: value and slope at zero and far away give the numbers; values at all widths and centres decide.
    """
    (start, far), (slope, far_slope) = value_and_slope(lambda s: points(s[:, None]), centers.new_tensor([0.0, FAR]))
    found: list[Column] = []
    for i in range(len(start)):
        a, b, c, d = (float(x[i]) for x in (start, slope, far, FAR * far_slope))
        candidates: list[Column] = [(a, None), (b, ("identity", 1.0))]
        candidates += [(x, (kind, b / x)) for kind, x in (("tanh", c), ("asinh", d)) if b * x > 0.0]
        for amplitude, curve in candidates:
            kind, rate = curve or ("identity", 1.0)
            decades = torch.logspace(-3, 3, 13).to(centers) / rate
            probes = torch.cat([centers, decades, -decades])
            expected = amplitude * (CURVES[kind][0](rate * probes) if curve else torch.ones_like(probes))
            if bool(((points(probes[:, None])[:, i] - expected).abs() <= 1e-13 * expected.abs()).all()):
                found.append((amplitude, curve))
                break
    return found if len(found) == len(start) else []
