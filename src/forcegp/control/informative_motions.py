"""Motions that teach most, from rest to rest within limits: how sure a model will be after one is known before it.

The covariance of a Gaussian process depends on where its data are alone. Without learned forces the information on base
takes its place (D-optimality; Swevers et al. 1997). Motions are cubic B-splines, in the hull of their points.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import BSpline
from torch import Tensor
from typing_extensions import override

from forcegp.atomic_files import atomic_file
from forcegp.control.tracking import Past, per_joint
from forcegp.data import Dataset, with_memory
from forcegp.data.dataset import require_rows
from forcegp.data.views import farthest_point_sampling
from forcegp.errors import InvalidInput, require_known, require_number, require_type, usable_arguments
from forcegp.evidence.bodies import ENTRIES, base_parameters, torque_regressor
from forcegp.inference.memory import blas_threads
from forcegp.inference.posterior import ExactPosterior
from forcegp.integration.integrators import check_time_step
from forcegp.mechanics import Contact
from forcegp.model import Model
from forcegp.posterior.posterior import Posterior
from forcegp.posterior.prediction import inverse_dynamics
from forcegp.progress import tell
from forcegp.robots import Robot
from forcegp.robots.arguments import finite_vector, whole_number
from forcegp.summary import Summary, rounded

QUANTITIES = ("position", "velocity", "acceleration", "torque")
SPANS, SAMPLES = 2.5, 20  # pieces of a spline per second, samples in each
MARGIN = 0.9  # of the limits of a robot file
SHRINK, ROUNDS, EXACT = 0.85, 40, 1e-12  # of a motion beyond its limits; rounding
LONGEST, INSIDE = 120.0, 0.95  # s, for the memory of all samples; of the positions, for a start that is not given
STATES, MOST_ROWS, MANY_ROWS = 150, 150, 400
"""Where the spread is computed; rows learned so far that take part in the search, and that stand for too many."""
DRY = 0.05  # velocity in rad/s (m/s) within which the dry friction of a robot without learned forces turns
Values = Float[np.ndarray, "n nv"]
AtTimes = Float[np.ndarray, "*times nv"]


class Motion(NamedTuple):
    """Free control points as offsets from the start, and samples, in rad, rad/s, rad/s^2, Nm (m, ...)."""

    points: Values
    q: Values
    v: Values
    a: Values
    u: Values


class LearnedForces:
    """What a posterior learns from `rows` rows of a motion about the states q, v, u that it is `judged_at`."""

    judged_at: tuple[Values, Values, Values]

    def __init__(self, posterior: Posterior, rows: int) -> None:
        self.rows, free, own = rows, posterior.model.with_contacts(()), posterior.likelihood
        known = replace(posterior, likelihood=replace(own, fixed_standardization=own.standardization))
        known = known if isinstance(known.latent, ExactPosterior) else of_few_rows(known, MANY_ROWS)
        two = ((x, replace(x.likelihood, model=free)) for x in (known, of_few_rows(known, MOST_ROWS)))
        self.posterior, self.few = (replace(x, likelihood=own, target=free) for x, own in two)

    def torques(self, *states: Values) -> Values:
        """u (n, nv) in Nm or N of q, v and a of a motion from rest."""
        q, v, a = map(torch.as_tensor, states)
        return inverse_dynamics(
            self.posterior, [q, v, a], None, False, Past(self.posterior.model).over(q)[0]
        ).mean.numpy()

    def steady(self, q: Values, v: Values) -> tuple[Values, Values, Values]:
        """The states of joints that have long moved so, with the u of no acceleration."""
        past, states = Past(self.posterior.model), [torch.as_tensor(x) for x in (q, v, 0.0 * v)]
        z = past.over(torch.stack([states[0] - states[1], states[0]], dim=1).flatten(0, 1))[0][1::2]
        return q, v, past.beside(inverse_dynamics(self.posterior, states, None, False, z).mean, z).numpy()

    def after(self, motion: Motion, posterior: Posterior) -> Posterior:
        """`posterior` with rows of the motion, far apart, at which just what it predicts was measured."""
        some, past = far_apart(motion.q, motion.v, motion.u, self.rows), Past(self.posterior.model)
        u = past.beside(torch.as_tensor(motion.u), past.over(torch.as_tensor(motion.q))[0]).numpy()
        q, v, u = motion.q[some], motion.v[some], u[some]
        a, time = posterior.predict(q, v, u, covariance=False).mean.numpy(), np.arange(float(len(q)))
        noise, model = posterior.noise_std.numpy(), posterior.model
        return posterior.with_rows(Dataset(q=q, v=v, u=u, a=a, time=time, noise_std=noise, model=model))

    def spread(self, posterior: Posterior) -> np.ndarray:
        """Standard deviation of each joint's acceleration (nv,), root mean square over the states."""
        return posterior.predict(*self.judged_at).variance.mean(0).sqrt().numpy()

    def score(self, motion: Motion) -> float:
        """What is to be small."""
        return float(np.linalg.norm(self.spread(self.after(motion, self.few))))


