"""Motions by a compiled loop: several in the lanes of vector registers, no Python per step, several threads.

A step calls the C program of the acceleration (`predictor_code`). The implicit step is Newton's method with its exact
Jacobian, shortened where it overshoots. A motion that the loop cannot carry to the end, because it diverges, because
Newton's method fails, or because it leaves the range of a table, is left to `integration`, which decides what it is.
"""

import ctypes
import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.codegen.c_writer import ROWS
from forcegp.codegen.library import in_threads
from forcegp.errors import NumericalWarning
from forcegp.integration.integrators import Integrator
from forcegp.integration.trajectory import SPEED_LIMIT, Trajectory, check_start, integrate, warn_of_divergence

STEPS = {
    "symplectic-euler": """
      PROGRAM(t, live, x, y);
      for (int j = 0; j < N; j++) { a[j] = y[j]; v1[j] = x[N + j] + dt * y[j]; q1[j] = x[j] + dt * v1[j]; }
""",
    "rk4": """
      const double c[4] = {0.0, 0.5 * dt, 0.5 * dt, dt}, b[4] = {dt / 6.0, dt / 3.0, dt / 3.0, dt / 6.0};
      for (int j = 0; j < N; j++) { q0[j] = q1[j] = x[j]; v0[j] = v1[j] = x[N + j]; y[j] = R(0.0); }
      for (int s = 0; s < 4; s++) {
        for (int j = 0; j < N; j++) { x[j] = q0[j] + c[s] * x[N + j]; x[N + j] = v0[j] + c[s] * y[j]; }
        PROGRAM(t, live, x, y);
        for (int j = 0; j < N; j++) {
          if (!s) a[j] = y[j];
          q1[j] += b[s] * x[N + j]; v1[j] += b[s] * y[j];
        }
      }
""",
    "implicit-midpoint": """
      const double h = 0.5 * dt;
      double length[LANES]; int done[LANES];
      for (int j = 0; j < N; j++) { q0[j] = x[j]; v0[j] = m[j] = x[N + j]; d[j] = R(0.0); }
      for (int k = 0; k < LANES; k++) { length[k] = 1.0; done[k] = 0; }
      PROGRAM(t, live, x, y);
      for (int j = 0; j < N; j++) a[j] = y[j];
      for (int round = 0; round < ROUNDS; round++) {
        for (int j = 0; j < N; j++) { x[j] = q0[j] + h * m[j]; x[N + j] = m[j]; }
        PROGRAM(t, live, x, y);
        int left = 0;
        for (int k = 0; k < live; k++) {
          double J[N][N], r[N], turned = 0.0, size = 0.0, step = 0.0, all = 0.0;
          if (done[k]) continue;
          for (int i = 0; i < N; i++) {
            r[i] = -(AT(m[i], k) - AT(v0[i], k) - h * AT(y[i], k));
            for (int j = 0; j < N; j++)
              J[i][j] = (i == j) - h * (AT(y[N + 3 * N * i + N + j], k) + h * AT(y[N + 3 * N * i + j], k));
          }
          for (int p = 0; p < N; p++) {
            int best = p;
            for (int i = p + 1; i < N; i++) if (fabs(J[i][p]) > fabs(J[best][p])) best = i;
            for (int j = 0; j < N; j++) { const double z = J[p][j]; J[p][j] = J[best][j]; J[best][j] = z; }
            const double z = r[p]; r[p] = r[best]; r[best] = z;
            for (int i = p + 1; i < N; i++) {
              const double w = J[i][p] / J[p][p];
              for (int j = p; j < N; j++) J[i][j] -= w * J[p][j];
              r[i] -= w * r[p];
            }
          }
          for (int i = N - 1; i >= 0; i--) {
            for (int j = i + 1; j < N; j++) r[i] -= J[i][j] * r[j];
            r[i] /= J[i][i];
          }
          for (int i = 0; i < N; i++) {
            turned += r[i] * AT(d[i], k); size += AT(d[i], k) * AT(d[i], k);
            step += r[i] * r[i]; all += AT(m[i], k) * AT(m[i], k);
          }
          if (turned < -0.5 * size && length[k] > 1e-4) { /* beyond the root: go back on the same step */
            const double shorter = fmin(fmax(1.0 / (1.0 - turned / size), 0.1), 0.5) * length[k];
            for (int i = 0; i < N; i++) AT(m[i], k) += (shorter - length[k]) * AT(d[i], k);
            length[k] = shorter;
          } else {
            for (int i = 0; i < N; i++) { AT(d[i], k) = r[i]; AT(m[i], k) += r[i]; }
            length[k] = 1.0;
            done[k] = sqrt(step) <= 1e-9 * (1.0 + sqrt(all));
          }
          left |= !done[k];
        }
        if (!left) break;
      }
      for (int j = 0; j < N; j++) { q1[j] = q0[j] + dt * m[j]; v1[j] = 2.0 * m[j] - v0[j]; }
      for (int k = 0; k < live; k++) if (!done[k]) AT(v1[0], k) = NAN;
""",
}
"""One step in C: from x = [q, v, u] to q1, v1, with the acceleration a at its beginning."""

