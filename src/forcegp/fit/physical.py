"""The numbers of laws and bodies from all rows of a log: weighted least squares, or maximum likelihood.

Torque is linear in the parameters of bodies and in most coefficients, so a few Gauss-Newton steps find them
(`forcegp.evidence.least_squares`). What is minimised is chosen by the evidence: `Torques`, `Accelerations`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from forcegp.data import Dataset, evenly
from forcegp.doubts import Doubt, Doubts
from forcegp.errors import DatasetError, InvalidInput, require_type
from forcegp.evidence import Accelerations, Torques
from forcegp.evidence.bodies import thickened
from forcegp.evidence.identifiability import BaseParameters, parameter_names
from forcegp.evidence.least_squares import LEAST, Fit, NoiseLevels, weighted_least_squares, without
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.fit.doubts import doubts_of_base, doubts_of_no_body, doubts_of_offsets
from forcegp.fit.equations import Equations, most_likely, possible_links
from forcegp.forces import Payload
from forcegp.model import Model
from forcegp.noise import Noise
from forcegp.posterior.fitted import STRETCHES, Estimates
from forcegp.robots import Robot

ROWS = 5_000
"""Rows that are used at most, evenly spread: more of a filtered recording add little."""
EQUATIONS = 40_000
"""As many rows hold these equations, one per degree of freedom, at most."""
REWEIGHTINGS = 2
"""Searches in which accelerations are weighted by noise of both kinds, after one in which each joint has its own."""
SEARCHES = 20
"""Most searches where forces and accelerations are both noisy, each about the accelerations of the last one."""
STEPS = 6
"""Evaluations in each, since the next one begins with other accelerations; twice as many after a search in vain."""
REACHED = 0.02
"""They end where a step is to lower the cost by fewer nats per coordinate: each is within a fifth of its error."""
FEWEST = 10 * STRETCHES
"""Rows that a payload needs."""

Progress = Callable[[int, float], None]
"""Called as progress(round, rms of the residual)."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the search ended: the model with its numbers, what they are worth, and the noise about it."""

    model: Model
    estimates: Estimates
    noise: Noise
    rows: Dataset
    history: tuple[float, ...]
    x: Float[np.ndarray, " k"]
    """Its coordinates."""


def fit_physical(
    model: Model,
    logs: Sequence[Dataset],
    evidence: Torques | Accelerations,
    rows: int | None = None,
    progress: Progress | None = None,
) -> Solution:
    """The open numbers of a model without unknown forces; of several logs payloads are in the first alone."""
    bodies = any(getattr(law, "learn", ()) or (isinstance(law, Payload) and not law.known) for law in model.laws)
    robot, thick = thickened(model.robot) if bodies else (model.robot, ())
    model = replace(model, robot=robot)
    most = rows_at_most(robot) if rows is None else rows
    logs = [log.rows(evenly(log, most)) for log in logs]
    typical = typical_sizes(model, logs)
    model = with_payloads_placed(model, logs, typical)
    space = ParameterSpace(model, typical)
    equations = Equations(space, logs, evidence)
    held = equations.held if evidence.of_torque and equations.held.shape[1] and equations.windows is None else None
    if held is not None and held.any(-1).sum(1).min() == robot.nv:
        raise InvalidInput("contacts hold every degree of freedom in every row, so no equation is left to learn from.")
    history: list[float] = []

    def note(done: int, rms: float) -> None:
        history.append(rms)
        if progress is not None:
            progress(done, rms)

    robust = evidence.robust
    options: dict[str, Any] = {"longest": space.longest_steps, "moved": space.moved}
    search = partial(weighted_least_squares, prior=space.prior, bounds=space.bounds, **options)
    noise, start = None, space.start
    if evidence.noisy_in_both:
        # levels of noise about a poor start would hide outliers
        first = partial(equations.in_torque, motions=equations.measured)
        begin = search(first, start=start, robust=True, held=held, progress=note).x if robust else start
        fit, noise = _with_noise_in_both(equations, search, begin, robust, note)
    elif evidence.of_torque:
        torque = partial(equations.in_torque, motions=equations.measured)
        fit = search(torque, start=start, robust=robust, held=held, progress=note)
    else:
        fit = search(equations.in_acceleration, start=start, robust=robust, progress=note)
        for _ in range(REWEIGHTINGS):
            predicted, M, H = equations.accelerations(fit.x)
            noise = NoiseLevels.of(equations.a - predicted, M, H, robust=robust)
            W = noise.whitening(H)

            def white(x: np.ndarray, W: np.ndarray = W) -> tuple[np.ndarray, np.ndarray]:
                r, jacobian = equations.in_acceleration(x)
                return (W @ r[..., None])[..., 0], W @ jacobian

            fit = search(white, start=fit.x, robust=robust, progress=note)
    found = space.model_at(fit.x)
    residual = equations.a - equations.accelerations(fit.x)[0]
    doubts = list(_doubts_of_payloads(space, fit, equations.windows is not None))
    estimates = _estimates(space, fit, equations, evidence, thick)
    if not robot.space.is_vector_space:
        doubts += doubts_of_base(model, found, equations.parts[0], residual[: len(logs[0])])
    Doubts(doubts).warn(stacklevel=4)
    level = model.noise
    if level is None or level.learn or level.acceleration is None:
        found_levels = Noise(tuple(np.sqrt((residual**2).mean(0)).clip(1e-12)))
        level = found_levels if noise is None else Noise(tuple(noise.acceleration), tuple(noise.force))
    return Solution(found, estimates, level, logs[0], tuple(history) or (0.0,), fit.x)


