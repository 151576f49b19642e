"""Contacts that nobody modelled, from motion and torque alone: `ContactMonitor`."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.optimize import minimize
from scipy.signal import lfilter
from scipy.stats import chi2, gumbel_r
from torch import Tensor

from forcegp.control.tracking import Moving, Past, joint_forces, model_of
from forcegp.doubts import Doubt, Doubts, look
from forcegp.errors import DatasetError, InvalidInput, require_number
from forcegp.evidence.least_squares import NoiseLevels
from forcegp.integration.integrators import check_time_step
from forcegp.posterior.predictor import Predictor
from forcegp.robots import Robot
from forcegp.robots.arguments import finite_vector, real_array

Torques = Float[np.ndarray, " rows"]
Motion = tuple[Any, Any, Any]
"""q, v and u (T, nv) of one recording; u[k] acts from row k to row k + 1."""

Residuals = tuple[Tensor, Tensor, Tensor | None, Tensor, Tensor, Tensor]
"""As of `_torques`, tau filtered, and M a, filtered, (T - 1 - settle, nv); in the middle of all steps velocities
(T - 1, nv), and how much of what friction remembers depends on what was before (T - 1, m)."""

BLOCK = 2.0  # seconds of free motion of which the largest distance counts once: what follows upon it resembles it
LEAST_BLOCKS = 20
SLOW = tuple(np.geomspace(0.01, 0.5, 8).tolist())
"""Of the root mean square velocity, over what errors of friction near rest may fade: Stribeck's velocity, or a part."""
MOST_ROWS, LEVEL_ROWS = 5000, 500  # that these errors are found from: filtered, neighbours tell the same; and levels
PLACES = 5  # points along each link where a contact is tried
UNSEEN = 1e-6  # of the largest effect of a force on torques: what has less is rounding, as on the axis of a joint
SAME = 1e-9  # relative; forces that differ by less are as large: one link ends where the next one begins
EXPLAINED = float(chi2.ppf(0.95, 1))  # links whose misfit is larger by less explain a torque as well as the best
TOUCHED, STRONG, FAR = 5.6, 10.0, 1.75
"""Interquartile ranges over the median that of 10,000 roots of largest distances one exceeds (Gumbel), or medians of a
joint's torque in their place, where distances take a push for errors near rest; and how many medians of these."""
POSTURES = 50  # at which the smallest forces are computed


@dataclass(frozen=True, eq=False)
class ContactState:
    """What a monitor found at rows (...): `torque` (..., nv) in Nm (N) of what touches the robot, low-pass filtered.

    `distance` (...) is its squared Mahalanobis distance from free motion; `alarm` where that is over the threshold;
    `probability` the share of stretches of 2 s of free motion that stay below it.
    """

    torque: Float[Tensor, "*rows nv"]
    distance: Float[Tensor, "*rows"]
    probability: Float[Tensor, "*rows"]
    alarm: Bool[Tensor, "*rows"]


@dataclass(frozen=True)
class ContactPlace:
    """A force (3,) in N, world axes, with its std, at a point (3,) in m of the link; `also` are other links."""

    link: str
    point: tuple[float, float, float]
    force: tuple[float, float, float]
    force_std: tuple[float, float, float]
    also: tuple[str, ...]


