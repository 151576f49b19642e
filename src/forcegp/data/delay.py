"""How late torques are: logged later than they act (a delay), or acting later than they are commanded (a lag).

Of both, the number of seconds is taken at which inverse dynamics fits the torques best.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

import forcegp.robots
from forcegp.data.dataset import Dataset, require_rows
from forcegp.data.filters import Lag
from forcegp.data.sampling import episodes_in_order
from forcegp.errors import DatasetError, InvalidInput

LEAST_DELAY, USUAL_DELAY, LARGEST_DELAY = 5e-4, 0.05, 0.2  # s
STEPS = 100  # Shifts that are tried to either side
BLOCKS = 8
TINY = 1e-12
MOST_ROWS = 5_000
SIGNIFICANT = 3.0  # Standard deviations by which a delay must differ from zero to be used
FRICTION_WIDTHS = 0.01, 0.03, 0.1, 0.3, 1.0  # Of dry friction, relative to the root mean square velocity
ROWS_PER_PARAMETER = 3

WORTH = 0.98
"""Unexplained torque with the common delay, relative to that without, above which the delay explains nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Delay:
    """Delay or lag of the torque and the motion [s], with standard deviations [s]; NaN where the log shows none.

    `kind` is "delay" or "lag".
    `common` is the one delay that suits all joints best: what a bus or a filter does to all of them alike. `seconds`
    (nv,) is that of each joint alone; where friction makes up most of a torque it can be a property of the friction.
    `residual` (2, nv) is the share of the torque's variance that inverse dynamics leaves unexplained, without a shift
    and at the joint's own best one; `remains` what the common delay leaves of what was unexplained, as the geometric
    mean over the joints.
    """

    common: float
    common_std: float
    seconds: Float[np.ndarray, " nv"]
    std: Float[np.ndarray, " nv"]
    residual: Float[np.ndarray, "2 nv"]
    remains: float
    kind: str = "delay"

    def _showing(self, seconds: float) -> np.ndarray:
        """Delays of the joints that show this one, to within three standard deviations or a half of it."""
        each, std = (x[np.isfinite(self.seconds)] for x in (self.seconds, self.std))
        near = np.abs(each - seconds) <= np.maximum(SIGNIFICANT * np.nan_to_num(std), 0.5 * abs(seconds))
        return each[near] if 2 * near.sum() > len(near) else each[:0]

    @property
    def significant(self) -> float:
        """The delay that most joints show, if it is more than three standard deviations from zero, else 0.

        It is the common one, or else the median of the joints: where friction makes up most of a torque, noise of the
        velocity can look like a delay, which the likelihood of all joints then follows.
        """
        if not np.isfinite(self.common):
            return 0.0
        median = float(np.median(self.seconds[np.isfinite(self.seconds)]))
        for seconds, remains in ((self.common, self.remains), (median, 0.0)):
            showing = self._showing(seconds)
            spread = max(self.common_std, float(np.std(showing)) / len(showing) ** 0.5 if len(showing) else np.inf)
            if abs(seconds) > max(SIGNIFICANT * spread, LEAST_DELAY) and remains < WORTH:
                return seconds
        return 0.0

    @property
    def reason(self) -> str:
        """The common delay and what became of it, for people."""
        if not np.isfinite(self.common):
            return f"the torques show no common {self.kind}"
        size, used = f"{1e3 * self.common:.1f} ms ± {1e3 * self.common_std:.1f} ms", self.significant
        if used == self.common:
            return f"{size}, which leaves {100.0 * self.remains:.0f} % of what inverse dynamics does not explain"
        if used:
            return (
                f"{1e3 * used:.1f} ms, which most joints show (all together {size}, by joints that are mostly friction)"
            )
        return f"{size}, but not more than three standard deviations in most joints: none is assumed"