def _with_noise_in_both(
    equations: Equations, search: Callable[..., Fit], x: np.ndarray, robust: bool, note: Progress
) -> tuple[Fit, NoiseLevels]:
    """Searches about likely accelerations, whose levels of noise are found along."""
    noise, least, number, evaluations, steps, rough = None, None, 0, 0, STEPS, not robust
    while True:
        number += 1
        levels = equations.levels(x, noise, least, robust, rough)
        likely = [
            part.likely(x, motion, levels, robust)
            for part, motion in zip(equations.parts, equations.measured, strict=True)
        ]
        if not rough:
            noise, least = levels, levels.scaled(LEAST) if least is None else least
        # its whitening holds levels of noise and weights, without forces of contacts
        known = np.ones(equations.a.shape[1])
        fit = search(partial(equations.whitened, likely=likely), start=x, known=known, evaluations=steps)
        evaluations += fit.evaluations
        steps, x = STEPS if (fit.x != x).any() else 2 * steps, fit.x
        note(number, float(np.sqrt((fit.white**2).mean())))
        reached = number > 1 and fit.expected <= REACHED * len(x)
        if noise is not None and (reached or number == SEARCHES):
            return replace(fit, evaluations=evaluations, settled=reached), noise
        rough = rough and fit.expected > len(x) and number < SEARCHES // 2


def _estimates(
    space: ParameterSpace, fit: Fit, equations: Equations, evidence: Torques | Accelerations, thick: tuple[str, ...]
) -> Estimates:
    """The numbers at the end of the search."""
    scaled = without(fit.jacobian / fit.noise[:, None], fit.span) * np.sqrt(fit.weight)[..., None]
    white = np.concatenate([scaled, (np.sqrt(fit.weight) * fit.white)[..., None]], axis=-1)
    prior = space.prior(fit.x)[1]
    base, by_body = None, None
    everything = len(space.carried) == len(space.own) and all(each.payload is None for each in space.carried)
    if everything and space.carried:
        Y = equations.parts[0].without_contacts(equations.measured[0].regressor)
        base = BaseParameters.of(Y.reshape(-1, Y.shape[-2] * 10), parameter_names(space.model.robot))
        by_body = _weak_directions(space, fit.information, prior.T @ prior)
    return Estimates.of_search(
        space.parameters,
        space.numbers(fit.x),
        space.number_slopes(fit.x),
        white.reshape(-1, white.shape[-1]),
        equations.stretches(),
        prior,
        by_body=by_body,
        base=base,
        evidence=str(evidence),
        rows=len(equations.a),
        evaluations=fit.evaluations,
        settled=fit.settled,
        thickened=thick,
    )


def _weak_directions(space: ParameterSpace, information: np.ndarray, prior: np.ndarray) -> dict[str, int]:
    """Of ten directions of each body, those of which the data hold less than the prior, as if others were known."""
    out = {}
    for body, each in enumerate(space.carried):
        own = slice(10 * body, 10 * body + 10)
        weak = np.linalg.eigvalsh(information[own, own]) < np.linalg.eigvalsh(prior[own, own]).mean()
        out[each.name] = int(weak.sum())
    return {name: count for name, count in sorted(out.items(), key=lambda entry: -entry[1]) if count}


