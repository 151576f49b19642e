"""What the torques show that a URDF seldom holds: payload, rotors, friction."""

import warnings
from collections.abc import Iterator

import numpy as np
import torch

from forcegp.checks.check_input import CheckInput, Finding, look, ok
from forcegp.checks.hypotheses import Hypothesis
from forcegp.data import estimate_delay
from forcegp.data.delay import shifted
from forcegp.errors import DataWarning, ForceGPError
from forcegp.evidence import Torques
from forcegp.fit import fit
from forcegp.forces import Payload, Rotor
from forcegp.forces.registry import force_name, usual_friction
from forcegp.model import Model
from forcegp.posterior import Posterior

ROWS = 1_000
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
            found = fit(Model(log.robot).with_forces(usual_friction(), Rotor(), Payload()), rows, Torques(), rows=ROWS)
    except (ForceGPError, np.linalg.LinAlgError):
        return  # too short, or what moves shows too little: excitation is reported by itself
    if not found.parameters.settled:
        return
    yield from _payload(found)
    yield from _rotors(inputs, found)
    yield _friction(found)


def _payload(found: Posterior) -> Iterator[Finding]:
    held = next(law for law in found.model.laws if isinstance(law, Payload))
    assert held.link is not None, "it was found"
    mass, link = found.parameters["payload.mass"], found.model.robot.link(held.link)
    if not mass.value > max(SURE * mass.std, LEAST_SHARE * link.mass):
        return
    place = [found.parameters[f"payload.center_of_mass.{x}"].value for x in "xyz"]
    yield look(
        subject="payload",
        seen=f"the torques show {mass.value:.3g} kg ± {mass.std:.1g} kg more at {held.link} than in the URDF, with its "
        f"centre of mass at ({', '.join(f'{1e3 * x:.0f}' for x in place)}) mm, if the URDF is right about the other "
        "links.",
        remedy=f"forcegp payload DATA --link {held.link}, with a --baseline without payload where the URDF is "
        "uncertain; or forcegp fit --forces bodies.",
        numbers={"mass": mass.value, "standard_error": mass.std, "center_of_mass": place},
    )


def _rotors(inputs: CheckInput, found: Posterior) -> Iterator[Finding]:
    rotors, robot = found.parameters.of("rotor"), found.model.robot
    values, errors = (np.array([getattr(rotors[name], what) for name in inputs.names]) for what in ("value", "std"))
    q = torch.tensor(inputs.rows().q[::50], device=robot.device)
    moving = robot.mass_matrix(q).diagonal(dim1=-2, dim2=-1).mean(dim=0).cpu().numpy()
    more = values > np.maximum(SURE * errors, LEAST_SHARE * moving)
    if not more.any():
        return
    joints = inputs.named(np.flatnonzero(more))
    stated = dict(zip(inputs.names, (values + robot.armature.cpu().numpy()).tolist(), strict=True))
    yield look(
        subject="rotors",
        seen="the torques show rotor inertias that the robot does not have: "
        f"{', '.join(f'{name} {stated[name]:.3g}' for name in joints)} (kg m², or kg).",
        remedy="State them as `armature`, one for each joint; or forcegp fit --forces rotor,bodies.",
        joints=joints,
        numbers={"armature": stated},
    )


def _friction(found: Posterior) -> Finding:
    laws = [force_name(law) for law in usual_friction()]
    parts = {name: each for name, each in found.parameters.items() if name.partition(".")[0] in laws}
    joints = found.model.robot.joint_names
    each: dict[str, list[str]] = {}
    for name, estimate in parts.items():
        label = next(name.removesuffix(f".{joint}") for joint in joints if name.endswith(f".{joint}"))
        each.setdefault(label, []).append(f"{estimate.value:.3g}")
    return ok(
        subject="friction",
        seen=f"of the joints: {'; '.join(f'{label} ' + ', '.join(values) for label, values in each.items())}.",
        remedy=f"forcegp fit --forces {','.join(laws)}; or gp:joint-friction, which needs no law.",
        numbers={name: estimate.value for name, estimate in parts.items()},
    )
