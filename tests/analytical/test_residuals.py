"""Residuals and their Jacobians against finite differences, and against the known forces of the system itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.models.arm import arm_system

from forcegp.analytical.bodies import ConsistentBodies
from forcegp.analytical.identifiability import body_pseudo_inertias
from forcegp.analytical.identification import joint_terms
from forcegp.analytical.recorded_rows import RecordedRows
from forcegp.errors import InvalidInput
from forcegp.mechanics import (
    Armature,
    ConstantJointForce,
    CoulombJointFriction,
    DirectionalJointFriction,
    LoadJointFriction,
    RotorInertia,
    StribeckJointFriction,
    ViscousJointFriction,
)

FORCES = {
    "viscous": ViscousJointFriction([0.1, 0.2, 0.3]),
    "coulomb": CoulombJointFriction([0.5, 0.4, 0.3], [0.2, 0.3, 0.4]),
    "stribeck": StribeckJointFriction([0.5, 0.4, 0.3], [0.7, 0.4, 0.9], [0.5, 0.6, 0.7], [0.2, 0.3, 0.4]),
    "load": LoadJointFriction([0.1, 0.05, 0.2], 0.3, [0.2, 0.3, 0.4]),
    "offset": ConstantJointForce([0.5, -0.4, 0.1]),
    "direction": DirectionalJointFriction([0.2, -0.1, 0.05]),
    "armature": Armature([0.01, 0.02, 0.03]),
    "rotor": RotorInertia([1e-3, 2e-3, 3e-3], [[3.0, 0.0, 0.0], [-1.0, 4.0, 0.0], [0.0, 1.0, 2.0]]),
}
CHOICES = [
    ("viscous", "coulomb", "offset", "armature"),
    ("stribeck", "rotor"),
    ("load", "offset", "armature"),
    ("viscous", None),
    ("viscous", "direction", "offset"),
]


def states(rows=6, seed=0):
    q, v, u, a = np.random.default_rng(seed).normal(size=(4, rows, 3))
    return q, v, u, a


def made(*names):
    """The arm with these forces listed, and the terms that estimate them."""
    bare = arm_system(0)
    listed = (*bare.known_forces, *(FORCES[name] for name in names if name))
    system = replace(bare, known_forces=listed)
    q, v, u, a = states()
    rotors = next((name for name in names if name in ("armature", "rotor")), None)
    terms = joint_terms(system, [name for name in names if name and name != rotors], rotors, q, v, u, a)
    return system, terms, (q, v, u, a)


@pytest.mark.parametrize("names", CHOICES)
def test_what_a_system_lists_is_where_the_coordinates_start(names):
    """At the start the residuals are those of the system's own dynamics, whose forces share no code with the terms."""
    system, terms, (q, v, u, a) = made(*names)
    rows, x = RecordedRows(system, terms, q, v, u), terms.start()
    bodies = ConsistentBodies(body_pseudo_inertias(system.robot).numpy())
    parameters = bodies.parameters(np.zeros(bodies.size))
    dynamics = system.dynamics(*(torch.tensor(s) for s in (q, v, u)))
    if "load" in names:  # whose load is that of the model, which is the measured one where the motion fits to it
        a = dynamics.acceleration_map().offset.numpy()
    force = (dynamics.M @ torch.tensor(a)[..., None])[..., 0] - dynamics.Q_K
    np.testing.assert_allclose(rows.needed_torque(parameters, x, a) - rows.force, force, atol=1e-10)
    predicted, M, _ = rows.acceleration(parameters, x)
    np.testing.assert_allclose(M, dynamics.M, atol=1e-12)
    np.testing.assert_allclose(predicted, dynamics.acceleration_map().offset, atol=1e-9)
    again = replace(system, known_forces=(*arm_system(0).known_forces, *terms.known_forces(x)))
    torch.testing.assert_close(again.dynamics(*(torch.tensor(s) for s in (q, v, u))).Q_K, dynamics.Q_K)


@pytest.mark.parametrize("likelihood", ["torque", "acceleration"])
@pytest.mark.parametrize("names", CHOICES)
def test_jacobians(names, likelihood):
    system, terms, (q, v, u, a) = made(*names)
    rows = RecordedRows(system, terms, q, v, u)
    bodies = ConsistentBodies(body_pseudo_inertias(system.robot).numpy())
    regressor = rows.regressor(a)
    x = np.concatenate([0.2 * np.random.default_rng(1).normal(size=bodies.size), terms.start()])

    def residual(x):
        parameters = bodies.parameters(x[: bodies.size])
        if likelihood == "torque":
            return rows.in_torque(parameters, x[bodies.size :], a, regressor)
        return rows.in_acceleration(parameters, x[bodies.size :], a)

    _, in_parameters, in_terms = residual(x)
    in_bodies = np.einsum("nibp,bpk->nibk", in_parameters, bodies.derivatives(x[: bodies.size])).reshape(6, 3, -1)
    found = np.concatenate([in_bodies, in_terms], axis=-1)
    step = 1e-6
    wanted = np.stack(
        [(residual(x + step * e)[0] - residual(x - step * e)[0]) / (2.0 * step) for e in np.eye(len(x))], axis=-1
    )
    np.testing.assert_allclose(found, wanted, atol=1e-6 * abs(wanted).max())


@pytest.mark.parametrize(
    ("friction", "rotors", "said"),
    [
        (("sticky",), None, "out of viscous, coulomb, stribeck, load, direction, offset"),
        (("coulomb", "stribeck"), None, "name one of them"),
        (("viscous",), "rotor", "lists none; add it to known_forces"),
        (("viscous",), "flywheel", "armature, rotor, or None"),
    ],
)
def test_choices_that_make_no_sense(friction, rotors, said):
    q, v, u, a = states()
    with pytest.raises(InvalidInput, match=said):
        joint_terms(arm_system(0), friction, rotors, q, v, u, a)


def test_a_force_that_is_listed_twice_is_not_estimated():
    twice = replace(arm_system(0), known_forces=(*arm_system(0).known_forces, FORCES["viscous"], FORCES["viscous"]))
    q, v, u, a = states()
    with pytest.raises(InvalidInput, match="more than once"):
        joint_terms(twice, ("viscous",), None, q, v, u, a)
