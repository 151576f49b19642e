"""Latents with one input as functions in pieces, whose cost does not depend on the number of training points.

A sum of Matern kernels of smoothness n - 1/2 is, between two neighbouring centres, e^-u and e^-v times polynomials of
degree n - 1, with u and v the scaled distances from the centres on both sides: the Matern is Markov. The same holds for
e(s) e(s') times a Matern of a monotone function of s, and products phi(s) phi(s') need no centres at all. Two passes
over the sorted centres sum w_j D_j^k e^-D_j of all centres at distances D_j on one side; every exponential decays. So
the built-in friction kernel and Matern kernels have an exact form. Every other kernel gets a cubic table.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.inference.kernel_matrices import PointMap
from forcegp.inference.kernel_terms import kernel_terms
from forcegp.inference.pathwise import ComposedSamples, FunctionSamples
from forcegp.inference.piecewise_tables import FARTHEST, TOLERANCE, OneInputFunctions, cubic_table, value_and_slope
from forcegp.inference.posterior import BLOCK_BYTES, LatentPosterior

MATERN = {0.5: (1.0,), 1.5: (1.0, 1.0), 2.5: (1.0, 1.0, 1.0 / 3.0)}
"""Smoothness nu -> p with k = sum_a p_a u^a e^-u, u = sqrt(2 nu) r (Rasmussen & Williams 2006, eq. 4.17)."""

MARGIN = 0.25
"""How far a table reaches beyond the centres on both sides, as a fraction of their range."""

FAR = 1e30
"""Where tanh(s / w) is 1, and s times the derivative of asinh(s / w) is 1, for any width w of a velocity."""

CURVES: dict[str, Callable[[Tensor], Tensor]] = {"identity": lambda s: s, "tanh": torch.tanh, "asinh": torch.asinh}
"""The functions of rate * s that kernels with an exact form are made of."""

IN_C = {
    "identity": ("{z}", "{rate}"),
    "tanh": ("r_tanh({z})", "{rate} * (1.0 - {y} * {y})"),
    "asinh": ("r_asinh({z})", "{rate} / r_sqrt(1.0 + {z} * {z})"),
}
"""A curve y of z = rate * s and its derivative to s."""

Curve = tuple[str, float]
"""A name in `CURVES` and its rate."""


@dataclass(frozen=True, eq=False)
class MarkovFunctions(OneInputFunctions):
    """sum_e envelope_e(s) (constant_e + Matern terms), exactly; an envelope is the product of some curves.

    `terms` are envelope, curve and number n of polynomial coefficients of every Matern term. Parameters: the rate of
    every curve, then what its distances are multiplied with of every term. A segment holds the curve at its ends, term
    by term, and for each function the coefficients of the left and the right polynomial, term by term.
    """

    curves: tuple[str, ...]
    envelopes: tuple[tuple[int, ...], ...]
    terms: tuple[tuple[int, int, int], ...]

    @override
    def values(self, s: Float[Tensor, " n"]) -> Float[Tensor, "n R"]:
        segment = torch.searchsorted(self.knots, s.detach().contiguous(), right=True)
        ends, own = self.shared[segment], self.own[segment]
        y = [CURVES[kind](s * rate) for kind, rate in zip(self.curves, self.parameters, strict=False)]
        levels: list[Tensor] = [constant.expand(len(s), -1) for constant in self.constants.mT]
        sides = [(term, m, sign) for m, term in enumerate(self.terms) for sign in (1.0, -1.0)]
        first = 0
        for side, ((envelope, curve, size), m, sign) in enumerate(sides):
            # Beyond the outermost centres one side has no centres and coefficients of zero.
            u = (self.parameters[len(y) + m] * sign * (y[curve] - ends[:, side])).clamp_min(0.0)
            decaying = torch.stack([u**a for a in range(size)], dim=-1) * (-u).exp()[:, None]
            levels[envelope] = levels[envelope] + (own[..., first : first + size] @ decaying[..., None])[..., 0]
            first += size
        one = torch.ones_like(s)
        parts = [
            math.prod((y[i] for i in factors), start=one)[:, None] * level
            for factors, level in zip(self.envelopes, levels, strict=True)
        ]
        return torch.stack(parts).sum(0)

    @override
    def c_source(self, name: str) -> str:
        names = [{"z": f"(p[{i}] * s)", "y": f"y{i}", "rate": f"p[{i}]"} for i in range(len(self.curves))]
        curves = [f"const real y{i} = {IN_C[kind][0].format(**names[i])};" for i, kind in enumerate(self.curves)]
        slopes = [f"({IN_C[kind][1].format(**names[i])})" for i, kind in enumerate(self.curves)]
        levels, changes = [[f"g{e}"] for e in range(len(self.envelopes))], [[] for _ in self.envelopes]
        distances, gathered, width = [], [], 0
        for m, (envelope, curve, size) in enumerate(self.terms):
            rate = f"p[{len(self.curves) + m}]"
            for side, sign in enumerate(("", "-")):
                u, w = f"u{2 * m + side}", [f"w{width + a}" for a in range(size)]
                distances.append(f"AT({u}, k) = {sign}{rate} * (AT(y{curve}, k) - row[k][{2 * m + side}]);")
                distances.append(f"if (AT({u}, k) < 0.0) AT({u}, k) = 0.0;")
                derivative = [f"({a + 1}.0 * {w[a + 1]} - {w[a]})" for a in range(size - 1)] + [f"(-{w[-1]})"]
                levels[envelope].append(f"e{u} * {_polynomial(w, u)}")
                changes[envelope].append(f"{sign}{rate} * {slopes[curve]} * e{u} * {_polynomial(derivative, u)}")
                gathered += [f"AT(w{width + a}, k) = own[{width + a}];" for a in range(size)]
                width += size
        sides, E = [f"u{i}" for i in range(2 * len(self.terms))], len(self.envelopes)
        value = [_times(factors, f"g{e}") for e, factors in enumerate(self.envelopes)]
        slope = [
            f"{slopes[i]} * {_times(factors[:place] + factors[place + 1 :], f'g{e}')}"
            for e, factors in enumerate(self.envelopes)
            for place, i in enumerate(factors)
        ] + [_times(self.envelopes[e], f"({' + '.join(found)})") for e, found in enumerate(changes) if found]
        own = f"const double *own = row[k] + {len(sides)} + {width} * r;"
        return f"""