class ContactMonitor:
    """A momentum observer around a model of the forces: what moves the robot beyond it is a contact.

    tau = M a - Q_K - Q_U in the middle of a step of `dt` s, filtered to first order with `bandwidth` Hz (De Luca &
    Mattone 2005), with the covariance S = M D_a M + D_f + D_s of free motion (`calibrate`), to which the spread of
    learned forces adds where `model`, `posterior.predictor()` or a `Model`, has one. D_s are errors of friction near
    rest, of the size s exp(-|v| / v_s), filtered as tau is: reversals show how large they are, and a joint that creeps
    has them for long. Where friction remembers, no joint has less of them, relative to its friction, than joints have
    on average, for the next motion may reverse where free motion did not; and what it remembers from before the first
    sample is unknown until the joint has moved. Where M a of a joint goes beyond what free motion has shown, its errors
    grow in proportion. An alarm is raised where tau^T S^-1 tau exceeds a threshold that free motion reaches as often as
    stated. Raises InvalidInput for arguments that do not fit and a monitor not calibrated, DatasetError for few rows.
    """

    def __init__(self, model: Moving, *, dt: float, bandwidth: float = 2.0) -> None:
        self.model, self.known = model, model_of(model)
        self.known.robot.require_vectors("monitors of contacts")
        if self.known.contacts:
            seen = "ContactMonitor looks for contacts that are not modelled, and this model has one"
            raise InvalidInput(f"{seen}; fit a log of free motion, or give posterior.with_contacts([]).")
        self.open = isinstance(model, Predictor) and model.kind != "none"
        check_time_step(dt)
        require_number("bandwidth", bandwidth, f"give Hz above 0 and below {0.5 / dt:g}, half the rate", below=0.5 / dt)
        self.robot: Robot = self.known.robot
        self.dt, self.bandwidth = float(dt), float(bandwidth)
        self.keep = math.exp(-2.0 * math.pi * bandwidth * dt)
        self.noise: NoiseLevels | None = None
        self.near_rest = np.zeros(self.robot.nv), np.ones(self.robot.nv)
        """Standard deviations s (nv,) of errors of friction at rest [Nm or N], and velocities v_s (nv,)."""
        self.largest = torch.full((self.robot.nv,), math.inf, dtype=torch.float64)
        """Of |M a| (nv,) in free motion [Nm or N], filtered."""
        self.usual = self.middle = torch.zeros(self.robot.nv, dtype=torch.float64)
        """Errors of friction near rest (nv,) in free motion [Nm or N], filtered: their root mean square, and median."""
        self.level = torch.zeros(self.robot.nv, len(self.known.memory.names), dtype=torch.float64)
        """Torques (nv, m) of all that friction remembers [Nm or N]."""
        self.ends = link_ends(self.robot)
        self.threshold = math.inf
        self.doubts = Doubts()
        """What speaks against the free motion: an offset, or stretches in which something touched the robot."""
        self._maxima = (0.0, 1.0)
        self.restart()

    def restart(self) -> None:
        """Forget earlier calls, as at the beginning of a recording."""
        self._filtered = torch.zeros(3, self.robot.nv, dtype=torch.float64)  # torque, M a, errors near rest
        self.past = Past(self.known)
        self._before: tuple[Tensor, Tensor, Tensor] | None = None

    def calibrate(self, free: Sequence[Motion], *, false_alarms_per_hour: float = 0.1) -> "ContactMonitor":
        """Learn the noise and the threshold from recordings (T, nv) of free motion; returns the monitor.

        Roots of the largest distances of stretches of 2 s follow a Gumbel distribution (Fisher, Tippett 1928), whose
        quantile is the threshold. Take another motion than the model learned from, as varied as those to come.
        """
        rate, words = false_alarms_per_hour, f"give a number above 0 and below {3600 / BLOCK:g}"
        require_number("false_alarms_per_hour", rate, words, below=3600 / BLOCK)
        settle, block = round(1.0 / (self.bandwidth * self.dt)), round(BLOCK / self.dt)
        found = [self._residuals(*motion, settle) for motion in free]
        if sum(len(tau) // block for tau, *_ in found) < LEAST_BLOCKS:
            seconds = sum(len(tau) for tau, *_ in found) * self.dt
            seen = f"free motion of {seconds:.3g} s is too short for a threshold"
            raise DatasetError(f"{seen}; give at least {LEAST_BLOCKS * BLOCK:g} s in stretches of {BLOCK:g} s or more.")
        tau, M, inertial = map(torch.cat, zip(*((tau, M, inertial) for tau, M, _, inertial, *_ in found), strict=True))
        v = torch.cat([each[4][settle:] for each in found])
        self.largest = inertial.abs().amax(0).clamp_min(1e-9)  # of a joint that rested, any motion is beyond
        self.noise = NoiseLevels.of(torch.linalg.solve(M, tau[..., None])[..., 0].numpy(), M.numpy())
        speed = np.maximum(v.square().mean(0).sqrt().numpy(), 1e-12)
        slow = [np.concatenate([self._near_rest(each[4], share * speed)[settle:] for each in found]) for share in SLOW]
        some = slice(None, None, max(1, len(tau) // MOST_ROWS))
        known = (M[some].square() @ torch.as_tensor(self.noise.acceleration).square()).numpy()
        best = [
            min((*errors_near_rest(tau[some, j].numpy(), known[:, j], each[some, j]), k) for k, each in enumerate(slow))
            for j in range(self.robot.nv)
        ]
        (_, force, at_rest, _), which = np.array(best).T, [each[-1] for each in best]
        self.noise = NoiseLevels(self.noise.acceleration, force)
        friction, self.level = self._friction(free)
        shown = (friction > UNSEEN * friction.max()) & bool(self.past.memory.names)
        share = math.sqrt(float(np.mean(np.square(at_rest[shown] / friction[shown])))) if shown.any() else 0.0
        fades = np.take(SLOW, which)
        fades = np.maximum(fades, np.exp(np.log(fades).mean())) if shown.any() else fades
        self.near_rest = np.maximum(at_rest, share * friction), fades * speed
        errors = torch.cat([self._errors(each) for each in found])
        self.usual, self.middle = errors.square().mean(0).sqrt(), errors.median(0).values
        distances = [self._distances(each) for each in found]
        largest = torch.cat([d[: len(d) // block * block].view(-1, block).amax(1) for d in distances])
        size = [d[: len(d) // block * block].view(-1, block, self.robot.nv).square().mean(1).sqrt() for d, *_ in found]
        self.doubts = Doubts([*self._offsets(tau), *_touches(largest.sqrt(), size)])
        self._maxima = gumbel_r.fit(largest.sqrt().numpy())
        self.threshold = float(gumbel_r.isf(rate * BLOCK / 3600.0, *self._maxima)) ** 2
        return self

    def __call__(self, q: Any, v: Any, u: Any) -> ContactState:
        """What the step to this sample shows, called every `dt` s; q, v and u (nv,), which acts from now on."""
        before, self._before = self._before, None  # of a broken sample the next one takes nothing over
        self._before = sample = self._motion(q, v, u)
        if before is None:
            return self._state(self._filtered[0], self._filtered.new_zeros(()))
        q, v = (0.5 * (old + new) for old, new in zip(before, sample[:2], strict=False))
        a = (sample[1] - before[1]) / self.dt
        tau, M, extra, unknown = self._torques(*(x[None] for x in (q, v, before[2], a)))
        now = torch.stack([tau[0], M[0] @ a, self._errors_now(v, unknown[0])])
        self._filtered = self._filtered + (1.0 - self.keep) * (now - self._filtered)
        torque, inertial, errors = self._filtered
        return self._state(torque, self._distance(torque[None], self._covariance(M, extra, errors, inertial))[0])

    def run(self, q: Any, v: Any, u: Any) -> ContactState:
        """The same of a whole recording (T, nv); nothing is known at its first row."""
        found, pad = self._residuals(q, v, u), torch.nn.functional.pad
        return self._state(pad(found[0], (0, 0, 1, 0)), pad(self._distances(found), (1, 0)))

    def place(self, q: Any, torque: Any) -> ContactPlace:
        """The contact at q (nv,) that explains an external torque (nv,) by a force without a moment.

        Least squares in the metric of the noise, at points along every link; of those alike the least force, and of
        forces as large the link that is nearest to the base.
        """
        q, tau = (torch.as_tensor(finite_vector(n, x, self.robot.nv)) for n, x in (("q", q), ("torque", torque)))
        M, J = self.levers(q)
        white = torch.linalg.inv(torch.linalg.cholesky(self._covariance(M, None, self.usual, 0.0 * tau)))
        along = torch.linspace(0.0, 1.0, PLACES, dtype=q.dtype)
        tau, J = white @ tau, (J[:, :1] + along[:, None, None] * (J[:, 1:] - J[:, :1])).flatten(0, 1) @ white.mT
        inverse = torch.linalg.pinv(J.mT, atol=UNSEEN * J.square().sum((-1, -2)).max().sqrt(), rtol=0.0)
        force = inverse @ tau
        misfit = (tau - (force[:, None] @ J)[:, 0]).square().sum(-1)
        newton, felt = force.norm(dim=-1), inverse.square().sum((-1, -2)) > 0.0  # what moves no joint explains nothing
        alike = felt & (misfit <= misfit.min() + EXPLAINED)
        best = int((alike & (newton <= (1.0 + SAME) * newton[alike].min())).nonzero()[0])
        links, ends = zip(*self.ends.items(), strict=True)
        also = dict.fromkeys(links[k // PLACES] for k in alike.nonzero()[:, 0].tolist())
        link, point = links[best // PLACES], ends[best // PLACES] * float(along[best % PLACES])
        x, y, z = (tuple(each.tolist()) for each in (point, force[best], inverse[best].square().sum(-1).sqrt()))
        return ContactPlace(link, x, y, z, tuple(name for name in also if name != link))

    def smallest_forces(self, q: Any) -> dict[str, list[float]]:
        """Forces [N] at the end of each link that reach the threshold: along the axis that is felt best, and worst.

        Medians over postures q (T, nv), at median errors near rest; inf along axes that no torque shows.
        """
        rows, found = torch.tensor(real_array("q", q), dtype=torch.float64), []
        for at in rows[:: max(1, len(rows) // POSTURES)]:
            M, J = self.levers(at)
            S = self._covariance(M, None, self.middle, 0.0 * at)
            felt = torch.linalg.eigvalsh(J[:, 1] @ torch.linalg.solve(S, J[:, 1].mT))[:, [2, 0]]
            found.append((self.threshold / torch.where(felt > UNSEEN**2 * felt.max(), felt, 0.0)).sqrt())
        return dict(zip(self.ends, torch.stack(found).median(0).values.tolist(), strict=True))

    def levers(self, q: Float[Tensor, " nq"]) -> list[Tensor]:
        """M (nv, nv), and Jacobians (L, 2, 3, nv) of both ends of every link, world axes; without branches."""
        kinematics = self.known.loaded_robot.kinematics(q)
        J = [kinematics.frame_jacobian(link, k * end)[:3] for link, end in self.ends.items() for k in (0, 1)]
        return [self.known.mass_matrix_at(kinematics), torch.stack(J).unflatten(0, (-1, 2))]

    @property
    def numbers(self) -> dict[str, Any]:
        """What it learned and how it chooses, by their names in programs."""
        noise, (at_rest, fades) = self.calibrated, self.near_rest
        own = {"PERIOD": self.dt, "SHARE": 1.0 - self.keep, "THRESHOLD": self.threshold, "LARGEST": self.largest}
        own |= {"ACCELERATIONS": noise.acceleration, "FORCES": noise.force, "AT_REST": at_rest, "FADES": fades}
        own |= {"USUAL": self.usual, "LEVEL": self.level, "ENDS": np.stack([*self.ends.values()]), "PLACES": PLACES}
        return own | {"UNSEEN": UNSEEN, "SAME": SAME, "EXPLAINED": EXPLAINED}

    @property
    def calibrated(self) -> NoiseLevels:
        """The noise of free motion. Raises InvalidInput before `calibrate`."""
        if self.noise is None:
            raise InvalidInput("this monitor is not calibrated: call calibrate([(q, v, u)]) with free motion first.")
        return self.noise

    def _offsets(self, tau: Tensor) -> Iterator[Doubt]:
        """Joints in which most of the torque that free motion leaves (rows, nv) is always the same."""
        for joint, mean, std in zip(self.robot.joint_names, tau.mean(0).tolist(), tau.std(0).tolist(), strict=True):
            if abs(mean) > std:  # Nm or N
                seen = f"free motion needs {mean:.2g} more than the model in joint {joint!r} all the time, ± {std:.1g}."
                yield look(about="offset", what=seen, do="Fit an offset, or find a payload.", joints=(joint,))

    def _covariance(self, M: Tensor, extra: Tensor | None, errors: Tensor, inertial: Tensor) -> Tensor:
        """S (..., nv, nv) of filtered torques where the mass matrix is M, with what the posterior leaves open.

        `errors` (..., nv) are those near rest, `inertial` (..., nv) M a, both filtered.
        """
        noise = self.calibrated
        acceleration, force = (torch.as_tensor(x).square() for x in (noise.acceleration, noise.force))
        S = (M * acceleration) @ M + (force + errors.square()).diag_embed()
        beyond = (inertial.abs() / self.largest).clamp_min(1.0)
        S = beyond[..., :, None] * S * beyond[..., None, :]
        return S if extra is None else S + extra

    def _motion(self, q: Any, v: Any, u: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Checked samples, (nv,) each or (T, nv)."""
        named = zip("qvu", (q, v, u), strict=True)
        found = [torch.tensor(real_array(name, x), dtype=torch.float64) for name, x in named]
        shapes = [tuple(x.shape) for x in found]
        if len({*shapes}) > 1 or shapes[0][-1:] != (self.robot.nv,) or not all(bool(x.isfinite().all()) for x in found):
            seen = f"q, v and u have shapes {', '.join(map(str, shapes))}"
            advice = f"all ({self.robot.nv},) for one sample or (T, {self.robot.nv}) for a recording."
            raise InvalidInput(f"{seen}; give finite numbers, {advice}")
        return found[0], found[1], found[2]

    def _near_rest(self, v: Tensor, fade: np.ndarray) -> np.ndarray:
        """exp(-|v| / fade) (T, nv), filtered as torques are."""
        return self._low_passed(np.exp(-np.abs(v.numpy()) / fade))

    def _friction(self, free: Sequence[Motion]) -> tuple[np.ndarray, Float[Tensor, "nv m"]]:
        """Root mean squares of modelled friction (nv,), the part that turns with v, and of all that is remembered."""
        rows = [torch.cat(each) for each in zip(*(self._motion(*motion) for motion in free), strict=True)]
        q, v, u = (each[:: max(1, len(each) // LEVEL_ROWS)] for each in rows)

        def forces(v: Tensor, z: Tensor) -> Tensor:
            return joint_forces(self.model, q, v, self.past.beside(u, z) if len(z) else u).Q

        one = torch.eye(self.level.shape[1], dtype=q.dtype)
        z, none = one.sum(0), forces(v, 0.0 * one.sum(0))
        level = [(forces(v, each) - none).square().mean(0).sqrt() for each in one]
        turning = 0.5 * (forces(v, z) - forces(-v, -z))
        return turning.square().mean(0).sqrt().numpy(), torch.stack(level, 1) if level else self.level

    def _errors_now(self, v: Tensor, unknown: Tensor) -> Tensor:
        """Of friction near rest (..., nv), and of what it remembers from before the first sample."""
        at_rest, fades = map(torch.as_tensor, self.near_rest)
        return at_rest * torch.exp(-v.abs() / fades) + unknown @ self.level.mT

    def _errors(self, found: Residuals) -> Tensor:  # filtered as torques are
        return torch.from_numpy(self._low_passed(self._errors_now(*found[4:]).numpy()))[-len(found[0]) :]

    def _distances(self, found: Residuals) -> Float[Tensor, " rows"]:
        tau, M, extra, inertial, *_ = found
        return self._distance(tau, self._covariance(M, extra, self._errors(found), inertial))

    def _residuals(self, q: Any, v: Any, u: Any, settle: int = 0) -> Residuals:
        q, v, u = self._motion(q, v, u)
        if q.dim() != 2 or len(q) < 2:
            raise InvalidInput(f"a recording has shape {tuple(q.shape)}; give (T, {self.robot.nv}), two rows or more.")
        self.past = Past(self.known)
        middle = 0.5 * (q[1:] + q[:-1]), 0.5 * (v[1:] + v[:-1])
        a = (v[1:] - v[:-1]) / self.dt
        tau, M, extra, unknown = self._torques(*middle, u[:-1], a)
        both = np.stack([tau.numpy(), (M @ a[..., None])[..., 0].numpy()])
        filtered, inertial = torch.from_numpy(self._low_passed(both, axis=1))
        extra = None if extra is None else extra[settle:]
        return filtered[settle:], M[settle:], extra, inertial[settle:], middle[1], unknown

    def _low_passed(self, values: np.ndarray, axis: int = 0) -> np.ndarray:
        return lfilter([1.0 - self.keep], [1.0, -self.keep], values, axis=axis)

    def _torques(self, q: Tensor, v: Tensor, u: Tensor, a: Tensor) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
        """M a - Q_K - Q_U at rows, M, M Cov(a) M of what the posterior leaves open, and `Past.open`."""
        unknown = q.new_zeros(len(q), 0)
        if self.past.memory.names:
            seen, unknown = self.past.over(q)
            u = self.past.beside(u, seen)
        at = joint_forces(self.model, q, v, u)
        M = at.M
        extra = M @ self.model(q, v, u)[1] @ M if self.open and isinstance(self.model, Predictor) else None
        return (M @ a[..., None])[..., 0] - at.Q, M, extra, unknown

    @staticmethod
    def _distance(tau: Tensor, S: Tensor) -> Float[Tensor, " rows"]:
        return (tau * torch.linalg.solve(S, tau[..., None])[..., 0]).sum(-1)

    def _state(self, tau: Tensor, distance: Tensor) -> ContactState:
        probability = torch.from_numpy(np.asarray(gumbel_r.cdf(distance.sqrt().numpy(), *self._maxima)))
        return ContactState(tau.clone(), distance, probability, distance > self.threshold)


def _touches(largest: Tensor, size: Sequence[Float[Tensor, "blocks nv"]]) -> Iterator[Doubt]:
    """Stretches whose largest distance, of which this is the root, or torques free motion would hardly reach."""
    low, middle, high = largest.quantile(largest.new_tensor([0.25, 0.5, 0.75]))
    strong = torch.cat([*size]) > STRONG * torch.cat([*size]).median(0).values.clamp_min(1e-9)
    far = ((largest > middle + TOUCHED * (high - low)) | strong.any(1)) & (largest > FAR * middle)
    starts, rows = np.concatenate([BLOCK * np.arange(len(each)) for each in size]), far.nonzero()[:, 0].numpy()
    for own in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else ():
        seen = f"from {starts[own[0]]:g} to {starts[own[-1]] + BLOCK:g} s free motion is far from the model"
        seen = f"{seen}, {float(largest[own].max() / middle):.2g} times as far as usual."
        yield look(about="touched", what=seen, do="If something touched the robot, leave that out: it hides contacts.")


def errors_near_rest(tau: Torques, known: Torques, slow: Torques) -> tuple[float, float, float]:
    """Standard deviations f and s by which tau ~ N(0, known + f^2 + (s slow)^2) is most likely.

    The first number is minus the mean logarithm of the likelihood, less a constant.
    """

    def cost(x: np.ndarray) -> float:
        S = known + np.exp(2.0 * x[0]) + np.exp(2.0 * x[1]) * slow**2
        return float(np.mean(np.log(S) + tau**2 / S)) / 2.0

    size = np.log(max(float(tau.std()), 1e-12))
    found = minimize(cost, [size, size], method="Nelder-Mead")
    return (float(found.fun), *np.exp(found.x).tolist())


def link_ends(robot: Robot) -> dict[str, Float[Tensor, "3"]]:
    """The point (m) of every moving link that is farthest from its joint."""
    layout, found = robot.layout, {}
    for body, joint in enumerate(layout.bodies):
        ends = [origin[:3, 3] for origin, parent in zip(layout.origins, layout.parents, strict=True) if parent == body]
        ends += [placed.offset[:3, 3] for placed in layout.links.values() if placed.body == body]
        turn = layout.links[joint.child].offset[:3, :3]
        ends = [*(turn.T @ end for end in ends), robot.link(joint.child).center_of_mass]
        found[joint.child] = torch.from_numpy(max(ends, key=np.linalg.norm))
    return found
