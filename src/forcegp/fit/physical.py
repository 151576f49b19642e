"""The numbers of laws and bodies from all rows of a log: Gauss-Newton steps of weighted least squares."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from forcegp.data import Dataset, evenly, with_memory
from forcegp.data.views import one_row_per_rest
from forcegp.doubts import Doubts
from forcegp.errors import InvalidInput, require_type
from forcegp.evidence import Accelerations, Torques
from forcegp.evidence.bodies import thickened
from forcegp.evidence.least_squares import LEAST, ROUNDS, Fit, NoiseLevels, Progress, weighted_least_squares
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.fit.doubts import doubts_of_memory
from forcegp.fit.equations import Equations
from forcegp.fit.payloads import changes_without_rests, doubts_of_payloads, misfit, with_payloads_placed
from forcegp.fit.unseen import Unseen
from forcegp.forces import Payload
from forcegp.model import Model
from forcegp.noise import Noise
from forcegp.posterior.fitted import Estimates
from forcegp.progress import tell

ROWS = 5_000  # rows that are used at most, evenly spread: more of a filtered recording add little
EQUATIONS = 40_000  # as many rows hold these equations, one per degree of freedom, at most
ROUGH_EQUATIONS = 7_000  # where a search begins, or is rough among accelerations: they take thrice the time of torques
WINDOWED, PER_WINDOW = 2_000, 10
"""Of means over windows so many rows are enough, or so many in each: half a second of a filtered log has few more."""
REWEIGHTINGS = 2  # searches in which accelerations are weighted by noise of both kinds, and rests by what they leave
SEARCHES = 20
"""Most searches where forces and accelerations are both noisy, each about the accelerations of the last one."""
STEPS = 6
"""Evaluations in each, since the next one begins with other accelerations; twice as many after a search in vain."""
Search = Callable[..., Fit]
REACHED, ROUGHER = 0.02, 20.0
"""Nats per coordinate that a step is to gain: each is within a fifth of its error; times that, where noise is all."""


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

    The search begins `near` a solution of the same model on other rows; `roughly` ends it sooner, without estimates.
    """
    bodies = any(getattr(law, "learn", ()) or (isinstance(law, Payload) and not law.known) for law in model.laws)
    robot, thick = thickened(model.robot) if bodies else (model.robot, ())
    model = replace(model, robot=robot)
    most, seconds = min(ROWS, EQUATIONS // robot.nv), evidence.mean if isinstance(evidence, Torques) else None
    if seconds:
        most = min(most, max(WINDOWED, int(PER_WINDOW * max(np.ptp(log.time) for log in logs) / seconds)))
    logs = [with_memory(log, model) for log in logs]
    model = with_payloads_placed(model, logs)
    if robot.space.is_vector_space and evidence.of_torque and not evidence.noisy_in_both:
        logs = [one_row_per_rest(log) for log in logs]
    some = ROUGH_EQUATIONS // robot.nv
    if rows is None and not seconds and max(map(len, logs)) > some:
        rows = some if roughly and not evidence.of_torque else None
        near = near or (None if rows else fit_physical(model, logs, evidence, some, roughly=True))
    logs = [log.rows(evenly(log, most if rows is None else rows)) for log in logs]
    typical = typical_sizes(model, logs) if near is None else near.typical
    space, unseen = ParameterSpace(model, typical), Unseen.of(model, logs[0], typical["force"])
    equations = Equations(space, logs, evidence, unseen.pushed)
    held = equations.hidden if evidence.of_torque and equations.held.shape[1] and equations.windows is None else None
    if held is not None and not unseen.pushed and held.any(-1).sum(1).min() == robot.nv:
        raise InvalidInput("contacts hold every degree of freedom in every row, so no equation is left to learn from.")
    history: list[float] = []

    def note(done: int, rms: float) -> None:
        history.append(rms)
        tell(min(done, ROUNDS), ROUNDS, f"all rows, step {done}: {rms:.3g}")

    options: dict[str, Any] = {"roughly": roughly, **space.steps}
    options["sizes"] = equations.sizes if all(len(log) == len(log.episodes) > 2 for log in logs) else None
    search = partial(weighted_least_squares, prior=space.prior, bounds=space.bounds, **options)
    noise, x, changes = None, space.start if near is None else near.x, None
    torque = partial(equations.in_torque, motions=equations.measured)
    if evidence.noisy_in_both:
        fit, noise = _with_noise_in_both(equations, search, x, note, rough=near is None, roughly=roughly)
    elif evidence.of_torque:
        fit = search(torque, start=x, held=held, progress=note)
        for _ in range(REWEIGHTINGS):
            if equations.weigh_rests(fit.residual):
                fit = search(torque, start=fit.x, held=held, progress=note)
        if options["sizes"] is not None and held is None and equations.rests:
            changes = changes_without_rests(search, torque, space, fit.x, equations.rests)
    else:
        if near is None:  # torques lead into the neighbourhood with a tenth of the work
            first = equations.in_acceleration if equations.held.shape[1] else torque
            x = search(first, start=x, roughly=True, progress=note).x
        fit, noise = _with_accelerations_weighted(equations, search, x, note)
        for _ in range(1, REWEIGHTINGS):
            fit, noise = _with_accelerations_weighted(equations, search, fit.x, note)
    found, residual = space.model_at(fit.x), equations.a - equations.accelerations(fit.x)[0]
    doubts = list(doubts_of_memory(space, fit.x))
    cause = None  # noise of single rows hides what is left
    if equations.tell_bodies and any(each.payload is not None for each in space.carried):
        gains = found.actuation.values["gain"].cpu().numpy() if equations.in_units_of_log else 1.0
        left = equations.left(fit.x, fit.noise * gains if noise is None else noise)
        cause = misfit(found, equations.parts, equations.each(equations.a), *left, fit)
        bodies = list(doubts_of_payloads(space, fit, -np.inf if cause is None else cause[2]))
        doubts += bodies or ([] if cause is None or cause[0] is None else [cause[0]])
    move = None if cause is None else cause[1]
    estimates = Estimates() if roughly else _estimates(space, fit, equations, evidence, thick, changes, move)
    doubts += unseen.doubts(model)
    Doubts(doubts).warn(stacklevel=4)
    told, level = tuple(doubt.to_dict() for doubt in doubts), model.noise
    if evidence.of_torque and model.contacts and noise is None:
        noise = unseen.levels(equations.a, equations.accelerations(fit.x), equations.held, fit.noise[: robot.nv])
    if level is None or level.learn or level.acceleration is None:
        found_levels = Noise(tuple(np.sqrt((residual**2).mean(0)).clip(1e-12)))
        level = found_levels if noise is None else Noise(tuple(noise.acceleration), tuple(noise.force))
        level = unseen.with_pushes(level)
    return Solution(found, estimates, level, with_memory(logs[0], found), tuple(history), fit.x, typical, told)


def _with_accelerations_weighted(
    equations: Equations, search: Search, x: np.ndarray, note: Progress
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
    equations: Equations, search: Search, x: np.ndarray, note: Progress, *, rough: bool = True, roughly: bool = False
) -> tuple[Fit, NoiseLevels]:
    """Searches about likely accelerations, whose levels of noise are found along; `rough` where x may be far off."""
    reached = REACHED * len(x) * (ROUGHER if roughly and not rough else 1.0)
    noise, least, number, evaluations, steps = None, None, 0, 0, STEPS
    while True:
        number += 1
        levels = equations.levels(x, noise, least, rough)
        likely = [part.likely(x, m, levels) for part, m in zip(equations.parts, equations.measured, strict=True)]
        if not rough:
            noise, least = levels, levels.scaled(LEAST) if least is None else least
        # its whitening holds levels of noise and weights, without forces of contacts
        known = np.ones_like(equations.sizes)
        fit = search(partial(equations.whitened, likely=likely), start=x, known=known, evaluations=steps)
        evaluations += fit.evaluations
        steps, x = STEPS if (fit.x != x).any() else 2 * steps, fit.x
        note(number, float(np.sqrt((fit.white**2).mean())))
        settled = number > 1 and fit.expected <= reached
        if noise is not None and (settled or number == SEARCHES):
            return replace(fit, evaluations=evaluations, settled=settled), noise
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
    white = np.concatenate([fit.white_jacobian, fit.white[..., None]], axis=-1)
    columns = np.arange(white.shape[1])  # equations of a row: of joints, and of sensors
    prior, by_body = space.prior(fit.x)[1], None
    everything = len(space.carried) == len(space.own) and all(each.payload is None for each in space.carried)
    if everything and space.carried:
        # of ten directions of each body, those of which the data hold less than the prior, as if others were known
        G, weak = prior.T @ prior, {}
        for body, each in enumerate(space.carried):
            own = slice(10 * body, 10 * body + 10), slice(10 * body, 10 * body + 10)
            weak[each.name] = int((np.linalg.eigvalsh(fit.information[own]) < np.linalg.eigvalsh(G[own]).mean()).sum())
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
    needed, measured, *moved = (np.sqrt((x**2).mean(0)) for x in (needed, delivered, v, a))
    each = (np.maximum(needed, measured), *moved)  # of a joint that is still as of one that hardly moves
    torque, velocity, change = (np.maximum(x, 1e-3 * max(float(x.max()), 1e-9)) for x in each)
    mass = np.maximum(mass, torque / change) if a.any() else mass
    position = state.positions.cpu().numpy()
    position = np.maximum(np.sqrt((position**2).mean(0)), 1e-3)
    return {"force": torque, "velocity": velocity, "inertia": mass, "position": position}


STRETCHES_LEFT_OUT = 4  # stretches of time that logs of fewer than three episodes are cut into
EPISODES_LEFT_OUT = 6  # groups of episodes, at most: a log that rests cut into pieces has dozens


def held_out_noise(model: Model, dataset: Dataset, evidence: Torques | Accelerations) -> Noise:
    """Noise of accelerations and forces about models identified without the rows in question.

    Residuals of the rows that parameters were fitted to are too small for others, so every stretch is predicted by a
    model identified from the rest (block cross-validation; Burman, Chow & Nolan 1994): episodes, where there are three
    or more, `EPISODES_LEFT_OUT` groups at most, else `STRETCHES_LEFT_OUT` of time. Raises InvalidInput for few rows.
    """
    require_type("model", model, Model)
    dataset = with_memory(require_type("dataset", dataset, Dataset), model)
    residuals, masses, mobilities, near, some = [], [], [], None, 2 * ROUGH_EQUATIONS // model.robot.nv
    for left_out in _left_out(dataset):
        kept = np.ones(len(dataset), dtype=bool)
        kept[left_out] = False
        near = fit_physical(model, [dataset.rows(kept)], evidence, rows=some, near=near, roughly=True)
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
    if len(known := np.array(dataset.episodes)) >= 3:
        groups = [known[k::EPISODES_LEFT_OUT] for k in range(min(EPISODES_LEFT_OUT, len(known)))]
        return [np.flatnonzero(np.isin(dataset.episode, group)) for group in groups]
    if len(dataset) < 2 * STRETCHES_LEFT_OUT:
        raise InvalidInput(f"the log has {len(dataset)} rows; held-out noise needs {2 * STRETCHES_LEFT_OUT} or more.")
    return np.array_split(np.lexsort((dataset.time, dataset.episode)), STRETCHES_LEFT_OUT)
