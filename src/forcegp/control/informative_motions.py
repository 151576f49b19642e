"""Motions that teach most, from rest to rest within limits: how sure a model will be after one is known before it.

The covariance of a Gaussian process depends on where its data are, not on what is measured there (Rasmussen & Williams
2006, eq. 2.26). Without learned forces, the determinant of the information on base parameters takes its place
(D-optimality; Swevers et al. 1997, "Optimal robot excitation and identification").
Motions are cubic B-splines (de Boor 1978, "A practical guide to splines"): q lies in the hull of the control points, of
which the first and last three are the start. v, a, torques and distances are bounded by samples, knots among them, and
in between by the error of linear interpolation, an eighth of the second difference (of q'' exactly that).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import BSpline
from typing_extensions import override

from forcegp.analytical.identifiability import base_parameters, torque_regressor
from forcegp.atomic_files import atomic_file
from forcegp.control.controller import per_joint
from forcegp.data import Dataset
from forcegp.data.row_selection import farthest_point_sampling
from forcegp.errors import InvalidInput, require_known, require_type
from forcegp.inference.cholesky_update import with_only, with_rows
from forcegp.inference.posterior import ExactPosterior, exact
from forcegp.integration.integrators import check_time_step
from forcegp.mechanics import Contact, MechanicalSystem
from forcegp.models import StructuredPosterior
from forcegp.models.protocol import Posterior
from forcegp.models.structured.components import inverse_dynamics
from forcegp.models.training_data import TrainingData
from forcegp.robots import Robot
from forcegp.robots.arguments import finite_vector, whole_number
from forcegp.summary import Summary, rounded

QUANTITIES = ("position", "velocity", "acceleration", "torque")
SPANS, SAMPLES, SHRINK, ROUNDS = 2.5, 20, 0.85, 40
"""Pieces of a spline per second, samples in each; how a motion is made smaller, and how often."""
CANDIDATES, CHANGES = 100, 200
"""Random motions, and random changes to the best of them."""
STATES, MOST_ROWS = 150, 150
"""At which the spread is computed; of the rows learned so far, those that take part in the search."""
DRY = 0.05
"""Velocity in rad/s (m/s) within which the dry friction of a robot without learned forces turns."""
Values = Float[np.ndarray, "n nv"]


class Motion(NamedTuple):
    """Free control points as offsets from the start, and samples, in rad, rad/s, rad/s^2, Nm (m, ...)."""

    points: Values
    q: Values
    v: Values
    a: Values
    u: Values


class LearnedForces:
    """What motions teach a posterior that takes `rows` rows of them."""

    def __init__(self, posterior: StructuredPosterior, rows: int) -> None:
        self.latent, self.rows = exact(posterior.latent, "choosing a motion"), rows
        self.posterior = posterior.with_contacts([]) if posterior.system.contacts else posterior
        states = torch.cat([posterior.training.q, posterior.training.v, posterior.training.u], dim=1).numpy()
        kept = farthest_point_sampling(states, min(MOST_ROWS, len(states)))
        self.few = with_only(self.latent, torch.as_tensor(kept))

    def torques(self, q: Values, v: Values, a: Values) -> Values:
        """u (n, nv) in Nm or N."""
        return inverse_dynamics(self.posterior, torch.as_tensor(np.hstack([q, v, a])), None, False).mean.numpy()

    def judge_at(self, *states: Values) -> None:
        """Takes the q, v and u (n, nv) at which forces are to be sure."""
        with torch.no_grad():
            at, prior = self.posterior.dynamics(*map(torch.as_tensor, states)), self.posterior.model.prior
            self.features = self.posterior.likelihood.standardization(prior.features(at))
            self.response = at.H @ prior.mixing(at)

    def after(self, motion: Motion, latent: ExactPosterior) -> ExactPosterior:
        """`latent` with rows of the motion, far apart, at which just what it predicts was measured."""
        states = np.hstack([motion.q, motion.v, motion.u])
        some = farthest_point_sampling(states, min(self.rows, len(states)))
        q, v, a, u = (torch.as_tensor(x[some]) for x in motion[1:])
        own, training = self.posterior.likelihood, self.posterior.training
        rows = replace(TrainingData(q, v, u, a), reference=training.reference or training)
        made = replace(own, system=self.posterior.system, training=rows, fixed_standardization=own.standardization)
        with torch.no_grad():
            features, W, _, noise = made.terms(self.posterior.parameters)
            predicted = (W @ latent.mean(features)[..., None])[..., 0]
            return with_rows(latent, features, W, predicted, noise.expand(len(q), *noise.shape[1:]))

    def spread(self, latent: ExactPosterior) -> np.ndarray:
        """Standard deviation of each joint's acceleration (nv,), root mean square over the states."""
        variance = (self.response @ latent.covariance(self.features) * self.response).sum(-1).mean(0)
        return self.posterior.widening * variance.clamp_min(0.0).sqrt().numpy()

    def score(self, motion: Motion) -> float:
        """What is to be small."""
        return float(np.linalg.norm(self.spread(self.after(motion, self.few))))


