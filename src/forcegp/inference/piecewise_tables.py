"""R functions of one input s in pieces, kept as one array of numbers that C code reads.

    f_r(s) = sum_e envelope_e(s) (c_re + sum_i w_ri(u_i) exp(-u_i)),   u_i = rate_i (y_i(s) - start_i)

An envelope is a product of curves y(s) (`CURVES`). Every segment has its own starts and polynomials w; a binary search
finds it. Without the exponential, and with w of degree 3, it is a cubic table of any function.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

TOLERANCE = 1e-8
MOST_INTERVALS = 2**15  # of a cubic table: 2 MB for one function
AT_ONCE = 1024  # points at which a function is differentiated together: its kernel functions are kept until then
FARTHEST = sys.float_info.max

CURVES: dict[str, tuple[Callable[[Tensor], Tensor], str, str]] = {
    "identity": (lambda z: z, "{z}", "{rate}"),
    "tanh": (torch.tanh, "r_tanh({z})", "{rate} * (1.0 - {y} * {y})"),
    "asinh": (torch.asinh, "r_asinh({z})", "{rate} / r_sqrt(1.0 + {z} * {z})"),
}
"""y as a function of z = rate * s: in torch, in C, and its derivative to s in C."""

SEARCH = """
/* The row of numbers of the segment of s: as many breakpoints are <= s as rows stand before it. */
static const double *one_input_segment(const double *table, double s) {
  const double *knot = table + 6 + (int)table[5];
  int low = 0, high = (int)table[0];
  while (low < high) {
    const int middle = (low + high) / 2;
    if (s < knot[middle]) high = middle; else low = middle + 1;
  }
  return knot + (int)table[0] + (int)table[4] * low;
}
"""
"""C text that the texts of `OneInputFunctions.c_source` need before them, once."""


class Side(NamedTuple):
    """One polynomial w of `size` coefficients, of the distance on a curve, times an envelope."""

    envelope: int
    curve: int
    size: int
    decays: bool = True


@dataclass(frozen=True, eq=False)
class OneInputFunctions:
    """R functions on K + 1 segments; known from `low` to `high` and NaN elsewhere, where the caller has to evaluate.

    `error` is the largest that was found while it was made, relative to the largest value: 0 for exact forms.
    """

    knots: Float[Tensor, " K"]
    starts: Float[Tensor, "K+1 I"]
    polynomials: Float[Tensor, "K+1 R W"]
    rates: Float[Tensor, " _"]  # of the curves, then of the sides
    constants: Float[Tensor, "R E"]
    curves: tuple[str, ...]
    envelopes: tuple[tuple[int, ...], ...]
    sides: tuple[Side, ...]
    low: float = -FARTHEST
    high: float = FARTHEST
    error: float = 0.0

    def evaluate(self, s: Float[Tensor, " n"]) -> tuple[Float[Tensor, "n R"], Float[Tensor, "n R"]]:
        """The functions and their derivatives; at a kink that to the right."""
        return value_and_slope(self.values, s)

    def values(self, s: Float[Tensor, " n"]) -> Float[Tensor, "n R"]:
        """The functions, differentiable in s."""
        segment = torch.searchsorted(self.knots, s.detach().contiguous(), right=True)
        s = s * torch.where((s >= self.low) & (s <= self.high), 1.0, torch.nan).to(s)
        y = [CURVES[kind][0](rate * s) for kind, rate in zip(self.curves, self.rates, strict=False)]
        levels, first = list(self.constants.mT[:, None].unbind()), 0
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
        """K, R, low, high, sizes of a row and of rates and constants; these, knots, a row per segment; all finite."""
        parameters = torch.cat([self.rates, self.constants.flatten()])
        rows = torch.cat([self.starts, self.polynomials.flatten(1)], dim=1)
        header = [len(self.knots), len(self.constants), self.low, self.high, rows.shape[1], len(parameters)]
        return torch.cat([rows.new_tensor(header), parameters, self.knots, rows.flatten()]).cpu().numpy()

    def c_source(self, name: str) -> str:
        """`static void name(const double *table, real s, real *f, real *slope)`, R entries of f and of slope or NULL.

        Functions of the same text differ by their tables only. Plain C99 for one state, where `real` is double and
        AT(x, k) is x, and for several in the lanes of a GCC vector; needs <math.h>, `SEARCH`, r_exp, r_tanh, ...
        """
        n, E, first = len(self.curves), range(len(self.envelopes)), 0
        names = [{"z": f"(p[{i}] * s)", "y": f"y{i}", "rate": f"p[{i}]"} for i in range(n)]
        ready = [f"const real y{i} = {CURVES[kind][1].format(**names[i])};" for i, kind in enumerate(self.curves)]
        slopes = [f"({CURVES[kind][2].format(**names[i])})" for i, kind in enumerate(self.curves)]
        found, values = ["row[k] = one_input_segment(table, AT(s, k)); (void)row;"], []
        lanes, changes = [f"AT(g{e}, k) = c[{e}];" for e in E], [[] for _ in E]
        for i, (envelope, curve, size, decays) in enumerate(self.sides):
            w, rate, decay = [f"w{first + a}" for a in range(size)], f"p[{n + i}]", f"exp{i}" if decays else "1.0"
            found += [f"AT(u{i}, k) = {rate} * (AT(y{curve}, k) - row[k][{i}]);", f"AT(u{i}, k) *= AT(u{i}, k) > 0.0;"]
            lanes += [f"AT({c}, k) = row[k][{len(self.sides)} + {self.polynomials.shape[2]} * r + {c[1:]}];" for c in w]
            values.append(f"const real a{i} = {_horner(w, f'u{i}')} * {decay}; g{envelope} = g{envelope} + a{i};")
            change = _horner([f"{a}.0 * {w[a]}" for a in range(1, size)] or ["0.0"], f"u{i}")
            changes[envelope].append(f"{rate} * {slopes[curve]} * ({change} * {decay}{f' - a{i}' * decays})")
            first += size
        decays = [f"const real exp{i} = r_exp(-u{i});" for i, side in enumerate(self.sides) if side.decays]
        slope = [_times(self.envelopes[e], f"({' + '.join(part)})") for e, part in enumerate(changes) if part]
        for e, factors in enumerate(self.envelopes):
            slope += [f"{slopes[i]} * {_times(factors[:k] + factors[k + 1 :], f'g{e}')}" for k, i in enumerate(factors)]
        real = [f"u{i}" for i in range(len(self.sides))], [f"g{e}" for e in E] + [f"w{i}" for i in range(first)]
        return f"""
