"""Measured torques against inverse dynamics: how much of each the robot explains, and by what factor.

For every joint, `u = s tau(q, v, a) + I a + d v + c tanh(v / w) + o` with tau the inverse dynamics of the URDF, the
laws of a rotor, viscous and dry friction (`forcegp.forces.columns`), and s, I, d, c >= 0, by non-negative least squares
(Lawson & Hanson 1974): friction always brakes, and a robot that needs a negative factor was logged with a wrong sign.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.optimize import nnls

from forcegp.data import Dataset
from forcegp.forces import Law
from forcegp.forces.columns import law_columns, usual_columns
from forcegp.robots import Robot

CONSTANT = 1e-24  # variance relative to the square below which a torque is constant: rounding
RESTS_ON_ROBOT = 0.5
POOR = 0.2
SLOW = 0.1  # of the root mean square velocity: where dry friction turns over


@dataclass(frozen=True, kw_only=True, eq=False)
class TorqueFit:
    """What the robot explains of the torque of each joint.

    `unexplained` (nv,) is the share of the torque's variance that is left, NaN for a torque that never changes;
    `coefficients` (nv, 5) are s, I, d, c, o; `predicted` (rows, nv) is the fitted torque.
    `friction` (nv,) is the share that is left without inverse dynamics and armature, `plain` (nv,) that without
    armature, whose s is `factor` (nv,): where tau is nearly proportional to a, s and I cannot be separated.
    """

    unexplained: Float[np.ndarray, " nv"]
    friction: Float[np.ndarray, " nv"]
    plain: Float[np.ndarray, " nv"]
    factor: Float[np.ndarray, " nv"]
    coefficients: Float[np.ndarray, "nv 5"]
    predicted: Float[np.ndarray, "rows nv"]

    @property
    def rests_on_robot(self) -> Bool[np.ndarray, " nv"]:
        """Whether `factor` means something: inverse dynamics explains half of the torque's variance beyond friction.

        And little is left: noise in tau makes the factor of a poor fit too small.
        """
        with np.errstate(invalid="ignore"):
            return (self.friction - self.plain > RESTS_ON_ROBOT) & (self.plain < POOR) & (self.factor > 0.0)

    def at(self, robot: Robot, tau: Float[np.ndarray, "rows nv"], rows: Dataset) -> Float[np.ndarray, "rows nv"]:
        """The fitted torque of other rows, whose inverse dynamics is `tau`."""
        parts = np.stack([tau, *columns_of(robot, rows)[:-1]], axis=-1)
        return (parts * self.coefficients[:, :4]).sum(-1) + self.coefficients[:, 4]


def columns_of(robot: Robot, rows: Dataset, widths: Sequence[float] = (SLOW,)) -> list[np.ndarray]:
    """Torques (rows, nv) of a rotor, viscous and dry friction, and an offset."""
    return usual_columns(robot, rows.q, rows.v, rows.u, rows.a, widths)


def needed_torques(robot: Robot, rows: Dataset, laws: Sequence[Law] = ()) -> Float[np.ndarray, "rows nv"]:
    """What the rigid bodies and these laws of joints need at these rows [Nm or N]."""
    with torch.no_grad():
        q, v, a = (torch.tensor(x, device=robot.device) for x in (rows.q, rows.v, rows.a))
        return robot.inverse_dynamics(q, v, a).cpu().numpy() + torques_of_laws(robot, rows, laws)


def torques_of_laws(robot: Robot, rows: Dataset, laws: Sequence[Law]) -> Float[np.ndarray, "rows nv"]:
    """What these known laws of joints need [Nm or N]."""
    return sum(law_columns(laws, robot, rows.q, rows.v, rows.u, rows.a), np.zeros_like(rows.v))


def fit_torques(
    robot: Robot, tau: Float[np.ndarray, "rows nv"], rows: Dataset, u: Float[np.ndarray, "rows nu"] | None = None
) -> TorqueFit:
    """Fit the torques of these rows, or others, to inverse dynamics tau of their motion."""
    u = rows.u if u is None else u
    parts = np.stack([tau, *columns_of(robot, rows)[:-1]], axis=-1)
    fits = [_JointFit(parts[:, joint], u[:, joint]) for joint in range(rows.nv)]
    every, plain, friction = ([fit.solved(columns) for fit in fits] for columns in ((0, 1, 2, 3), (0, 2, 3), (2, 3)))
    return TorqueFit(
        unexplained=np.array([share for _, share in every]),
        friction=np.array([share for _, share in friction]),
        plain=np.array([share for _, share in plain]),
        factor=np.array([solution[0] for solution, _ in plain]),
        coefficients=np.stack([solution for solution, _ in every]),
        predicted=np.stack([fit.predicted(solution) for fit, (solution, _) in zip(fits, every, strict=True)], axis=1),
    )


def unexplained_shares(robot: Robot, tau: np.ndarray, rows: Dataset) -> Float[np.ndarray, "nv nv"]:
    """Share of the variance of each torque (column) that tau, v and a of each joint (row) leave; NaN if constant."""
    parts, joints = np.stack([tau, *columns_of(robot, rows)[:-1]], axis=-1), range(rows.nv)
    return np.array([[_JointFit(parts[:, j], rows.u[:, k]).solved((0, 1, 2, 3))[1] for k in joints] for j in joints])


class _JointFit:
    """One joint's torque and what may explain it; a free constant takes the means out of both sides."""

    def __init__(self, columns: Float[np.ndarray, "rows 4"], u: Float[np.ndarray, " rows"]) -> None:
        self.columns = columns
        self.centered = self.columns - self.columns.mean(axis=0)
        self.size = np.linalg.norm(self.centered, axis=0)
        self.mean = float(u.mean())
        self.target = u - self.mean
        self.spread = float(np.square(self.target).sum())
        self.constant = not self.spread > CONSTANT * max(float(np.square(u).sum()), 1e-300)

    def solved(self, chosen: tuple[int, ...]) -> tuple[np.ndarray, float]:
        """Coefficients (5,), the constant last, and the unexplained share with some of the columns."""
        solution = np.zeros(5)
        solution[4] = self.mean
        if self.constant:
            return solution, np.nan
        used = [column for column in chosen if self.size[column] > 1e-9 * max(float(self.size.max()), 1e-300)]
        if not used:
            return solution, 1.0
        basis, triangle = np.linalg.qr(self.centered[:, used] / self.size[used])
        right = basis.T @ self.target
        factors, left = nnls(triangle, right)
        outside = float(np.square(self.target - basis @ right).sum())
        solution[used] = factors / self.size[used]
        solution[4] = self.mean - float(self.columns.mean(axis=0) @ solution[:4])
        return solution, float((left**2 + outside) / self.spread)

    def predicted(self, solution: np.ndarray) -> np.ndarray:
        """The torque (rows,) with these coefficients."""
        return self.columns @ solution[:4] + solution[4]