def estimate_delay(
    dataset: Dataset,
    robot: forcegp.robots.Robot | None = None,
    *,
    kind: Literal["delay", "lag"] = "delay",
) -> Delay:
    """The delay of u behind the motion, joint by joint: `u_logged(t + delay)` acts at t.

    For every shift up to .2 s to either side, u is fitted by least squares to what rigid bodies with friction
    in the joints need: the torque regressor of `robot` (default: that of `dataset.model`), acceleration and velocity
    of the joint, smooth signs of the velocity of several widths, and a constant. So the delay rests neither on the
    robot's parameters nor on one law of friction: with one smooth sign, friction that falls with velocity looked 20 ms
    late. The laws of the dataset's model have columns, too. The best
    shift has the least sum of squares, by a parabola through the three smallest: among shifts up to 50 ms and, where it
    lies at their end, up to .2 s, for each joint and for all together. Its standard deviation comes from leaving
    out each eighth of the log in turn (block jackknife; Kuensch 1989, "The jackknife and the bootstrap for general
    stationary observations").

    `kind="lag"` finds the time constant T of an actuator of first order instead: u(t) acts with T u_a' + u_a = u.

    Filter first: q, v, u and a must be those of one filter. Raises InvalidInput without a robot, or with contacts,
    whose forces are not known; DatasetError for a log shorter than .4 s.
    """
    robot = _robot(dataset, robot)
    near = _estimated(dataset, robot, USUAL_DELAY, kind)
    open_ones = np.isnan(near.seconds) & np.isfinite(near.residual[0])
    at_end = np.isnan(near.common + near.common_std)  # that of a part of the log lies beyond
    if not (open_ones.any() or at_end):
        return near
    try:
        far = _estimated(dataset, robot, LARGEST_DELAY, kind)
    except DatasetError:  # too short for that
        return near
    if at_end:
        return far
    parts = {
        name: np.where(open_ones, getattr(far, name), getattr(near, name)) for name in ("seconds", "std", "residual")
    }
    return replace(near, **parts)


def _estimated(dataset: Dataset, robot: forcegp.robots.Robot, largest: float, kind: str) -> Delay:
    parts = _Shifts(dataset, largest, kind)
    zero = int(np.argmin(np.abs(parts.shifts)))
    features = torque_columns(robot, dataset.rows(parts.rows))
    nv = dataset.nv
    profiles = np.full((nv, BLOCKS + 1, len(parts.shifts)), np.nan)  # of all rows, and of all but one block
    residual = np.full((2, nv), np.nan)
    for joint in range(nv):
        shifted = parts.torque(dataset.u[:, joint])  # (shifts, rows)
        spread = np.square(shifted - shifted.mean(axis=1, keepdims=True)).sum(axis=1)
        if not spread.min() > 1e-12 * np.square(shifted).sum(axis=1).max():
            continue  # a torque that does not change has no delay
        profiles[joint] = least_squares(_orthonormal(features[joint]), shifted.T)
        residual[:, joint] = profiles[joint, 0, zero] / spread[zero], profiles[joint, 0].min() / spread[zero]
    seconds = np.array([[lowest(profile, parts.shifts) for profile in own] for own in profiles])
    # Noise of every joint is unknown: the likelihood of one delay is the product of powers of the residuals.
    finite = profiles[np.isfinite(residual[0])]
    likelihoods = np.log(finite + TINY * finite.max(initial=0.0)).sum(axis=0)
    common = np.array([lowest(profile, parts.shifts) for profile in likelihoods])
    likelihood = likelihoods[0]
    return Delay(
        common=float(common[0]),
        common_std=float(jackknife(common[None, 1:])[0]),
        seconds=seconds[:, 0],
        std=jackknife(seconds[:, 1:]),
        residual=residual,
        remains=float(np.exp((likelihood.min() - likelihood[zero]) / max(len(finite), 1))),
        kind=kind,
    )


def least_squares(
    basis: Float[np.ndarray, "rows columns"], targets: Float[np.ndarray, "rows targets"]
) -> Float[np.ndarray, "parts targets"]:
    """What columns leave of the square sum of every target: of all rows, then of all but each block of them."""
    blocks = np.array_split(np.arange(len(targets)), BLOCKS)
    normal = np.stack([basis[rows].T @ basis[rows] for rows in blocks])
    right = np.stack([basis[rows].T @ targets[rows] for rows in blocks])
    square = np.stack([np.square(targets[rows]).sum(axis=0) for rows in blocks])
    sums = [part.sum(axis=0) for part in (normal, right, square)]
    without = [
        _unexplained(sums[0] - n, sums[1] - r, sums[2] - s) for n, r, s in zip(normal, right, square, strict=True)
    ]
    return np.stack([_unexplained(*sums), *without])


def jackknife(each: Float[np.ndarray, "estimates blocks"]) -> np.ndarray:
    """Standard deviation of an estimate from its values without each block; NaN where one of them is."""
    return np.sqrt((each.shape[-1] - 1) * np.var(each, axis=-1))


