"""Latents with one input as functions in pieces, whose cost does not depend on the number of training points.

A sum of Matern kernels of smoothness n - 1/2 is, between neighbouring centres, e^-u and e^-v times polynomials of
degree n - 1, with u and v the scaled distances from the centres on both sides, for it is Markov. The same holds for
envelopes e(s) e(s') times a Matern of a monotone curve of s; products phi(s) phi(s') need no centres at all. So the
friction kernel and Materns have an exact form, which two passes over the sorted centres prepare; others get a table.
"""

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor

from forcegp.codegen.c_writer import c_text, filled
from forcegp.errors import InvalidInput
from forcegp.inference.kernel_matrices import PointMap
from forcegp.inference.pathwise import ComposedSamples, DrawnTerm, FunctionSamples, kernel_terms
from forcegp.inference.posterior import LatentPosterior

MOST_INTERVALS = 2**15
AT_ONCE = 256  # points at which a function is differentiated together: its kernel functions are kept until then

CURVES: dict[str, tuple[Callable[[Tensor], Tensor], str, str]] = {
    "identity": (lambda z: z, "{z}", "{rate}"),
    "tanh": (torch.tanh, "r_tanh({z})", "{rate} * (1.0 - {y} * {y})"),
    "beyond": (
        lambda z: z - z.clamp(-1.0, 1.0),
        "({z} - 0.5 * (r_sqrt(({z} + 1.0) * ({z} + 1.0)) - r_sqrt(({z} - 1.0) * ({z} - 1.0))))",
        "{rate} * (1.0 - 0.5 * (({z} + 1.0) / r_sqrt(({z} + 1.0) * ({z} + 1.0) + 1e-300)"
        " - ({z} - 1.0) / r_sqrt(({z} - 1.0) * ({z} - 1.0) + 1e-300)))",
    ),
    "asinh": (torch.asinh, "r_asinh({z})", "{rate} / r_sqrt(1.0 + {z} * {z})"),
}
"""y as a function of z = rate * s: in torch, in C, and its derivative to s in C."""


