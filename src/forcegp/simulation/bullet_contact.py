"""PyBullet's own contact between a small sphere at the tool point and the table: unilateral, with Coulomb friction."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from forcegp.errors import InvalidInput
from forcegp.simulation.bullet import BulletArm
from forcegp.simulation.contact_forces import ArmState, ContactForces
from forcegp.simulation.tables import FlatTable, Table

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
    ElementTree.SubElement(collision, "origin", rpy="0 0 0", xyz=" ".join(repr(float(entry)) for entry in point))
    geometry = ElementTree.SubElement(collision, "geometry")
    ElementTree.SubElement(geometry, "sphere", radius=repr(SPHERE_RADIUS))
    return ElementTree.tostring(root, encoding="unicode")