class BaseParameters:
    """What motions teach of base parameters, viscous and dry friction; torques count over their limits (nv,)."""

    def __init__(self, system: MechanicalSystem, limits: np.ndarray) -> None:
        self.system, self.scale = replace(system, contacts=()), np.where(np.isinf(limits), 1.0, limits)
        self.columns = list(base_parameters(system.robot).independent)

    def torques(self, q: Values, v: Values, a: Values) -> Values:
        """u (n, nv) in Nm or N against all known forces, those of friction as without u."""
        at = self.system.dynamics(*map(torch.as_tensor, (q, v, 0.0 * a)))
        return ((at.M @ torch.as_tensor(a)[..., None])[..., 0] - at.Q_K).numpy()

    def regressor(self, motion: Motion) -> np.ndarray:
        """Of all samples, (rows, k)."""
        q, v, a = map(torch.as_tensor, motion[1:4])
        Y = torque_regressor(self.system.robot, q, v, a)[..., self.columns]
        Y = torch.cat([Y, torch.diag_embed(v), torch.diag_embed((v / DRY).tanh())], dim=-1)
        return (Y.numpy() / self.scale[:, None]).reshape(-1, Y.shape[-1])

    def score(self, motion: Motion) -> float:
        """What is to be small: minus log det of the information."""
        return -float(np.linalg.slogdet(np.linalg.qr(self.regressor(motion), mode="r"))[1])


@dataclass(frozen=True, eq=False)
class SplineMotions:
    """Motions of `seconds` from the posture `start` (nv,) and back; the points of `surfaces` stay `clearance` away.

    `limits` are the ends (2, nv) of each of QUANTITIES, the position as an offset from the start.
    """

    robot: Robot
    start: Float[np.ndarray, " nv"]
    limits: Mapping[str, Float[np.ndarray, "2 nv"]]
    seconds: float
    torques: Callable[[Values, Values, Values], Values]
    surfaces: Sequence[Contact]
    clearance: float

    @cached_property
    def basis(self) -> list[BSpline]:
        """Of q, v and a, one function per free control point."""
        spans = max(8, round(SPANS * self.seconds))
        knots = np.pad(np.linspace(0.0, self.seconds, spans + 1), 3, "edge")
        q = BSpline(knots, np.eye(spans + 3)[:, 3:-3], 3)
        return [q, q.derivative(1), q.derivative(2)]

    @cached_property
    def _samples(self) -> list[Float[np.ndarray, "n K"]]:
        time = np.linspace(0.0, self.seconds, SAMPLES * (self.basis[0].c.shape[1] + 3) + 1)
        return [spline(time) for spline in self.basis]

    def random(self, rng: np.random.Generator) -> Values:
        """Control points of any size and smoothness, not yet within the limits."""
        low, high = self.limits["position"]
        points, memory = rng.standard_normal((self.basis[0].c.shape[1], len(low))), rng.uniform(-0.5, 0.9, len(low))
        for k in range(1, len(points)):
            points[k] = memory * points[k - 1] + np.sqrt(1.0 - memory**2) * points[k]
        return rng.uniform(0.0, 0.7) * rng.uniform(low, high) + rng.uniform(0.1, 0.6, len(low)) * (high - low) * points

    def used(self, name: str, x: Values) -> Float[np.ndarray, " nv"]:
        """The largest value of a quantity over its limit; of the position from its control points."""
        ends, more = self.limits[name], 0.0 if name == "position" else _between(x)
        reached = np.stack([x.min(0) - more, x.max(0) + more])
        return np.divide(reached, ends, out=np.zeros_like(ends), where=ends != 0.0).max(0)

    def kept(self, points: Values) -> Motion:
        """The motion of these points, made smaller until all limits hold. Raises InvalidInput where nothing is left."""
        points = np.clip(points, *self.limits["position"])
        for _ in range(ROUNDS):
            q, v, a = (sample @ points for sample in self._samples)
            fast = np.maximum(self.used("velocity", v), self.used("acceleration", a)).clip(1.0)
            points, q, v, a = (x / fast for x in (points, q, v, a))
            motion = Motion(points, self.start + q, v, a, self.torques(self.start + q, v, a))
            torque, distances = self.used("torque", motion.u), self.distances(motion.q)
            if (torque <= 1.0).all() and (distances >= self.clearance).all():
                return motion
            points = SHRINK * points
        j, near = int(torque.argmax()), int(distances.argmin()) if len(distances) else 0
        what = f"joint {self.robot.joint_names[j]} needs {torque[j]:.3g} times its torque limit"
        if torque[j] <= 1.0:
            contact = self.surfaces[near]
            what = f"frame {contact.frame!r} is {distances[near]:.3g} m from a {type(contact.surface).__name__}"
        raise InvalidInput(
            f"{what} at the start, so no motion keeps its limits (clearance={self.clearance:g} m); start elsewhere, or "
            "change limits or clearance."
        )

    def distances(self, q: Values) -> Float[np.ndarray, " surfaces"]:
        """The least signed distance of every point from its surface in m."""
        at = self.robot.kinematics(torch.as_tensor(q))
        each = np.array([x.distance(at).numpy() for x in self.surfaces]).reshape(-1, len(q)).T
        return each.min(0) - _between(each)


