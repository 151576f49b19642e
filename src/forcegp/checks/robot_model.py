"""What was stated of the robot: a URDF that is not believable, and contacts that the rows contradict."""

from __future__ import annotations

import numpy as np

from forcegp.checks.check_input import CheckInput
from forcegp.checks.findings import Finding, listed, look
from forcegp.data import contact_doubts
from forcegp.mechanics import MechanicalSystem
from forcegp.robots import Robot


def robot_findings(robot: Robot) -> list[Finding]:
    """Moving links without inertia, equal inertias, centres of mass and radii of gyration beyond the robot's reach."""
    moving = [robot.link(name) for name in robot.link_names if robot.link(name).joint is not None]
    heavy = [link for link in moving if link.mass > 0.0]
    reach = _reach(robot)
    found = []
    light = [link.name for link in moving if link.mass == 0.0]
    alone = [name for name in light if name in {joint.child for joint in robot.joints}]
    if alone:
        found.append(
            look(
                subject="URDF",
                seen=f"{listed(alone)} move with a joint of their own but have no mass.",
                remedy="Add their <inertial>, or expect their inertia to be missing.",
            )
        )
    shapes = {(link.mass, link.inertia) for link in heavy}
    if len(heavy) > 2 and len(shapes) == 1:
        found.append(
            look(
                subject="URDF",
                seen=f"all {len(heavy)} moving links have the same mass and inertia ({heavy[0].mass:g} kg): a "
                "placeholder.",
                remedy="Use the manufacturer's URDF, or identify the inertias (forcegp identify).",
            )
        )
    for link in heavy:
        gyration = float(np.sqrt(np.linalg.eigvalsh(np.array(link.inertia)).max() / link.mass))
        center = float(np.linalg.norm(link.center_of_mass))
        if reach > 0.0 and (gyration > reach or center > 2.0 * reach):
            found.append(
                look(
                    subject="URDF",
                    seen=f"link {link.name} has a radius of gyration of {gyration:.3g} m and its centre of mass "
                    f"{center:.3g} m "
                    f"from its joint; the whole robot reaches about {reach:.3g} m.",
                    remedy="Check the units of this link (kg, m, kg m²).",
                    numbers={"gyration": gyration, "center": center, "reach": reach},
                )
            )
    return found


def _reach(robot: Robot) -> float:
    """Sum of the distances between joints, plus the largest distance of a centre of mass from its joint [m]."""
    origins = sum(float(np.linalg.norm(joint.origin[:3, 3])) for joint in robot.layout.joints)
    centers = [float(np.linalg.norm(robot.link(name).center_of_mass)) for name in robot.link_names]
    return origins + max(centers, default=0.0) if origins > 0.0 else 0.0


def contact_findings(inputs: CheckInput, system: MechanicalSystem | None) -> list[Finding]:
    """Contacts beside which the motion runs, whose force acts elsewhere or not at all, or that are missing."""
    return [
        Finding(
            severity="wrong" if doubt.kind == "off" else "look",
            subject="contact",
            seen=doubt.seen,
            remedy=doubt.remedy,
            numbers={"kind": doubt.kind, **doubt.numbers},
        )
        for doubt in contact_doubts(inputs.mended, system)
    ]
