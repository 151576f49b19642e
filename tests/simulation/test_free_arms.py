"""`ur5-free` and `double-pendulum`: rows against Pinocchio and closed forms, friction against its law, refusals."""

from importlib.resources import files

import numpy as np
import pytest
from tests.robots.pinocchio_oracle import Oracle

from forcegp.errors import InvalidInput
from forcegp.simulation import FreeArmConfig, simulate

TEXTS = {
    "ur5-free": files("forcegp.simulation").joinpath("ur5.urdf").read_text(),
    "double-pendulum": files("forcegp.simulation").joinpath("double_pendulum.urdf").read_text(),
}


def simulated(arm, **options):
    return simulate(arm, **({"seconds": 1.0, "noise": 0.0} | options))


@pytest.mark.parametrize("arm", TEXTS)
def test_rows_satisfy_pinocchios_inverse_dynamics(arm):
    data = simulated(arm, seed=3)
    oracle = Oracle(TEXTS[arm], data.model.robot)  # with the rotors as armature
    forces = np.array([oracle.inverse_dynamics(*row) for row in zip(data.q, data.v, data.a, strict=True)])
    np.testing.assert_allclose(forces, data.u + data.truth["Q_U"], rtol=1e-9, atol=1e-9)
    assert abs(data.truth["Q_U"]).max() > 0.02 * max(joint.effort_limit for joint in data.model.robot.joints)


@pytest.mark.parametrize("arm", TEXTS)
def test_rows_are_one_motion(arm):
    """Accelerations integrate to velocities, velocities to positions: a different controller step would not."""
    data = simulated(arm, joint_friction="none")
    dt = data.time[1] - data.time[0]
    np.testing.assert_allclose(np.diff(data.q, axis=0), dt * data.v[1:], atol=0.5 * dt**2 * abs(data.a).max())
    np.testing.assert_allclose(np.diff(data.v, axis=0), dt * data.a[:-1], atol=0.05 * dt * abs(data.a).max())
    assert abs(data.v[0]).max() == 0.0  # from rest
    assert abs(data.v).max() > 0.3


@pytest.mark.parametrize(("kind", "near_rest"), [("stribeck", 0.03), ("coulomb", 0.02), ("none", 0.0)])
def test_friction_follows_its_law(kind, near_rest):
    data = simulated("double-pendulum", joint_friction=kind, seconds=1.5)
    v, share = data.v, 0.0 if kind == "none" else 1.0
    law = (0.02 + (near_rest - 0.02) * np.exp(-((v / 0.1) ** 2))) * np.tanh(v / 0.02) + 0.01 * v
    np.testing.assert_allclose(data.truth["Q_U"], -20.0 * share * law, atol=1e-12)
    assert ("Q_U.joint-friction" in data.truth) == (kind != "none")
    assert (data.u * data.v).sum() > 0.0 or kind == "none"  # friction takes what the motors give


def test_seeds_and_noise_have_streams_of_their_own():
    plain, noisy = (simulated("double-pendulum", noise=noise) for noise in (0.0, 0.1))
    np.testing.assert_array_equal(plain.q, noisy.q)
    np.testing.assert_array_equal(plain.a, noisy.truth["a"])
    assert np.std(noisy.a - plain.a) == pytest.approx(0.1, rel=0.1)
    assert noisy.noise_std.tolist() == [0.1] * 2
    assert plain.noise_std is None
    both = simulated("double-pendulum", episodes=2)
    np.testing.assert_array_equal(both.q[:240], plain.q)
    assert abs(both.q[240:] - plain.q).max() > 0.1
    assert abs(simulated("double-pendulum", seed=1).q - plain.q).max() > 0.1
    limits = [joint.effort_limit for joint in plain.model.robot.joints]
    assert (abs(both.u) <= limits).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"arm": "ur10"}, "arm"),
        ({"arm": "ur5-free", "seconds": 0.0}, "seconds is 0.0; it must be one number, from 0.1 to 1e5 s"),
        ({"arm": "ur5-free", "joint_friction": "lugre"}, "lugre"),
    ],
)
def test_configurations_that_mean_nothing_are_refused(options, message):
    with pytest.raises(InvalidInput, match=message):
        FreeArmConfig(**options)
