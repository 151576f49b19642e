"""The tool's contact as the simulation computes it: none, or an ideal bilateral constraint with friction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from forcegp.errors import SimulationError
from forcegp.simulation.bullet import BulletArm
from forcegp.simulation.friction_laws import PointFriction, RoughPatch
from forcegp.simulation.tables import Table


@dataclass(frozen=True, eq=False)
class ArmState:
    """The arm before a step, with what its dynamics and its tool point are there (`BulletArm.tool`)."""

    q: Float[np.ndarray, " nv"]
    v: Float[np.ndarray, " nv"]
    mass: Float[np.ndarray, "nv nv"]
    bias: Float[np.ndarray, " nv"]
    position: Float[np.ndarray, "3"]
    quaternion: Float[np.ndarray, "4"]
    jacobian: Float[np.ndarray, "6 nv"]
    bias_acceleration: Float[np.ndarray, "6"]

    @staticmethod
    def of(arm: BulletArm) -> ArmState:
        """The present one."""
        q, v = arm.state()
        return ArmState(q, v, arm.mass_matrix(q), arm.bias_forces(q, v), *arm.tool(v))


@dataclass(frozen=True, eq=False)
class ContactForces:
    """What acted at the tool during a step: normal force [N], friction (3,) [N, world axes] and its joint torques."""

    normal_force: float
    friction: Float[np.ndarray, "3"]
    joint_friction_torques: Float[np.ndarray, " nv"]
    acts: bool


class NoContact:
    """Free motion."""

    def step(self, arm: BulletArm, state: ArmState, applied: Float[np.ndarray, " nv"]) -> ContactForces:
        """Advance the arm by one step under the torques of actuators and joint friction [Nm]."""
        arm.step(applied)
        return ContactForces(0.0, np.zeros(3), np.zeros_like(applied), False)


class IdealContact:
    """The tool point stays on the table from its first touch on: `A a = b` with Baumgarte's b, and friction there.

    `omega` [rad/s] and `zeta` stabilise the constraint; where a `patch` is given friction is scaled with the place.
    """

    def __init__(
        self, table: Table, friction: PointFriction, omega: float, zeta: float, patch: RoughPatch | None = None
    ):
        self.table = table
        self.friction = friction
        self.omega, self.zeta = omega, zeta
        self.patch = patch
        self.touched = False

    def step(self, arm: BulletArm, state: ArmState, applied: Float[np.ndarray, " nv"]) -> ContactForces:
        """Advance the arm by one step under the torques of actuators and joint friction [Nm] and those of the table.

        Raises SimulationError where friction is so strong that the normal force is not determined.
        """
        distance = self.table.distance(state.position)
        self.touched = self.touched or distance <= 0.0
        if not self.touched:
            return NoContact().step(arm, state, applied)
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
        if self.patch is not None:
            friction = self.patch.scale(float(state.position[0])) * friction
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
            "friction coefficients, a smaller patch_factor or another posture (start_degrees)."
        )
    return needed / (alpha + gamma) if needed > 0 else needed / (alpha - gamma)