static void {name}(const double *table, real s, real *f, real *slope) {{
  const double *p = table + 6, *row[LANES];
  for (int k = 0; k < LANES; ++k) if (!(AT(s, k) >= table[2] && AT(s, k) <= table[3])) AT(s, k) = NAN;
  {" ".join(ready)}
  {f"real {', '.join(real[0])};" * bool(self.sides)}
  for (int k = 0; k < LANES; ++k) {{ {" ".join(found)} }}
  {" ".join(decays)}
  for (int r = 0; r < (int)table[1]; ++r) {{
    const double *c = p + {len(self.rates)} + {len(E)} * r;
    real {", ".join(real[1])};
    for (int k = 0; k < LANES; ++k) {{ {" ".join(lanes)} }}
    {" ".join(values)}
    f[r] = {" + ".join(_times(factors, f"g{e}") for e, factors in enumerate(self.envelopes))};
    if (slope) slope[r] = {" + ".join(slope) or "g0 - g0"};
  }}
}}
"""


def cubic_table(
    function: Callable[[Tensor], Tensor], low: float, high: float, tolerance: float, places: Float[Tensor, " _"]
) -> OneInputFunctions | None:
    """Cubic polynomials between values and slopes of `function`, s (n,) -> (n, R), with a continuous derivative.

    Intervals are halved until the error at five points of each, and at `places` where the functions may be narrow, is
    at most `tolerance` of the largest value. None where `MOST_INTERVALS` do not suffice.
    """
    x, done = torch.linspace(low, high, 33).to(places), torch.zeros(32, dtype=torch.bool, device=places.device)
    inner = x.new_tensor([0.11, 0.3, 0.5, 0.71, 0.88])
    f, d, error = *value_and_slope(function, x), x.new_zeros(())
    while True:
        table = _hermite(x, f, d)
        points = torch.cat([(x[:-1, None] + inner * x.diff()[:, None])[~done].flatten(), places])
        inside = torch.searchsorted(x[1:-1].contiguous(), points, right=True)
        points, inside = points[~done[inside]], inside[~done[inside]]
        with torch.no_grad():
            exact = torch.cat([function(part) for part in points.split(AT_ONCE)])
        largest = torch.cat([f, exact]).abs().max()
        worst = x.new_zeros(len(done)).scatter_reduce(0, inside, (table.values(points) - exact).abs().amax(1), "amax")
        done |= worst <= 0.5 * tolerance * largest  # half: it may be larger in between; False where NaN
        error = torch.maximum(error, worst[done].max() / largest) if done.any() and largest > 0.0 else error
        if done.all():
            return replace(table, error=float(error))
        if len(x) > MOST_INTERVALS:
            return None
        middles = (0.5 * (x[:-1] + x[1:]))[~done]
        at, (new_f, new_d) = torch.cat([x, middles]), value_and_slope(function, middles)
        x, order = at.sort()
        f, d, done = torch.cat([f, new_f])[order], torch.cat([d, new_d])[order], done.repeat_interleave(2 - done.int())


def value_and_slope(function: Callable[[Tensor], Tensor], s: Float[Tensor, " n"]) -> tuple[Tensor, Tensor]:
    """R functions (n, R) of one input and their derivatives, by automatic differentiation."""
    found = []
    for part in s.detach().split(AT_ONCE):
        with torch.enable_grad():
            at = part.clone().requires_grad_()
            f = function(at)
            sums = (f + 0.0 * at[:, None]).sum(0).unbind()  # constants have a derivative, too
            slopes = [torch.autograd.grad(column, at, retain_graph=True)[0] for column in sums]
        found.append((f.detach(), torch.stack(slopes, dim=-1)))
    values, slopes = zip(*found, strict=True)
    return torch.cat(values), torch.cat(slopes)


def _hermite(x: Float[Tensor, " K"], f: Float[Tensor, "K R"], d: Float[Tensor, "K R"]) -> OneInputFunctions:
    h = x.diff()[:, None]
    step, left, right = (f[1:] - f[:-1]) / h, d[:-1], d[1:]
    w = torch.stack([f[:-1], left, (3.0 * step - 2.0 * left - right) / h, (left + right - 2.0 * step) / h**2], dim=-1)
    rows = [torch.cat([part[:1], part, part[-1:]]) for part in (x[:-1, None], w)]  # at `high` it is still known
    one, none = x.new_ones(2), x.new_zeros(f.shape[1], 1)
    sides = (Side(0, 0, 4, decays=False),)
    return OneInputFunctions(x, *rows, one, none, ("identity",), ((),), sides, float(x[0]), float(x[-1]))


def _horner(coefficients: list[str], u: str) -> str:
    return f"({coefficients[0]} + {u} * {_horner(coefficients[1:], u)})" if coefficients[1:] else coefficients[0]


def _times(factors: tuple[int, ...], value: str) -> str:
    return " * ".join([*(f"y{i}" for i in factors), value])
