"""The equations of least squares: what rows of logs say of the coordinates of bodies and laws, and means over time."""

from collections.abc import Callable, Sequence
from functools import cached_property, partial

import numpy as np
from jaxtyping import Float

from forcegp.data import Dataset
from forcegp.data.views import SHORTEST, at_rest, postures, rests_alone, runs
from forcegp.errors import InvalidInput
from forcegp.evidence import Accelerations, Torques
from forcegp.evidence.least_squares import Chained, Jacobian, NoiseLevels, Regressor, orthonormal_columns, without
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.evidence.recorded_rows import LikelyAccelerations, Motion, RecordedRows
from forcegp.forces import Actuation
from forcegp.posterior.fitted import STRETCHES

STANDS, LESS = 0.03, 0.7
"""Share of its root mean square velocity below which a joint stands, and of what rows leave elsewhere over what they
leave there, below which they count for less: gears then hold any load, as a controller that integrates leaves it."""
SLIGHT = 0.1  # share of what a joint needs by the start, below which known torques do not tell how much it carries


class Equations:
    """Rows of one log or several as one array each, and the equations that they give at x."""

    def __init__(
        self, space: ParameterSpace, logs: Sequence[Dataset], evidence: Torques | Accelerations, pushed: Sequence[int]
    ) -> None:
        self.space, self.evidence, self.logs = space, evidence, logs
        self.parts = [
            RecordedRows(
                space, log.q, log.v, log.u, loaded=not k, strokes=log.strokes, sensed=log.measured, pushed=pushed
            )
            for k, log in enumerate(logs)
        ]
        self.a = np.concatenate([log.a for log in logs])
        self.ends = np.cumsum([len(log) for log in logs])[:-1]
        self.measured = [part.moving(a) for part, a in zip(self.parts, self.each(self.a), strict=True)]
        held = [part.open if evidence.of_torque else part.held for part in self.parts]
        most = max(each.shape[1] for each in held)  # zeros where a log has fewer directions of contact forces
        self.held = np.concatenate([np.pad(each, ((0, 0), (0, most - each.shape[1]), (0, 0))) for each in held])
        self.links, each = self.parts[0].links, self.parts[0].equations
        if any(part.links != self.links for part in self.parts):
            raise InvalidInput("a baseline needs torque sensors at the same links as the log; leave others out.")
        self.sizes, self.hidden = space.typical["force"][each], self.held[:, :, each]
        """Of the equations of joints and of sensors at links: typical torques, and directions that contacts hide."""
        gains = any(isinstance(space.model.laws[term.law], Actuation) for term in space.terms)
        self.in_units_of_log = gains and not self.held.shape[1]
        seconds = evidence.mean if isinstance(evidence, Torques) else None
        # any numbers explain a few postures
        self.tell_bodies = seconds is not None and not self.links and not all(map(at_rest, logs))
        self.windows = None if seconds is None else WindowMeans(logs, seconds)
        self.weights: np.ndarray | None = None  # of equations; None: 1
        self._stays: tuple[np.ndarray, ...] = ()
        """Regressors of the last search, which no coordinate changes."""
        # what drives deliver is among the known laws, unless their gains are estimated
        known = np.concatenate([part.force + gains * part.delivered + part.at_contacts for part in self.parts])
        slight = np.sqrt(np.square(known).mean(axis=0)) <= (0.0 if gains else SLIGHT) * space.typical["force"]
        free = evidence.of_torque and space.bodies.size and space.model.robot.base == "fixed" and not self.held.shape[1]
        alone = {j: np.eye(known.shape[1])[j] for j in np.flatnonzero(slight & bool(free)).tolist()}
        motions = {j: [self._moving(0.0 * row), self._moving(row)] for j, row in alone.items()}
        inertias = {j: float(self._inertia(space.start, j, own)[0]) for j, own in motions.items()}
        self.passive = {j: (motions[j], inertia) for j, inertia in inertias.items() if inertia > 0.0}
        """Joints without torque: motions at rest and with 1 rad/s^2 of this joint, and the inertia at the start."""

    def each(self, values: np.ndarray) -> list[np.ndarray]:
        """Rows by log."""
        return np.split(values, self.ends)

    def equations(
        self, x: np.ndarray, parts: Sequence[tuple[np.ndarray, ...]], windows: "WindowMeans | None" = None
    ) -> tuple[np.ndarray, Jacobian]:
        """Residuals and their Jacobian in x, from derivatives in standard parameters and coordinates of laws.

        With `windows` means of these, which are taken before the numbers of columns are multiplied.
        """
        r, Y, in_terms = zip(*parts, strict=True)
        residual, mean = np.concatenate(r), np.asarray if windows is None else windows.mean
        if len(Y) != len(self._stays) or any(a is not b for a, b in zip(Y, self._stays, strict=True)):
            flat = mean(np.concatenate(Y).reshape(*residual.shape, 10 * len(self.space.carried)))
            self._stays, self._regressor = Y, Regressor(self._weighted(flat))
        slopes, others = self.space.bodies.slopes(x[: self.space.bodies.size]), mean(np.concatenate(in_terms))
        return self._weighted(mean(residual)), Chained(self._regressor, slopes, self._weighted(others))

    def _weighted(self, values: np.ndarray) -> np.ndarray:
        w = self.weights
        return values if w is None else values * w.reshape(values.shape[:2] + (1,) * (values.ndim - 2))

    def weigh_rests(self, left: Float[np.ndarray, "rows n"]) -> bool:
        """Let rows in which a joint stands count by what they leave, of which these are residuals; whether any do."""
        if self.windows is not None or self.links or self.held.shape[1] or self.passive:
            return False
        left = left if self.weights is None else left / self.weights
        self.weights, self._stays = weights_of_rests(self.logs, left), ()
        return bool((self.weights < 1.0).any())

    def _moving(self, a: Float[np.ndarray, " nv"]) -> list[Motion]:
        return [part.moving(a + 0.0 * part.v) for part in self.parts]

    def _inertia(self, x: np.ndarray, joint: int, motions: Sequence[Sequence[Motion]]) -> np.ndarray:
        """What a joint needs more in the second of two motions, as mean of the rows; then its derivatives in x."""
        means = []
        for motion in motions:
            r, jacobian = self.equations(
                x, [part.in_torque(x, own)[:3] for part, own in zip(self.parts, motion, strict=True)]
            )
            means.append(np.append(r[:, joint].mean(), np.asarray(jacobian)[:, joint].mean(axis=0)))
        return means[1] - means[0]

    def in_torque(self, x: np.ndarray, motions: Sequence[Motion]) -> tuple[np.ndarray, Jacobian]:
        """Torques needed less those measured; beside gains, where contacts hide nothing, as they are logged."""
        # those of passive joints are over their inertia: else they would vanish with the bodies that they move
        found = [part.in_torque(x, motion)[:3] for part, motion in zip(self.parts, motions, strict=True)]
        windows = None if self.held.shape[1] else self.windows
        r, jacobian = self.equations(x, found, windows)
        for joint, (own, first) in self.passive.items():
            jacobian, (inertia, *slopes) = np.asarray(jacobian), self._inertia(x, joint, own) / first
            r[:, joint] /= inertia
            jacobian[:, joint] = (jacobian[:, joint] - r[:, [joint]] * np.array(slopes)) / inertia
        if self.windows is not None and windows is None:
            free = partial(without, span=orthonormal_columns(self.hidden))
            r, jacobian = self.windows.mean(free(r)), self.windows.mean(free(np.asarray(jacobian)))
        return self._as_logged(x, r, np.asarray(jacobian)) if self.in_units_of_log else (r, jacobian)

    def _as_logged(self, x: np.ndarray, r: np.ndarray, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals and their Jacobian over the gains, in units of the log, whose noise no gain changes."""
        # as torques they vanish with the gains and all that is unknown, which no noise would speak against
        column = self.space.bodies.size
        for own, term in zip(self.space.split(x)[1], self.space.terms, strict=True):
            if isinstance(self.space.model.laws[term.law], Actuation):
                places, gains = list(term.joints or ()), np.ones(r.shape[1])
                gains[places] = term.values(own)
                r, jacobian, columns = r / gains, jacobian / gains[:, None], range(column, column + len(places))
                jacobian[:, places, columns] -= r[:, places] * (term.slopes(own) / gains[places])
            column += len(term.size)
        return r, jacobian

    def in_acceleration(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Accelerations measured less those predicted, and the same of IMUs."""
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

    def left(
        self, x: np.ndarray, noise: NoiseLevels | Float[np.ndarray, " nv"]
    ) -> tuple[list[np.ndarray], Callable[[Sequence[np.ndarray]], np.ndarray]]:
        """What is left of the torques of every log, and what makes whitened residuals of derivatives of torques.

        `noise` is that of both kinds, or of what the log has as torque. Neither holds forces of contacts.
        """
        one, motions = np.eye(self.a.shape[1]), self.measured
        free = [without(np.tile(one, (len(part.v), 1, 1)), orthonormal_columns(part.open)) for part in self.parts]
        if isinstance(noise, NoiseLevels):
            likely = [part.likely(x, own, noise) for part, own in zip(self.parts, motions, strict=True)]
            motions, white = [each.motion for each in likely], [each.whitening for each in likely]
        else:
            passive = {j: self._inertia(x, j, own)[0] / first for j, (own, first) in self.passive.items()}
            white = [each / (noise * [passive.get(j, 1.0) for j in range(len(one))])[:, None] for each in free]

        def whitened(columns: Sequence[np.ndarray]) -> np.ndarray:
            each = np.concatenate([W @ own for W, own in zip(white, columns, strict=True)])
            return each if self.windows is None else self.windows.mean(each)

        torques = (part.in_torque(x, own)[0] for part, own in zip(self.parts, motions, strict=True))
        return [(P @ r[..., None])[..., 0] for P, r in zip(free, torques, strict=True)], whitened

    def accelerations(self, x: np.ndarray) -> list[np.ndarray]:
        """Predicted accelerations, M and H."""
        return [np.concatenate(each) for each in zip(*(part.acceleration(x) for part in self.parts), strict=True)]

    def whitening(self, noise: NoiseLevels, H: np.ndarray) -> np.ndarray:
        """Of the residuals of `in_acceleration`."""
        felt = np.concatenate([part.felt for part in self.parts]) @ H
        level = np.concatenate([noise.acceleration, self.parts[0].felt_noise])
        return NoiseLevels(level, noise.force).whitening(np.concatenate([H, felt], axis=1))

    def levels(self, x: np.ndarray, near: NoiseLevels | None, least: NoiseLevels | None, rough: bool) -> NoiseLevels:
        """The noise about the estimates at x, sought `near` others and above `least`."""
        if rough:
            noise = self.parts[0].rough_noise(x, self.each(self.a)[0])
        else:
            predicted, M, H = self.accelerations(x)
            noise = NoiseLevels.of(self.a - predicted, M, H, near)
        if least is None:
            return noise
        return NoiseLevels(np.fmax(noise.acceleration, least.acceleration), np.fmax(noise.force, least.force))

    @cached_property
    def rests(self) -> list[np.ndarray]:
        """Numbers of rows by rest of logs of postures: friction holds the same share as long as a joint stands."""
        found = [rests_alone(log) for log in self.logs]
        found = [postures(log) if each is None else each for each, log in zip(found, self.logs, strict=True)]
        if any(each is None or each.max() >= STRETCHES for each in found):
            return []
        label = np.concatenate([each + STRETCHES * k for k, each in enumerate(found) if each is not None])
        label = label if self.windows is None else label[self.windows.starts]
        return [np.flatnonzero(label == each) for each in np.unique(label)]

    def stretches(self) -> list[np.ndarray]:
        """Numbers of rows by stretch of time, some of each log in every one; of postures each is one."""
        if self.rests:
            return self.rests
        lengths = [len(log) for log in self.logs] if self.windows is None else self.windows.lengths
        starts, numbers = np.concatenate([[0], np.cumsum(lengths)]), []
        for log, start, length in zip(self.logs, starts, lengths, strict=False):
            order = np.lexsort((log.time, log.episode)) if self.windows is None else np.arange(length)
            numbers.append(np.array_split(start + order, min(STRETCHES, sum(lengths))))
        return [each for each in [np.concatenate(each) for each in zip(*numbers, strict=True)] if len(each)]


def weights_of_rests(logs: Sequence[Dataset], left: Float[np.ndarray, "rows nv"]) -> Float[np.ndarray, "rows nv"]:
    """What residuals count for: 1, or less where a joint stands, by what is left there."""
    v, time = (np.concatenate([getattr(log, name) for log in logs]) for name in ("v", "time"))
    stands = np.abs(v) < STANDS * np.sqrt(np.square(v).mean(axis=0))
    for own in stands.T:
        for begin, end in runs(own):
            own[begin:end] = time[end - 1] - time[begin] >= SHORTEST  # else it turns back
    moving, still = (np.sqrt((left**2 * rows).sum(0) / rows.sum(0).clip(1)) for rows in (~stands, stands))
    few = np.minimum(stands.sum(0), (~stands).sum(0)) < STRETCHES
    return np.where(stands & ~few & (moving <= LESS * still), moving / still.clip(1e-300), 1.0)


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
        return np.add.reduceat(values, self.starts, axis=0) / self.roots.reshape(-1, *(1,) * (values.ndim - 1))
