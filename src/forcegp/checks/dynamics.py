"""What the torques show that a URDF seldom holds: payload, rotors, friction."""

import warnings
from collections.abc import Iterator

import numpy as np
import torch

from forcegp.analytical import PayloadEstimate, identify_payload
from forcegp.checks.check_input import CheckInput, Finding, look, ok
from forcegp.checks.hypotheses import Hypothesis
from forcegp.data import estimate_delay
from forcegp.data.delay import shifted
from forcegp.errors import DataWarning, ForceGPError
from forcegp.mechanics import MechanicalSystem

ROWS = 3_000
SURE = 4.0  # standard errors from zero
LEAST_SHARE = 0.02  # of the mass of the last link and of the moving inertia: less is not worth a word


def dynamics_findings(inputs: CheckInput, log: Hypothesis) -> Iterator[Finding]:
    """Payload, rotor inertia and friction, from a log with the errors corrected that were found."""
    if inputs.prepared is None or inputs.contacts:
        return
    rows = log.correction.applied(inputs.prepared.dataset)
    try:
        late = estimate_delay(rows, log.robot).significant
        rows = shifted(rows, np.full(rows.nv, late))
        with warnings.catch_warnings():  # of what hides a payload: the finding states what it rests on
            warnings.simplefilter("ignore", DataWarning)
            found = identify_payload(rows, MechanicalSystem(log.robot), rows=ROWS)
    except (ForceGPError, np.linalg.LinAlgError):
        return  # too short, or what moves shows too little: excitation is reported by itself
    if not found.fit.settled:
        return
    yield from _payload(found)
    yield from _rotors(inputs, found)
    yield _friction(inputs, found)


def _payload(found: PayloadEstimate) -> Iterator[Finding]:
    error, link = found.standard_errors["mass"], found.system.robot.link(found.link)
    if not found.mass > max(SURE * error, LEAST_SHARE * link.mass):
        return
    center = ", ".join(f"{1e3 * x:.0f}" for x in found.center_of_mass)
    yield look(
        subject="payload",
        seen=f"the torques show {found.mass:.3g} kg ± {error:.1g} kg more at {found.link} than the URDF has, with its "
        f"centre of mass at ({center}) mm, if the URDF is right about the other links.",
        remedy=f"forcegp payload DATA --link {found.link}, with a --baseline without payload where the URDF is "
        "uncertain; or forcegp identify.",
        numbers={"mass": found.mass, "standard_error": error, "center_of_mass": found.center_of_mass.tolist()},
    )


def _rotors(inputs: CheckInput, found: PayloadEstimate) -> Iterator[Finding]:
    values, errors = (np.array([found.joints[f"armature.{name}"][k] for name in inputs.names]) for k in (0, 1))
    robot = found.system.robot
    q = torch.tensor(inputs.rows().q[::50], device=robot.device)
    moving = robot.mass_matrix(q).diagonal(dim1=-2, dim2=-1).mean(dim=0).cpu().numpy()
    more = values - robot.armature.cpu().numpy() > np.maximum(SURE * errors, LEAST_SHARE * moving)
    if not more.any():
        return
    joints = inputs.named(np.flatnonzero(more))
    sizes = ", ".join(f"{name} {values[inputs.names.index(name)]:.3g}" for name in joints)
    yield look(
        subject="rotors",
        seen=f"the torques show rotor inertias that the robot does not have: {sizes} (kg m², or kg).",
        remedy="State them as `armature`, one for each joint; or forcegp identify --model consistent, which estimates "
        "them with all else.",
        joints=joints,
        numbers={"armature": dict(zip(inputs.names, values.tolist(), strict=True))},
    )


def _friction(inputs: CheckInput, found: PayloadEstimate) -> Finding:
    def each(field: str) -> str:
        return ", ".join(f"{found.joints[f'{field}.{name}'][0]:.3g}" for name in inputs.names)

    return ok(
        subject="friction",
        seen=f"of the joints: dry {each('coulomb')} Nm or N, more near rest by {each('breakaway')}; viscous "
        f"{each('viscous')} per rad/s or m/s.",
        remedy="forcegp identify --model consistent --friction viscous,stribeck; or let forcegp fit learn it.",
        numbers={name: value for name, (value, _) in found.joints.items()},
    )