class BaseParameters:
    """What shows of base parameters, viscous and dry friction; torques count over their limits (nv,)."""

    def __init__(self, model: Model, limits: np.ndarray) -> None:
        self.model, self.scale = replace(model, contacts=()), np.where(np.isinf(limits), 1.0, limits)
        self.columns = list(base_parameters(model.robot))

    def torques(self, *states: Values) -> Values:
        """u (n, nv) in Nm or N of q, v and a of a motion from rest, against known forces as they are without u."""
        (q, v, a), past = map(torch.as_tensor, states), Past(self.model)
        at = self.model.dynamics(q, v, past.beside(0.0 * a, past.over(q)[0]))
        return ((at.M @ a[..., None])[..., 0] - at.Q_K).numpy()

    def dry(self, motion: Motion) -> Tensor:
        """Dry friction (m, nv) over its level: as the laws of the model remember, else of velocities alone."""
        dry, first = (torch.as_tensor(motion.v) / DRY).tanh(), 0
        z = Past(self.model).over(torch.as_tensor(motion.q))[0]
        for law in self.model.laws:
            if (joints := law.memory_joints(self.model.robot)) is not None and law.transmission is None:
                dry[:, list(joints)] = z[:, first : first + len(joints)]
            first += len(law.memory_names(self.model.robot))
        return dry

    def triangle(self, motion: Motion) -> np.ndarray:
        """R (k, k) of the QR decomposition of the regressor, of some samples after the other: all would fill GB."""
        nv, R = len(self.scale), np.zeros((0, len(self.columns) + 2 * len(self.scale)))
        some, dry = max(1, ENTRIES // (10 * nv**2)), self.dry(motion)
        for begin in range(0, len(motion.q), some):
            q, v, a = (torch.as_tensor(x[begin : begin + some]) for x in motion[1:4])
            Y = torque_regressor(self.model.robot, q, v, a)[..., self.columns]
            Y = torch.cat([Y, torch.diag_embed(v), torch.diag_embed(dry[begin : begin + some])], dim=-1)
            Y = (Y.numpy() / self.scale[:, None]).reshape(-1, Y.shape[-1])
            R = np.asarray(np.linalg.qr(np.concatenate([R, Y]), mode="r"))
        return R

    def score(self, motion: Motion) -> float:
        """What is to be small: minus log det of the information."""
        return -float(np.linalg.slogdet(self.triangle(motion))[1])


@dataclass(frozen=True, eq=False, repr=False)
class Excitation(Summary):
    """A motion of `seconds` that `excitation` chose, from rest at `start` (nv,) and back.

    `limits` are the ends (2, nv) of position (from the start), velocity, acceleration and torque. `model` is the
    posterior that was given, `expected` the same after the motion, `spread` (2, nv) the std of the acceleration before
    and after, in rad/s^2 (m/s^2). Without learned forces these are None, and `condition` is that of the regressor.
    """

    robot: Robot
    start: Float[np.ndarray, " nv"]
    limits: Mapping[str, Float[np.ndarray, "2 nv"]]
    seconds: float
    torques: Callable[..., Values]
    surfaces: Sequence[Contact]
    clearance: float
    motion: Motion
    model: Posterior | None = None
    expected: Posterior | None = None
    spread: np.ndarray | None = None
    condition: float | None = None

    @cached_property
    def basis(self) -> list[BSpline]:
        """Of q, v and a, one function per free control point."""
        spans = max(8, round(SPANS * self.seconds))
        q = BSpline(np.pad(np.linspace(0.0, self.seconds, spans + 1), 3, "edge"), np.eye(spans + 3)[:, 3:-3], 3)
        return [q, q.derivative(1), q.derivative(2)]

    @cached_property
    def _samples(self) -> list[Float[np.ndarray, "n K"]]:
        time = np.linspace(0.0, self.seconds, SAMPLES * (self.basis[0].c.shape[1] + 3) + 1)
        return [spline(time) for spline in self.basis]

    @property
    def usage(self) -> dict[str, Float[np.ndarray, " nv"]]:
        """The largest position (from the start), velocity, acceleration and torque over their limits."""
        values = self.motion.points, *self.motion[2:]
        return {name: self.used(name, x) for name, x in zip(QUANTITIES, values, strict=True)}

    @override
    def facts(self) -> Mapping[str, object]:
        """How much it uses of the limits, and what it teaches."""
        spread = () if self.spread is None else np.linalg.norm(self.spread, axis=1)
        teaches = {"spread": rounded(spread), "condition": self.condition}
        return {name: f"{x.max():.0%} of limit" for name, x in self.usage.items()} | teaches

    def trajectory(self, t: Any) -> tuple[AtTimes, AtTimes, AtTimes]:
        """q, v and a (n, nv) at times t (n,) in s, or (nv,) at one; at rest before and after."""
        q, v, a = (spline(np.clip(t, 0.0, self.seconds)) @ self.motion.points for spline in self.basis)
        return self.start + q, v, a

    def save_csv(self, path: str | Path, rate: float = 100.0, *, overwrite: bool = True) -> None:
        """Write t in s and q, v, a and u of every joint, `rate` rows per second, as `forcegp import` reads them."""
        check_time_step(rate)
        time = np.arange(round(self.seconds * rate) + 1) / rate
        states = self.trajectory(time)
        names = ["t", *(f"{what}_{joint}" for what in "qvau" for joint in self.robot.joint_names)]
        quoted = (f'"{name.replace(chr(34), 2 * chr(34))}"' if set(name) & {",", '"'} else name for name in names)
        with atomic_file(path, overwrite=overwrite) as temporary:
            table = np.hstack([time[:, None], *states, self.torques(*states)])
            np.savetxt(temporary, table, "%.9g", ",", header=",".join(quoted), comments="", encoding="utf-8")

    def used(self, name: str, x: Values) -> Float[np.ndarray, " nv"]:
        """The largest value of a quantity over its limit; of the position from its control points."""
        ends, more = self.limits[name], 0.0 if name == "position" else _between(x)
        reached = np.stack([x.min(0) - more, x.max(0) + more])
        return np.divide(reached, ends, out=np.zeros_like(ends), where=ends != 0.0).max(0)

    def random(self, rng: np.random.Generator) -> Values:
        """Control points of any size and smoothness, not yet within the limits."""
        low, high = self.limits["position"]
        points, memory = rng.standard_normal((self.basis[0].c.shape[1], len(low))), rng.uniform(-0.5, 0.9, len(low))
        for k in range(1, len(points)):
            points[k] = memory * points[k - 1] + np.sqrt(1.0 - memory**2) * points[k]
        return rng.uniform(0.0, 0.7) * rng.uniform(low, high) + rng.uniform(0.1, 0.6, len(low)) * (high - low) * points

    def kept(self, points: Values) -> Motion:
        """The motion of these points, made smaller until all limits hold. Raises InvalidInput where nothing is left."""
        points = np.clip(points, *self.limits["position"])
        torque, distances = np.zeros(self.robot.nv), np.zeros(0)
        for _ in range(ROUNDS):
            q, v, a = (sample @ points for sample in self._samples)
            fast = np.maximum(self.used("velocity", v), self.used("acceleration", a)).clip(1.0) * (1.0 + EXACT)
            points, q, v, a = points / fast, self.start + q / fast, v / fast, a / fast
            distances = self.distances(q)
            if (distances >= self.clearance).all():
                motion = Motion(points, q, v, a, self.torques(q, v, a))
                torque = self.used("torque", motion.u)
                if (torque <= 1.0).all():
                    return motion
            points = SHRINK * points
        j = int(torque.argmax())
        what = f"joint {self.robot.joint_names[j]} needs {torque[j]:.3g} times its torque limit"
        if (distances < self.clearance).any():
            j = int(distances.argmin())
            what = f"frame {self.surfaces[j].frame!r} is {distances[j]:.3g} m from its surface, not {self.clearance:g},"
        raise InvalidInput(f"{what} at the start, so no motion keeps its limits; start elsewhere, or change limits.")

    def distances(self, q: Values) -> Float[np.ndarray, " surfaces"]:
        """The least signed distance of every point from its surface in m."""
        at = self.robot.kinematics(torch.as_tensor(q))
        each = np.array([x.distance(at).numpy() for x in self.surfaces]).reshape(-1, len(q)).T
        return each.min(0) - _between(each)


def of_few_rows(posterior: Posterior, count: int) -> Posterior:
    """The same posterior, exact, of `count` of its rows alone, far apart."""
    own, given = posterior.likelihood, posterior.training
    kept = torch.as_tensor(far_apart(given.q, given.v, given.u, count))
    sensed = {name: x[kept] for name, x in given.sensed.items()}
    some = replace(given, sensed=sensed, **{name: x[kept] for name, x in vars(given).items() if isinstance(x, Tensor)})
    own = replace(own, training=some)  # standardised as before
    return replace(posterior, likelihood=own, latent=own.condition(own.kernels, posterior.hyperparameters))


def far_apart(q: Any, v: Any, u: Any, count: int) -> np.ndarray:
    """Numbers of `count` rows, or of all, as a fit chooses them."""
    return farthest_point_sampling(np.hstack([q, v, u]), min(count, len(q)))


def _between(samples: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " k"]:
    return np.abs(np.diff(samples, 2, axis=0)).max(0) / 8.0


def motion_limits(robot: Robot, start: np.ndarray, given: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The `limits`: those given, and `MARGIN` times the URDF's. InvalidInput names a joint that cannot keep them."""
    for name in given:
        require_known("limit", name, "excitation", QUANTITIES)
    joints = [(x.lower, x.upper, MARGIN * x.velocity_limit, np.inf, MARGIN * x.effort_limit) for x in robot.joints]
    lower, upper, *most = np.array(joints).T
    inset = 0.5 * (1.0 - MARGIN) * np.nan_to_num(upper - lower, posinf=0.0)
    stated, limits = [np.stack([lower + inset - start, upper - inset - start])], {}
    for name, ends in zip(QUANTITIES, stated + [np.outer((-1.0, 1.0), x) for x in most], strict=True):
        asked = per_joint(f"limits[{name!r}]", given.get(name, np.inf), robot.nv).numpy()
        limits[name] = low, high = ends.clip(-asked, asked)
        wrong = (low > 0.0) | (high < 0.0) | (low == high) | (np.isinf(high) & (name == "velocity"))
        if wrong.any():
            j = int(wrong.argmax())
            ends = f"{name} limits of {low[j]:.4g} and {high[j]:.4g}{' from there' * (name == 'position')}"
            seen = f"joint {robot.joint_names[j]}: no motion from {start[j]:.4g} can be chosen within {ends}"
            raise InvalidInput(f"{seen}; give limits={{{name!r}: ...}}, or another start.")
    limits["position"] = np.where(np.isinf(limits["position"]), limits["velocity"], limits["position"])
    return limits


@usable_arguments("excitation")
def excitation(
    model: Robot | Model | Posterior,
    *,
    seconds: float = 10.0,
    limits: Mapping[str, Any] | None = None,
    start: Any = None,
    surfaces: Sequence[Contact] | None = None,
    clearance: float = 0.05,
    task: Dataset | None = None,
    rows: int = 100,
    motions: int = 300,
    seed: int = 0,
) -> Excitation:
    """The motion from rest at `start` and back after which learned forces are surest.

    * model: a `Posterior`, whose accelerations at the states of `task` (None: any within the limits) are to
      be sure once it has learned from `rows` rows of the motion; or a robot or another model, for the
      identification of base parameters and friction.
    * limits: of "position" (from the start), "velocity", "acceleration" and "torque", numbers or one per joint, in rad,
      s and Nm (m, N); nine tenths of those of the URDF count, too.
    * start: posture (nv,); None takes the mean of the training rows, or the middle of the joints' limits.
    * surfaces: contacts whose points keep `clearance` m away; None takes the model's. No other collision is looked at.
    * motions: how many to look at; the first third at random, the others as changes to the best so far.

    Raises InvalidInput for arguments that do not fit and, naming the joint, for limits that cannot be kept.
    """
    if not isinstance(model, Robot | Model | Posterior):
        raise InvalidInput(f"model is a {type(model).__name__}; give a Robot, a Model or a fitted model.")
    known = Model(model) if isinstance(model, Robot) else model.model if isinstance(model, Posterior) else model
    known.robot.require_vectors("planned motions")
    robot, rng = known.robot, np.random.default_rng(whole_number("seed", seed, 0))
    for name, value, most in (("seconds", seconds, LONGEST), ("clearance", clearance, 1e9)):
        require_number(name, value, f"give a positive number of at most {most:g}", below=math.nextafter(most, math.inf))
    if start is None:
        half = np.array([(x.upper - x.lower) / 2.0 for x in robot.joints])
        lowest = np.array([x.lower if np.isfinite(x.lower) else 0.0 for x in robot.joints])
        middle = lowest + np.nan_to_num(half, posinf=0.0)
        start = model.training.q.mean(0).numpy() if isinstance(model, Posterior) else middle
        start = start.clip(middle - INSIDE * MARGIN * half, middle + INSIDE * MARGIN * half)
    start = finite_vector("start", start, robot.nv)
    bounds = motion_limits(robot, start, require_type("limits", {} if limits is None else limits, Mapping))
    rows, motions = whole_number("rows", rows, 1), whole_number("motions", motions, 1, 100_000)
    learned = model if isinstance(model, Posterior) and model.latent_names else None
    teaches = BaseParameters(known, bounds["torque"][1]) if learned is None else LearnedForces(learned, rows)
    surfaces = (known if surfaces is None else known.with_contacts(surfaces)).contacts
    draft = Excitation(robot, start, bounds, seconds, teaches.torques, surfaces, clearance, Motion(*[start] * 5))
    best, least, size = draft.kept(0.0 * draft.random(rng)), np.inf, 0.3  # refuses the start
    if isinstance(teaches, LearnedForces) and task is not None:
        require_rows("task", task, robot.joint_names, "the model", "")
        task = with_memory(task, known)
        some = np.linspace(0, len(task) - 1, min(STATES, len(task))).astype(int)
        teaches.judged_at = task.q[some], task.v[some], task.u[some]
    elif isinstance(teaches, LearnedForces):
        q, v = (rng.uniform(low, high, (STATES, robot.nv)) for low, high in (bounds[x] for x in QUANTITIES[:2]))
        teaches.judged_at = teaches.steady(start + q, v)
    with blas_threads(MOST_ROWS):
        for k in range(motions):
            points, changed = draft.random(rng), k >= max(1, motions // 3)
            if changed:  # change some joints for some time
                middle, width = rng.uniform(0.0, len(points)), rng.uniform(1.0, len(points))
                near = np.exp(-((np.arange(len(points)) - middle) ** 2) / (2.0 * width**2))[:, None]
                points = best.points + size * near * (rng.random(robot.nv) < 0.5) * points
            motion = draft.kept(points)
            score = teaches.score(motion)
            size *= (1.3 if score < least else 0.96) if changed else 1.0
            best, least = (motion, score) if score < least else (best, least)
            tell(k + 1, motions)
    if not np.isfinite(least):
        raise InvalidInput(f"no motion of {motions} shows all base parameters; give more seconds, limits or motions.")
    if isinstance(teaches, BaseParameters):
        R = teaches.triangle(best)
        return replace(draft, motion=best, condition=float(np.linalg.cond(R / np.linalg.norm(R, axis=0))))
    before, after = teaches.posterior, teaches.after(best, teaches.posterior)
    spread = np.stack([teaches.spread(x) for x in (before, after)])
    return replace(draft, motion=best, model=before, expected=after, spread=spread)
