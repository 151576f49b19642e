"""Warnings about a base that moves: masses that do not fit, and forces that brake it."""

from warnings import warn

import numpy as np
from jaxtyping import Float

from forcegp.data import thruster_columns
from forcegp.errors import DataWarning
from forcegp.evidence.identifiability import carrying
from forcegp.evidence.recorded_rows import RecordedRows
from forcegp.forces import RigidBodies
from forcegp.model import Model

BRAKED = 0.4
"""Correlation of missing accelerations of a base with its velocity: below .2 in logs of feet, wheels and rotors without
drag, .45 to .83 with drag or ground friction."""
OTHER_ROBOT = 2.0
"""Factor between the masses of log and file, or of what holds the robot up, from which on one of them is wrong."""


def warn_of_what_holds_it_up(
    given: Model, found: Model, rows: RecordedRows, residual: Float[np.ndarray, "rows nv"]
) -> None:
    """Where log and file have different masses, the base lacks a force of the size of gravity, or something brakes."""
    robot, missing = given.robot, 0.0
    own = carrying(robot)
    if not any(isinstance(law, RigidBodies) and len(law.bodies(own, robot)) == len(own) for law in given.laws):
        return
    masses = [sum(each.robot.tree.inertias[carrying(each.robot), 3, 3, 0].tolist()) for each in (given, found)]
    if robot.base == "floating":
        rotation = rows.kinematics.frame_pose(robot.layout.moving[0])[:, :3, :3].cpu().numpy()
        missing = float(np.linalg.norm((rotation @ residual[:, :3, None]).mean(0)))
    wrong = ""
    if not masses[0] / OTHER_ROBOT <= masses[1] <= masses[0] * OTHER_ROBOT:
        wrong = f"by this log the robot weighs {masses[1]:.3g} kg, by its file {masses[0]:.3g} kg"
    elif missing * OTHER_ROBOT > np.linalg.norm(robot.gravity.cpu().numpy()) > 0.0:
        wrong = f"accelerations of the base are wrong by {missing:.3g} m/s^2 on average"
    if wrong:
        warn(
            f"{wrong}: what holds it up is not what the log states. Check flags of stance, thrust coefficients and the "
            "unit of u.",
            DataWarning,
            stacklevel=4,
        )
    linear = {"floating": 3, "planar": 2}.get(robot.base, 0)
    missed, v = residual[:, :linear], rows.v[:, :linear]
    braked = -float((missed * v).sum()) / max(float(np.linalg.norm(missed) * np.linalg.norm(v)), 1e-300)
    if not wrong and braked > BRAKED:
        remedy = "weigh it, since thrust and mass look alike, and let forcegp fit learn the forces"
        if not thruster_columns(given):
            remedy = "forcegp fit --forces rigid-bodies:LINK,gp:joint,gp:joint-friction learns both"
        warn(
            f"what the model lacks brakes the base (correlation {braked:.2g} with its velocity): ground friction or "
            f"drag, which this regression takes for mass; {remedy}.",
            DataWarning,
            stacklevel=4,
        )
