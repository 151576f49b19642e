"""From identified bodies back to a robot: every link keeps its share of its body.

A body is often several links. With the factors of its old and new pseudo-inertia, ``P = V V^T`` and ``P' = U U^T``
(upper triangular), every link gets ``C P_k C^T`` with ``C = U V^-1``: they add up to P', each stays physically
possible, and links that were equal stay equal. Motions show nothing but their sum.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from forcegp.analytical.bodies import upper_cholesky
from forcegp.analytical.regressor import body_names, body_pseudo_inertias
from forcegp.errors import NonPhysicalInertia
from forcegp.robots import Robot
from forcegp.robots.inertia import pseudo_inertia
from forcegp.robots.urdf_writer import replace_dynamics, replace_inertial

THIN = 1e-5
"""Bodies with a second moment about the centre of mass below this fraction of that about the origin are thickened."""
THICKNESS = 0.05
"""Standard deviation of the mass that thickening adds, as a fraction of the body's size."""


def thickened(robot: Robot) -> tuple[Robot, tuple[str, ...]]:
    """The robot with bodies of some thickness, since only they have coordinates; and the links that were changed.

    Points, rods and plates (ideal ones, as simple URDFs have them) get an isotropic second moment.
    """
    text, changed = robot.urdf_text, []
    for body, (pseudo, joint) in enumerate(zip(body_pseudo_inertias(robot).numpy(), robot.joints, strict=True)):
        mass, center = pseudo[3, 3], pseudo[:3, 3] / pseudo[3, 3]
        about_center = pseudo[:3, :3] - mass * np.outer(center, center)
        size = max(np.trace(pseudo[:3, :3]), 1e-8 * mass)
        if np.linalg.eigvalsh(about_center)[0] > THIN * size:
            continue
        links = [name for name, place in robot.layout.links.items() if place.body == body]
        heaviest = max(links, key=lambda name: robot.link(name).mass)
        link = robot.link(heaviest)
        inertia = np.array(link.inertia) + 2.0 * THICKNESS**2 * size * np.eye(3)  # of the isotropic second moment
        center = np.array(link.center_of_mass)
        text = replace_inertial(text, heaviest, link.mass, center, inertia, source=robot.source)
        changed.append(heaviest if heaviest == joint.child else f"{heaviest} (of {joint.child})")
    return (_again(robot, text) if changed else robot), tuple(changed)


def with_bodies(robot: Robot, wanted: Float[np.ndarray, "nv 4 4"]) -> Robot:
    """A robot whose bodies have these pseudo-inertias, in the frames of their joints' child links.

    Raises NonPhysicalInertia, naming the bodies, where no body has them.
    """
    impossible = [name for name, pseudo in zip(body_names(robot), wanted, strict=True) if not _definite(pseudo)]
    if impossible:
        raise NonPhysicalInertia(
            f"no body has the inertia that least squares found for {', '.join(impossible)}, so there is no such robot; "
            "its torques and accelerations can be predicted all the same. For a robot use inertias='consistent'."
        )
    change = upper_cholesky(wanted) @ np.linalg.inv(upper_cholesky(body_pseudo_inertias(robot).numpy()))
    text = robot.urdf_text
    for name, placement in robot.layout.links.items():
        link = robot.link(name)
        if link.joint is None or link.mass == 0.0:
            continue
        body = placement.body
        offset = np.linalg.inv(robot.layout.child_frames[body]) @ placement.offset
        there = np.linalg.inv(offset) @ change[body] @ offset
        # a congruence by [[A, t], [0, s]] moves the moments about the centre of mass by A alone: no cancellation
        own = pseudo_inertia(link.mass, np.zeros(3), np.array(link.inertia))[:3, :3]
        A, shift, scale = there[:3, :3], there[:3, 3], there[3, 3]
        center = (A @ np.array(link.center_of_mass) + shift) / scale
        second = A @ own @ A.T
        inertia = np.trace(second) * np.eye(3) - second
        text = replace_inertial(text, name, link.mass * scale**2, center, inertia, source=robot.source)
    return _again(robot, text)


def with_joint_dynamics(robot: Robot, damping: np.ndarray | None, friction: np.ndarray | None) -> Robot:
    """The robot whose URDF has <dynamics damping friction> (nv,) of every joint; None leaves what is there."""
    text = robot.urdf_text
    for index, joint in enumerate(robot.joints):
        values = {"damping": damping, "friction": friction}
        given = {name: float(value[index]) for name, value in values.items() if value is not None}
        text = replace_dynamics(text, joint.name, given, source=robot.source) if given else text
    return _again(robot, text)


def _again(robot: Robot, text: str) -> Robot:
    return Robot.from_urdf_text(
        text, source=robot.source, gravity=robot.gravity, armature=robot.armature, locked=robot.locked
    ).to(robot.device)


def _definite(pseudo: np.ndarray) -> bool:
    try:
        np.linalg.cholesky(pseudo)
    except np.linalg.LinAlgError:
        return False
    return True
