"""The tool's contact: friction laws, and an ideal bilateral constraint."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from forcegp.errors import SimulationError
from forcegp.simulation.bullet import ArmState, BulletArm
from forcegp.simulation.trajectory import Table


@dataclass(frozen=True)
class ViscousFriction:
    """`F = -coefficient p'` (Stokes; coefficient in N/(m/s)), whatever the normal force is.

    As in Rath, Geist, Trimpe 2021 it acts on the whole velocity, of which almost nothing is normal to the surface.
    """

    load_dependent: ClassVar[bool] = False  # whether `force` is per newton of normal force
    coefficient: float

    def force(self, velocity: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Force on the sliding point [N] at its velocity [m/s]; never does positive work."""
        return -self.coefficient * velocity


@dataclass(frozen=True)
class DryFriction:
    """Dry friction that depends on the velocity, per newton of normal force, smooth at rest.

    With the tangential velocity `p't` and its length s, `F = -mu(s) |N| p't / sqrt(s^2 + smoothing^2)` and
    `mu(s) = coulomb + (static - coulomb) exp(-(s / breakaway_velocity)^2)` (Bo and Pavelescu; Olsson et al. 1998,
    section 2.1); velocities in m/s. Below `smoothing` the point creeps.
    """

    load_dependent: ClassVar[bool] = True
    coulomb: float
    static: float
    breakaway_velocity: float
    smoothing: float

    def level(self, speed: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """mu at tangential speeds [m/s]."""
        return self.coulomb + (self.static - self.coulomb) * np.exp(-((speed / self.breakaway_velocity) ** 2))

    def coefficient(self, speed: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """`|F| / |N|` at tangential speeds [m/s]."""
        return np.asarray(self.level(speed) * speed / np.sqrt(speed**2 + self.smoothing**2))

    def force(self, velocity: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """As of `ViscousFriction`, per newton of normal force; `normal` is a unit vector."""
        tangential = velocity - (normal @ velocity) * normal
        speed = np.sqrt(tangential @ tangential)
        return -self.level(speed) / np.sqrt(speed**2 + self.smoothing**2) * tangential


PointFriction = ViscousFriction | DryFriction


class ContactForces(NamedTuple):
    """What acted at the tool during a step: normal force [N], friction (3,) [N, world axes] and its joint torques."""

    multiplier: float
    tool_force: Float[np.ndarray, "3"]
    tool_torques: Float[np.ndarray, " nv"]
    in_contact: bool


@dataclass
class IdealContact:
    """The tool point stays on the table from its first touch on: `A a = b` with Baumgarte's b, and friction there.

    Without `friction` it touches nothing.

    `omega` [rad/s] and `zeta` stabilise the constraint.
    """

    table: Table
    friction: PointFriction | None
    omega: float
    zeta: float
    touched: bool = False

    def step(self, arm: BulletArm, state: ArmState, applied: Float[np.ndarray, " nv"]) -> ContactForces:
        """Advance the arm by one step under the torques of actuators and joint friction [Nm] and those of the table.

        Raises SimulationError where friction is so strong that the normal force is not determined.
        """
        distance = self.table.distance(state.position)
        self.touched = self.touched or distance <= 0.0
        if not self.touched or self.friction is None:
            arm.step(applied)
            return ContactForces(0.0, np.zeros(3), np.zeros_like(applied), False)
        normal = self.table.normal(state.position)
        jacobian = state.jacobian[:3]
        velocity = jacobian @ state.v
        # A column of a matrix on purpose: BLAS adds in another order along it than along a contiguous vector, and seeds
        # shall give the motion that they gave when this was a row of the Jacobian.
        row = np.stack([normal @ jacobian] * 2, axis=1)[:, 0]
        # A a = b, the second derivative of distance(p(q)) = 0 with Baumgarte's terms (Rath et al. 2021, eqs. 3 and 4)
        bias = normal @ state.bias_acceleration[:3] + self.table.curvature(state.position, velocity)
        b = -bias - 2.0 * self.zeta * self.omega * (row @ state.v) - self.omega**2 * distance

        friction = self.friction.force(velocity, normal)
        torques = jacobian.T @ friction
        if self.friction.load_dependent:
            multiplier = multiplier_with_friction(state.mass, applied - state.bias, row, torques, float(b))
            friction, torques = abs(multiplier) * friction, abs(multiplier) * torques
        else:
            free, per_newton = np.linalg.solve(state.mass, np.stack([applied - state.bias + torques, row], axis=1)).T
            multiplier = float((b - row @ free) / (row @ per_newton))
        arm.step(applied + torques + multiplier * row)
        return ContactForces(multiplier, friction, torques, True)


def multiplier_with_friction(
    mass: Float[np.ndarray, "nv nv"],
    force: Float[np.ndarray, " nv"],
    row: Float[np.ndarray, " nv"],
    per_load: Float[np.ndarray, " nv"],
    b: float,
) -> float:
    """The multiplier [N] of `row . a = b` where friction gives the joint torques `per_load |lambda|`.

    `M a = force + per_load |lambda| + row^T lambda` makes `alpha lambda + gamma |lambda| = b - row M^-1 force` with
    `alpha = row M^-1 row^T` and `gamma = row M^-1 per_load`: two straight lines that meet at 0. For `|gamma| < alpha`
    both rise and there is exactly one solution; otherwise there are two or none, Painleve's paradox (Brogliato,
    Nonsmooth Mechanics, section 5.5), and SimulationError is raised.
    """
    free, per_newton, per_friction = np.linalg.solve(mass, np.stack([force, row, per_load], axis=1)).T
    alpha, gamma, needed = float(row @ per_newton), float(row @ per_friction), b - float(row @ free)
    if not abs(gamma) < alpha:
        raise SimulationError(
            f"friction changes the normal acceleration by {abs(gamma):.3g} 1/kg per newton of normal force, the normal "
            f"force itself by {alpha:.3g} 1/kg: the normal force is not determined (Painleve's paradox). Use smaller "
            "friction coefficients or another posture (start_degrees)."
        )
    return needed / (alpha + gamma) if needed > 0 else needed / (alpha - gamma)
