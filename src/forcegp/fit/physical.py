"""The numbers of laws and bodies from all rows of a log: Gauss-Newton steps of weighted least squares."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from forcegp.data import Dataset, evenly, with_memory
from forcegp.data.views import at_rest, one_row_per_rest, postures, rests_alone
from forcegp.doubts import Doubts
from forcegp.errors import InvalidInput, require_type
from forcegp.evidence import Accelerations, Torques
from forcegp.evidence.bodies import thickened
from forcegp.evidence.least_squares import (
    LEAST,
    ROUNDS,
    Chained,
    Fit,
    Jacobian,
    NoiseLevels,
    Regressor,
    orthonormal_columns,
    weighted_least_squares,
    without,
)
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.evidence.recorded_rows import LikelyAccelerations, Motion, RecordedRows
from forcegp.fit.doubts import doubts_of_memory
from forcegp.fit.payloads import changes_without_rests, doubts_of_payloads, misfit, with_payloads_placed
from forcegp.fit.unseen import Unseen
from forcegp.forces import Actuation, Payload
from forcegp.model import Model
from forcegp.noise import Noise
from forcegp.posterior.fitted import STRETCHES, Estimates
from forcegp.progress import tell


class Equations:
    """Rows of one log or several as one array each, and the equations that they give at x."""

    def __init__(
        self,
        space: ParameterSpace,
        logs: Sequence[Dataset],
        evidence: Torques | Accelerations,
        pushed: Sequence[int] = (),
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
        self._stays: tuple[np.ndarray, ...] = ()
        """Regressors of the last search, which no coordinate changes."""
        robot, logged = space.model.robot, np.concatenate([part.delivered for part in self.parts])
        idle = evidence.of_torque and space.bodies.size and robot.base == "fixed" and not self.held.shape[1]
        alone = {j: row for j, row in enumerate(np.eye(robot.nv)) if idle and not logged[:, j].any()}
        motions = {j: [self._moving(0.0 * row), self._moving(row)] for j, row in alone.items()}
        self.passive = {j: (own, self._inertia(space.start, j, own)[0]) for j, own in motions.items()}
        """Joints without any torque: motions at rest and with 1 rad/s^2 of this joint, and the inertia at the start."""

    def each(self, values: np.ndarray) -> list[np.ndarray]:
        """Rows by log."""
        return np.split(values, self.ends)

    def equations(self, x: np.ndarray, parts: Sequence[tuple[np.ndarray, ...]]) -> tuple[np.ndarray, Jacobian]:
        """Residuals and their Jacobian in x, from derivatives in standard parameters and coordinates of laws."""
        r, Y, in_terms = zip(*parts, strict=True)
        residual = np.concatenate(r)
        if len(Y) != len(self._stays) or any(a is not b for a, b in zip(Y, self._stays, strict=True)):
            flat = np.concatenate(Y).reshape(*residual.shape, 10 * len(self.space.carried))
            self._stays, self._regressor = Y, Regressor(flat)
        slopes = self.space.bodies.slopes(x[: self.space.bodies.size])
        return residual, Chained(self._regressor, slopes, np.concatenate(in_terms))

    def _moving(self, a: Float[np.ndarray, " nv"]) -> list[Motion]:
        """All rows with these accelerations."""
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
        """Torques needed less those measured; beside gains, where contacts hide nothing, as they are logged.

        Those of passive joints are over their inertia: else they would vanish with the bodies that they move.
        """
        found = [part.in_torque(x, motion)[:3] for part, motion in zip(self.parts, motions, strict=True)]
        r, jacobian = self.equations(x, found)
        for joint, (own, first) in self.passive.items():
            jacobian, (inertia, *slopes) = np.asarray(jacobian), self._inertia(x, joint, own) / first
            r[:, joint] /= inertia
            jacobian[:, joint] = (jacobian[:, joint] - r[:, [joint]] * np.array(slopes)) / inertia
        if self.windows is not None:
            free = partial(without, span=orthonormal_columns(self.hidden) if self.held.shape[1] else None)
            r, jacobian = self.windows.mean(free(r)), self.windows.mean(free(np.asarray(jacobian)))
        return self._as_logged(x, r, np.asarray(jacobian)) if self.in_units_of_log else (r, jacobian)

    def _as_logged(self, x: np.ndarray, r: np.ndarray, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals and their Jacobian over the gains, in units of the log, whose noise no gain changes.

        As torques they vanish with the gains and all that is unknown, which no noise would speak against.
        """
        column = self.space.bodies.size
        for own, term in zip(self.space.split(x)[1], self.space.terms, strict=True):
            if isinstance(self.space.model.laws[term.law], Actuation):
                places, gains = list(term.joints or ()), np.ones(r.shape[1])
                gains[places] = term.values(own)
                r, jacobian = r / gains, jacobian / gains[:, None]
                columns = range(column, column + len(places))
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
        starts = np.concatenate([[0], np.cumsum(lengths)])
        numbers = []
        for log, start, length in zip(self.logs, starts, lengths, strict=False):
            order = np.lexsort((log.time, log.episode)) if self.windows is None else np.arange(length)
            numbers.append(np.array_split(start + order, min(STRETCHES, sum(lengths))))
        rows = [np.concatenate(each) for each in zip(*numbers, strict=True)]
        return [each for each in rows if len(each)]


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