def _between(samples: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " k"]:
    """How far a smooth quantity may go beyond its samples."""
    return np.abs(np.diff(samples, 2, axis=0)).max(0) / 8.0


def motion_limits(robot: Robot, start: np.ndarray, given: Mapping[str, Any], margin: float) -> dict[str, np.ndarray]:
    """The `limits` of `SplineMotions`: those given, and `margin` times those of the URDF, whichever are smaller.

    Raises InvalidInput, naming joint and limit, where no motion from this start can keep them.
    """
    for name in given:
        require_known("limit", name, "excitation", QUANTITIES)
    stated = np.array([(x.lower, x.upper, x.velocity_limit, x.effort_limit) for x in robot.joints]).T
    half = np.stack([(stated[1] - stated[0]) / 2.0, stated[2], np.full(robot.nv, np.inf), stated[3]])
    middle, limits = np.where(np.isinf(half[0]), 0.0, stated[0] + half[0] - start), {}
    for name, most in zip(QUANTITIES, margin * half, strict=True):
        ends = np.outer((-1.0, 1.0), most) + (middle if name == "position" else 0.0)
        asked = per_joint(f"limits[{name!r}]", given.get(name, np.inf), robot.nv).numpy()
        limits[name] = low, high = ends.clip(-asked, asked)
        wrong = (low > 0.0) | (high < 0.0) | (low == high) | (np.isinf(high) & (name == "velocity"))
        if wrong.any():
            j = int(wrong.argmax())
            raise InvalidInput(
                f"joint {robot.joint_names[j]}: no motion from {start[j]:.4g} can be chosen within {name} limits of "
                f"{low[j]:.4g} and {high[j]:.4g}{' from there' * (name == 'position')}; give limits={{{name!r}: ...}}, "
                "another start or margin."
            )
    endless = np.isinf(limits["position"])
    limits["position"] = np.where(endless, limits["velocity"], limits["position"])
    return limits


@dataclass(frozen=True, eq=False, repr=False)
class Excitation(Summary):
    """The motion that `excitation` chose; `motions` are those that it was chosen among, with their limits.

    `model` is the posterior that was given, `expected` the same after the motion: its mean unchanged, its intervals
    exact at the hyper-parameters at hand. `spread` (2, nv) is the standard deviation of the acceleration that learned
    forces leave open, before and after, in rad/s^2 (m/s^2). Without learned forces these are None, and `condition` is
    that of the regressor of base parameters and friction.
    """

    motions: SplineMotions
    motion: Motion
    model: StructuredPosterior | None = None
    expected: StructuredPosterior | None = None
    spread: np.ndarray | None = None
    condition: float | None = None

    @property
    def usage(self) -> dict[str, Float[np.ndarray, " nv"]]:
        """The largest position (from the start), velocity, acceleration and torque over their limits."""
        values = self.motion.points, *self.motion[2:]
        return {name: self.motions.used(name, x) for name, x in zip(QUANTITIES, values, strict=True)}

    @override
    def facts(self) -> Mapping[str, object]:
        """How much it uses of the limits, and what it teaches."""
        open_before_and_after = () if self.spread is None else np.linalg.norm(self.spread, axis=1)
        teaches = {"spread": rounded(open_before_and_after), "condition": self.condition}
        return {name: f"{x.max():.0%} of limit" for name, x in self.usage.items()} | teaches

    def trajectory(self, t: Any) -> tuple[Values, Values, Values]:
        """q, v and a (n, nv) at times t (n,) in s, or (nv,) at one; at rest before and after."""
        t = np.clip(t, 0.0, self.motions.seconds)
        q, v, a = (spline(t) @ self.motion.points for spline in self.motions.basis)
        return self.motions.start + q, v, a

    def save_csv(self, path: str | Path, rate: float = 100.0) -> None:
        """Write t in s and q, v, a and u of every joint, `rate` rows per second, as `forcegp import` reads them."""
        check_time_step(rate)
        time = np.arange(round(self.motions.seconds * rate) + 1) / rate
        states = self.trajectory(time)
        names = ["t", *(f"{what}_{joint}" for what in "qvau" for joint in self.motions.robot.joint_names)]
        table = np.hstack([time[:, None], *states, self.motions.torques(*states)])
        with atomic_file(path) as temporary:
            np.savetxt(temporary, table, "%.9g", ",", header=",".join(names), comments="", encoding="utf-8")


