"""Functions of one input in pieces, stored as one array of numbers that C code reads, and cubic tables of any function.

The array holds, in this order: a header (see `HEADER`), parameters, constants of every function, the first segment of
every bucket, breakpoints, and one row of numbers for every segment, whose functions follow each other. A bucket and a
search among the few breakpoints within it find the segment, so that time does not grow with their number.
"""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import Self, override

HEADER = ("breakpoints", "functions", "low", "high", "buckets", "first", "buckets per unit", "row", "parameters")
"""What the first numbers of a table are; it holds from `low` to `high`, and is NaN elsewhere."""

FARTHEST = sys.float_info.max

TOLERANCE = 1e-8
"""Largest error of a cubic table, relative to the largest value."""

MOST_INTERVALS = 2**15
"""Of a cubic table: 1.5 MB for one function."""

AT_ONCE = 1024
"""Points at which a function is differentiated together: its kernel functions are kept until then."""

SEARCH = """
/* The row of the segment that holds s: as many breakpoints are <= s as rows stand before it. */
static const double *one_input_segment(const double *table, double s) {
  const int breakpoints = (int)table[0], buckets = (int)table[4];
  const double *first = table + 9 + (int)table[8], *knot = first + buckets + 1;
  const double place = (s - table[5]) * table[6];
  const int bucket = place >= buckets ? buckets - 1 : place > 0.0 ? (int)place : 0;
  int low = (int)first[bucket], high = (int)first[bucket + 1];
  while (low < high) {
    const int middle = (low + high) / 2;
    if (s < knot[middle]) high = middle; else low = middle + 1;
  }
  return knot + breakpoints + (int)table[7] * low;
}
"""
"""C text that the text of every `c_source` needs before it, once."""


@dataclass(frozen=True, eq=False)
class OneInputFunctions(ABC):
    """R functions of one input, given on K + 1 segments between and beyond K breakpoints, each of which starts one."""

    knots: Float[Tensor, " K"]
    shared: Float[Tensor, "K+1 _"]  # numbers of a segment that all functions have in common
    own: Float[Tensor, "K+1 R _"]
    parameters: Float[Tensor, " P"]
    constants: Float[Tensor, "R E"]
    low: float
    high: float

    @abstractmethod
    def values(self, s: Float[Tensor, " n"]) -> Float[Tensor, "n R"]:
        """The functions, differentiable in s; NaN where they are not known (`covers`)."""

    @abstractmethod
    def c_source(self, name: str) -> str:
        """`static void name(const double *table, real s, real *f, real *slope)` in C99, for arrays from `table`.

        f and slope hold R entries; slope may be NULL. Functions with the same text differ by their table only. Needs
        <math.h>, `SEARCH`, the type `real`, LANES, AT(x, lane) and r_exp, r_tanh, r_asinh, r_sqrt of a `real`.
        """

    def evaluate(self, s: Float[Tensor, " n"]) -> tuple[Float[Tensor, "n R"], Float[Tensor, "n R"]]:
        """The functions and their derivatives; at a kink that on its right."""
        return value_and_slope(self.values, s)

    def covers(self, s: Float[Tensor, " n"]) -> Tensor:
        """Whether the functions are known at the points."""
        return (s >= self.low) & (s <= self.high)

    def only(self, function: int) -> Self:
        """One of the R functions by itself."""
        one = slice(function, function + 1)
        return replace(self, own=self.own[:, one], constants=self.constants[one])

    def table(self) -> Float[np.ndarray, " _"]:
        """All numbers, for C; they are finite."""
        knots = self.knots.detach().cpu().numpy()
        width, buckets = knots[-1] - knots[0], 2 * len(knots)
        per_unit = buckets / width if width > 0.0 else 0.0
        # By the arithmetic of the C code, which is monotone: rounding moves no point across the bounds of its bucket.
        bucket = np.clip((knots - knots[0]) * per_unit, 0, buckets - 1).astype(int)
        rows = torch.cat([self.shared, self.own.flatten(1)], dim=1)
        parameters = torch.cat([self.parameters, self.constants.flatten()])
        sizes = len(knots), self.own.shape[1], self.low, self.high, buckets, knots[0], per_unit
        header = np.array([*sizes, rows.shape[1], len(parameters)])
        first = np.searchsorted(bucket, np.arange(buckets + 1))
        numbers = [part.detach().cpu().numpy().ravel() for part in (parameters, rows)]
        return np.concatenate([header, numbers[0], first, knots, numbers[1]])