UNSEEN = 1e-3  # singular values below this fraction of the largest belong to directions that no torque shows


def estimated_gravity(
    robot: Robot, rows: Dataset, tau: Float[np.ndarray, "rows nv"], fit: TorqueFit
) -> Float[np.ndarray, "3"] | None:
    """Gravity [m/s^2] that leaves least of the torques unexplained, by least squares over all joints.

    Every joint has its friction, armature, constant and factor of inertial torques free, and counts by the spread of
    its torque. Directions that no torque shows stay those of the robot. None where nothing is left to fit.
    """
    nominal = robot.gravity.cpu().numpy()
    q = torch.tensor(rows.q, device=robot.device)
    with torch.no_grad():
        axes = [with_gravity(robot, axis).gravity_forces(q).cpu().numpy() for axis in np.eye(3)]
    pulls = np.stack(axes, axis=-1)  # (rows, nv, 3): torque per m/s^2
    of_laws, matrices, targets = columns_of(robot, rows), [], []
    for joint in np.flatnonzero(np.isfinite(fit.unexplained)):
        u, pull = rows.u[:, joint], pulls[:, joint]
        free = np.stack([tau[:, joint] - pull @ nominal, *(each[:, joint] for each in of_laws)], axis=1)
        basis = np.linalg.qr(free)[0]
        factor = fit.factor[joint] if fit.factor[joint] > 0.0 else 1.0
        weight = 1.0 / max(float(np.std(u)), 1e-12)
        matrices.append(weight * factor * (pull - basis @ (basis.T @ pull)))
        targets.append(weight * (u - basis @ (basis.T @ u)))
    if not matrices:
        return None
    matrix, target = np.concatenate(matrices), np.concatenate(targets)
    estimated = nominal + np.linalg.lstsq(matrix, target - matrix @ nominal, rcond=UNSEEN)[0]
    return estimated if np.linalg.norm(estimated) > 0.0 else None


def with_gravity(robot: Robot, gravity: Float[np.ndarray, "3"]) -> Robot:
    """The same robot under other gravity [m/s^2]."""
    along = torch.as_tensor(gravity, dtype=robot.tree.gravity.dtype, device=robot.device)
    fall = torch.zeros_like(robot.tree.fall)
    fall[:, 3, 0] = along
    return replace(robot, tree=replace(robot.tree, gravity=along, fall=fall))
