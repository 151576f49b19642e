"""Rows of several logs as equations in the coordinates of one search, and the link that carries a payload."""

from collections.abc import Sequence
from functools import partial

import numpy as np
from jaxtyping import Float

from forcegp.data import Dataset
from forcegp.evidence import Accelerations, Torques
from forcegp.evidence.least_squares import Chained, Jacobian, NoiseLevels, Regressor, without
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.evidence.recorded_rows import LikelyAccelerations, Motion, RecordedRows
from forcegp.posterior.fitted import STRETCHES
from forcegp.robots import Robot

CLEARLY = 10.0
"""Nats by which another link must explain more than the usual one."""


def _usual_link(robot: Robot) -> str:
    """A base that moves, else of the last joint the last link of the file.

    Joints that move several bodies, as those of fingers, count as none, if there are others: what fingers hold moves
    with the hand.
    """
    if robot.base != "fixed":
        return robot.layout.moving[0]
    last = max(_alone(robot), default=len(robot.layout.bodies) - 1)
    return [name for name, place in robot.layout.links.items() if place.body == last][-1]


def possible_links(robot: Robot) -> tuple[str, ...]:
    """The usual one, then those behind which chains of joints end or part: hands, feet, trunks."""
    usual, children = _usual_link(robot), np.bincount([body for body in robot.layout.parents if body >= 0])
    ends = [body for body in _alone(robot) if body >= len(children) or children[body] != 1]
    at_usual = robot.layout.links[usual].body
    return (usual, *(robot.layout.bodies[body].child for body in ends if body != at_usual))


def most_likely(
    payloads: Float[np.ndarray, "windows nv links 10"],
    residual: Float[np.ndarray, "windows nv"],
    others: Float[np.ndarray, "windows nv k"],
) -> int:
    """The place of the link whose payload, with the `others`, leaves least of the residual, if it weighs something.

    Joints are weighted by what payloads on all links together leave. The first link is taken but where another one
    explains `CLEARLY` more.
    """
    all_of_them = np.concatenate([others, payloads.reshape(*residual.shape, -1)], axis=-1)
    noise = np.ones(residual.shape[1])
    for _ in range(3):  # weights change what is left, a little
        left = left_by_least_squares(all_of_them / noise[:, None], residual / noise)[0] * noise
        noise = np.sqrt((left**2).mean(0)).clip(1e-9 * np.sqrt((residual**2).mean()) + 1e-300)
    costs = []
    for k in range(payloads.shape[2]):
        columns = np.concatenate([payloads[:, :, k], others], axis=-1)
        left, found = left_by_least_squares(columns / noise[:, None], residual / noise)
        costs.append(0.5 * float((left**2).sum()) if found[0] > 0.0 or k == 0 else np.inf)
    best = int(np.argmin(costs))
    return best if costs[best] < costs[0] - CLEARLY else 0


def left_by_least_squares(
    columns: Float[np.ndarray, "windows nv k"], residual: Float[np.ndarray, "windows nv"]
) -> tuple[Float[np.ndarray, "windows nv"], Float[np.ndarray, " k"]]:
    """What least squares leave of the residual, and by which numbers."""
    flat = columns.reshape(-1, columns.shape[-1])
    size = np.linalg.norm(flat, axis=0).clip(1e-300)
    found = np.linalg.lstsq(flat / size, -residual.ravel(), rcond=1e-10)[0] / size
    return residual + columns @ found, found


def _alone(robot: Robot) -> Sequence[int]:
    """Bodies with links whose joint moves no other one."""
    drives = [drive.joint for drive in robot.layout.drives]
    solid = {place.body for place in robot.layout.links.values()}
    return [body for body, joint in enumerate(drives) if drives.count(joint) == 1 and body in solid]


