"""Fits as they were: numbers with their intervals and who decides them, noise, settings, predictions, warnings."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.evidence.test_contact_forces import held, measured
from tests.fit.test_friction_choice import LEVEL, log_with, sign
from tests.fit.test_motion_fit import line, recording
from tests.fit.test_payload import Found, loaded, log
from tests.goldens.compare import assert_unchanged
from tests.posterior.arm import arm_data, arm_model

from forcegp import Accelerations, ContactForces, JointForces, JointFriction, Motions, Torques, fit
from forcegp.data.dataset import TORQUE
from forcegp.fit import calibrated
from forcegp.fit.sensors import torque_sensor_doubts
from forcegp.forces import Actuation, GearFriction, LoadFriction, Offset, RigidBodies, Rotor, Spring, Stribeck, Viscous
from forcegp.inference import OptimizerOptions

FREE = arm_model(0)
FEW = {"restarts": 3, "options": OptimizerOptions(iterations=4)}


def in_air(*forces, evidence=None, **more):
    return fit(FREE.with_forces(*forces), arm_data(80, 0, FREE), evidence or Torques(), **more)


FITS = {
    "laws": lambda: in_air(Viscous(), Stribeck(), Rotor(), Offset(), Spring()),
    "bodies": lambda: in_air(RigidBodies(("fore", "hand")), LoadFriction(), Actuation(gain=None)),
    "accelerations": lambda: in_air(RigidBodies("all"), Viscous(), evidence=Accelerations()),
    "both": lambda: in_air(Viscous(), Rotor(), evidence=Torques("both")),
    "sensor": lambda: fit(held(Viscous()), pushed(), [Torques(), ContactForces()]),
    "payload": lambda: Found(log(loaded(), 1, seconds=6.0, noise=0.05), laws=(Viscous(),)).posterior,
    "gears": lambda: fit(
        FREE.with_forces(Viscous(), GearFriction()),
        log_with(lambda v, rigid: (LEVEL + 0.1 * abs(rigid)) * sign(v), rows=900), Torques(), rows=600,
    ),
    "motions": lambda: fit(log_of_cart().model.with_forces(Viscous()), log_of_cart(), [Accelerations(), Motions()]),
    "hidden": lambda: fit(held(Viscous()), replace(pushed(), measured={}), Torques()),
    "calibrated": lambda: calibrated(FITS["cart"](), log_of_cart(), (0.1, 0.25)),
    "cart": lambda: fit(log_of_cart().model.with_forces(Viscous()), log_of_cart(), Accelerations()),
    "friction": lambda: in_air(JointFriction(), evidence=Accelerations(), points=40, **FEW),
    "beside": lambda: in_air(Viscous(), JointForces(("q",)), evidence=Accelerations(), points=30, **FEW),
    "plane": lambda: fit(arm_model().with_forces(JointForces()), arm_data(40, 1), points=25, **FEW),
}  # fmt: skip


def pushed():
    return measured(held(Viscous(0.7)), held(), rows=60, noise=0.2)


def log_of_cart():
    return recording(line, 0, 3.0)


@pytest.mark.parametrize("case", FITS)
def test_what_is_found_is_what_it_was(case):
    with warnings.catch_warnings(record=True, action="always") as said:
        posterior = FITS[case]().with_settings(widening=1.0)  # processors round it apart
    entries, rows = posterior.parameters.entries, posterior.training
    predicted = posterior.predict(rows.q[:5], rows.v[:5], rows.u[:5])
    found = {
        "numbers": {each.name: [each.value, each.std, each.start, each.prior_std] for each in entries},
        "decided": [f"{each.name} [{each.unit}] {each.decided_by}: {each.why}" for each in entries],
        "noise": posterior.model.noise,
        "settings": {name: x for name, x in posterior.settings.items() if name != "optimizer"},
        "searched": {name: x.tolist() for name, x in posterior.hyperparameters.items()},
        "predicted": [predicted.mean.tolist(), predicted.covariance.tolist(), torch.tensor(len(rows)).item()],
        "said": [str(each.message) for each in said],
    }  # fmt: skip
    assert_unchanged(f"fit/{case}", found, rtol=1e-3)


def test_torque_sensors_beside_what_bodies_need():
    log, found = log_with(lambda v, rigid: LEVEL * sign(v), rows=1500), {}
    bodies = FREE.robot.inverse_dynamics(*(torch.tensor(getattr(log, name)) for name in "qva")).numpy()
    noise = np.random.default_rng(0).standard_normal(bodies.shape)
    changes = {f"times {factor:g}": factor * bodies for factor in (-1.0, 0.02, 0.08, 0.93, 0.97, 1.04, 1.06, 9.0, 20.0)}
    changes |= {f"drift {x:g}": bodies + x * np.linspace(-1, 1, len(log))[:, None] for x in (0.05, 0.2, 0.8)}
    changes |= {f"noise {x:g}": bodies + x * noise * bodies.std(0) for x in (0.5, 2.0, 4.0, 9.0)}
    for name, values in (changes | {"swapped": bodies[:, [1, 0, 2]], "offset": bodies + 0.3}).items():
        columns = zip(log.joint_names, values.T[:, :, None], strict=True)
        measured_there = {f"{TORQUE}{joint}": column for joint, column in columns}
        doubts = torque_sensor_doubts(replace(log, measured=measured_there), FREE)
        found[name] = [[f"{each.level} {each.do}", *each.joints, each.numbers] for each in doubts]
    assert_unchanged("fit/torque sensors", found, rtol=1e-3)
