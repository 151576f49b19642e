"""The torque regressor, and which combinations of its parameters show in joint forces.

    tau = M(q) a + bias(q, v) - armature a = Y(q, v, a) pi

(Atkeson, An & Hollerbach, "Estimation of inertial parameters of manipulator loads and links", IJRR 1986). A *body* is
what one joint moves as one: its child link with every link fixed to it; only their sum shows in joint forces. ``pi``
has the `PARAMETERS` of body after body, about the origin and in the axes of the child link (Pinocchio's order). A base
that moves is one body, whose joint forces are the wrench that the world puts on it. Bodies without mass have none.

The columns of the torque regressor are linearly dependent for every motion: a link's mass shows only together with
others. QR with column pivoting takes independent columns first, ``W P = Q [R1 R2; 0 0]``; the base parameters are

    beta = pi_1 + R1^-1 R2 pi_2

with pi_1 the parameters of the independent columns and pi_2 those that are regrouped into them (Gautier, "Numerical
calculation of the base inertial parameters of robots", J. Robotic Systems 1991). The condition number of the
independent columns, each divided by its norm, measures how well a motion excites them.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.robots import Robot
from forcegp.robots.inertia import standard_of_pseudo_inertia

PARAMETERS = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
"""Names of the standard parameters of one body; mx = m cx."""
UNITS = ("kg", *("kg m",) * 3, *("kg m^2",) * 6)
"""Their units."""


def torque_regressor(
    robot: Robot, q: Float[Tensor, "*#rows nq"], v: Float[Tensor, "*#rows nv"], a: Float[Tensor, "*#rows nv"]
) -> Float[Tensor, "... nv columns"]:
    """Y (..., nv, 10 bodies) with ``Y @ standard_parameters(robot)`` the joint forces in Nm or N, without armature.

    Columns are named by `parameter_names`. Differentiable in all arguments. Raises InvalidInput for wrong shapes,
    dtypes or devices.
    """
    return robot.kinematics(q, v).torque_regressor(a)[..., carrying(robot), :].flatten(-2)


def carrying(robot: Robot) -> list[int]:
    """Numbers of the bodies with mass: what lies between the joints of a universal joint has no parameters."""
    return robot.tree.inertias[:, 3, 3, 0].nonzero()[:, 0].tolist()


def standard_parameters(robot: Robot) -> Float[Tensor, "columns"]:
    """The parameters pi (10 bodies,) that the robot's URDF gives, links fixed to one another merged."""
    return standard_of_pseudo_inertia(body_pseudo_inertias(robot)).flatten()


def body_pseudo_inertias(robot: Robot) -> Float[Tensor, "bodies 4 4"]:
    """Pseudo-inertia of every body in the frame of its child link."""
    own = carrying(robot)
    inverse = torch.linalg.inv(torch.as_tensor(robot.layout.child_frames[own], device=robot.device))
    return inverse @ robot.tree.inertias[own, ..., 0] @ inverse.mT


def body_names(robot: Robot) -> tuple[str, ...]:
    """What the bodies are called: by the child link of their joint."""
    return tuple(robot.layout.bodies[body].child for body in carrying(robot))


def parameter_names(robot: Robot) -> tuple[str, ...]:
    """Names of the regressor's columns: `LINK.m`, `LINK.mx`, ..., `LINK.Izz` for every body."""
    return tuple(f"{body}.{parameter}" for body in body_names(robot) for parameter in PARAMETERS)