@dataclass(frozen=True, eq=False)
class CubicTable(OneInputFunctions):
    """Piecewise cubic functions with a continuous derivative; `error` is the largest that was found, relative."""

    error: float

    @override
    def values(self, s: Float[Tensor, " n"]) -> Float[Tensor, "n R"]:
        segment = torch.searchsorted(self.knots, s.detach().contiguous(), right=True)
        start, per_unit = self.shared[segment].unbind(-1)
        t = torch.where(self.covers(s), (s - start) * per_unit, torch.nan)[:, None]
        c = self.own[segment]
        return c[..., 0] + t * (c[..., 1] + t * (c[..., 2] + t * c[..., 3]))

    @override
    def c_source(self, name: str) -> str:
        return f"""
static void {name}(const double *table, real s, real *f, real *slope) {{
  const double *row[LANES];
  real t, per_unit;
  for (int k = 0; k < LANES; ++k) {{
    row[k] = one_input_segment(table, AT(s, k));
    const int covered = AT(s, k) >= table[2] && AT(s, k) <= table[3];
    AT(t, k) = covered ? (AT(s, k) - row[k][0]) * row[k][1] : NAN;
    AT(per_unit, k) = row[k][1];
  }}
  for (int r = 0; r < (int)table[1]; ++r) {{
    real a, b, c, d;
    for (int k = 0; k < LANES; ++k) {{
      const double *own = row[k] + 2 + 4 * r;
      AT(a, k) = own[0]; AT(b, k) = own[1]; AT(c, k) = own[2]; AT(d, k) = own[3];
    }}
    f[r] = a + t * (b + t * (c + t * d));
    if (slope) slope[r] = (b + t * (2.0 * c + 3.0 * t * d)) * per_unit;
  }}
}}
"""


def cubic_table(
    function: Callable[[Tensor], Tensor],
    low: float,
    high: float,
    *,
    tolerance: float = TOLERANCE,
    places: Float[Tensor, " _"] | None = None,
) -> CubicTable | None:
    """A table of `function`, s (n,) -> (n, R), from `low` to `high`, which is differentiated at the breakpoints.

    Intervals are halved until the error is at most `tolerance` of the largest value at five points in each, and at
    `places` where the functions may be narrow. None where `MOST_INTERVALS` do not suffice.
    """
    x = torch.linspace(low, high, 33, dtype=torch.float64, device=None if places is None else places.device)
    f, d = value_and_slope(function, x)
    inner = x.new_tensor([0.11, 0.3, 0.5, 0.71, 0.88])
    places = x.new_zeros(0) if places is None else places[(places >= low) & (places <= high)]
    done, largest, error = torch.zeros(len(x) - 1, dtype=torch.bool, device=x.device), f.abs().max(), 0.0
    while True:
        table = _hermite(x, f, d)
        points = torch.cat([(x[:-1, None] + inner * x.diff()[:, None])[~done].flatten(), places])
        inside = torch.searchsorted(x[1:-1].contiguous(), points, right=True)
        points, inside = points[~done[inside]], inside[~done[inside]]
        exact = torch.cat([_plain(function, part) for part in points.split(AT_ONCE)])
        largest = torch.maximum(largest, exact.abs().max())
        found = (table.values(points) - exact).abs().amax(-1)
        worst = torch.zeros_like(done, dtype=x.dtype).scatter_reduce(0, inside, found, "amax")
        good = done | (worst <= tolerance * largest)  # False where NaN
        error = max(error, float(worst[good].max() / largest) if good.any() and largest > 0.0 else 0.0)
        if good.all():
            return replace(table, error=error)
        if len(x) + int((~good).sum()) > MOST_INTERVALS:
            return None
        middles = (0.5 * (x[:-1] + x[1:]))[~good]
        new_f, new_d = value_and_slope(function, middles)
        order = torch.cat([x, middles]).argsort()
        x, f, d = torch.cat([x, middles])[order], torch.cat([f, new_f])[order], torch.cat([d, new_d])[order]
        done = good.repeat_interleave(torch.where(good, 1, 2))


def value_and_slope(function: Callable[[Tensor], Tensor], s: Float[Tensor, " n"]) -> tuple[Tensor, Tensor]:
    """R functions (n, R) of one input and their derivatives, by automatic differentiation."""
    found = []
    for part in s.detach().split(AT_ONCE):
        with torch.enable_grad():
            at = part.clone().requires_grad_()
            f = function(at)
            columns = f.sum(0).unbind() if f.requires_grad else ()  # constant functions do not depend on s
            given = [torch.autograd.grad(column, at, retain_graph=True, allow_unused=True)[0] for column in columns]
        zero = torch.zeros_like(at)
        slopes = [zero if slope is None else slope for slope in given] or [zero] * f.shape[1]
        found.append((f.detach(), torch.stack(slopes, dim=-1)))
    values, slopes = zip(*found, strict=True)
    return torch.cat(values), torch.cat(slopes)


def _plain(function: Callable[[Tensor], Tensor], s: Tensor) -> Tensor:
    with torch.no_grad():
        return function(s)


def _hermite(x: Float[Tensor, " K"], f: Float[Tensor, "K R"], d: Float[Tensor, "K R"]) -> CubicTable:
    h = x.diff()
    step, left, right = f[1:] - f[:-1], h[:, None] * d[:-1], h[:, None] * d[1:]
    own = torch.stack([f[:-1], left, 3.0 * step - 2.0 * left - right, left + right - 2.0 * step], dim=-1)
    shared = torch.stack([x[:-1], 1.0 / h], dim=-1)
    rows = [torch.cat([part[:1], part, part[-1:]]) for part in (shared, own)]  # at its ends the table still holds
    none = x.new_zeros(0), x.new_zeros(f.shape[1], 0)
    return CubicTable(x, *rows, *none, float(x[0]), float(x[-1]), 0.0)