LOOP = """
int evaluate(long first, long last, const double *const *t, long steps, double dt, const double *start_q,
             const double *start_v, const double *u, double *Q, double *V, double *A, long long *ended) {
  enum {N = JOINTS, ROUNDS = 60};
  real x[3 * N], y[OUTPUTS], q1[N], v1[N], a[N], q0[N], v0[N], m[N], d[N];
  (void)q0; (void)v0; (void)m; (void)d;
  for (long i = first; i < last; i += LANES) {
    const long live = last - i < LANES ? last - i : LANES;
    int going = 0;
    for (int k = 0; k < LANES; k++) {
      const long row = k < live ? i + k : last - 1;
      for (int j = 0; j < N; j++) {
        AT(x[j], k) = start_q[row * N + j];
        AT(x[N + j], k) = start_v[row * N + j];
        if (k < live) { Q[row * (steps + 1) * N + j] = AT(x[j], k); V[row * (steps + 1) * N + j] = AT(x[N + j], k); }
      }
      if (k < live) { ended[row] = -1; going |= 1 << k; }
    }
    long stopped = 0;
    for (long s = 0; s < steps && going; s++) {
      stopped = s + 1;
      rows_read(u + (i * steps + s) * N, steps * N, N, live, x + 2 * N);
      real qs[N], vs[N];
      for (int j = 0; j < N; j++) { qs[j] = x[j]; vs[j] = x[N + j]; }
      { STEP }
      real fast = R(0.0), none = R(0.0);
      for (int j = 0; j < N; j++) { fast += v1[j] * v1[j]; none += q1[j] - q1[j]; }
      int usual = going == (1 << live) - 1;
      for (int k = 0; k < live; k++) usual &= AT(fast, k) <= LIMIT * LIMIT && AT(none, k) == 0.0;
      if (usual) {
        for (int j = 0; j < N; j++) { x[j] = q1[j]; x[N + j] = v1[j]; }
        rows_write(q1, N, live, Q + (i * (steps + 1) + s + 1) * N, (steps + 1) * N);
        rows_write(v1, N, live, V + (i * (steps + 1) + s + 1) * N, (steps + 1) * N);
        rows_write(a, N, live, A + (i * steps + s) * N, steps * N);
        continue;
      }
      for (int k = 0; k < live; k++) {
        double *to_q = Q + ((i + k) * (steps + 1) + s + 1) * N, *to_v = V + ((i + k) * (steps + 1) + s + 1) * N;
        int finite = 1, slow = 1;
        const int before = going >> k & 1;
        for (int j = 0; j < N; j++) {
          finite &= AT(q1[j], k) - AT(q1[j], k) == 0.0 && AT(v1[j], k) - AT(v1[j], k) == 0.0;
          slow &= fabs(AT(v1[j], k)) <= LIMIT;
          A[((i + k) * steps + s) * N + j] = before ? AT(a[j], k) : NAN;
        }
        if (before && !(finite && slow)) { going &= ~(1 << k); ended[i + k] = finite ? s + 1 : -2 - (s + 1); }
        for (int j = 0; j < N; j++) {
          const int on = going >> k & 1;
          AT(x[j], k) = on ? AT(q1[j], k) : AT(qs[j], k); /* where it stopped the program can be asked */
          AT(x[N + j], k) = on ? AT(v1[j], k) : AT(vs[j], k);
          to_q[j] = on ? AT(q1[j], k) : NAN;
          to_v[j] = on ? AT(v1[j], k) : NAN;
        }
      }
    }
    for (int k = 0; k < live; k++) for (long s = stopped; s < steps; s++) for (int j = 0; j < N; j++) {
      Q[((i + k) * (steps + 1) + s + 1) * N + j] = V[((i + k) * (steps + 1) + s + 1) * N + j] = NAN;
      A[((i + k) * steps + s) * N + j] = NAN;
    }
  }
  return 0;
}
"""