def excitation(
    model: Robot | MechanicalSystem | Posterior,
    *,
    seconds: float = 10.0,
    limits: Mapping[str, Any] | None = None,
    margin: float = 0.9,
    start: Any = None,
    surfaces: Sequence[Contact] | None = None,
    clearance: float = 0.05,
    task: Dataset | None = None,
    rows: int = 100,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Excitation:
    """The motion from rest at `start` and back after which learned forces are surest.

    * model: a fitted `StructuredGP`, whose accelerations at the states of `task` (None: any within the limits) are to
      be sure once it has learned from `rows` rows of the motion; or a robot, a system or another model, for the
      identification of base parameters and friction.
    * limits: of "position" (from the start), "velocity", "acceleration" and "torque", numbers or one per joint, in rad,
      s and Nm (m, N); those of the URDF count, too, `margin` times.
    * start: posture (nv,); None takes the mean of the training rows, or the middle of the joints' ranges.
    * surfaces: contacts whose points keep `clearance` m away; None takes the model's. No other collision is looked at.

    Raises InvalidInput for arguments that do not fit and, naming the joint, for limits that cannot be kept.
    """
    require_type("model", model, (Robot, MechanicalSystem, Posterior))
    learned = model if isinstance(model, StructuredPosterior) and model.latent_names else None
    system = MechanicalSystem(model) if isinstance(model, Robot) else getattr(model, "system", model)
    robot, rng = system.robot, np.random.default_rng(whole_number("seed", seed, 0))
    check_time_step(seconds)
    if start is None and learned is not None:
        start = learned.training.q.mean(0)
    elif start is None:
        start = [x.lower + (x.upper - x.lower) / 2.0 if x.upper - x.lower < np.inf else 0.0 for x in robot.joints]
    start = finite_vector("start", start, robot.nv)
    bounds, rows = motion_limits(robot, start, limits or {}, margin), whole_number("rows", rows, 1)
    teaches = BaseParameters(system, bounds["torque"][1]) if learned is None else LearnedForces(learned, rows)
    touched = system.contacts if surfaces is None else tuple(surfaces)
    motions = SplineMotions(robot, start, bounds, seconds, teaches.torques, touched, clearance)
    motions.kept(0.0 * motions.random(rng))  # refuses the start
    if isinstance(teaches, LearnedForces) and task is not None:
        some = np.linspace(0, len(task) - 1, min(STATES, len(task))).astype(int)
        teaches.judge_at(task.q[some], task.v[some], task.u[some])
    elif isinstance(teaches, LearnedForces):
        q, v = (rng.uniform(*bounds[name], (STATES, robot.nv)) for name in QUANTITIES[:2])
        teaches.judge_at(start + q, v, teaches.torques(start + q, v, 0.0 * v))
    best, least, size = Motion(*[start] * 5), np.inf, 0.3
    for k in range(CANDIDATES + CHANGES):
        points = motions.random(rng)
        if k >= CANDIDATES:  # change some joints for some time
            middle, width = rng.uniform(0.0, len(points)), rng.uniform(1.0, len(points))
            near = np.exp(-((np.arange(len(points)) - middle) ** 2) / (2.0 * width**2))[:, None]
            points = best.points + size * near * (rng.random(robot.nv) < 0.5) * points
        motion = motions.kept(points)
        score = teaches.score(motion)
        size *= 1.0 if k < CANDIDATES else 1.3 if score < least else 0.96
        if score < least:
            best, least = motion, score
        progress(k + 1, CANDIDATES + CHANGES)
    if isinstance(teaches, BaseParameters):
        Y = teaches.regressor(best)
        return Excitation(motions, best, condition=float(np.linalg.cond(Y / np.linalg.norm(Y, axis=0))))
    after = teaches.after(best, teaches.latent)
    spread = np.stack([teaches.spread(latent) for latent in (teaches.latent, after)])
    return Excitation(motions, best, teaches.posterior, replace(teaches.posterior, latent=after), spread)
