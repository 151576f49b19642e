"""Non-linear least squares, where the noise of each joint is found along with the coordinates.

Iteratively reweighted: sum_j rows log(sum_n r_nj^2) is least. Accelerations with noise of both kinds have the
covariance diag(sigma_a^2) + H diag(sigma_F^2) H^T. Forces along A^T are integrated out under a flat prior.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from forcegp.errors import NumericalError

ROWS = 2000  # rows that levels are found from at most, evenly spread
LEAST, MOST = 1e-3, 1e2
"""Smallest and largest standard deviation, relative to that of all residuals: where constraints hide directions, a step
of the search that goes further has a covariance that rounding makes singular."""
Rows = Float[np.ndarray, "rows nv"]
Matrices = Float[np.ndarray, "rows nv nv"]


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """Standard deviations per joint: of accelerations [rad/s^2 or m/s^2] and of forces [Nm or N]."""

    acceleration: Float[np.ndarray, " equations"]
    force: Float[np.ndarray, " nv"]

    @classmethod
    def of(
        cls, residual: Rows, M: Matrices, H: Matrices | None = None, near: "NoiseLevels | None" = None
    ) -> "NoiseLevels":
        """Those of largest likelihood, each between `LEAST` and `MOST` times the whole: Fisher scoring of logarithms.

        `H` is that of Gauss' principle under constraints; None is M^-1. The search begins `near` others, if given.
        """
        chosen = np.unique(np.linspace(0, len(residual) - 1, min(ROWS, len(residual))).astype(int))
        inverse = torch.as_tensor(np.linalg.inv(M[chosen]) if H is None else H[chosen])
        r = torch.as_tensor(residual[chosen])
        in_force = (torch.as_tensor(M[chosen]) @ r[..., None])[..., 0]
        whole = torch.stack([x.square().mean(0).sqrt().clamp_min(1e-12) for x in (r, in_force)])
        middle = np.full(whole.numel(), np.log(0.5))
        low, high = np.log(LEAST), np.log(MOST)
        x = middle
        if near is not None:
            x = np.log(np.concatenate([near.acceleration, near.force]) / whole.numpy().ravel()).clip(low, high)

        def at(x: np.ndarray, _: float) -> _Point:
            """With the expected curvature tr(S^-1 dS S^-1 dS') / 2."""
            acceleration, force = whole * torch.as_tensor(x).exp().view_as(whole)
            lower = torch.linalg.cholesky(_covariance(inverse, acceleration, force))
            precision = torch.cholesky_inverse(lower)
            weighted = (precision @ r[..., None])[..., 0]
            # a weak pull to the middle keeps a level that the residuals do not inform from running away
            value = 0.5 * (r * weighted).sum() + lower.diagonal(dim1=-2, dim2=-1).log().sum()
            across = inverse @ precision
            both = across @ inverse
            left = torch.cat([precision.diagonal(dim1=-2, dim2=-1), both.diagonal(dim1=-2, dim2=-1)], -1).sum(0)
            explained = torch.cat([weighted, (inverse @ weighted[..., None])[..., 0]], -1).square().sum(0)
            squares, mixed = torch.cat([acceleration, force]).square(), across.square().sum(0)
            parts = torch.cat([precision.square().sum(0), mixed.mT], 1), torch.cat([mixed, both.square().sum(0)], 1)
            curvature = torch.cat(parts)
            curvature = (2.0 * squares * squares[:, None] * curvature).numpy() + np.eye(len(x))
            slope = (squares * (left - explained)).numpy() + x - middle
            return _Point(x, float(value) + 0.5 * float(((x - middle) ** 2).sum()), slope, curvature)

        x, *_ = _minimized(at, x, (np.array(low), np.array(high)), np.inf, MOST_EVALUATIONS)
        acceleration, force = whole.numpy() * np.exp(x).reshape(whole.shape)
        return cls(acceleration, force)

    def scaled(self, factor: float) -> "NoiseLevels":
        """All levels times this."""
        return NoiseLevels(factor * self.acceleration, factor * self.force)

    def whitening(self, H: Float[np.ndarray, "rows equations nv"]) -> Float[np.ndarray, "rows equations equations"]:
        """L_n^-1 with S_n = L_n L_n^T: residuals times this have the identity as covariance. H as in `of`."""
        S = _covariance(torch.as_tensor(H), torch.as_tensor(self.acceleration), torch.as_tensor(self.force))
        return np.linalg.inv(torch.linalg.cholesky(S).numpy())


def _covariance(inverse: Tensor, acceleration: Tensor, force: Tensor) -> Tensor:
    return torch.diag_embed(acceleration.square()) + (inverse * force.square()) @ inverse.mT


ROUNDS = 16  # most rounds of reweighting
MOST_EVALUATIONS = 300  # of the residuals in one round
CONTENT, ROUGHLY = 0.01, 1.0
"""Two steps in a row that lower the objective by less than so many nats end a round; `ROUGHLY` as noise changes."""
PASSES = 20  # over the noise of residuals, in each round, where unknown forces are left out
LEAST_NOISE = 1e-6  # noise that is this fraction of the residual at the start counts as none: the data are exact
SHARED = 2.0
"""Rows that the level of noise that all joints share, relative to their sizes, counts as where rows are few."""
SETTLED, NEARLY = 1e-3, 0.03
"""Relative change of the noise level that ends them, and one from which on they are no longer rough."""


class Regressor:
    """Derivatives (rows, nv, p) that stay as they are while coordinates change, so their squares are summed once."""

    def __init__(self, values: Float[np.ndarray, "rows nv p"]) -> None:
        self.values = values

    @cached_property
    def squares(self) -> Float[np.ndarray, "nv p p"]:
        """Y_j^T Y_j of every joint."""
        return np.stack([self.values[:, j].T @ self.values[:, j] for j in range(self.values.shape[1])])


@dataclass(frozen=True, eq=False)
class Chained:
    """The Jacobian [Y C, T] (rows, nv, k): of it Y stays, C (p, m) is small, and T (rows, nv, t) has few columns."""

    regressor: Regressor
    inner: Float[np.ndarray, "p m"]
    others: Float[np.ndarray, "rows nv t"]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.concatenate([self.regressor.values @ self.inner, self.others], axis=-1)

    def normal_equations(
        self, white: Rows, noise: Float[np.ndarray, " nv"]
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
        """J^T r and J^T J over the noise, without J, which takes longer to write than all products."""
        Y, p, count = self.regressor.values, len(self.inner), self.others.shape[-1]
        across, squares, slope = np.zeros((p, count)), np.zeros((count, count)), np.zeros(count)
        for joint, level in enumerate(noise):
            shown = np.flatnonzero(self.others[:, joint].any(axis=0))  # most numbers of laws act on one joint
            T, r = self.others[:, joint, shown] / level, white[:, joint]
            across[:, shown] += Y[:, joint].T @ (T / level)
            squares[np.ix_(shown, shown)] += T.T @ T
            slope[shown] += T.T @ r
        own, C, across = np.tensordot(noise**-2.0, self.regressor.squares, 1), self.inner, self.inner.T @ across
        gradient = C.T @ (Y.reshape(white.size, p).T @ (white / noise).ravel())
        return np.concatenate([gradient, slope]), np.block([[C.T @ own @ C, across], [across.T, squares]])


Jacobian = Float[np.ndarray, "rows nv k"] | Chained
Residual = Callable[[np.ndarray], tuple[np.ndarray, Any]]
"""x -> residuals (rows, nv) and `Jacobian` (rows, nv, k); of the prior (p,) and (p, k)."""
Moved = Callable[[np.ndarray, np.ndarray], np.ndarray]
Progress = Callable[[int, float], None]
"""x and a step -> where it leads: x + step to first order."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Where least squares ended.

    `x` (k,), `residual` (rows, nv) and `jacobian` (rows, nv, k), `noise` (nv,), `prior_information` (k, k) and
    `prior_gradient` (k,), of half a square. `span` (rows, nv, m): directions of whitened residuals that unknown forces
    have. `expected`: nats of the last first step.
    """

    x: Float[np.ndarray, " k"]
    residual: Rows
    jacobian: Float[np.ndarray, "rows nv k"]
    noise: Float[np.ndarray, " nv"]
    prior_information: Float[np.ndarray, "k k"]
    prior_gradient: Float[np.ndarray, " k"]
    evaluations: int
    settled: bool
    span: Float[np.ndarray, "rows nv m"] | None = None
    expected: float = 0.0

    @property
    def white(self) -> Rows:
        """Residuals over their noise, without what unknown forces explain."""
        return without(self.residual / self.noise, self.span)

    @property
    def white_jacobian(self) -> Float[np.ndarray, "rows nv k"]:
        """The Jacobian over the noise, without what unknown forces explain."""
        return without(self.jacobian / self.noise[:, None], self.span)

    @cached_property
    def information(self) -> Float[np.ndarray, "k k"]:
        """Gauss-Newton curvature of the data, each residual weighted by its noise."""
        weighted = self.white_jacobian.reshape(-1, len(self.x))
        return weighted.T @ weighted


def weighted_least_squares(
    residual: Residual,
    prior: Residual,
    start: Float[np.ndarray, " k"],
    bounds: tuple[np.ndarray, np.ndarray],
    *,
    longest: Callable[[np.ndarray], np.ndarray] | float = np.inf,
    progress: Progress | None = None,
    held: Float[np.ndarray, "rows m nv"] | None = None,
    known: Float[np.ndarray, " nv"] | None = None,
    evaluations: int = MOST_EVALUATIONS,
    moved: Moved = np.add,
    sizes: Float[np.ndarray, " nv"] | None = None,
    roughly: bool = False,
) -> Fit:
    """Minimise sum_nj (r_nj / sigma_j)^2 + |prior|^2 over x and sigma; `progress(round, rms)` after each round.

    `longest` is the most that a coordinate may change in a step from there. `held` are directions of r that unknown
    forces have, which do not count. `known` is sigma where it is not to be found. A round takes so many `evaluations`.
    Steps follow `moved`: residuals that are as good as linear along it have no curved valleys. With `sizes`, sigma is
    drawn towards one share of these, as if by `SHARED` rows more: of a few rows a joint may be fitted exactly.
    `roughly` ends sooner, within some hundredths of the noise and a nat.
    """
    last: list[tuple[np.ndarray, tuple[np.ndarray, Any]]] = []

    def at(point: np.ndarray) -> tuple[np.ndarray, Any]:
        if not last or not np.array_equal(last[0][0], point):
            last[:] = [(point.copy(), residual(point))]
        return last[0][1]

    low, high = bounds
    x = np.clip(start, low, high)
    r, jacobian = at(x)
    some = slice(None) if held is None else np.unique(np.linspace(0, len(r) - 1, min(ROWS, len(r))).astype(int))
    seen = None if held is None else held[some]
    span = _span(held, np.ones(r.shape[1]))
    noise, total, settled = _noise(r, span) if known is None else known, 0, False
    converged, expected, content = False, 0.0, CONTENT if known is not None else ROUGHLY
    floor = np.maximum((LEAST_NOISE if held is None else LEAST) * noise, np.finfo(np.float64).tiny)
    for round_number in range(1, ROUNDS + 1):
        point = partial(_point, at, prior, noise, _span(held, noise))
        x, nfev, converged, expected = _minimized(point, x, bounds, longest, evaluations, moved, content)
        total += nfev
        r, jacobian = at(x)
        before = noise
        # forces of contacts hide most of it at first
        for _ in range(0 if known is not None else 1 if held is None else PASSES):
            noise = np.maximum(noise * _noise(r[some] / noise, _span(seen, noise)), floor)
        if sizes is not None:
            common = ((noise / sizes) ** 2).mean() * sizes**2
            noise = np.sqrt((len(r) * noise**2 + SHARED * common) / (len(r) + SHARED))
        if progress is not None:
            progress(round_number, float(np.sqrt((without(r, _span(held, np.ones_like(noise))) ** 2).mean())))
        change = float((abs(noise - before) / before).max())
        near = change <= NEARLY
        settled = near if roughly else change <= SETTLED and content < ROUGHLY
        content = CONTENT if near else ROUGHLY
        if settled:
            break
    p, P = prior(x)
    done = total, settled and converged, _span(held, noise), expected
    return Fit(x, r, np.asarray(jacobian), noise, P.T @ P, P.T @ p, *done)


def without(values: Float[np.ndarray, "rows nv *k"], span: Float[np.ndarray, "rows nv m"] | None) -> np.ndarray:
    """The part of every row that is orthogonal to these orthonormal columns (or zeros)."""
    if span is None:
        return values
    flat = values.reshape(*values.shape[:2], -1)
    return (flat - span @ (span.swapaxes(1, 2) @ flat)).reshape(values.shape)


def _span(held: np.ndarray | None, noise: np.ndarray) -> np.ndarray | None:
    """Orthonormal columns for the directions `held` of residuals over this noise."""
    return None if held is None else orthonormal_columns(held / noise)


def orthonormal_columns(directions: Float[np.ndarray, "rows m nv"]) -> Float[np.ndarray, "rows nv m"]:
    """Of the space of these independent rows, the last of which may be zeros."""
    columns = np.linalg.qr(directions.swapaxes(1, 2))[0]
    return columns * (directions != 0.0).any(-1)[:, None, : columns.shape[-1]]


@dataclass(frozen=True, eq=False)
class _Point:
    """Cost, gradient and Gauss-Newton curvature (both halved) at x."""

    x: np.ndarray
    cost: float
    gradient: np.ndarray
    curvature: np.ndarray


def _minimized(
    point: Callable[[np.ndarray, float], _Point],
    x: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    longest: Callable[[np.ndarray], np.ndarray] | float,
    most: int,
    moved: Moved = np.add,
    content: float = CONTENT,
) -> tuple[np.ndarray, int, bool, float]:
    """Levenberg-Marquardt in bounds, on normal equations: x, evaluations, whether it converged, what it expected."""
    # coordinates at a bound that the gradient pushes against stay there for a step; steps are clipped to the bounds
    low, high = bounds
    here, damping, idle, first = point(x, np.inf), 1e-4, 0, None
    for evaluation in range(1, most + 1):
        damped = here.curvature + damping * np.diag(here.curvature.diagonal() + 1e-12)
        step = step_within(here.gradient, damped, low - here.x, high - here.x)
        step /= float((abs(step) / (longest(here.x) if callable(longest) else longest)).max(initial=1.0))
        expected = -float(here.gradient @ step + 0.5 * step @ here.curvature @ step)
        first = expected if first is None else first
        if abs(expected) <= 1e-3 * content or idle == 2:
            return here.x, evaluation, True, first
        trial = point(moved(here.x, step), here.cost)
        gain = (here.cost - trial.cost) / abs(expected)
        if trial.cost < here.cost:
            idle = idle + 1 if here.cost - trial.cost < content else 0
            here = trial
        elif damping > 1e12:  # rounding hides any descent
            return here.x, evaluation, True, first
        # Marquardt's rule: trust the quadratic model more where it was right, less where it was wrong
        damping = max(0.2 * damping, 1e-12) if gain > 0.75 else damping if gain > 0.25 else 5.0 * damping
    return here.x, most, False, first or 0.0


def step_within(gradient: np.ndarray, curvature: np.ndarray, least: np.ndarray, most: np.ndarray) -> np.ndarray:
    """The step to the minimum: what goes too far ends at its bound, and the others go on beside that."""
    step, free = np.zeros_like(gradient), ((least < 0.0) | (gradient < 0.0)) & ((most > 0.0) | (gradient > 0.0))
    while free.any():
        beside = gradient[free] + curvature[np.ix_(free, ~free)] @ step[~free]
        step[free] = -np.linalg.solve(curvature[np.ix_(free, free)], beside)
        within = np.clip(step, least, most)
        if (within == step).all():
            break
        free &= within == step
        step = within
    return step


def _point(
    at: Residual, prior: Residual, noise: np.ndarray, span: np.ndarray | None, x: np.ndarray, best: float = np.inf
) -> _Point:
    bad = _Point(x, np.inf, np.zeros_like(x), np.eye(len(x)))
    with np.errstate(over="ignore", invalid="ignore"):  # a step that went too far is as good as infinitely bad
        try:
            (r, jacobian), (prior_r, prior_jacobian) = at(x), prior(x)
        except (np.linalg.LinAlgError, NumericalError):  # a mass matrix that rounding made singular
            return bad
        white = without(r / noise, span)
        cost = 0.5 * float((white**2).sum() + (prior_r**2).sum())
        if cost >= best:  # a step that is not taken needs no derivatives
            return replace(bad, cost=cost)
        if isinstance(jacobian, Chained) and span is None:
            gradient, curvature = jacobian.normal_equations(white, noise)
        else:
            flat = without(np.asarray(jacobian) / noise[:, None], span).reshape(-1, len(x))
            gradient, curvature = flat.T @ white.ravel(), flat.T @ flat
        gradient, curvature = gradient + prior_jacobian.T @ prior_r, curvature + prior_jacobian.T @ prior_jacobian
    return _Point(x, cost, gradient, curvature) if np.isfinite(cost) and np.isfinite(curvature).all() else bad


def _noise(r: np.ndarray, span: np.ndarray | None) -> np.ndarray:
    left = 1.0 if span is None else np.sqrt(np.maximum(1.0 - (span**2).sum(-1).mean(0), 1e-9))
    # data that the start explains exactly have next to none
    return np.maximum(np.sqrt((without(r, span) ** 2).mean(axis=0)) / left, 1e-12)


def correlation_time(residual: Rows, episode: Int[np.ndarray, " rows"]) -> np.ndarray:
    """Rows that one independent residual is worth, per joint: 1 + 2 sum of autocorrelations until they turn negative.

    The sum ends as Geyer's initial positive sequence does ("Practical Markov chain Monte Carlo", Stat. Science 1992).
    """
    total, times, open_ = (residual**2).sum(0), np.ones(residual.shape[1]), np.ones(residual.shape[1], dtype=bool)
    for lag in range(1, len(residual) - 1, 2):
        pair = np.zeros(residual.shape[1])
        for shift in (lag, lag + 1):
            same = episode[shift:] == episode[:-shift]
            pair += (residual[shift:] * residual[:-shift] * same[:, None]).sum(0) / np.maximum(total, 1e-300)
        open_ &= pair > 0.0
        if not open_.any():
            break
        times += np.where(open_, 2.0 * pair, 0.0)
    return times
