"""`identify_payload`: mass, centre of mass and inertia of what a robot holds, from joint torques.

The payload is one more body, fixed to a link, in the equations of `forcegp.analytical.recorded_rows`:

    Y(q, v, a) pi + h Y_b(q, v, a) pi_p + M_0 a + t(x; v, a) = Q,

with h = 1 in the rows in which the robot holds it and b the body that carries it (Atkeson, An & Hollerbach 1986).
Equations are averaged over windows of time, which takes noise of the acceleration, under which inertias look too small,
but leaves friction as sharp as it is. Where a base moves, that is too little: Y is that of the accelerations that are
likely by the robot identified before (`RecordedRows.likely`), and noise of a stays in the residuals. Forces of feet
that stand are left out before (`recorded_rows`). Without a `baseline` the links are those of the URDF. With one they
are estimated, too, and an error that both logs share is not mistaken for the payload.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.stats import t as student

from forcegp.analytical.bodies import ConsistentBodies, thickened, with_bodies
from forcegp.analytical.identifiability import body_pseudo_inertias, standard_parameters
from forcegp.analytical.identification import identify_analytical, joint_terms, rows_at_most
from forcegp.analytical.least_squares import Fit, weighted_least_squares
from forcegp.analytical.payload_doubts import warn_of_no_body, warn_of_offsets
from forcegp.analytical.payload_link import most_likely, possible_links
from forcegp.analytical.recorded_rows import RecordedRows
from forcegp.analytical.result import AnalyticalIdentification, with_terms
from forcegp.data import Dataset
from forcegp.data.dataset_arguments import require_rows
from forcegp.errors import DatasetError, InvalidInput, require_type, usable_arguments
from forcegp.mechanics import MechanicalSystem
from forcegp.robots import Robot
from forcegp.robots.arguments import whole_number
from forcegp.robots.inertia import physical_of_pseudo_inertia, pseudo_inertia
from forcegp.robots.urdf_file import replace_inertial
from forcegp.summary import Summary

LAWS = "viscous", "stribeck", "offset"
USUAL = 0.5, 0.05  # kg; m: where the search begins, and the size of the body
WEAK = 0.01  # weight of the prior on a payload: a factor of e in its mass costs 0.02 nats
WINDOW = 0.4  # s
STRETCHES = 20  # of time; residuals of different ones count as independent
QUANTITIES = ("mass", *(f"center_of_mass.{x}" for x in "xyz"), *(f"inertia.{x}" for x in ("xx", "yy", "zz")))
UNITS = dict(zip(QUANTITIES, ("kg", *("m",) * 3, *("kg m^2",) * 3), strict=True))


@dataclass(frozen=True, eq=False, repr=False)
class PayloadEstimate(Summary):
    """What `identify_payload` found, in the frame of `link`; inertia is about the payload's own centre of mass.

    `pseudo_inertia` (4, 4) is that of the payload, `joints` friction and rotors with their standard
    errors, `system` the robot with all of it, and `baseline` whether a log without the payload was used.
    """

    link: str
    pseudo_inertia: Float[np.ndarray, "4 4"]
    values: dict[str, float]
    standard_errors: dict[str, float]
    joints: dict[str, tuple[float, float]]
    system: MechanicalSystem
    baseline: bool
    rows: int
    fit: Fit

    @property
    def mass(self) -> float:
        """In kg."""
        return self.values["mass"]

    @property
    def center_of_mass(self) -> Float[np.ndarray, "3"]:
        """In m, in the frame of the link."""
        return np.array([self.values[f"center_of_mass.{x}"] for x in "xyz"])

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals of `values`, by Student's distribution with one degree of freedom less than `STRETCHES`."""
        reach = float(student.ppf(0.975, STRETCHES - 1))
        return {
            name: (value - reach * self.standard_errors[name], value + reach * self.standard_errors[name])
            for name, value in self.values.items()
        }

    def facts(self) -> dict[str, object]:
        """Mass, place and what they rest on."""
        center = ", ".join(f"{1e3 * x:.1f}" for x in self.center_of_mass)
        return {
            "payload": f"{self.mass:.3f} ± {self.standard_errors['mass']:.3f} kg at ({center}) mm of {self.link}",
            "compared with": "a log without it" if self.baseline else "the URDF",
            "rows": self.rows,
            "converged": self.fit.settled,
        }

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain JSON values."""
        numbers = {
            name: {"unit": UNITS[name], "value": value, "standard_error": self.standard_errors[name],
                   "interval_95": list(self.intervals[name])}
            for name, value in self.values.items()
        }  # fmt: skip
        joints = {name: {"value": value, "standard_error": error} for name, (value, error) in self.joints.items()}
        whole = {"link": self.link, "baseline": self.baseline, "rows": self.rows, "converged": self.fit.settled}
        return {"payload": numbers, "joints": joints, **whole}


def identify_payload(
    dataset: Dataset,
    system: MechanicalSystem | None = None,
    *,
    baseline: Dataset | None = None,
    link: str | None = None,
    friction: tuple[str, ...] = LAWS,
    rotors: Literal["armature", "rotor"] | None = "armature",
    rows: int | None = None,
    identified: AnalyticalIdentification | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> PayloadEstimate:
    """Mass, centre of mass and inertia of a payload on `link`, with friction and rotor inertia estimated along.

    Parameters
    ----------
    dataset: a log with the payload: q, v, u and a, filtered alike (`forcegp.data.Preparation`), in no contact.
    system: the robot without the payload. None takes that of the dataset.
    baseline: a log of the same robot without the payload. None trusts the inertias of the URDF.
    link: what carries it. None is the base that moves, or the link at which joints end or part, that explains most
        (`forcegp.analytical.payload_link`).
    friction, rotors: as for `identify_analytical`.
    rows: use so many of each log at most, evenly spread; None as for `identify_analytical`.
    identified: what `identify_analytical` found in `dataset`, if it is there already; of use where the base moves.
    progress: called by `identify_analytical`, which is most of the work where the base moves.

    Standard errors come from leaving out each twentieth of the logs in turn (block jackknife; Kuensch 1989, "The
    jackknife and the bootstrap for general stationary observations"), so that errors of the friction law, which last,
    count.
    Raises InvalidInput for another robot, an unknown or unmoved link and a system in contact, and DatasetError for too
    few rows.
    """
    with usable_arguments("identify_payload"):
        given = require_type("dataset", dataset, Dataset).system if system is None else system
        system = require_type("system", given, MechanicalSystem, ", for example MechanicalSystem(robot)")
        logs = [dataset] if baseline is None else [dataset, baseline]
        for name, log in zip(("dataset", "baseline"), logs, strict=False):
            require_rows(name, log, system.robot.joint_names, "the robot")
            if len(log) < 10 * STRETCHES:
                raise DatasetError(f"{name} has {len(log)} rows; a payload needs {10 * STRETCHES} or more.")
        rows = rows_at_most(system.robot) if rows is None else rows
        if whole_number("rows", rows, 0) < 10 * STRETCHES:
            raise InvalidInput(f"rows is {rows}; it must be at least {10 * STRETCHES}.")
        if identified is not None:
            require_type("identified", identified, AnalyticalIdentification, ", as identify_analytical returns it")
            if identified.given.robot.joint_names != system.robot.joint_names:
                raise InvalidInput("identified is of another robot; give what was found in `dataset`, or leave it out.")
    robot, _ = thickened(system.robot)
    system = system.with_robot(robot)
    candidates = possible_links(robot) if link is None else (link,)
    for name in candidates:
        robot.link(name)  # raises UnknownLink
    carriers = [robot.layout.links[name].body for name in candidates]
    if min(carriers) < 0:
        raise InvalidInput(f"link {link!r} does not move, so nothing on it shows; give a moving one.")
    chosen = [np.unique(np.linspace(0, len(log) - 1, min(rows, len(log))).astype(int)) for log in logs]
    q, v, u, a = (np.concatenate([getattr(log, x)[at] for log, at in zip(logs, chosen, strict=True)]) for x in "qvua")
    holds = np.repeat([1.0, 0.0][: len(logs)], [len(at) for at in chosen])

    terms = joint_terms(system, friction, rotors, q, v, u, a)
    recorded = RecordedRows(system, terms, q, v, u)
    likely_a, from_noise = a, np.zeros(1)
    if not robot.space.is_vector_space:  # noise of a would explain any mass of a base
        parts = np.split(np.arange(len(a)), np.flatnonzero(np.diff(holds)) + 1)
        states = [(q[at], v[at], u[at], a[at]) for at in parts]
        found = [
            identify_analytical(log, system, friction=friction, rotors=rotors, likelihood="both", progress=progress)
            if identified is None or log is not dataset
            else identified
            for log in logs
        ]
        likely = [_likely(own, *rows) for own, rows in zip(found, states, strict=True)]
        likely_a, from_noise = (np.concatenate(x) for x in zip(*likely, strict=True))
    windows = _Windows([log.rows(at) for log, at in zip(logs, chosen, strict=True)])

    def equations(forces: np.ndarray) -> np.ndarray:
        return windows.mean(recorded.without_contacts(forces))

    links = body_pseudo_inertias(robot).cpu().numpy()
    regressor = recorded.regressor(likely_a, (*terms.bodies, *carriers))
    regressor[:, :, len(links) :] *= holds[:, None, None, None]
    place = 0
    if len(candidates) > 1:
        r, in_links, in_terms = recorded.in_torque(
            standard_parameters(robot).cpu().numpy(), terms.start(), likely_a, regressor[:, :, : len(links)]
        )
        unknown = in_terms if baseline is None else np.concatenate([in_terms, in_links.reshape(*r.shape, -1)], axis=-1)
        place = most_likely(equations(regressor[:, :, len(links) :]), equations(r + from_noise), equations(unknown))
        regressor = np.delete(regressor, [len(links) + k for k in range(len(candidates)) if k != place], axis=2)
    link = candidates[place]
    offset = np.linalg.inv(robot.layout.child_frames[carriers[place]]) @ robot.layout.links[link].offset
    usual = _usual(offset)[None]
    bodies = ConsistentBodies(usual if baseline is None else np.concatenate([links, usual]))
    stated = standard_parameters(robot).reshape(-1, 10).cpu().numpy()[: len(links) if baseline is None else 0]
    split, known = bodies.size, len(stated)
    constant = equations(regressor[:, :, known:])

    def residual(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        parameters = np.concatenate([stated, bodies.parameters(x[:split])])
        r, in_parameters, in_terms = recorded.in_torque(parameters, x[split:], likely_a, regressor)
        r = r + from_noise
        seen = constant if in_parameters is regressor else equations(in_parameters[:, :, known:])
        in_bodies = np.einsum("nibp,bpk->nibk", seen, bodies.derivatives(x[:split]))
        return equations(r), np.concatenate([in_bodies.reshape(*in_bodies.shape[:2], -1), equations(in_terms)], axis=-1)

    center, spread = terms.prior()
    weights = np.concatenate([np.ones(split - 10), np.full(10, WEAK**0.5)])

    def prior(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        distance, in_bodies = bodies.distance(x[:split])
        values = np.concatenate([weights * distance, (x[split:] - center) / spread])
        return values, block_diag(weights[:, None] * in_bodies, np.diag(1.0 / spread))

    low, high = terms.bounds
    bounds = np.concatenate([np.full(split, -np.inf), low]), np.concatenate([np.full(split, np.inf), high])
    longest = np.concatenate([np.full(split, bodies.longest_step), terms.longest_steps])
    start = np.concatenate([np.zeros(split), terms.start()])

    fit = weighted_least_squares(residual, prior, start, bounds, longest=longest, moved=bodies.moved)

    def numbers(x: np.ndarray) -> np.ndarray:
        return _numbers(bodies.pseudo_inertias(x[:split])[-1], offset)

    covariance = _jackknife(fit, windows.lengths)
    step = 1e-5 * np.eye(len(fit.x))[split - 10 : split]
    slopes = np.stack([(numbers(fit.x + d) - numbers(fit.x - d)) / 2e-5 for d in step], axis=1)
    warn_of_offsets(fit, np.array([name.startswith("offset.") for name in terms.names], dtype=bool), slopes[0])
    warn_of_no_body(fit, constant[:, :, -1], bodies.parameters(fit.x[:split])[-1], split, link)
    errors = np.sqrt(np.diag(slopes @ covariance[split - 10 : split, split - 10 : split] @ slopes.T))
    of_terms = np.sqrt(np.diag(covariance)[split:]) * terms.slopes(fit.x[split:]).ravel()
    found, there = bodies.pseudo_inertias(fit.x[:split]), np.linalg.inv(offset)
    payload = there @ found[-1] @ there.T
    bare = robot if baseline is None else with_bodies(robot, found[:-1])
    values = terms.totals(fit.x[split:])
    return PayloadEstimate(
        link=link,
        pseudo_inertia=payload,
        values=dict(zip(QUANTITIES, numbers(fit.x).tolist(), strict=True)),
        standard_errors=dict(zip(QUANTITIES, errors.tolist(), strict=True)),
        joints={name: (float(x), float(e)) for name, x, e in zip(terms.names, values.ravel(), of_terms, strict=True)},
        system=with_terms(system, _carrying(bare, link, payload), terms, fit.x[split:]),
        baseline=baseline is not None,
        rows=len(q),
        fit=fit,
    )


class _Windows:
    """Means over windows of time, times the root of their rows, so that white noise keeps its size."""

    def __init__(self, logs: list[Dataset]) -> None:
        number = np.concatenate([np.full(len(log), k) for k, log in enumerate(logs)])
        episode, time = (np.concatenate([getattr(log, name) for log in logs]) for name in ("episode", "time"))
        keys = np.stack([number, episode, np.floor(time / WINDOW)])
        self.starts = np.flatnonzero(np.r_[True, (np.diff(keys) != 0).any(axis=0)])
        self.roots = np.sqrt(np.diff(np.r_[self.starts, len(time)]))
        self.lengths = np.bincount(number[self.starts]).tolist()
        """Windows of every log."""

    def mean(self, values: np.ndarray) -> np.ndarray:
        """(rows, ...) as (windows, ...)."""
        sums = np.add.reduceat(values, self.starts, axis=0)
        return sums / self.roots.reshape(-1, *(1,) * (values.ndim - 1))


def _likely(
    found: AnalyticalIdentification, q: np.ndarray, v: np.ndarray, u: np.ndarray, a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """a* and the offset that it leaves (`LikelyAccelerations`) in these rows, by an identified robot."""
    recorded = RecordedRows(found.given, found.terms, q, v, u)
    likely = recorded.likely(found.parameters, found.fit.x[found.bodies.size :], a, recorded.regressor(a))
    return likely.a, likely.offset


def _usual(offset: np.ndarray) -> np.ndarray:
    """A usual payload on the link at this pose (4, 4), in the frame of its body."""
    mass, size = USUAL
    return offset @ pseudo_inertia(mass, np.zeros(3), 0.4 * mass * size**2 * np.eye(3)) @ offset.T


def _numbers(pseudo: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """`QUANTITIES` of a pseudo-inertia (4, 4) in the frame of its body, for a link at this pose in it."""
    mass, center, inertia = physical_of_pseudo_inertia(np.linalg.inv(offset) @ pseudo @ np.linalg.inv(offset).T)
    return np.array([mass, *center, *np.diag(inertia)])


def _jackknife(fit: Fit, lengths: list[int]) -> np.ndarray:
    """Covariance of the coordinates from leaving out one stretch of time after the other, by one step of the search."""
    windows = np.split(np.arange(sum(lengths)), np.cumsum(lengths)[:-1])
    stretches = [np.concatenate(part) for part in zip(*(np.array_split(x, STRETCHES) for x in windows), strict=True)]
    scaled, r = fit.jacobian / fit.noise[:, None], fit.residual / fit.noise
    whole, moved = fit.information + fit.prior_information, []
    for at in stretches:
        own = scaled[at].reshape(-1, scaled.shape[-1])
        moved.append(np.linalg.solve(whole - own.T @ own, own.T @ r[at].ravel()))
    apart = np.stack(moved) - np.mean(moved, axis=0)
    unseen = np.linalg.solve(whole, np.linalg.solve(whole, fit.prior_information).T)
    return (STRETCHES - 1) / STRETCHES * apart.T @ apart + unseen


def _carrying(robot: Robot, link: str, payload: np.ndarray) -> Robot:
    """The robot whose link has the payload of this pseudo-inertia (4, 4) added."""
    held = robot.link(link)
    whole = payload + pseudo_inertia(held.mass, np.array(held.center_of_mass), np.array(held.inertia))
    parts = physical_of_pseudo_inertia(whole)
    return robot.with_text(replace_inertial(robot.urdf_text, link, *parts, source=robot.source))
