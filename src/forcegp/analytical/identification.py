"""`identify_analytical`: rigid-body parameters from a recording; and how wrong such systems are about other motions."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal
from warnings import warn

import numpy as np
import torch
from scipy.linalg import block_diag

from forcegp.analytical.bodies import BodyCoordinates, ConsistentBodies, FreeBodies, thickened
from forcegp.analytical.identifiability import body_pseudo_inertias
from forcegp.analytical.joint_terms import JointTerms
from forcegp.analytical.least_squares import LEAST, Fit, NoiseLevels, weighted_least_squares
from forcegp.analytical.recorded_rows import LikelyAccelerations, RecordedRows, Rows
from forcegp.analytical.result import AnalyticalIdentification
from forcegp.data import Dataset, thruster_columns
from forcegp.data.dataset_arguments import require_rows
from forcegp.errors import DataWarning, InvalidInput, require_type, usable_arguments
from forcegp.mechanics import MechanicalSystem
from forcegp.robots import Robot
from forcegp.robots.arguments import whole_number

Inertias = Literal["consistent", "free"]
Likelihood = Literal["torque", "acceleration", "both"]
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


def identify_analytical(
    dataset: Dataset,
    system: MechanicalSystem | None = None,
    *,
    friction: Sequence[str] = ("viscous", "coulomb"),
    rotors: Literal["armature", "rotor"] | None = "armature",
    inertias: Inertias = "consistent",
    likelihood: Likelihood | None = None,
    prior_strength: float = 1.0,
    robust: bool = False,
    rows: int | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> AnalyticalIdentification:
    """Inertial parameters of every body, friction and rotor inertia by weighted least squares.

    Parameters
    ----------
    dataset: q, v, u and a, filtered alike (`forcegp.data.Preparation`); rows need not be in order of time.
    system: start and prior: the robot, friction it lists, and forces that are given. None takes that of the dataset.
        Forces of feet that stand, of loops and of wheels are unknown and left out exactly; other contacts are refused.
    friction: out of "viscous", "coulomb" or "stribeck" or "load" (c + mu |u|), and "offset" and "direction"
        (viscous friction that differs by direction). Velocity scales are estimated, too.
    rotors: "armature": one inertia per joint. "rotor": those of the system's RotorInertia. None: as listed.
    inertias: "consistent": every estimate belongs to a body (log-Cholesky coordinates, Rucker & Wensing 2022). "free":
        any numbers, that is, ordinary least squares of base parameters, which often give no robot.
    likelihood: "torque": residuals of inverse dynamics. "acceleration": of forward dynamics, maximum likelihood where
        accelerations are noisy (differentiated positions) and forces are, too (`NoiseLevels`). "both": of inverse
        dynamics with the accelerations that were there, where u and a are noisy (`forcegp.analytical.recorded_rows`).
        The last two need consistent inertias. None: "both" where the base moves, whose rows noise of a alone would
        draw to masses of zero; else, and for free inertias, "torque".
    prior_strength: weight w of a prior w/2 d^2 around the system that is given, with d the affine-invariant distance of
        bodies (one heavier throughout by a factor e costs 2 w; Lee, Wensing & Park 2020) and weak terms of friction. It
        decides what the data do not, and hardly what they do.
    robust: count residuals beyond 1.5 standard deviations by their absolute value (soft L1); with "both", whole
        rows by their logarithm (Cauchy), begun where soft L1 of accelerations ends.
    rows: use so many at most, evenly spread. None: 5,000, and fewer beyond eight degrees of freedom.
    progress: called as progress(round, rms of the residual).

    Raises InvalidInput for options that make no sense and for contacts that slide, whose friction is not measured.
    """
    with usable_arguments("identify_analytical"):
        given = require_type("dataset", dataset, Dataset).system if system is None else system
        system = require_type("system", given, MechanicalSystem, ", for example MechanicalSystem(robot)")
        require_rows("dataset", dataset, system.robot.joint_names, "the robot")
        for name, given, allowed in (
            ("inertias", inertias, ("consistent", "free")),
            ("likelihood", likelihood, ("torque", "acceleration", "both")),
        ):
            if given not in allowed and (name, given) != ("likelihood", None):
                raise InvalidInput(f"{name} is {given!r}; give one of {', '.join(allowed)}.")
        if likelihood is None:
            likelihood = "torque" if inertias == "free" or system.robot.space.is_vector_space else "both"
        if inertias == "free" and likelihood != "torque":
            raise InvalidInput(
                "accelerations need a mass matrix that can be inverted, which free inertias need not have; use "
                f"inertias='consistent' with likelihood={likelihood!r}."
            )
        if not (np.isfinite(prior_strength) and prior_strength > 0.0):
            raise InvalidInput(
                f"prior_strength is {prior_strength}; it must be > 0, since data never determine all of it."
            )
        require_type("robust", robust, bool)
        rows = rows_at_most(system.robot) if rows is None else rows
        if whole_number("rows", rows, 0) < 1:
            raise InvalidInput(f"rows is {rows}; it must be at least 1.")
    chosen = np.unique(np.linspace(0, len(dataset) - 1, min(rows, len(dataset))).astype(int))
    q, v, u, a = (getattr(dataset, name)[chosen] for name in ("q", "v", "u", "a"))
    robot, thick = thickened(system.robot)
    system = system.with_robot(robot)
    reference = body_pseudo_inertias(robot).cpu().numpy()
    bodies: BodyCoordinates = ConsistentBodies(reference) if inertias == "consistent" else FreeBodies(reference)
    terms = joint_terms(system, friction, rotors, q, v, u, a)
    recorded = RecordedRows(system, terms, q, v, u)
    regressor = recorded.regressor(a)
    split = bodies.size
    held = recorded.held if likelihood != "acceleration" and recorded.held.shape[1] else None
    if held is not None and held.any(-1).sum(1).min() == a.shape[1]:
        raise InvalidInput("contacts hold every degree of freedom in every row, so no equation is left to learn from.")

    def residual(x: np.ndarray, likely: LikelyAccelerations | None = None) -> tuple[np.ndarray, np.ndarray]:
        parameters = bodies.parameters(x[:split])
        if likely is not None:
            r, in_parameters, in_terms = recorded.in_torque(parameters, x[split:], likely.a, likely.regressor)
            W, same = likely.whitening, in_parameters is likely.regressor
            r, in_terms = (W @ (r + likely.offset)[..., None])[..., 0], W @ in_terms
            in_parameters = likely.white_regressor if same else likely.white(in_parameters)
        elif likelihood == "torque":
            r, in_parameters, in_terms = recorded.in_torque(parameters, x[split:], a, regressor)
        else:
            r, in_parameters, in_terms = recorded.in_acceleration(parameters, x[split:], a)
        jacobian = np.empty((*r.shape, len(x)))
        derivatives = bodies.derivatives(x[:split])
        size = split // len(derivatives)
        for body, derivative in enumerate(derivatives):  # matrix products, where `einsum` would loop by itself
            jacobian[..., body * size : (body + 1) * size] = in_parameters[:, :, body] @ derivative
        jacobian[..., split:] = in_terms
        return r, jacobian

    center, spread = terms.prior()
    weight = prior_strength**0.5

    def prior(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        distance, in_bodies = bodies.distance(x[:split])
        values = np.concatenate([distance, (x[split:] - center) / spread])
        return weight * values, weight * block_diag(in_bodies, np.diag(1.0 / spread))

    low, high = terms.bounds
    longest = np.concatenate([np.full(split, bodies.longest_step), terms.longest_steps])
    bounds = np.concatenate([np.full(split, -np.inf), low]), np.concatenate([np.full(split, np.inf), high])

    def search(
        start: np.ndarray,
        whitening: np.ndarray | None = None,
        likely: LikelyAccelerations | None = None,
        steps: int = STEPS,
    ) -> Fit:
        def white(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            r, jacobian = residual(x, likely)
            return (r, jacobian) if whitening is None else ((whitening @ r[..., None])[..., 0], whitening @ jacobian)

        if likely is not None:  # its whitening holds levels of noise and weights, without forces of contacts
            options: dict[str, Any] = {"known": np.ones(a.shape[1]), "evaluations": steps}
        else:
            options = {"robust": robust, "held": held if likelihood == "torque" else None, "progress": progress}
        return weighted_least_squares(white, prior, start, bounds, longest=longest, moved=bodies.moved, **options)

    def search_with_noise_in_both(x: np.ndarray) -> tuple[Fit, NoiseLevels]:
        noise, least, number, evaluations, steps, rough = None, None, 0, 0, STEPS, not robust
        while True:
            parameters, number = bodies.parameters(x[:split]), number + 1
            likely = recorded.likely(parameters, x[split:], a, regressor, noise, least, robust, rough)
            if not rough:
                noise, least = likely.noise, likely.noise.scaled(LEAST) if least is None else least
            fit = search(x, likely=likely, steps=steps)
            evaluations += fit.evaluations
            steps, x = STEPS if (fit.x != x).any() else 2 * steps, fit.x
            if progress is not None:
                progress(number, float(np.sqrt((fit.white**2).mean())))
            reached = number > 1 and fit.expected <= REACHED * len(x)
            if noise is not None and (reached or number == SEARCHES):
                return replace(fit, evaluations=evaluations, settled=reached), noise
            rough = rough and fit.expected > len(x) and number < SEARCHES // 2

    start, noise = np.concatenate([np.zeros(split), terms.start()]), None
    if likelihood == "both":
        # levels of noise about a poor start would hide outliers
        fit, noise = search_with_noise_in_both(search(start).x if robust else start)
    else:
        fit = search(start)
    for _ in range(REWEIGHTINGS if likelihood == "acceleration" else 0):
        predicted, M, H = recorded.acceleration(bodies.parameters(fit.x[:split]), fit.x[split:])
        noise = NoiseLevels.of(a - predicted, M, H, robust=robust)
        fit = search(fit.x, noise.whitening(H))
    found = AnalyticalIdentification(
        given=system,
        bodies=bodies,
        terms=terms,
        fit=fit,
        likelihood=likelihood,
        prior_strength=prior_strength,
        episode=dataset.episode[chosen],
        regressor=recorded.without_contacts(regressor),
        thickened=thick,
        noise=noise,
    )
    if not system.robot.space.is_vector_space:
        _warn_of_what_holds_it_up(found, recorded, a)
    return found


def rows_at_most(robot: Robot) -> int:
    """Rows that are used where the caller gives no number."""
    return min(ROWS, EQUATIONS // robot.nv)


def joint_terms(
    system: MechanicalSystem,
    friction: Sequence[str],
    rotors: str | None,
    q: np.ndarray,
    v: np.ndarray,
    u: np.ndarray,
    a: np.ndarray,
) -> JointTerms:
    """Terms whose coordinates are in proportion to the forces, velocities and M of these rows.

    Forces are those measured or those of inverse dynamics, whichever are larger: light joints may have friction alone,
    passive ones are not driven. Inertia is at least what these forces accelerate: the rotor of a wrist has a thousand
    times that of its link.
    """
    at_q, at_v, at_u = (torch.as_tensor(np.array(x), device=system.robot.device) for x in (q, v, u))
    state = system.state(at_q, at_v, at_u)
    kinematics, delivered = state.kinematics, state.delivered.cpu().numpy()
    needed = kinematics.inverse_dynamics(torch.as_tensor(np.array(a), device=system.robot.device)).cpu().numpy()
    mass = system.mass_matrix(kinematics).diagonal(dim1=-2, dim2=-1).mean(0).cpu().numpy()
    needed, measured, speed = (np.sqrt((x**2).mean(0)) for x in (needed, delivered, v))
    torque, velocity = (np.maximum(x, 1e-3 * max(float(x.max()), 1e-9)) for x in (np.maximum(needed, measured), speed))
    mass = np.maximum(mass, torque / np.maximum(np.sqrt((a**2).mean(0)), 1e-12)) if a.any() else mass
    return JointTerms(system, friction, rotors, torque=torque, velocity=velocity, mass=mass)


BRAKED = 0.4
"""Correlation of missing accelerations of a base with its velocity: below .2 in logs of feet, wheels and rotors without
drag, .45 to .83 with drag or ground friction."""
OTHER_ROBOT = 2.0
"""Factor between the masses of log and file, or of what holds the robot up, from which on one of them is wrong."""


def _warn_of_what_holds_it_up(found: AnalyticalIdentification, rows: RecordedRows, a: Rows) -> None:
    """Where log and file have different masses, the base lacks a force of the size of gravity, or something brakes."""
    robot, mass, missing = found.given.robot, found.total_mass[0], 0.0
    given = float(found.bodies.parameters(np.zeros(found.bodies.size))[:, 0].sum())
    residual = a - rows.acceleration(found.parameters, found.fit.x[found.bodies.size :])[0]
    if robot.base == "floating":
        rotation = rows.kinematics.frame_pose(robot.layout.moving[0])[:, :3, :3].cpu().numpy()
        missing = float(np.linalg.norm((rotation @ residual[:, :3, None]).mean(0)))
    wrong = ""
    if not given / OTHER_ROBOT <= mass <= given * OTHER_ROBOT:
        wrong = f"by this log the robot weighs {mass:.3g} kg, by its file {given:.3g} kg"
    elif missing * OTHER_ROBOT > np.linalg.norm(robot.gravity.cpu().numpy()) > 0.0:
        wrong = f"accelerations of the base are wrong by {missing:.3g} m/s^2 on average"
    if wrong:
        warn(
            f"{wrong}: what holds it up is not what the log states. Check flags of stance, thrust coefficients and the "
            "unit of u.",
            DataWarning,
            stacklevel=3,
        )
    linear = {"floating": 3, "planar": 2}.get(robot.base, 0)
    missed, v = residual[:, :linear], rows.v[:, :linear]
    braked = -float((missed * v).sum()) / max(float(np.linalg.norm(missed) * np.linalg.norm(v)), 1e-300)
    if not wrong and braked > BRAKED:
        remedy = "weigh it, since thrust and mass look alike, and let forcegp fit learn the forces"
        if not thruster_columns(found.given):
            remedy = "forcegp identify --learn LINK:mass,com --prior joint,joint-friction learns both"
        warn(
            f"what the model lacks brakes the base (correlation {braked:.2g} with its velocity): ground friction or "
            f"drag, which this regression takes for mass; {remedy}.",
            DataWarning,
            stacklevel=3,
        )


STRETCHES = 4
"""Stretches of time that logs of fewer than three episodes are cut into."""


def held_out_noise(dataset: Dataset, system: MechanicalSystem, **how: Any) -> NoiseLevels:
    """Noise of accelerations and forces about systems identified without the rows in question.

    Residuals of the rows that parameters were fitted to are too small for others: those of a filtered log resemble
    their neighbours. So every stretch is predicted by a system identified from the rest (block cross-validation;
    Burman, Chow & Nolan 1994), and the levels of noise are those of all these residuals. Each search begins anew: from
    the fit to all rows it takes up to a third less time, but stops near that fit, whose rows it has not to have seen,
    and levels differ by up to some percent.

    `how` are the options of `identify_analytical`; inertias must be consistent. Rows are left out by episodes, where
    there are three or more, else by `STRETCHES` stretches of time.
    Raises InvalidInput for free inertias, whose mass matrix need not be one, and for too few rows.
    """
    require_type("dataset", dataset, Dataset)
    if how.get("inertias", "consistent") != "consistent":
        raise InvalidInput("held-out noise needs a mass matrix that can be inverted; use inertias='consistent'.")
    residuals, masses, mobilities = [], [], []
    for left_out in _stretches(dataset):
        kept = np.ones(len(dataset), dtype=bool)
        kept[left_out] = False
        found = identify_analytical(dataset.rows(kept), system, **how).system
        rows = dataset.rows(left_out)
        q, v, u = (torch.tensor(x, device=found.robot.device) for x in (rows.q, rows.v, rows.u))
        dynamics = found.dynamics(q, v, u)
        residuals.append(rows.a - dynamics.acceleration_map().offset.cpu().numpy())
        masses.append(dynamics.M.cpu().numpy())
        mobilities.append(dynamics.H.cpu().numpy())
    return NoiseLevels.of(np.concatenate(residuals), np.concatenate(masses), np.concatenate(mobilities))


def _stretches(dataset: Dataset) -> list[np.ndarray]:
    """Row numbers of each stretch."""
    if len(dataset.episodes) >= 3:
        return [np.flatnonzero(dataset.episode == number) for number in dataset.episodes]
    if len(dataset) < 2 * STRETCHES:
        raise InvalidInput(f"the dataset has {len(dataset)} rows; held-out noise needs {2 * STRETCHES} or more.")
    return np.array_split(np.lexsort((dataset.time, dataset.episode)), STRETCHES)