RANK_TOLERANCE = 1e-9
"""Diagonal entries of R below this fraction of the largest are zero, for columns of norm 1."""
NAMED = 1e-6
"""Coefficients below this fraction of the largest in a base parameter are rounding."""
RANDOM_ROWS = 50
"""Random states per joint that stand for every motion."""


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """What a regressor (rows, p) identifies of p parameters.

    `independent` are the columns of the base parameters in the order of QR, `dependent` those that are regrouped,
    `regrouping` (r, p - r) is R1^-1 R2 for columns as they are, `unseen` the columns that are zero, which are in
    neither, and `condition` that of the independent columns, each divided by its norm.
    """

    names: tuple[str, ...]
    independent: tuple[int, ...]
    dependent: tuple[int, ...]
    unseen: tuple[int, ...]
    regrouping: Float[np.ndarray, "r dependent"]
    condition: float

    @classmethod
    def of(cls, regressor: Float[np.ndarray, "rows p"], names: tuple[str, ...]) -> "BaseParameters":
        """From the stacked rows of a regressor. Raises InvalidInput where it is zero or not finite."""
        if not np.isfinite(regressor).all():
            raise InvalidInput("the regressor is not finite; check q, v and a for NaN and infinity.")
        norms = np.linalg.norm(regressor, axis=0)
        seen = np.flatnonzero(norms > RANK_TOLERANCE * norms.max())
        if norms.max() == 0.0:
            raise InvalidInput("the regressor is zero: nothing moves and nothing weighs, so no parameter shows.")
        triangular, order = scipy.linalg.qr(regressor[:, seen] / norms[seen], mode="r", pivoting=True)
        diagonal = np.abs(triangular.diagonal())
        rank = int((diagonal > RANK_TOLERANCE * diagonal[0]).sum())
        first, rest = seen[order[:rank]], seen[order[rank:]]
        scaled = scipy.linalg.solve_triangular(triangular[:rank, :rank], triangular[:rank, rank:])
        regrouping = scaled * norms[rest] / norms[first][:, None]
        values = np.linalg.svd(triangular[:rank, :rank], compute_uv=False)
        unseen = np.setdiff1d(np.arange(len(names)), seen)
        return cls(
            names,
            *(tuple(int(k) for k in columns) for columns in (first, rest, unseen)),
            regrouping=regrouping,
            condition=float(values[0] / values[-1]),
        )

    @property
    def rank(self) -> int:
        """How many base parameters there are."""
        return len(self.independent)

    @property
    def expressions(self) -> tuple[str, ...]:
        """Every base parameter as a sum, for instance "fore.mz + 0.25 hand.m"."""
        return tuple(self._expression(row) for row in range(self.rank))

    def values(self, parameters: Float[np.ndarray, " p"]) -> Float[np.ndarray, " r"]:
        """Base parameters beta of these parameters."""
        return parameters[list(self.independent)] + self.regrouping @ parameters[list(self.dependent)]

    def _expression(self, row: int) -> str:
        weights = self.regrouping[row]
        terms = [self.names[self.independent[row]]]
        scale = max(1.0, float(abs(weights).max(initial=0.0)))
        for column, weight in zip(self.dependent, weights, strict=True):
            if abs(weight) > NAMED * scale:
                factor = "" if abs(abs(weight) - 1.0) < NAMED else f"{abs(weight):.3g} "
                terms.append(f"{'+' if weight > 0 else '-'} {factor}{self.names[column]}")
        return " ".join(terms)


def base_parameters(robot: Robot) -> BaseParameters:
    """The base parameters of a robot, whatever the motion: from random states, the same ones every time."""
    turns, v, a = np.random.default_rng(0).normal(0.0, 2.0, (3, RANDOM_ROWS * robot.nv, robot.nv))
    q = robot.space.integrate(robot.space.neutral(), torch.tensor(turns, device=robot.device)).cpu().numpy()
    return excitation(robot, q, v, a)


def excitation(
    robot: Robot, q: Float[np.ndarray, "rows nq"], v: Float[np.ndarray, "rows nv"], a: Float[np.ndarray, "rows nv"]
) -> BaseParameters:
    """What recorded states identify: `rank` below that of `base_parameters` means that something never showed."""
    states = (torch.as_tensor(np.array(x), device=robot.device) for x in (q, v, a))
    return BaseParameters.of(torque_regressor(robot, *states).flatten(0, 1).cpu().numpy(), parameter_names(robot))
