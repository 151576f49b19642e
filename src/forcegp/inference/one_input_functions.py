"""Latents with one input as functions in pieces, whose cost does not depend on the number of training points.

A sum of Matern kernels of smoothness n - 1/2 is, between neighbouring centres, e^-u and e^-v times polynomials of
degree n - 1, with u and v the scaled distances from the centres on both sides, for it is Markov. The same holds for
envelopes e(s) e(s') times a Matern of a monotone curve of s; products phi(s) phi(s') need no centres at all. So the
friction kernel and Materns have an exact form, which two passes over the sorted centres prepare; others get a table.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.inference.kernel_matrices import PointMap
from forcegp.inference.kernel_terms import DrawnTerm, kernel_terms
from forcegp.inference.pathwise import ComposedSamples, FunctionSamples
from forcegp.inference.piecewise_tables import CURVES, OneInputFunctions, cubic_table, value_and_slope
from forcegp.inference.posterior import LatentPosterior

MATERN = {0.5: (1.0,), 1.5: (1.0, 1.0), 2.5: (1.0, 1.0, 1.0 / 3.0)}
"""Smoothness nu -> p with k = sum_a p_a u^a e^-u, u = sqrt(2 nu) r (Rasmussen & Williams 2006, eq. 4.17)."""

TOLERANCE = 1e-8
MARGIN = 0.25  # of a table beyond the centres, as a fraction of their range
FAR = 1e30  # there tanh(s / w) is 1, and s times the derivative of asinh(s / w), for any width w


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
    centers, kernel = latent.features[index].detach(), latent.kernels.dense[index]
    if centers.shape[-1] != 1:
        return None
    weights = latent.weights[index].detach()[:, None] if coefficients is None else coefficients.detach()
    exact = markov_functions(latent.kernels[index], centers[:, 0], weights)
    if exact is not None and not smooth:
        return exact
    function = exact.values if exact else lambda s: kernel.cross(s[:, None], centers) @ weights
    return cubic_table(function, centers[:, 0], MARGIN, tolerance)


def drawn_form(
    drawn: FunctionSamples | ComposedSamples, latent: LatentPosterior, index: int, tolerance: float = TOLERANCE
) -> OneInputFunctions | None:
    """S functions of one latent, drawn from its posterior: exact where they have no cosines, otherwise a cubic table.

    None as in `one_input_form`.
    """
    centers = latent.features[index].detach()
    if centers.shape[-1] != 1:
        return None
    if isinstance(drawn, ComposedSamples) and not any(term.frequencies for term in drawn.terms[index]):
        beta, terms = drawn.beta[index].mT, drawn.terms[index]
        exact = markov_functions(latent.kernels[index], centers[:, 0], beta, terms, drawn.widening)
        if exact is not None:
            return exact
    return cubic_table(lambda s: drawn.one(index, s[:, None]).mT, centers[:, 0], MARGIN, tolerance)


def markov_functions(
    kernel: Kernel,
    centers: Float[Tensor, " N"],
    coefficients: Float[Tensor, "N R"],
    drawn: Sequence[DrawnTerm] = (),
    widening: float = 1.0,
) -> OneInputFunctions | None:
    """sum_j k(s, s_j) c_jr exactly; None where the kernel is not made of `CURVES` and Materns of them.

    Where `drawn` has functions of its terms, without cosines, `widening` times these are added.
    """
    try:
        terms = kernel_terms(kernel)
    except InvalidInput:
        return None
    grids = [_places(each, centers) for each in drawn]
    coefficients = torch.cat([coefficients, coefficients.new_zeros(sum(map(len, grids)), coefficients.shape[1])])
    first, centers = len(centers), torch.cat([centers, *grids])
    knots, place = torch.unique(centers, return_inverse=True)
    curves: dict[tuple[str, float], int] = {}
    constants: dict[tuple[int, ...], Tensor] = {}
    sides, rates, starts, polynomials = [], [], [], [np.zeros((len(knots) + 1, coefficients.shape[1], 0))]
    for number, term in enumerate(terms):
        weights, envelope, root = coefficients * float(term.scale), [], widening * math.sqrt(float(term.scale))
        for feature in term.features:
            amplitude, curve = _curve(feature, centers)
            weights, root = weights * amplitude**2, root * amplitude
            if curve:
                envelope.append(curves.setdefault(curve, len(curves)))
                weights = weights * CURVES[curve[0]][0](curve[1] * centers)[:, None]
            elif not amplitude:
                return None
        key = tuple(sorted(envelope))
        constant = constants.setdefault(key, torch.zeros_like(weights[0]))
        if not term.factors:
            constants[key] = constant + weights.sum(0) + (root * drawn[number].weights[0][:, 0] if drawn else 0.0)
            continue
        factor, *others = term.factors
        amplitude, curve = _curve(factor.embedding, centers)
        if others or not curve or factor.power >= 0.0 or factor.shape not in MATERN:
            return None
        if drawn:
            own = slice(first, first := first + len(grids[number]))
            weights[own] += root * _news(drawn[number]).mT
        polynomial, rate = MATERN[factor.shape], math.sqrt(2.0 * factor.shape) * abs(amplitude)
        side = list(constants).index(key), curves.setdefault(curve, len(curves)), len(polynomial), True
        y = CURVES[curve[0]][0](curve[1] * knots)
        at_knots = torch.zeros_like(weights[: len(knots)]).index_add_(0, place, weights).cpu().numpy()
        h = rate * y.diff().cpu().numpy()
        left, right = _one_side(at_knots, h, polynomial), _one_side(at_knots[::-1], h[::-1], polynomial)[::-1]
        outside = np.zeros_like(left[:1])
        polynomials += [np.concatenate([outside, left]), np.concatenate([right, outside])]
        starts += [torch.cat([y[:1], y]), torch.cat([y, y[-1:]])]
        sides, rates = [*sides, side, side], [*rates, rate, -rate]
    return OneInputFunctions(
        knots,
        torch.stack(starts, dim=-1) if starts else knots.new_zeros(len(knots) + 1, 0),
        torch.as_tensor(np.concatenate(polynomials, axis=-1), device=knots.device),
        knots.new_tensor([rate for _, rate in curves] + rates),
        torch.stack(list(constants.values()), dim=-1),
        tuple(kind for kind, _ in curves),
        tuple(constants),
        tuple(sides),
    )


def _news(drawn: DrawnTerm) -> Float[Tensor, "S P"]:
    """Weights of the kernel functions about the points of a grid, which give the values there."""
    assert drawn.grid is not None
    h, values = drawn.grid[1] - drawn.grid[0], drawn.weights[0][:, 0]
    news = torch.cat([values[:, :1], (values[:, 1:] - (-h).exp() * values[:, :-1]) / -torch.expm1(-2.0 * h)], dim=1)
    return news - (-h).exp() * torch.cat([news[:, 1:], torch.zeros_like(news[:, :1])], dim=1)


def _places(drawn: DrawnTerm, centers: Float[Tensor, " N"]) -> Float[Tensor, " P"]:
    """The inputs at which a drawn term has its grid; none where it has none."""
    amplitude, curve = _curve(drawn.term.factors[0].embedding, centers) if drawn.grid is not None else (0.0, None)
    if drawn.grid is None or not curve:
        return centers[:0]
    return (torch.sinh if curve[0] == "asinh" else torch.clone)(drawn.grid / amplitude) / curve[1]


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


def _curve(points: PointMap, centers: Float[Tensor, " N"]) -> tuple[float, tuple[str, float] | None]:
    """Features or an embedding as an amplitude times a curve of rate * s, or times 1 (None); (0, None) if neither.

    Whatever its class: value and slope at zero and far away give the numbers; values at all widths and centres decide.
    """
    values, slopes = value_and_slope(lambda s: points(s[:, None]), centers.new_tensor([0.0, FAR]))
    if values.shape[1] == 1:
        (a, c), (b, d) = values[:, 0].tolist(), slopes[:, 0].tolist()
        found = [(x, (kind, b / x)) for kind, x in (("tanh", c), ("asinh", FAR * d)) if b * x > 0.0]
        for amplitude, curve in [(a, None), (b, ("identity", 1.0)), *found]:
            kind, rate = curve or ("identity", 1.0)
            decades = torch.logspace(-3, 3, 13).to(centers) / rate
            probes = torch.cat([centers, decades, -decades])
            expected = amplitude * (CURVES[kind][0](rate * probes) if curve else torch.ones_like(probes))
            if amplitude and bool(((points(probes[:, None])[:, 0] - expected).abs() <= 1e-13 * expected.abs()).all()):
                return amplitude, curve
    return 0.0, None