static void {name}(const double *table, real s, real *f, real *slope) {{
  const double *p = table + 9{", *row[LANES]" if sides else ""};
  {_lines(2, curves or ["(void)s;"])}
  {f"real {', '.join(sides)};" if sides else ""}
  {_lines(2, _each_lane(["row[k] = one_input_segment(table, AT(s, k));", *distances]) if sides else [])}
  {_lines(2, [f"const real e{u} = r_exp(-{u});" for u in sides])}
  for (int r = 0; r < (int)table[1]; ++r) {{
    const double *constant = p + {len(self.parameters)} + {E} * r;
    real {", ".join([f"g{e}" for e in range(E)] + [f"w{i}" for i in range(width)])};
    {_lines(4, _each_lane([own] * bool(sides) + [f"AT(g{e}, k) = constant[{e}];" for e in range(E)] + gathered))}
    {_lines(4, [f"g{e} = {' + '.join(level)};" for e, level in enumerate(levels) if len(level) > 1])}
    f[r] = {" + ".join(value)};
    if (slope) slope[r] = {" + ".join(slope) or "g0 - g0"};
  }}
}}
"""


def one_input_form(
    latent: LatentPosterior,
    index: int,
    coefficients: Float[Tensor, "N R"] | None = None,
    *,
    smooth: bool = False,
    tolerance: float = TOLERANCE,
) -> OneInputFunctions | None:
    """sum_j k(z, z_j) c_jr of one latent in the form that suits its kernel; without coefficients, its posterior mean.

    A `CubicTable` is at most `tolerance` (relative to the largest value) from the sum and reaches `MARGIN` beyond the
    centres; `smooth` asks for one where the exact form would have kinks. None for latents with several inputs, and
    where a table would be too large (`MOST_INTERVALS`); evaluate those sums themselves.
    """
    centers = latent.features[index].detach()
    if centers.shape[-1] != 1:
        return None
    weights = latent.weights[index].detach()[:, None] if coefficients is None else coefficients.detach()
    exact = markov_functions(latent.kernels[index], centers[:, 0], weights)
    if exact is not None and not smooth:
        return exact
    kernel, height = latent.kernels.dense[index], max(1, BLOCK_BYTES // (8 * max(1, len(centers))))

    def kernel_sum(s: Tensor) -> Tensor:
        return torch.cat([kernel.cross(part[:, None], centers) @ weights for part in s.split(height)])

    places = centers[:, 0].unique()
    return cubic_table(exact.values if exact else kernel_sum, *reach(places), tolerance=tolerance, places=places)


def drawn_form(
    drawn: FunctionSamples | ComposedSamples, latent: LatentPosterior, index: int, *, tolerance: float = TOLERANCE
) -> OneInputFunctions | None:
    """S functions of one latent, drawn from its posterior, as a cubic table; None as in `one_input_form`.

    Functions of a Matern of smoothness 1/2 have cosines of any frequency and need a larger `tolerance`.
    """
    places = latent.features[index].detach()[:, 0].unique()
    if latent.features[index].shape[-1] != 1:
        return None
    return cubic_table(lambda s: drawn.one(index, s[:, None]).mT, *reach(places), tolerance=tolerance, places=places)


def reach(places: Float[Tensor, " K"]) -> tuple[float, float]:
    """The range of a table of functions with these centres."""
    low, high = float(places.min()), float(places.max())
    margin = MARGIN * (high - low or max(1.0, abs(low)))
    return low - margin, high + margin


def markov_functions(
    kernel: Kernel, centers: Float[Tensor, " N"], coefficients: Float[Tensor, "N R"]
) -> MarkovFunctions | None:
    """sum_j k(s, s_j) c_jr exactly; None where the kernel is not made of `CURVES` and Materns of them."""
    try:
        terms = kernel_terms(kernel)
    except InvalidInput:
        return None
    knots, place = torch.unique(centers, return_inverse=True)
    nothing = coefficients.new_zeros(coefficients.shape[1])
    curves: dict[Curve, int] = {}
    constants: dict[tuple[int, ...], Tensor] = {}
    found, rates, ends, own = [], [], [], []
    with torch.no_grad():
        for term in terms:
            columns = [_curves(feature, centers) for feature in term.features]
            warps = [_curves(factor.embedding, centers) for factor in term.factors]
            if None in columns or None in warps or len(warps) > 1:
                return None
            for factors in product(*(entries for entries in columns if entries is not None)):
                numbers = [curves.setdefault(curve, len(curves)) for _, curve in factors if curve is not None]
                envelope = tuple(sorted(numbers))
                scale = float(term.scale) * math.prod(amplitude for amplitude, _ in factors) ** 2
                shape = [CURVES[curve[0]](centers * curve[1]) for _, curve in factors if curve is not None]
                weights = coefficients * (scale * math.prod(shape, start=torch.ones_like(centers)))[:, None]
                constants.setdefault(envelope, nothing)
                if not warps:
                    constants[envelope] = constants[envelope] + weights.sum(0)
                    continue
                assert warps[0] is not None
                if len(warps[0]) != 1 or term.factors[0].power != -0.5 or term.factors[0].shape not in MATERN:
                    return None
                ((amplitude, warp),) = warps[0]
                if warp is None:
                    return None
                polynomial, rate = MATERN[term.factors[0].shape], math.sqrt(2.0 * term.factors[0].shape) * abs(amplitude)
                y = CURVES[warp[0]](knots * warp[1])
                at_knots = weights.new_zeros(len(knots), weights.shape[1]).index_add_(0, place, weights).cpu().numpy()
                h = rate * y.diff().cpu().numpy()
                left, right = _one_side(at_knots, h, polynomial), _one_side(at_knots[::-1], h[::-1], polynomial)[::-1]
                outside = np.zeros_like(left[:1])
                sides = np.concatenate([outside, left]), np.concatenate([right, outside])
                own.append(torch.as_tensor(np.concatenate(sides, axis=-1), device=centers.device))
                ends += [torch.cat([y[:1], y]), torch.cat([y, y[-1:]])]
                found.append((list(constants).index(envelope), curves.setdefault(warp, len(curves)), len(polynomial)))
                rates.append(rate)
    empty = knots.new_zeros(len(knots) + 1, 0)
    return MarkovFunctions(
        knots,
        torch.stack(ends, dim=-1) if ends else empty,
        torch.cat(own, dim=-1) if own else empty[:, None].expand(-1, len(nothing), -1),
        knots.new_tensor([rate for _, rate in curves] + rates),
        torch.stack(list(constants.values()), dim=-1),
        -FARTHEST,
        FARTHEST,
        tuple(kind for kind, _ in curves),
        tuple(constants),
        tuple(found),
    )


def _one_side(weights: np.ndarray, h: np.ndarray, polynomial: tuple[float, ...]) -> Float[np.ndarray, "K R n"]:
    """Coefficients of u^a in sum_j w_j p(u + D_j) e^-D_j of all centres up to each one, at distances D_j from it.

    From centre to centre, which lie h apart, sum_j w_j D_j^k e^-D_j is shifted by the binomial theorem.
    """
    n = len(polynomial)
    shift = np.zeros((len(h), n, n))
    expand = np.zeros((n, n))
    for k, i in product(range(n), repeat=2):
        if i <= k:
            shift[:, k, i] = np.exp(-h) * math.comb(k, i) * h ** (k - i)
            expand[i, k - i] = polynomial[k] * math.comb(k, i)
    sums = np.zeros((len(weights), n, weights.shape[1]))
    sums[:, 0] = weights
    for i in range(1, len(weights)):
        sums[i] += shift[i - 1] @ sums[i - 1]
    return np.moveaxis(expand @ sums, 1, 2)


def _curves(feature: PointMap, centers: Float[Tensor, " N"]) -> list[tuple[float, Curve | None]] | None:
    """Each column of `feature` as an amplitude times a curve (None: a constant), by its values; None if one is not."""
    # Any kernel's function is recognised, whatever its class: value and slope at zero and far away give the two
    # numbers, and values at many widths and at all centres decide.
    (start, far), (slope, far_slope) = value_and_slope(lambda s: feature(s[:, None]), centers.new_tensor([0.0, FAR]))
    found = []
    for column in range(len(start)):
        a0, d0, a1, d1 = (float(x[column]) for x in (start, slope, far, FAR * far_slope))
        candidates: list[tuple[float, Curve | None]] = [(a0, None), (d0, ("identity", 1.0))]
        candidates += [(a, (kind, d0 / a)) for kind, a in (("tanh", a1), ("asinh", d1)) if d0 * a > 0.0]
        for amplitude, curve in candidates:
            kind, rate = curve or ("identity", 1.0)
            decades = torch.logspace(-3, 3, 13, dtype=centers.dtype, device=centers.device) / rate
            probes = torch.cat([centers, decades, -decades])
            expected = amplitude * (CURVES[kind](rate * probes) if curve else torch.ones_like(probes))
            if bool(((feature(probes[:, None])[:, column] - expected).abs() <= 1e-13 * expected.abs()).all()):
                found.append((amplitude, curve))
                break
        else:
            return None
    return found


def _polynomial(coefficients: list[str], u: str) -> str:
    first, *others = coefficients
    return f"({first} + {u} * {_polynomial(others, u)})" if others else first


def _times(factors: tuple[int, ...], value: str) -> str:
    return " * ".join([f"y{i}" for i in factors] + [value])


def _each_lane(statements: list[str]) -> list[str]:
    return ["for (int k = 0; k < LANES; ++k) {", *(f"  {statement}" for statement in statements), "}"]


def _lines(indent: int, statements: list[str]) -> str:
    return ("\n" + " " * indent).join(statements)