class _Shifts:
    """The rows that are compared, and how to shift a torque against them."""

    def __init__(self, dataset: Dataset, largest: float, kind: str) -> None:
        thin = max(1, -(-len(dataset) // MOST_ROWS))
        rows, self.episodes = [np.zeros(0, int)], []
        for number, part, _ in episodes_in_order(dataset):
            own = np.flatnonzero(dataset.episode == number)
            inner = (part.time >= part.time[0] + largest) & (part.time <= part.time[-1] - largest)
            rows.append(own[inner][::thin])
            self.episodes.append((own, part.time, dataset.time[rows[-1]]))
        self.rows = np.concatenate(rows)
        if len(self.rows) < 10 * BLOCKS:
            raise DatasetError(
                f"{len(self.rows)} rows lie more than {largest} s from the ends of their episodes; a delay needs at "
                f"least {10 * BLOCKS}. Record longer, or give the delay in s."
            )
        first, count = (0.0, STEPS + 1) if kind == "lag" else (-largest, 2 * STEPS + 1)
        self.kind, self.shifts = kind, np.linspace(first, largest, count)

    def torque(self, u: np.ndarray) -> np.ndarray:
        """(shifts, rows) torque at the rows' times plus each shift, or after each lag."""
        parts = []
        for own, time, at in self.episodes:
            if self.kind == "lag":
                rows = np.searchsorted(time, at)
                parts.append(np.stack([Lag(lag)(u[own], time)[rows] for lag in self.shifts]))
            elif len(at):
                parts.append(CubicSpline(time, u[own])(at + self.shifts[:, None]))
        return np.concatenate(parts, axis=1)


def torque_columns(robot: forcegp.robots.Robot, dataset: Dataset) -> Float[np.ndarray, "nv rows columns"]:
    """What the torque of each joint may be made of, except for its parameters; with the laws of the dataset's model."""
    import torch  # half a second, which only delays should cost

    from forcegp.forces.columns import law_columns, usual_columns

    q, v, a = (torch.tensor(getattr(dataset, name), device=robot.device) for name in ("q", "v", "a"))
    with torch.no_grad():
        if len(dataset) > ROWS_PER_PARAMETER * 10 * robot.nv:
            torque = robot.kinematics(q, v).torque_regressor(a).flatten(-2)
        else:  # factors of the robot's own torques, of which there are three
            gravity, bias = robot.gravity_forces(q), robot.bias_forces(q, v)
            parts = (robot.inverse_dynamics(q, v, a) - bias, bias - gravity, gravity)
            torque = torch.stack(parts, dim=-1)
    rows = dataset.q, dataset.v, dataset.u, dataset.a
    laws = () if dataset.model is None or dataset.model.robot is not robot else dataset.model.laws
    own = [*usual_columns(robot, *rows, FRICTION_WIDTHS), *law_columns(laws, robot, *rows)]
    return np.concatenate([torque.cpu().numpy(), np.stack(own, axis=-1)], axis=-1).transpose(1, 0, 2)


def _orthonormal(features: Float[np.ndarray, "rows columns"]) -> np.ndarray:
    """Orthonormal columns that span the same space."""
    size = np.linalg.norm(features, axis=0)
    used = features[:, size > 1e-9 * size.max()]
    left, values, _ = np.linalg.svd(used / np.linalg.norm(used, axis=0), full_matrices=False)
    return left[:, values > 1e-6 * values[0]]


def _unexplained(normal: np.ndarray, right: np.ndarray, square: np.ndarray) -> Float[np.ndarray, " shifts"]:
    """Least sum of squares of every shift, from normal equations."""
    solution = np.linalg.lstsq(normal, right, rcond=1e-9)[0]
    return np.maximum(square - (right * solution).sum(axis=0), 0.0)


def lowest(values: Float[np.ndarray, " shifts"], shifts: Float[np.ndarray, " shifts"]) -> float:
    """Place of the least value, by a parabola; NaN at either end."""
    at = int(np.argmin(values))
    if at in (0, len(values) - 1):
        return float("nan")
    left, middle, right = values[at - 1 : at + 2]
    curvature = left - 2.0 * middle + right
    offset = 0.5 * (left - right) / curvature if curvature > 0.0 else 0.0
    return float(shifts[at] + offset * (shifts[1] - shifts[0]))


def _robot(dataset: Dataset, robot: forcegp.robots.Robot | None) -> forcegp.robots.Robot:
    model = dataset.model
    if robot is None and model is None:
        raise InvalidInput(
            "a delay is found by comparing torques with inverse dynamics, which needs the robot: give its URDF, or the "
            "delay in s."
        )
    if model is not None and model.contacts:
        raise InvalidInput(
            "the forces of contacts are not known, so a delay cannot be found in this log. Give the delay in s, or use "
            "a log without contact."
        )
    if robot is None:
        assert model is not None
        robot = model.robot
    require_rows("dataset", dataset, robot.joint_names, robot.name)
    if not torques_of_joints(dataset):
        raise InvalidInput(
            "a delay is found from the torque of every joint, which u does not hold for a base that moves or actuators "
            "of another kind; give the delay in s."
        )
    return robot


def torques_of_joints(dataset: Dataset) -> bool:
    """Whether u has one torque per degree of freedom."""
    model = dataset.model
    return model is None or (model.actuators == model.robot.joint_names and model.actuation.matrix is None)
