"""Latents with one input as functions in pieces, whose cost does not depend on the number of training points.

A sum of Materns is Markov: between neighbouring centres it is e^-u and e^-v times polynomials. Other kernels have none.
"""

import hashlib
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.codegen.c_writer import c_text, filled
from forcegp.codegen.graph import Graph
from forcegp.errors import InvalidInput
from forcegp.inference.dense_kernels import PointMap
from forcegp.inference.pathwise import DrawnTerm, FunctionSamples, draw_functions, kernel_terms
from forcegp.inference.posterior import LatentPosterior
from forcegp.inference.prepared_kernels import PADDING, CompressedCovariance, KernelSum, kernel_sums

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
    a search within it find it. A side is (envelope, curve, number of coefficients of w).
    """

    knots: Float[Tensor, " K"]
    starts: Float[Tensor, "K+1 I"]
    polynomials: Float[Tensor, "K+1 R W"]
    rates: Float[Tensor, " _"]  # of the curves, then of the sides
    constants: Float[Tensor, "R E"]
    curves: tuple[str, ...]
    envelopes: tuple[tuple[int, ...], ...]
    sides: tuple[tuple[int, int, int], ...]

    def values(self, s: Float[Tensor, " n"]) -> Float[Tensor, "n R"]:
        """The functions, differentiable in s."""
        segment, first = torch.searchsorted(self.knots, s.detach().contiguous(), right=True), 0
        y = [CURVES[kind][0](rate * s) for kind, rate in zip(self.curves, self.rates, strict=False)]
        levels = list(self.constants.mT[:, None].unbind())
        for i, (envelope, curve, size) in enumerate(self.sides):
            # Beyond the outermost centres of a Matern one side has none, and coefficients of zero.
            u = (self.rates[len(y) + i] * (y[curve] - self.starts[segment, i])).clamp_min(0.0)
            powers = torch.stack([u**a for a in range(size)], dim=-1) * (-u).exp()[:, None]
            w = self.polynomials[segment, :, first : first + size]
            levels[envelope] = levels[envelope] + (w @ powers[..., None])[..., 0]
            first += size
        products = [math.prod((y[i] for i in factors), start=torch.ones_like(s)) for factors in self.envelopes]
        return torch.stack([p[:, None] * g for p, g in zip(products, levels, strict=True)]).sum(0)

    def only(self, r: int) -> "OneInputFunctions":
        """One of the functions."""
        return replace(self, polynomials=self.polynomials[:, r : r + 1], constants=self.constants[r : r + 1])

    def table(self) -> Float[np.ndarray, " _"]:
        """All numbers: 8 of the header, rates and constants, buckets, knots, one row for every segment."""
        parameters = torch.cat([self.rates, self.constants.flatten()]).cpu().numpy()
        rows = torch.cat([self.starts, self.polynomials.flatten(1)], dim=1).cpu().numpy()
        knots, count = self.knots.cpu().numpy(), 2 * len(self.knots)
        per_unit = count / (knots[-1] - knots[0]) if knots[-1] > knots[0] else 0.0
        # by the arithmetic of the C text, which is monotone: no rounding moves a point into a wrong bucket
        bucket = np.clip((knots - knots[0]) * per_unit, 0, count - 1).astype(int)
        sizes = [len(knots), len(self.constants), 0, 0, rows.shape[1], len(parameters)]
        parts = [[*sizes, knots[0], per_unit], parameters, bucket.searchsorted(np.arange(count + 1)), knots]
        return np.concatenate([*parts, rows.ravel()])

    def c_source(self, name: str) -> str:
        """`static void name(const double *table, real s, real *f, real *slope)`, R entries of f and of slope or NULL.

        C99 for one state (real is double, AT(x, k) is x) or several in the lanes of a GCC vector.
        """
        n, E, first = len(self.curves), range(len(self.envelopes)), 0
        names = [{"z": f"(p[{i}] * s)", "y": f"y{i}", "rate": f"p[{i}]"} for i in range(n)]
        ready = [f"const real y{i} = {CURVES[kind][1].format(**names[i])};" for i, kind in enumerate(self.curves)]
        slopes = [f"({CURVES[kind][2].format(**names[i])})" for i, kind in enumerate(self.curves)]
        found, values, lanes, changes = [], [], [f"AT(g{e}, k) = c[{e}];" for e in E], [[] for _ in E]
        for i, (envelope, curve, size) in enumerate(self.sides):
            w, rate = [f"w{first + a}" for a in range(size)], f"p[{n + i}]"
            found += [f"AT(u{i}, k) = {rate} * (AT(y{curve}, k) - row[k][{i}]);", f"AT(u{i}, k) *= AT(u{i}, k) > 0.0;"]
            lanes += [f"AT({c}, k) = row[k][{len(self.sides)} + {self.polynomials.shape[2]} * r + {c[1:]}];" for c in w]
            values.append(f"const real a{i} = {_horner(w, f'u{i}')} * exp{i}; g{envelope} = g{envelope} + a{i};")
            change = _horner([f"{a}.0 * {w[a]}" for a in range(1, size)] or ["0.0"], f"u{i}")
            changes[envelope].append(f"{rate} * {slopes[curve]} * ({change} * exp{i} - a{i})")
            first += size
        decaying = [f"const real exp{i} = r_exp(-u{i});" for i in range(len(self.sides))]
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


def value_and_slope(function: Callable[[Tensor], Tensor], s: Float[Tensor, " n"]) -> tuple[Tensor, Tensor]:
    """R functions (n, R) of one input and their derivatives, by automatic differentiation."""
    with torch.enable_grad():
        at = s.detach().clone().requires_grad_()
        f = function(at)
        sums = (f + 0.0 * at[:, None]).sum(0).unbind()  # constants have a derivative, too
        return f.detach(), torch.stack([torch.autograd.grad(y, at, retain_graph=True)[0] for y in sums], -1)


def _horner(coefficients: list[str], u: str) -> str:
    return f"({coefficients[0]} + {u} * {_horner(coefficients[1:], u)})" if coefficients[1:] else coefficients[0]


def _times(factors: tuple[int, ...], value: str) -> str:
    return " * ".join([*(f"y{i}" for i in factors), value])


MATERN = {0.5: (1.0,), 1.5: (1.0, 1.0), 2.5: (1.0, 1.0, 1.0 / 3.0)}
"""Smoothness nu -> p with k = sum_a p_a u^a e^-u, u = sqrt(2 nu) r (Rasmussen & Williams 2006, eq. 4.17)."""

FAR = 1e30  # there tanh(s / w) is 1, and s times the derivative of asinh(s / w), for any width w


def one_input_form(
    latent: LatentPosterior,
    index: int,
    coefficients: Float[Tensor, "N R"] | None = None,
    functions: FunctionSamples | None = None,
) -> OneInputFunctions | None:
    """sum_j k(s, s_j) c_jr of one latent, exactly; without coefficients its posterior mean, or S drawn `functions`.

    None where the kernel is not made of `CURVES` and Materns of them, and for functions that have cosines.
    """
    centers = latent.features[index].detach()
    drawn, widening = (functions.terms[index], functions.widening) if functions else ((), 1.0)
    if centers.shape[-1] != 1 or any(term.frequencies for term in drawn):
        return None
    if coefficients is None:
        coefficients = functions.beta[index].mT if functions else latent.weights[index][:, None]
    try:
        terms = kernel_terms(latent.kernels[index])
    except InvalidInput:
        return None
    coefficients, centers = coefficients.detach(), centers[:, 0]
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
        if others or not curve or factor.smoothness not in MATERN:
            return None
        if drawn:
            own = slice(first, first := first + len(grids[number]))
            weights[own] += root * _news(drawn[number]).mT
        polynomial, rate = MATERN[factor.smoothness], math.sqrt(2.0 * factor.smoothness) * abs(amplitude)
        side = list(constants).index(key), curves.setdefault(curve, len(curves)), len(polynomial)
        y = CURVES[curve[0]][0](curve[1] * knots)
        at_knots = torch.zeros_like(weights[: len(knots)]).index_add_(0, place, weights).cpu().numpy()
        h = rate * y.diff().cpu().numpy()
        left, right = _one_side(at_knots, h, polynomial), _one_side(at_knots[::-1], h[::-1], polynomial)[::-1]
        outside = np.zeros_like(left[:1])
        polynomials += [np.concatenate([outside, left]), np.concatenate([right, outside])]
        starts += [torch.cat([y[:1], y]), torch.cat([y, y[-1:]])]
        sides, rates = [*sides, side, side], [*rates, rate, -rate]
    start = torch.stack(starts, dim=-1) if starts else knots.new_zeros(len(knots) + 1, 0)
    pieces = torch.as_tensor(np.concatenate(polynomials, axis=-1), device=knots.device)
    levels, every = torch.stack(list(constants.values()), dim=-1), knots.new_tensor([x for _, x in curves] + rates)
    kinds = tuple(kind for kind, _ in curves)
    return OneInputFunctions(knots, start, pieces, every, levels, kinds, tuple(constants), tuple(sides))


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
    """Coefficients of u^a in sum_j w_j p(u + D_j) e^-D_j over the centres up to each one, D_j away from it."""
    # From one centre to the next, h away, the binomial theorem shifts sum_j w_j D_j^k e^-D_j; all exponentials decay
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
    """Features or an embedding as an amplitude times a curve of rate * s, or times 1 (None); (0, None) if neither."""
    # whatever its class: value and slope at zero and far away give the numbers; values at all widths and centres decide
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


@dataclass(frozen=True, eq=False, kw_only=True)
class OneInputCall(KernelSum):
    """One latent by the pieces of its mean; `pieces_of_roots` are those of the compressed covariance, whole vectors."""

    functions: OneInputFunctions
    pieces_of_roots: OneInputFunctions | None = None

    @classmethod
    def in_pieces(cls, whole: KernelSum, functions: OneInputFunctions) -> "OneInputCall":
        """The same latent as a sum, of which its prior variance is taken."""
        return cls(**{each.name: getattr(whole, each.name) for each in fields(KernelSum)}, functions=functions)

    @property
    @override
    def width(self) -> int:
        return 1

    @override
    def given(self, graph: Graph, z: Sequence[int]) -> list[int]:
        return list(z)

    @override
    def call(self, graph: Graph, z: Sequence[int], slopes: bool) -> list[int]:
        return graph.call(self.name + ("_slopes" if slopes else ""), z, 1, {(0, 0): 1} if slopes else None)

    @override
    def table(self) -> np.ndarray:
        return self.functions.table()

    @override
    def root_table(self) -> np.ndarray:
        assert self.pieces_of_roots is not None, "asked for with a compressed covariance only"
        return self.pieces_of_roots.table()

    @override
    def c_source(self, lanes: int, slopes: bool) -> str:
        name = self.name + ("_slopes" if slopes else "")
        pieces, called = _once(self.functions, "pieces", 1)
        call = f"(void)live; {called}(t, z[0], f, {'f + 1' if slopes else '0'});"
        return f"{pieces}static APART void {name}(const double *t, long live, const real *z, real *f) {{ {call} }}"

    @override
    def roots_source(self, lanes: int, rank: int) -> str:
        assert self.pieces_of_roots is not None, "asked for with a compressed covariance only"
        pieces, called = _once(self.pieces_of_roots, "roots", lanes)
        head = f"static void {self.name}_roots(const double *t, const double *F, const double *z, double *P)"
        return f"{pieces}{head} {{ (void)t; {called}(F, z[0], P, 0); }}"


def latent_calls(latent: LatentPosterior, compressed: CompressedCovariance | None) -> tuple[KernelSum, ...]:
    """The processes as C functions, in the form that suits each. Raises InvalidInput for an untraceable kernel."""
    found: list[KernelSum] = []
    sums = kernel_sums(latent)
    factors = [None] * len(sums) if compressed is None else compressed.factors
    for part, F in zip(sums, factors, strict=True):
        roots = None if F is None else torch.nn.functional.pad(F, (0, -F.shape[-1] % PADDING))
        index = part.latents[0]
        functions = one_input_form(latent, index) if len(part.latents) == 1 else None
        if functions is None:
            found.append(replace(part, roots=roots))
        else:
            pieces = None if roots is None else one_input_form(latent, index, roots[0])
            found.append(replace(OneInputCall.in_pieces(part, functions), pieces_of_roots=pieces))
    return tuple(found)


def drawn_calls(
    latent: LatentPosterior, calls: Sequence[KernelSum], samples: int, seed: int, widening: float
) -> list[tuple[KernelSum, ...]] | None:
    """The functions that `draw_functions` draws, in the forms that `calls` have; None where one has no such form."""
    drawn = draw_functions(latent, samples, seed, widening)
    forms = [(part, one_input_form(latent, part.latents[0], functions=drawn)) for part in calls]
    known = [(part, form) for part, form in forms if form is not None]
    if len(known) < len(forms):
        return None
    return [tuple(OneInputCall.in_pieces(part, form.only(r)) for part, form in known) for r in range(samples)]


def _once(functions: OneInputFunctions, purpose: str, lanes: int) -> tuple[str, str]:
    """The C text, which is skipped where it stands already, and the name of its function."""
    text = functions.c_source("NAME").replace("static void", "static APART void", 1)
    if purpose == "roots" and lanes > 1:  # one state is a double
        text = re.sub(r"AT\((\w+), k\)", r"\1", re.sub(r"\breal\b", "double", text))
        text = re.sub(r"\br_(exp|tanh|asinh|sqrt)\b", r"\1", text.replace("LANES", "1"))
    name = f"{purpose}_{hashlib.sha256(text.encode()).hexdigest()[:8]}"
    return f"#ifndef {name}_\n#define {name}_\n{text.replace('NAME', name)}#endif\n", name