def loop_source(method: str, function: str, nv: int) -> str:
    """The C function `evaluate` of a loop whose steps call `function`, which for implicit ones gives slopes, too."""
    outputs = nv + 3 * nv**2 if method == "implicit-midpoint" else nv
    text = ROWS + LOOP.replace("STEP", STEPS[method].replace("PROGRAM", function), 1)
    for name, value in (("JOINTS", nv), ("OUTPUTS", outputs), ("LIMIT", repr(SPEED_LIMIT))):
        text = text.replace(name, str(value))
    return text


def fused(
    loops: "Sequence[FusedLoop]",
    method: Integrator,
    acceleration: Callable[[Tensor, Tensor, Tensor], Tensor],
    q: Float[Tensor, "n nv"],
    v: Float[Tensor, "n nv"],
    u: Float[Tensor, "steps n nv"],
    dt: float,
    threads: int,
    what: str = "motions",
) -> Trajectory:
    """`integrate`, by compiled loops; each takes as many motions as the others, one after the other.

    Motions that a loop could not finish are integrated again, with those of the other loops from the same place.
    """
    check_start(v, dt)
    own, count, forces = len(q) // len(loops), len(q), u.movedim(0, 1)
    places = [slice(own * k, own * (k + 1)) for k in range(len(loops))]
    parts = [loop(q[at], v[at], forces[at], dt, threads) for loop, at in zip(loops, places, strict=True)]
    Q, V, A, ended = parts[0] if len(parts) == 1 else map(torch.cat, zip(*parts, strict=True))
    not_found = torch.zeros(count, dtype=torch.bool)
    left = torch.nonzero((ended < -1).view(-1, own).any(0))[:, 0]
    if len(left):
        rows = (own * torch.arange(len(loops))[:, None] + left).flatten()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericalWarning)  # given below, of all motions
            again = integrate(method, acceleration, q[rows], v[rows], u[:, rows], dt)
        for kept, found in ((Q, again.q), (V, again.v), (A, again.a)):
            kept[rows] = found.movedim(0, 1)
        ended[rows], not_found[rows] = again.diverged_at, again.not_found
    warn_of_divergence(ended, not_found, method.failure, dt, what)
    return Trajectory(Q.movedim(1, 0), V.movedim(1, 0), A.movedim(1, 0), ended, not_found)


class Motions(NamedTuple):
    """q, v (..., T+1, nv) in rad and rad/s (m and m/s), a (..., T, nv) in rad/s^2 (m/s^2), as in a `Rollout`.

    `diverged_at` (...) is the row from which on a motion is NaN because it diverged, -1 if it lasted to the end.
    """

    q: Tensor
    v: Tensor
    a: Tensor
    diverged_at: Tensor


class FusedLoop:
    """`evaluate` of a loaded library; `tables` are those of the functions that it calls."""

    def __init__(self, library: ctypes.CDLL, tables: Sequence[Tensor]) -> None:
        self.library, self._held = library, tuple(tables)
        self._tables = (ctypes.c_void_p * max(len(tables), 1))(*(x.data_ptr() for x in tables))
        self._evaluate = library.evaluate
        self._evaluate.argtypes = (
            [ctypes.c_long] * 2 + [ctypes.c_void_p, ctypes.c_long, ctypes.c_double] + [ctypes.c_void_p] * 7
        )

    def __call__(
        self, q: Tensor, v: Tensor, u: Tensor, dt: float, threads: int
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """q, v (n, T + 1, nv), a (n, T, nv) from states (n, nv) under forces (n, T, nv), and where motions stopped.

        (n,) -1 for those that lasted, the row from which on a motion is NaN for those that became too fast, and -2 less
        that row for those that the loop could not carry on.
        """
        n, steps, nv = u.shape
        Q, V = torch.empty(2, n, steps + 1, nv, dtype=torch.float64).unbind()
        A, ended = torch.empty(n, steps, nv, dtype=torch.float64), torch.empty(n, dtype=torch.int64)
        given = [x.contiguous() for x in (q, v, u)]
        pointers = [x.data_ptr() for x in (*given, Q, V, A, ended)]
        parts = max(1, min(threads, n // 8))
        bounds = [8 * (n * k // parts // 8) for k in range(parts)] + [n]

        def part(k: int) -> int:
            return self._evaluate(bounds[k], bounds[k + 1], self._tables, steps, dt, *pointers)

        in_threads(part, parts)
        return Q, V, A, ended