class Equations:
    """Rows of one log or several as one array each, and the equations that they give at x."""

    def __init__(self, space: ParameterSpace, logs: Sequence[Dataset], evidence: Torques | Accelerations) -> None:
        self.space, self.evidence, self.logs = space, evidence, logs
        self.parts = [RecordedRows(space, log.q, log.v, log.u, loaded=not k) for k, log in enumerate(logs)]
        self.a = np.concatenate([log.a for log in logs])
        self.ends = np.cumsum([len(log) for log in logs])[:-1]
        self.measured = [part.moving(a) for part, a in zip(self.parts, self.each(self.a), strict=True)]
        self.held = _stacked([part.held for part in self.parts])
        seconds = evidence.mean if isinstance(evidence, Torques) else None
        self.windows = None if seconds is None else WindowMeans(logs, seconds)
        self._stays: tuple[np.ndarray, ...] = ()
        """Regressors of the last search, which no coordinate changes."""

    def each(self, values: np.ndarray) -> list[np.ndarray]:
        """Rows by log."""
        return np.split(values, self.ends)

    def joined(self, parts: Sequence[tuple[np.ndarray, ...]]) -> list[np.ndarray]:
        """Arrays of all logs."""
        return [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]

    def equations(self, x: np.ndarray, parts: Sequence[tuple[np.ndarray, ...]]) -> tuple[np.ndarray, Jacobian]:
        """Residuals and their Jacobian in x, from derivatives in standard parameters and coordinates of laws."""
        r, Y, in_terms = zip(*parts, strict=True)
        if len(Y) != len(self._stays) or any(a is not b for a, b in zip(Y, self._stays, strict=True)):
            flat = np.concatenate(Y).reshape(*self.a.shape, 10 * len(self.space.carried))
            self._stays, self._regressor = Y, Regressor(flat)
        slopes = self.space.bodies.slopes(x[: self.space.bodies.size])
        return np.concatenate(r), Chained(self._regressor, slopes, np.concatenate(in_terms))

    def in_torque(self, x: np.ndarray, motions: Sequence[Motion]) -> tuple[np.ndarray, Jacobian]:
        """Torques needed less those measured."""
        found = [part.in_torque(x, motion)[:3] for part, motion in zip(self.parts, motions, strict=True)]
        r, jacobian = self.equations(x, found)
        if self.windows is None:
            return r, jacobian
        free = partial(without, span=self.held.swapaxes(1, 2) if self.held.shape[1] else None)
        return self.windows.mean(free(r)), self.windows.mean(free(np.asarray(jacobian)))

    def in_acceleration(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Accelerations measured less those predicted."""
        found = [part.in_acceleration(x, a) for part, a in zip(self.parts, self.each(self.a), strict=True)]
        r, jacobian = self.equations(x, found)
        return r, np.asarray(jacobian)

    def whitened(self, x: np.ndarray, likely: Sequence[LikelyAccelerations]) -> tuple[np.ndarray, Jacobian]:
        """Torques needed less those measured, over the noise of both."""
        found = []
        for part, each in zip(self.parts, likely, strict=True):
            r, Y, in_terms, _ = part.in_torque(x, each.motion)
            Y = each.white_regressor if Y is each.motion.regressor else each.white(Y)
            found.append(((each.whitening @ (r + each.offset)[..., None])[..., 0], Y, each.whitening @ in_terms))
        r, jacobian = self.equations(x, found)
        if self.windows is None:
            return r, jacobian
        return self.windows.mean(r), self.windows.mean(np.asarray(jacobian))

    def accelerations(self, x: np.ndarray) -> list[np.ndarray]:
        """Predicted accelerations, M and H."""
        return self.joined([part.acceleration(x) for part in self.parts])

    def levels(
        self, x: np.ndarray, near: NoiseLevels | None, least: NoiseLevels | None, robust: bool, rough: bool
    ) -> NoiseLevels:
        """The noise about the estimates at x, sought `near` others and above `least`."""
        if rough:
            noise = self.parts[0].rough_noise(x, self.each(self.a)[0])
        else:
            predicted, M, H = self.accelerations(x)
            noise = NoiseLevels.of(self.a - predicted, M, H, near, robust)
        if least is None:
            return noise
        return NoiseLevels(np.fmax(noise.acceleration, least.acceleration), np.fmax(noise.force, least.force))

    def stretches(self) -> list[np.ndarray]:
        """Numbers of equations by stretch of time, some of each log in every one."""
        lengths = [len(log) for log in self.logs] if self.windows is None else self.windows.lengths
        nv, starts = self.a.shape[1], np.concatenate([[0], np.cumsum(lengths)])
        numbers = []
        for log, start, length in zip(self.logs, starts, lengths, strict=False):
            order = np.arange(length)
            if self.windows is None:
                order = np.lexsort((log.time, log.episode))
            numbers.append(np.array_split(start + order, min(STRETCHES, sum(lengths))))
        rows = [np.concatenate(each) for each in zip(*numbers, strict=True)]
        return [(nv * each[:, None] + np.arange(nv)).ravel() for each in rows if len(each)]


class WindowMeans:
    """Means over windows of time, times the root of their rows, so that white noise keeps its size."""

    def __init__(self, logs: Sequence[Dataset], seconds: float) -> None:
        number = np.concatenate([np.full(len(log), k) for k, log in enumerate(logs)])
        episode, time = (np.concatenate([getattr(log, name) for log in logs]) for name in ("episode", "time"))
        keys = np.stack([number, episode, np.floor(time / seconds)])
        self.starts = np.flatnonzero(np.r_[True, (np.diff(keys) != 0).any(axis=0)])
        self.roots = np.sqrt(np.diff(np.r_[self.starts, len(time)]))
        self.lengths = np.bincount(number[self.starts]).tolist()
        """Windows of every log."""

    def mean(self, values: np.ndarray) -> np.ndarray:
        """(rows, ...) as (windows, ...)."""
        sums = np.add.reduceat(values, self.starts, axis=0)
        return sums / self.roots.reshape(-1, *(1,) * (values.ndim - 1))


def _stacked(held: Sequence[np.ndarray]) -> np.ndarray:
    """Directions of contact forces of all logs, as many in every row: zeros where a log has fewer."""
    most = max(each.shape[1] for each in held)
    return np.concatenate([np.pad(each, ((0, 0), (0, most - each.shape[1]), (0, 0))) for each in held])