ROWS = 5_000
"""Rows that are used at most, evenly spread: more of a filtered recording add little."""
EQUATIONS = 40_000
"""As many rows hold these equations, one per degree of freedom, at most."""
REWEIGHTINGS = 2
"""Searches in which accelerations are weighted by noise of both kinds."""
SEARCHES = 20
"""Most searches where forces and accelerations are both noisy, each about the accelerations of the last one."""
STEPS = 6
"""Evaluations in each, since the next one begins with other accelerations; twice as many after a search in vain."""
REACHED = 0.02
"""They end where a step is to lower the cost by fewer nats per coordinate: each is within a fifth of its error."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the search ended: the model with its numbers, what they are worth, and the noise about it."""

    model: Model
    estimates: Estimates
    noise: Noise
    rows: Dataset
    history: tuple[float, ...]
    x: Float[np.ndarray, " k"]
    """Its coordinates, and the sizes that they relate to."""
    typical: dict[str, Float[np.ndarray, " nv"]]
    doubts: tuple[dict[str, Any], ...] = ()
    """What speaks against it, as JSON."""


def fit_physical(
    model: Model,
    logs: Sequence[Dataset],
    evidence: Torques | Accelerations,
    rows: int | None = None,
    near: Solution | None = None,
    roughly: bool = False,
) -> Solution:
    """The open numbers of a model without unknown forces; of several logs payloads are in the first alone.

    The search begins `near` a solution of the same model on other rows, if given; `roughly` ends it sooner.
    """
    bodies = any(getattr(law, "learn", ()) or (isinstance(law, Payload) and not law.known) for law in model.laws)
    robot, thick = thickened(model.robot) if bodies else (model.robot, ())
    model = replace(model, robot=robot)
    most = min(ROWS, EQUATIONS // robot.nv) if rows is None else rows
    logs = [with_memory(log, model) for log in logs]
    model = with_payloads_placed(model, logs)
    if robot.space.is_vector_space and evidence.of_torque and not evidence.noisy_in_both:
        logs = [one_row_per_rest(log) for log in logs]
    logs = [log.rows(evenly(log, most)) for log in logs]
    typical = typical_sizes(model, logs) if near is None else near.typical
    space = ParameterSpace(model, typical)
    unseen = Unseen.of(model, logs[0], typical["force"])
    equations = Equations(space, logs, evidence, unseen.pushed)
    held = equations.hidden if evidence.of_torque and equations.held.shape[1] and equations.windows is None else None
    if held is not None and not unseen.pushed and held.any(-1).sum(1).min() == robot.nv:
        raise InvalidInput("contacts hold every degree of freedom in every row, so no equation is left to learn from.")
    history: list[float] = []

    def note(done: int, rms: float) -> None:
        history.append(rms)
        tell(min(done, ROUNDS), ROUNDS, f"all rows, step {done}: {rms:.3g}")

    options: dict[str, Any] = {"longest": space.longest_steps, "moved": space.moved, "roughly": roughly}
    options["sizes"] = equations.sizes if all(len(log) == len(log.episodes) > 2 for log in logs) else None
    search = partial(weighted_least_squares, prior=space.prior, bounds=space.bounds, **options)
    noise, x, changes = None, space.start if near is None else near.x, None
    torque = partial(equations.in_torque, motions=equations.measured)
    if evidence.noisy_in_both:
        fit, noise = _with_noise_in_both(equations, search, x, note)
    elif evidence.of_torque:
        fit = search(torque, start=x, held=held, progress=note)
        if options["sizes"] is not None and held is None and equations.rests:
            changes = changes_without_rests(search, torque, space, fit.x, equations.rests)
    else:
        if near is None:  # torques lead into the neighbourhood with a tenth of the work
            first = equations.in_acceleration if equations.held.shape[1] else torque
            x = search(first, start=x, roughly=True, progress=note).x
        fit, noise = _with_accelerations_weighted(equations, search, x, note)
        for _ in range(1, REWEIGHTINGS):
            fit, noise = _with_accelerations_weighted(equations, search, fit.x, note)
    found = space.model_at(fit.x)
    residual = equations.a - equations.accelerations(fit.x)[0]
    doubts = list(doubts_of_memory(space, fit.x))
    cause = None  # noise of single rows hides what is left
    if equations.tell_bodies and any(each.payload is not None for each in space.carried):
        gains = found.actuation.values["gain"].cpu().numpy() if equations.in_units_of_log else 1.0
        left = equations.left(fit.x, fit.noise * gains if noise is None else noise)
        cause = misfit(found, equations.parts, equations.each(equations.a), *left, fit)
        bodies = list(doubts_of_payloads(space, fit, -np.inf if cause is None else cause[2]))
        doubts += bodies if bodies or cause is None else [cause[0]]
    estimates = _estimates(space, fit, equations, evidence, thick, changes, None if cause is None else cause[1])
    doubts += unseen.doubts(model)
    Doubts(doubts).warn(stacklevel=4)
    told = tuple(doubt.to_dict() for doubt in doubts)
    level = model.noise
    if evidence.of_torque and model.contacts and noise is None:
        noise = unseen.levels(equations.a, equations.accelerations(fit.x), equations.held, fit.noise[: robot.nv])
    if level is None or level.learn or level.acceleration is None:
        found_levels = Noise(tuple(np.sqrt((residual**2).mean(0)).clip(1e-12)))
        level = found_levels if noise is None else Noise(tuple(noise.acceleration), tuple(noise.force))
        level = unseen.with_pushes(level)
    found_rows = with_memory(logs[0], found)
    return Solution(found, estimates, level, found_rows, tuple(history) or (0.0,), fit.x, typical, told)


def _with_accelerations_weighted(
    equations: Equations, search: Callable[..., Fit], x: np.ndarray, note: Callable[[int, float], None]
) -> tuple[Fit, NoiseLevels]:
    """A search among accelerations that the noise of both kinds about x weights."""
    predicted, M, H = equations.accelerations(x)
    noise = NoiseLevels.of(equations.a - predicted, M, H)
    W = equations.whitening(noise, H)

    def white(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r, jacobian = equations.in_acceleration(x)
        return (W @ r[..., None])[..., 0], W @ jacobian

    return search(white, start=x, progress=note), noise


def _with_noise_in_both(
    equations: Equations, search: Callable[..., Fit], x: np.ndarray, note: Callable[[int, float], None]
) -> tuple[Fit, NoiseLevels]:
    """Searches about likely accelerations, whose levels of noise are found along."""
    noise, least, number, evaluations, steps, rough = None, None, 0, 0, STEPS, True
    while True:
        number += 1
        levels = equations.levels(x, noise, least, rough)
        likely = [
            part.likely(x, motion, levels) for part, motion in zip(equations.parts, equations.measured, strict=True)
        ]
        if not rough:
            noise, least = levels, levels.scaled(LEAST) if least is None else least
        # its whitening holds levels of noise and weights, without forces of contacts
        known = np.ones_like(equations.sizes)
        fit = search(partial(equations.whitened, likely=likely), start=x, known=known, evaluations=steps)
        evaluations += fit.evaluations
        steps, x = STEPS if (fit.x != x).any() else 2 * steps, fit.x
        note(number, float(np.sqrt((fit.white**2).mean())))
        reached = number > 1 and fit.expected <= REACHED * len(x)
        if noise is not None and (reached or number == SEARCHES):
            return replace(fit, evaluations=evaluations, settled=reached), noise
        rough = rough and fit.expected > len(x) and number < SEARCHES // 2


def _estimates(
    space: ParameterSpace,
    fit: Fit,
    equations: Equations,
    evidence: Torques | Accelerations,
    thick: tuple[str, ...],
    changes: np.ndarray | None,
    move: np.ndarray | None,
) -> Estimates:
    """The numbers at the end of the search."""
    white = np.concatenate([fit.white_jacobian, fit.white[..., None]], axis=-1)
    columns = np.arange(white.shape[1])  # equations of a row: of joints, and of sensors
    prior = space.prior(fit.x)[1]
    by_body = None
    everything = len(space.carried) == len(space.own) and all(each.payload is None for each in space.carried)
    if everything and space.carried:
        # of ten directions of each body, those of which the data hold less than the prior, as if others were known
        G, weak = prior.T @ prior, {}
        for body, each in enumerate(space.carried):
            own = slice(10 * body, 10 * body + 10), slice(10 * body, 10 * body + 10)
            few = np.linalg.eigvalsh(fit.information[own]) < np.linalg.eigvalsh(G[own]).mean()
            weak[each.name] = int(few.sum())
        by_body = {name: count for name, count in sorted(weak.items(), key=lambda entry: -entry[1]) if count}
    return Estimates.of_search(
        space.parameters,
        space.numbers(fit.x),
        space.number_slopes(fit.x),
        white.reshape(-1, white.shape[-1]),
        [(len(columns) * rows[:, None] + columns).ravel() for rows in equations.stretches()],
        prior,
        changes,
        move,
        by_body=by_body,
        evidence=str(evidence),
        rows=len(equations.a),
        evaluations=fit.evaluations,
        settled=fit.settled,
        thickened=thick,
    )


def typical_sizes(model: Model, logs: Sequence[Dataset]) -> dict[str, Float[np.ndarray, " nv"]]:
    """Sizes of forces, positions, velocities and inertias of each joint in these rows, to which coordinates relate.

    Forces are the larger of those measured and of inverse dynamics, inertia at least what they accelerate: rotors.
    """
    q, v, u, a = (np.concatenate([getattr(log, x) for log in logs]) for x in "qvua")
    at_q, at_v, at_u = (torch.as_tensor(x, device=model.robot.device) for x in (q, v, u))
    state = model.state(at_q, at_v, at_u)
    kinematics, delivered = state.kinematics, state.delivered.cpu().numpy()
    needed = kinematics.inverse_dynamics(torch.as_tensor(a, device=model.robot.device)).cpu().numpy()
    mass = model.mass_matrix(state).diagonal(dim1=-2, dim2=-1).mean(0).cpu().numpy()
    needed, measured, speed = (np.sqrt((x**2).mean(0)) for x in (needed, delivered, v))
    torque, velocity = (np.maximum(x, 1e-3 * max(float(x.max()), 1e-9)) for x in (np.maximum(needed, measured), speed))
    mass = np.maximum(mass, torque / np.maximum(np.sqrt((a**2).mean(0)), 1e-12)) if a.any() else mass
    position = state.positions.cpu().numpy()
    position = np.maximum(np.sqrt((position**2).mean(0)), 1e-3)
    return {"force": torque, "velocity": velocity, "inertia": mass, "position": position}


STRETCHES_LEFT_OUT = 4
"""Stretches of time that logs of fewer than three episodes are cut into."""


def held_out_noise(model: Model, dataset: Dataset, evidence: Torques | Accelerations) -> Noise:
    """Noise of accelerations and forces about models identified without the rows in question.

    Residuals of the rows that parameters were fitted to are too small for others, so every stretch is predicted by a
    model identified from the rest (block cross-validation; Burman, Chow & Nolan 1994): episodes, where there are three
    or more, else `STRETCHES_LEFT_OUT` stretches of time. Raises InvalidInput for too few rows.
    """
    require_type("model", model, Model)
    dataset = with_memory(require_type("dataset", dataset, Dataset), model)
    residuals, masses, mobilities, near = [], [], [], None
    for left_out in _left_out(dataset):
        kept = np.ones(len(dataset), dtype=bool)
        kept[left_out] = False
        near = fit_physical(model, [dataset.rows(kept)], evidence, near=near, roughly=True)
        found = near.model
        rows = with_memory(dataset.rows(left_out), found)
        q, v, u = (torch.tensor(x, device=found.robot.device) for x in (rows.q, rows.v, rows.u))
        dynamics = found.dynamics(q, v, u)
        residuals.append(rows.a - dynamics.acceleration_map().offset.cpu().numpy())
        masses.append(dynamics.M.cpu().numpy())
        mobilities.append(dynamics.H.cpu().numpy())
    levels = NoiseLevels.of(np.concatenate(residuals), np.concatenate(masses), np.concatenate(mobilities))
    return Noise(tuple(levels.acceleration), tuple(levels.force))


def _left_out(dataset: Dataset) -> list[np.ndarray]:
    """Row numbers of each stretch."""
    if len(dataset.episodes) >= 3:
        return [np.flatnonzero(dataset.episode == number) for number in dataset.episodes]
    if len(dataset) < 2 * STRETCHES_LEFT_OUT:
        raise InvalidInput(f"the log has {len(dataset)} rows; held-out noise needs {2 * STRETCHES_LEFT_OUT} or more.")
    return np.array_split(np.lexsort((dataset.time, dataset.episode)), STRETCHES_LEFT_OUT)
