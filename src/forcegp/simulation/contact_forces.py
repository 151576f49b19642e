"""The tool's contact: friction laws, an ideal bilateral constraint, or PyBullet's own unilateral contact."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from forcegp.errors import InvalidInput, SimulationError
from forcegp.robots.urdf import numbers
from forcegp.simulation.bullet import ArmState, BulletArm
from forcegp.simulation.trajectory import FlatTable, Table


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
    `mu(s) = coulomb + (static - coulomb) exp(-(s / breakaway_velocity)^2)`: Tustin's exponential, as a Gaussian, of
    Bo and Pavelescu (Armstrong-Helouvry, Dupont, Canudas de Wit 1994, section 2.1; Olsson et al. 1998, section 2.1).
    `static = coulomb` is Coulomb's law. The square root stands for the sign, so that there is no sticking: below
    `smoothing` the point creeps.

    coulomb, static: dimensionless; breakaway_velocity, smoothing: m/s.
    """

    load_dependent: ClassVar[bool] = True
    coulomb: float
    static: float
    breakaway_velocity: float
    smoothing: float

    def coefficient(self, speed: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """`|F| / |N|` at tangential speeds [m/s]."""
        level = self.coulomb + (self.static - self.coulomb) * np.exp(-((speed / self.breakaway_velocity) ** 2))
        return np.asarray(level * speed / np.sqrt(speed**2 + self.smoothing**2))

    def force(self, velocity: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """As of `ViscousFriction`, per newton of normal force; `normal` is a unit vector."""
        tangential = velocity - (normal @ velocity) * normal
        speed = np.sqrt(tangential @ tangential)
        level = self.coulomb + (self.static - self.coulomb) * np.exp(-((speed / self.breakaway_velocity) ** 2))
        return -level / np.sqrt(speed**2 + self.smoothing**2) * tangential


PointFriction = ViscousFriction | DryFriction


@dataclass(frozen=True)
class RoughPatch:
    """A strip of the table, `lower < x < upper`, where friction is `factor` times as large; edges some mm wide.

    `1 + (factor - 1) / 2 [tanh((x - lower) / width) - tanh((x - upper) / width)]`; x and lengths in m.
    """

    lower: float
    upper: float
    factor: float
    width: float = 0.003

    def scale(self, x: float) -> float:
        """How many times as large friction is at x [m]."""
        inside = 0.5 * (np.tanh((x - self.lower) / self.width) - np.tanh((x - self.upper) / self.width))
        return float(1.0 + (self.factor - 1.0) * inside)


class ContactForces(NamedTuple):
    """What acted at the tool during a step: normal force [N], friction (3,) [N, world axes] and its joint torques."""

    multiplier: float
    tool_force: Float[np.ndarray, "3"]
    tool_torques: Float[np.ndarray, " nv"]
    in_contact: bool


class NoContact:
    """Free motion."""

    def step(self, arm: BulletArm, state: ArmState, applied: Float[np.ndarray, " nv"]) -> ContactForces:
        """Advance the arm by one step under the torques of actuators and joint friction [Nm]."""
        arm.step(applied)
        return ContactForces(0.0, np.zeros(3), np.zeros_like(applied), False)


@dataclass
class IdealContact:
    """The tool point stays on the table from its first touch on: `A a = b` with Baumgarte's b, and friction there.

    `omega` [rad/s] and `zeta` stabilise the constraint; where a `patch` is given friction is scaled with the place.
    """

    table: Table
    friction: PointFriction
    omega: float
    zeta: float
    patch: RoughPatch | None = None
    touched: bool = False

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


SPHERE_RADIUS = 1e-3
"""Of the sphere at the tool point [m]. The collision table lies as much lower, so that the sphere's centre, which is
the tool point, is on the nominal surface when it touches; friction acts one radius below it."""


class BulletContact:
    """The table as a collision shape in the arm's simulation, with `coefficient` of friction and without restitution.

    The arm's URDF must come from `with_tool_sphere`.
    """

    def __init__(self, arm: BulletArm, table: Table, coefficient: float):
        bullet, client = arm.bullet, {"physicsClientId": arm.client}
        self.table = table
        if isinstance(table, FlatTable):
            shape = bullet.createCollisionShape(bullet.GEOM_PLANE, planeNormal=table.upward.tolist(), **client)
            base = (table.offset - SPHERE_RADIUS) * table.upward
        else:
            shape = bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=table.radius - SPHERE_RADIUS, **client)
            base = table.center
        self._body = bullet.createMultiBody(0.0, shape, basePosition=base.tolist(), **client)
        # Bullet multiplies the coefficients of the two bodies.
        surface = {"lateralFriction": coefficient, "restitution": 0.0, "rollingFriction": 0.0, "spinningFriction": 0.0}
        bullet.changeDynamics(self._body, -1, **surface, **client)
        bullet.changeDynamics(arm.body, arm.joints[-1], **{**surface, "lateralFriction": 1.0}, **client)
        # The default of 50 iterations to 1e-7 leaves friction short of its cone; one contact is cheap.
        bullet.setPhysicsEngineParameter(numSolverIterations=500, solverResidualThreshold=0.0, **client)

    def step(self, arm: BulletArm, state: ArmState, applied: Float[np.ndarray, " nv"]) -> ContactForces:
        """Advance the arm by one step under the torques of actuators and joint friction [Nm] and those of the table.

        The normal force is the one that PyBullet reports, along the normal at the tool point; the torques of friction
        are what it leaves unexplained in `M a + bias = applied + A^T lambda + ...`, to which the sphere's radius adds a
        small lever arm; the friction force is PyBullet's.
        """
        arm.step(applied)
        acceleration = (arm.state()[1] - state.v) / arm.time_step
        normal_force, friction = 0.0, np.zeros(3)
        for point in arm.bullet.getContactPoints(arm.body, self._body, physicsClientId=arm.client):
            normal_force += point[9]
            friction += point[10] * np.array(point[11]) + point[12] * np.array(point[13])
        if normal_force <= 0.0:
            return ContactForces(0.0, np.zeros(3), np.zeros_like(applied), False)
        row = self.table.normal(state.position) @ state.jacobian[:3]
        torques = state.mass @ acceleration + state.bias - applied - normal_force * row
        return ContactForces(normal_force, friction, torques, True)


def with_tool_sphere(urdf: str, link: str, point: Sequence[float]) -> str:
    """The URDF with a small collision sphere at a point [m] of a link."""
    root = ElementTree.fromstring(urdf)
    body = root.find(f"link[@name='{link}']")
    if body is None:
        raise InvalidInput(f"the URDF has no link {link!r} to put the tool's sphere on.")
    collision = ElementTree.SubElement(body, "collision")
    ElementTree.SubElement(collision, "origin", rpy="0 0 0", xyz=numbers(point))
    geometry = ElementTree.SubElement(collision, "geometry")
    ElementTree.SubElement(geometry, "sphere", radius=repr(SPHERE_RADIUS))
    return ElementTree.tostring(root, encoding="unicode")
