"""Residuals and their Jacobians against finite differences, and against the dynamics of the model itself."""

import numpy as np
import pytest
import torch
from tests.posterior.arm import arm_model

from forcegp import Coulomb, LoadFriction
from forcegp.errors import InvalidInput
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.evidence.recorded_rows import RecordedRows
from forcegp.fit.physical import typical_sizes
from forcegp.forces import DirectionalFriction, Offset, Payload, RigidBodies, Rotor, Spring, Stribeck, Viscous
from forcegp.model import Model

COUPLED = [[3.0, 0.0, 0.0], [-1.0, 4.0, 0.0], [0.0, 1.0, 2.0]]
LAWS = {
    "viscous": Viscous([0.1, 0.2, 0.3]), "coulomb": Coulomb([0.5, 0.4, 0.3], [0.2, 0.3, 0.4]),
    "stribeck": Stribeck([0.5, 0.4, 0.3], [0.7, 0.4, 0.9], [0.5, 0.6, 0.7], [0.2, 0.3, 0.4]),
    "load": LoadFriction([0.1, 0.05, 0.2], 0.3, [0.2, 0.3, 0.4]), "offset": Offset([0.5, -0.4, 0.1]),
    "direction": DirectionalFriction([0.2, -0.1, 0.05]), "spring": Spring([2.0, 1.0, 3.0], [0.1, -0.2, 0.3]),
    "rotor": Rotor([0.01, 0.02, 0.03]), "coupled": Rotor([1e-3, 2e-3, 3e-3], transmission=COUPLED),
    "load of motors": LoadFriction([0.1, 0.05, 0.2], 0.3, [0.2, 0.3, 0.4], transmission=COUPLED),
    "damped motors": Viscous([0.1, 0.2, 0.3], transmission=COUPLED),
}  # fmt: skip
CHOICES = [
    ("viscous", "coulomb", "offset", "rotor"), ("stribeck", "coupled"), ("load", "offset", "rotor"),
    ("viscous", "direction", "spring"), ("load of motors", "damped motors", "coupled"),
]  # fmt: skip


def arm_rows(rows=6, seed=0):
    return tuple(np.random.default_rng(seed).normal(size=(4, rows, 3)))


def made(*names: str) -> tuple[Model, ParameterSpace, tuple[np.ndarray, ...]]:
    """The arm with these laws, and a space in which they are estimated, with all bodies."""
    q, v, u, a = arm_rows()
    model = arm_model(0).with_forces(*(LAWS[name] for name in names))
    if any(law.under_load for law in model.laws):
        # whose load is that of the model, which is the measured one where the motion fits to it
        a = model.dynamics(*map(torch.tensor, (q, v, u))).acceleration_map().offset.numpy()
    typical = {"force": abs(u).max(0), "position": np.ones(3), "velocity": abs(v).max(0), "inertia": np.ones(3)}
    opened = model.with_forces(RigidBodies("all"), *(LAWS[name].open() for name in names))
    return model, ParameterSpace(opened, typical), (q, v, u, a)


@pytest.mark.parametrize("names", CHOICES)
def test_what_a_model_states_is_where_the_coordinates_start(names):
    model, space, (q, v, u, a) = made(*names)
    rows, x = RecordedRows(space, q, v, u), space.start
    dynamics = model.dynamics(*map(torch.tensor, (q, v, u)))
    force = (dynamics.M @ torch.tensor(a)[..., None])[..., 0] - dynamics.Q_K
    np.testing.assert_allclose(rows.in_torque(x, rows.moving(a))[0], force, atol=1e-10)
    predicted, M, _ = rows.acceleration(x)
    np.testing.assert_allclose(M, dynamics.M, atol=1e-12)
    np.testing.assert_allclose(predicted, dynamics.acceleration_map().offset, atol=1e-9)
    again = space.model_at(x)
    assert not again.is_open
    torch.testing.assert_close(again.dynamics(*map(torch.tensor, (q, v, u))).Q_K, dynamics.Q_K)


@pytest.mark.parametrize("likelihood", ["torque", "acceleration"])
@pytest.mark.parametrize("names", CHOICES)
def test_jacobians(names, likelihood):
    _, space, (q, v, u, a) = made(*names)
    rows, x = RecordedRows(space, q, v, u), space.start
    x[: space.bodies.size] = 0.2 * np.random.default_rng(1).normal(size=space.bodies.size)

    def residual(x):
        return (rows.in_torque(x, rows.moving(a)) if likelihood == "torque" else rows.in_acceleration(x, a))[:3]

    _, in_parameters, in_laws = residual(x)
    found = np.concatenate([space.bodies.chained(x[: space.bodies.size], in_parameters), in_laws], axis=-1)
    wanted = [(residual(x + 1e-6 * e)[0] - residual(x - 1e-6 * e)[0]) / 2e-6 for e in np.eye(len(x))]
    np.testing.assert_allclose(found, np.stack(wanted, -1), atol=1e-6 * abs(np.array(wanted)).max())
    numbers = [(space.numbers(x + 1e-6 * e) - space.numbers(x - 1e-6 * e)) / 2e-6 for e in np.eye(len(x))]
    np.testing.assert_allclose(space.number_slopes(x), np.stack(numbers, -1), atol=1e-6 * abs(np.array(numbers)).max())


def test_parameters_say_what_they_are():
    _, space, _ = made("viscous", "spring")
    named = {each.name: each for each in space.parameters}
    assert named["viscous.bend"].unit == "Nm s/rad"
    assert named["viscous.bend"].start == pytest.approx(0.3)
    assert named["spring.rest.pan"].unit == "rad"
    assert named["hand.mass"].unit == "kg"
    assert len(named) == 30 + 3 + 6


def test_forces_that_nothing_can_be_estimated_of():
    q, v, u, _ = arm_rows()
    typical = dict.fromkeys(("force", "position", "velocity", "inertia"), np.ones(3))
    weightless = arm_model(0).without_mean().with_forces(Viscous())
    with pytest.raises(InvalidInput, match=r"lack RigidBodies\(\)"):
        RecordedRows(ParameterSpace(weightless, typical), q, v, u)
    with pytest.raises(InvalidInput, match="slides on it"):
        RecordedRows(ParameterSpace(arm_model(1).with_forces(Viscous()), typical), q, v, u)
    with pytest.raises(InvalidInput, match="does not move"):
        arm_model(0).with_forces(Payload("base"))


def test_typical_sizes_are_those_of_the_log():
    from tests.posterior.arm import arm_data

    data = arm_data(50, 1, arm_model(0))
    typical = typical_sizes(data.model.with_forces(Viscous()), [data])
    assert {name: size.shape for name, size in typical.items()} == dict.fromkeys(typical, (3,))
    assert all((size > 0.0).all() for size in typical.values())