@dataclass(frozen=True, eq=False)
class OneInputFunctions:
    """R functions of one input s on K + 1 segments, kept as one array of numbers that C code reads.

        f_r(s) = sum_e envelope_e(s) (c_re + sum_i w_ri(u_i) exp(-u_i)),   u_i = rate_i (y_i(s) - start_i)

    An envelope is a product of curves y(s) (`CURVES`). Every segment has its own starts and polynomials w; a bucket and
    a search within it find it. Without the exponential, and with w of degree 3, it is a cubic table.
    Known from `low` to `high` and NaN elsewhere, where the caller has to evaluate.

    A side is (envelope, curve, number of coefficients of w, whether it decays). `error` is the largest that was found
    while a table was made, relative to the largest value.
    """

    knots: Float[Tensor, " K"]
    starts: Float[Tensor, "K+1 I"]
    polynomials: Float[Tensor, "K+1 R W"]
    rates: Float[Tensor, " _"]  # of the curves, then of the sides
    constants: Float[Tensor, "R E"]
    curves: tuple[str, ...]
    envelopes: tuple[tuple[int, ...], ...]
    sides: tuple[tuple[int, int, int, bool], ...]
    low: float = -sys.float_info.max
    high: float = sys.float_info.max
    error: float = 0.0

    def values(self, s: Float[Tensor, " n"]) -> Float[Tensor, "n R"]:
        """The functions, differentiable in s."""
        segment, first = torch.searchsorted(self.knots, s.detach().contiguous(), right=True), 0
        s = s * torch.where((s >= self.low) & (s <= self.high), 1.0, torch.nan).to(s)
        y = [CURVES[kind][0](rate * s) for kind, rate in zip(self.curves, self.rates, strict=False)]
        levels = list(self.constants.mT[:, None].unbind())
        for i, (envelope, curve, size, decays) in enumerate(self.sides):
            # Beyond the outermost centres of a Matern one side has none, and coefficients of zero.
            u = (self.rates[len(y) + i] * (y[curve] - self.starts[segment, i])).clamp_min(0.0)
            powers = torch.stack([u**a for a in range(size)], dim=-1) * ((-u).exp()[:, None] if decays else 1.0)
            w = self.polynomials[segment, :, first : first + size]
            levels[envelope] = levels[envelope] + (w @ powers[..., None])[..., 0]
            first += size
        products = [math.prod((y[i] for i in factors), start=torch.ones_like(s)) for factors in self.envelopes]
        return torch.stack([p[:, None] * g for p, g in zip(products, levels, strict=True)]).sum(0)

    def only(self, r: int) -> "OneInputFunctions":
        """One of the functions."""
        return replace(self, polynomials=self.polynomials[:, r : r + 1], constants=self.constants[r : r + 1])

    def table(self) -> Float[np.ndarray, " _"]:
        """All numbers, finite: 8 of the header, rates and constants, buckets, knots, one row for every segment."""
        parameters = torch.cat([self.rates, self.constants.flatten()]).cpu().numpy()
        rows = torch.cat([self.starts, self.polynomials.flatten(1)], dim=1).cpu().numpy()
        knots, count = self.knots.cpu().numpy(), 2 * len(self.knots)
        per_unit = count / (knots[-1] - knots[0]) if knots[-1] > knots[0] else 0.0
        # by the arithmetic of the C text, which is monotone: no rounding moves a point into a wrong bucket
        bucket = np.clip((knots - knots[0]) * per_unit, 0, count - 1).astype(int)
        sizes = [len(knots), len(self.constants), self.low, self.high, rows.shape[1], len(parameters)]
        parts = [[*sizes, knots[0], per_unit], parameters, bucket.searchsorted(np.arange(count + 1)), knots]
        return np.concatenate([*parts, rows.ravel()])

    def c_source(self, name: str) -> str:
        """`static void name(const double *table, real s, real *f, real *slope)`, R entries of f and of slope or NULL.

        Functions of the same text differ by their tables only. Plain C99 for one state, where `real` is double and
        AT(x, k) is x, and for several in the lanes of a GCC vector; needs <math.h>, r_exp, r_tanh, r_asinh, r_sqrt.
        """
        n, E, first = len(self.curves), range(len(self.envelopes)), 0
        names = [{"z": f"(p[{i}] * s)", "y": f"y{i}", "rate": f"p[{i}]"} for i in range(n)]
        ready = [f"const real y{i} = {CURVES[kind][1].format(**names[i])};" for i, kind in enumerate(self.curves)]
        slopes = [f"({CURVES[kind][2].format(**names[i])})" for i, kind in enumerate(self.curves)]
        found, values, lanes, changes = [], [], [f"AT(g{e}, k) = c[{e}];" for e in E], [[] for _ in E]
        for i, (envelope, curve, size, decays) in enumerate(self.sides):
            w, rate, decay = [f"w{first + a}" for a in range(size)], f"p[{n + i}]", f"exp{i}" if decays else "1.0"
            found += [f"AT(u{i}, k) = {rate} * (AT(y{curve}, k) - row[k][{i}]);", f"AT(u{i}, k) *= AT(u{i}, k) > 0.0;"]
            lanes += [f"AT({c}, k) = row[k][{len(self.sides)} + {self.polynomials.shape[2]} * r + {c[1:]}];" for c in w]
            values.append(f"const real a{i} = {_horner(w, f'u{i}')} * {decay}; g{envelope} = g{envelope} + a{i};")
            change = _horner([f"{a}.0 * {w[a]}" for a in range(1, size)] or ["0.0"], f"u{i}")
            changes[envelope].append(f"{rate} * {slopes[curve]} * ({change} * {decay}{f' - a{i}' * decays})")
            first += size
        decaying = [f"const real exp{i} = r_exp(-u{i});" for i, side in enumerate(self.sides) if side[3]]
        slope = [_times(self.envelopes[e], f"({' + '.join(part)})") for e, part in enumerate(changes) if part]
        for e, factors in enumerate(self.envelopes):
            slope += [f"{slopes[i]} * {_times(factors[:k] + factors[k + 1 :], f'g{e}')}" for k, i in enumerate(factors)]
        words: dict[str, object] = {"NAME": name, "RATES": len(self.rates), "ENVELOPES": len(E)}
        words |= {"CURVES": " ".join(ready), "DISTANCES": " ".join(f"real u{i};" for i in range(len(self.sides)))}
        words |= {"AWAY": " ".join(found), "DECAYS": " ".join(decaying), "COEFFICIENTS": " ".join(lanes)}
        words |= {"NUMBERS": ", ".join([f"g{e}" for e in E] + [f"w{i}" for i in range(first)])}
        words |= {"SIDES": " ".join(values), "SLOPE": " + ".join(slope) or "g0 - g0"}
        words["VALUE"] = " + ".join(_times(factors, f"g{e}") for e, factors in enumerate(self.envelopes))
        return filled(c_text(__name__, "one_input.c"), words)


def cubic_table(
    function: Callable[[Tensor], Tensor], centers: Float[Tensor, " N"], margin: float, tolerance: float
) -> OneInputFunctions | None:
    """Cubic polynomials between values and slopes of `function`, s (n,) -> (n, R), with a continuous derivative.

    They reach `margin` times the range of the centres beyond these. Intervals are halved until the error at five points
    of each, and at the centres, near which functions may be narrow, is at most half of `tolerance` times the largest
    value. None where `MOST_INTERVALS` do not suffice.
    """
    places = centers.unique()
    more = margin * float(places[-1] - places[0] or places[0].abs().clamp_min(1.0))
    x = torch.linspace(float(places[0]) - more, float(places[-1]) + more, 33).to(places)
    inner, done, error = x.new_tensor([0.11, 0.3, 0.5, 0.71, 0.88]), x[1:] < x[0], x.new_zeros(())
    f, d = value_and_slope(function, x)
    while len(x) <= MOST_INTERVALS:
        table = _hermite(x, f, d)
        points = torch.cat([(x[:-1, None] + inner * x.diff()[:, None])[~done].flatten(), places])
        inside = torch.searchsorted(x[1:-1].contiguous(), points, right=True)
        points, inside = points[~done[inside]], inside[~done[inside]]
        with torch.no_grad():
            exact = torch.cat([function(part) for part in points.split(AT_ONCE)])
        largest = torch.cat([f, exact]).abs().max().clamp_min(sys.float_info.min)
        worst = x.new_zeros(len(done)).scatter_reduce(0, inside, (table.values(points) - exact).abs().amax(1), "amax")
        done |= worst <= 0.5 * tolerance * largest  # half, for between the points it may be larger
        error = torch.maximum(error, (worst * done).max() / largest)
        if done.all():
            return replace(table, error=float(error))
        x, order = torch.cat([x, (0.5 * (x[:-1] + x[1:]))[~done]]).sort()
        new_f, new_d = value_and_slope(function, x[order >= len(f)])
        f, d = torch.cat([f, new_f])[order], torch.cat([d, new_d])[order]
        done = done.repeat_interleave(2 - done.int())
    return None


