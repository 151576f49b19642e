"""`quadruped`: rows obey the equations of motion with Pinocchio's numbers; what is unknown is found from few rows."""

import numpy as np
import pinocchio as pin
import pytest
import torch

from forcegp import Accelerations, Stribeck, Viscous, fit
from forcegp.errors import InvalidInput
from forcegp.forces import Body, RigidBodies
from forcegp.simulation import QuadrupedConfig, simulate_quadruped


@pytest.fixture(scope="module")
def clean():
    return simulate_quadruped(QuadrupedConfig(seconds=4.0, seed=1, noise=0.0, payload=0.0))


def test_rows_obey_the_equations_of_motion(clean):
    model = pin.buildModelFromXML(clean.model.robot.urdf_text, pin.JointModelFreeFlyer())
    data = model.createData()
    order = [model.joints[model.getJointId(name)].idx_v for name in clean.model.robot.joint_names[6:]]
    feet = [model.getFrameId(f"{leg}_foot") for leg in ("front_left", "front_right", "rear_left", "rear_right")]
    for k in range(0, len(clean), 97):
        q, v, a, tau = pin.neutral(model), *np.zeros((3, model.nv))
        q[:7] = clean.q[k, :7]
        q[[place + 1 for place in order]] = clean.q[k, 7:]
        for values, given in ((v, clean.v[k]), (a, clean.a[k])):
            values[:6], values[order] = given[:6], given[6:]
        tau[order] = clean.u[k, :12] + clean.truth["Q_U"][k, 6:]
        pin.computeJointJacobians(model, data, q)
        pin.forwardKinematics(model, data, q, v, a)
        for foot, number in enumerate(feet):
            J = pin.getFrameJacobian(model, data, number, pin.LOCAL_WORLD_ALIGNED)[:3]
            tau += J.T @ clean.truth["lambda"][k, 3 * foot : 3 * foot + 3]
            if clean.u[k, 12 + foot]:
                assert np.abs(J @ v).max() < 1e-10
                drift = pin.getFrameClassicalAcceleration(model, data, number, pin.LOCAL_WORLD_ALIGNED).linear
                assert np.abs(drift).max() < 1e-9
        np.testing.assert_allclose(pin.rnea(model, data, q, v, a), tau, atol=1e-9)


def test_velocities_and_accelerations_are_derivatives(clean):
    inside, q = np.arange(1, 200), torch.tensor(clean.q)
    slope = 120.0 * clean.model.robot.difference(q[inside - 1], q[inside + 1])
    np.testing.assert_allclose(slope, clean.v[inside], atol=2e-3)
    np.testing.assert_allclose(120.0 * (clean.v[inside + 1] - clean.v[inside - 1]), clean.a[inside], atol=0.1)


def test_feet_push_and_never_pull(clean):
    assert clean.truth["lambda"][:, 2::3][clean.u[:, 12:] > 0].min() > 0.0


@pytest.mark.nightly
def test_payload_friction_and_foot_forces_are_found():
    train = simulate_quadruped(QuadrupedConfig(seconds=6.0, seed=1))
    test, trunk = simulate_quadruped(QuadrupedConfig(seconds=3.0, seed=2)), train.model.robot.link("trunk")
    model = train.model.with_forces(RigidBodies({"trunk": Body(0.01)}), Viscous(), Stribeck())
    posterior = fit(model, train, Accelerations(), rows=200)
    assert posterior.parameters["trunk.mass"].value - trunk.mass == pytest.approx(2.0, rel=0.02)
    prediction = posterior.predict(test.q, test.v, test.u)
    urdf = train.model.dynamics(*(torch.tensor(x) for x in (test.q, test.v, test.u)))
    known = urdf.acceleration(torch.zeros_like(urdf.Q_K)).numpy()
    error, before = (np.square(a - test.truth["a"]).mean(0) ** 0.5 for a in (prediction.mean.numpy(), known))
    assert np.linalg.norm(error[:6]) < 0.1 * np.linalg.norm(before[:6])
    assert np.linalg.norm(error[6:]) < 0.1 * np.linalg.norm(before[6:])
    forces = test.truth["lambda"]
    assert np.square(prediction.multiplier.mean.numpy() - forces).mean() < 0.05**2 * np.square(forces).mean()


@pytest.mark.parametrize("wrong", [{"payload": -1.0}, {"joint_friction": "lugre"}, {"seconds": 0}])
def test_other_numbers_are_refused(wrong):
    with pytest.raises(InvalidInput, match=next(iter(wrong))):
        QuadrupedConfig(**wrong)