def rows_at_most(robot: Robot) -> int:
    """Rows that are used where the caller gives no number."""
    return min(ROWS, EQUATIONS // robot.nv)


def typical_sizes(model: Model, logs: Sequence[Dataset]) -> dict[str, Float[np.ndarray, " nv"]]:
    """Sizes of forces, positions, velocities and inertias of each joint in these rows, to which coordinates relate.

    Forces are those measured or those of inverse dynamics, whichever are larger: light joints may have friction alone,
    passive ones are not driven. Inertia is at least what these forces accelerate: the rotor of a wrist has a thousand
    times that of its link.
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
    bases = (law.inertia_basis(model.robot) for law in model.laws if law.learned)
    basis = next((found for found in bases if found is not None), None)
    if basis is not None:
        mass = mass / np.maximum(basis.cpu().numpy().diagonal(axis1=1, axis2=2).sum(1), 1e-12)
    return {"force": torque, "velocity": velocity, "inertia": mass, "position": position}


def with_payloads_placed(model: Model, logs: Sequence[Dataset], typical: dict[str, np.ndarray]) -> Model:
    """The model whose payload without a link is on the one where it explains the log best.

    Raises DatasetError for logs too short for a payload.
    """
    unknown = [law for law in model.laws if isinstance(law, Payload) and not law.known]
    for name, log in zip(("the log", "the baseline"), logs, strict=False):
        if unknown and len(log) < FEWEST:
            raise DatasetError(f"{name} has {len(log)} rows; a payload needs {FEWEST} or more.")
    open_ones = [law for law in unknown if law.link is None]
    if len(open_ones) > 1:
        raise InvalidInput("forces list two payloads without a link, which no log tells apart; name their links.")
    named = [law.link for law in unknown if law.link is not None]
    bodies = [model.robot.layout.links[model.robot.link(link).name].body for link in named]
    if len(set(bodies)) < len(bodies):
        raise InvalidInput(
            f"forces list two payloads on one body ({', '.join(named)}), which no log tells apart; leave one out."
        )
    if not open_ones:
        return model
    candidates = possible_links(model.robot)
    chosen = candidates[0]
    if len(candidates) > 1:
        forces = [force for force in model.forces if force is not open_ones[0]]
        tried = [Payload(link) for link in candidates]
        space = ParameterSpace(replace(model, forces=(*forces, *tried)), typical)
        evidence = Torques(mean=WINDOW)
        equations = Equations(space, logs, evidence)
        names = [each.name for each in space.carried]
        places = [names.index(f"payload.{link}") for link in candidates]
        r, jacobian = _without_payloads(equations, space, places)
        Y = np.concatenate([motion.regressor for motion in equations.measured])[:, :, places]
        assert equations.windows is not None, "its evidence has means"
        free = equations.held.swapaxes(1, 2) if equations.held.shape[1] else None
        chosen = candidates[most_likely(equations.windows.mean(without(Y, free)), r, jacobian)]
    placed = replace(open_ones[0], link=chosen)
    return replace(model, forces=tuple(placed if force is open_ones[0] else force for force in model.forces))


WINDOW = 0.4
"""Seconds that torques are averaged over where the link of a payload is sought, and by `forcegp payload`."""


def _without_payloads(
    equations: Equations, space: ParameterSpace, places: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Residual at the start without the payloads, and the Jacobian in all other coordinates."""
    bare = []
    for motion in equations.measured:
        regressor = motion.regressor.copy()
        regressor[:, :, list(places)] = 0.0
        bare.append(replace(motion, regressor=regressor))
    r, jacobian = equations.in_torque(space.start, bare)
    of_payloads = np.concatenate([np.arange(10 * place, 10 * place + 10) for place in places])
    return r, np.delete(np.asarray(jacobian), of_payloads, axis=-1)


def _doubts_of_payloads(space: ParameterSpace, fit: Fit, averaged: bool) -> Iterator[Doubt]:
    for body, each in enumerate(space.carried):
        if each.payload is None:
            continue
        own, column = space.bodies.slices[body], space.names.index(f"{each.name}.mass")
        slope = space.number_slopes(fit.x)[column, own]
        laws = [type(space.model.laws[term.law]).__name__ for term in space.terms for _ in term.size]
        offsets = np.array([law == "Offset" for law in laws], dtype=bool)
        yield from doubts_of_offsets(fit, offsets, slope, own)
        if averaged:  # noise of single rows hides what is left
            number = len(space.carried)
            one = np.eye(10 * number)[10 * body : 10 * body + 10].reshape(10, 1, number, 10)
            slopes = space.bodies.chained(fit.x[: space.bodies.size], one)[:, 0, own]
            link = getattr(space.model.laws[each.payload], "link", "")
            yield from doubts_of_no_body(fit, space.standard_parameters(fit.x)[body], slopes, own, link)


STRETCHES_LEFT_OUT = 4
"""Stretches of time that logs of fewer than three episodes are cut into."""


def held_out_noise(model: Model, dataset: Dataset, evidence: Torques | Accelerations) -> Noise:
    """Noise of accelerations and forces about models identified without the rows in question.

    Residuals of the rows that parameters were fitted to are too small for others: those of a filtered log resemble
    their neighbours. So every stretch is predicted by a model identified from the rest (block cross-validation;
    Burman, Chow & Nolan 1994), and the levels of noise are those of all these residuals. Each search begins anew: from
    the fit to all rows it takes up to a third less time, but stops near that fit, whose rows it has not to have seen,
    and levels differ by up to some percent. Rows are left out by episodes, where there are three or more, else by
    `STRETCHES_LEFT_OUT` stretches of time. Raises InvalidInput for too few rows.
    """
    require_type("model", model, Model)
    residuals, masses, mobilities = [], [], []
    for left_out in _left_out(require_type("dataset", dataset, Dataset)):
        kept = np.ones(len(dataset), dtype=bool)
        kept[left_out] = False
        found = fit_physical(model, [dataset.rows(kept)], evidence).model
        rows = dataset.rows(left_out)
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