def value_and_slope(function: Callable[[Tensor], Tensor], s: Float[Tensor, " n"]) -> tuple[Tensor, Tensor]:
    """R functions (n, R) of one input and their derivatives, by automatic differentiation."""
    found = []
    for part in s.detach().split(AT_ONCE):
        with torch.enable_grad():
            at = part.clone().requires_grad_()
            f = function(at)
            sums = (f + 0.0 * at[:, None]).sum(0).unbind()  # constants have a derivative, too
            found.append(
                (f.detach(), torch.stack([torch.autograd.grad(y, at, retain_graph=True)[0] for y in sums], -1))
            )
    return torch.cat([f for f, _ in found]), torch.cat([slope for _, slope in found])


def _hermite(x: Float[Tensor, " K"], f: Float[Tensor, "K R"], d: Float[Tensor, "K R"]) -> OneInputFunctions:
    h, left, right = x.diff()[:, None], d[:-1], d[1:]
    step = (f[1:] - f[:-1]) / h
    w = torch.stack([f[:-1], left, (3.0 * step - 2.0 * left - right) / h, (left + right - 2.0 * step) / h**2], dim=-1)
    starts, w = (torch.cat([part[:1], part, part[-1:]]) for part in (x[:-1, None], w))  # at its ends it is still known
    curves, sides, none = ("identity",), ((0, 0, 4, False),), 0.0 * f[0, :, None]
    return OneInputFunctions(x, starts, w, x.new_ones(2), none, curves, ((),), sides, float(x[0]), float(x[-1]))


def _horner(coefficients: list[str], u: str) -> str:
    return f"({coefficients[0]} + {u} * {_horner(coefficients[1:], u)})" if coefficients[1:] else coefficients[0]


def _times(factors: tuple[int, ...], value: str) -> str:
    return " * ".join([*(f"y{i}" for i in factors), value])


MATERN = {0.5: (1.0,), 1.5: (1.0, 1.0), 2.5: (1.0, 1.0, 1.0 / 3.0)}
"""Smoothness nu -> p with k = sum_a p_a u^a e^-u, u = sqrt(2 nu) r (Rasmussen & Williams 2006, eq. 4.17)."""

TOLERANCE = 1e-8
MARGIN = 0.25  # of a table beyond the centres, as a fraction of their range
FAR = 1e30  # there tanh(s / w) is 1, and s times the derivative of asinh(s / w), for any width w


def one_input_form(
    latent: LatentPosterior,
    index: int,
    coefficients: Float[Tensor, "N R"] | None = None,
) -> OneInputFunctions | None:
    """sum_j k(z, z_j) c_jr of one latent in the form that suits its kernel; without coefficients, its posterior mean.

    A table is at most `TOLERANCE` of the largest value from the sum and reaches `MARGIN` beyond the centres. None for
    several inputs and where `MOST_INTERVALS` do not suffice.
    """
    centers, kernel = latent.features[index].detach(), latent.kernels.dense[index]
    if centers.shape[-1] != 1:
        return None
    weights = latent.weights[index].detach()[:, None] if coefficients is None else coefficients.detach()
    exact = markov_functions(latent.kernels[index], centers[:, 0], weights)
    if exact is not None:
        return exact
    return cubic_table(lambda s: kernel.cross(s[:, None], centers) @ weights, centers[:, 0], MARGIN, TOLERANCE)


def drawn_form(
    drawn: FunctionSamples | ComposedSamples, latent: LatentPosterior, index: int, tolerance: float = TOLERANCE
) -> OneInputFunctions | None:
    """S drawn functions of one latent: exact where without cosines, else a table. None as in `one_input_form`."""
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
        if not drawn and not term.factors and not bool(term.columns(centers[:, None]).any()):
            continue  # nothing at any centre, as of what lies beyond them
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
    owner = getattr(points, "__self__", None)
    if isinstance(limit := getattr(owner, "limit", None), float):  # its numbers do not show at zero and far away
        return float(owner.slope) * limit, ("beyond", 1.0 / limit)  # type: ignore[union-attr]  # it has both
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
