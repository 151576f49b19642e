"""R functions of one input s in pieces, kept as one array of numbers that C code reads.

    f_r(s) = sum_e envelope_e(s) (c_re + sum_i w_ri(u_i) exp(-u_i)),   u_i = rate_i (y_i(s) - start_i)

An envelope is a product of curves y(s) (`CURVES`). Every segment has its own starts and polynomials w; a bucket and a
search within it find it. Without the exponential, and with w of degree 3, it is a cubic table of any function.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

MOST_INTERVALS = 2**15
AT_ONCE = 256  # points at which a function is differentiated together: its kernel functions are kept until then

CURVES: dict[str, tuple[Callable[[Tensor], Tensor], str, str]] = {
    "identity": (lambda z: z, "{z}", "{rate}"),
    "tanh": (torch.tanh, "r_tanh({z})", "{rate} * (1.0 - {y} * {y})"),
    "asinh": (torch.asinh, "r_asinh({z})", "{rate} / r_sqrt(1.0 + {z} * {z})"),
}
"""y as a function of z = rate * s: in torch, in C, and its derivative to s in C."""


@dataclass(frozen=True, eq=False)
class OneInputFunctions:
    """R functions on K + 1 segments; known from `low` to `high` and NaN elsewhere, where the caller has to evaluate.

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

    def evaluate(self, s: Float[Tensor, " n"]) -> tuple[Float[Tensor, "n R"], Float[Tensor, "n R"]]:
        """The functions and their derivatives; at a kink that to the right."""
        return value_and_slope(self.values, s)

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

    def only(self, r: int) -> OneInputFunctions:
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
        return f"""
static void {name}(const double *table, real s, real *f, real *slope) {{
  const double *p = table + 8, *bucket = p + (int)table[5], *row[LANES];
  const int knots = (int)table[0], buckets = 2 * knots;
  const double *knot = bucket + buckets + 1;
  for (int k = 0; k < LANES; ++k) {{
    if (!(AT(s, k) >= table[2] && AT(s, k) <= table[3])) AT(s, k) = NAN;
    const double place = (AT(s, k) - table[6]) * table[7];
    const int b = place >= buckets ? buckets - 1 : place > 0.0 ? (int)place : 0;
    int low = (int)bucket[b], high = (int)bucket[b + 1]; /* as many knots are <= s as rows stand before its own */
    while (low < high) {{ const int m = (low + high) / 2; if (AT(s, k) < knot[m]) high = m; else low = m + 1; }}
    row[k] = knot + knots + (int)table[4] * low; (void)row;
  }}
  {" ".join(ready)}
  {" ".join(f"real u{i};" for i in range(len(self.sides)))}
  for (int k = 0; k < LANES; ++k) {{ {" ".join(found)} }}
  {" ".join(decaying)}
  for (int r = 0; r < (int)table[1]; ++r) {{
    const double *c = p + {len(self.rates)} + {len(E)} * r;
    real {", ".join([f"g{e}" for e in E] + [f"w{i}" for i in range(first)])};
    for (int k = 0; k < LANES; ++k) {{ {" ".join(lanes)} }}
    {" ".join(values)}
    f[r] = {" + ".join(_times(factors, f"g{e}") for e, factors in enumerate(self.envelopes))};
    if (slope) slope[r] = {" + ".join(slope) or "g0 - g0"};
  }}
}}
"""


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
