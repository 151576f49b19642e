"""Tracking controllers: torques against Pinocchio, errors against the size of a step, and what is refused."""

import numpy as np
import pinocchio
import pytest
import torch
from tests.goldens.compare import assert_unchanged
from tests.posterior.arm import arm_data, arm_model, quick_fit
from torch.testing import assert_close

from forcegp import ComputedTorque, HybridForce, Model, Robot, Viscous, fit
from forcegp.errors import ContactError, InvalidInput, NumericalError
from forcegp.forces import Actuation, ContactFriction, Coulomb, JointForces, JointFriction, RigidBodies

LINK = """<link name="{0}"><inertial><origin xyz="0 0.02 -0.2"/><mass value="{1}"/>
<inertia ixx="0.02" iyy="0.02" izz="0.004" ixy="0" ixz="0.001" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/><origin xyz="0 0 {3}"/>
<axis xyz="{4}"/><limit lower="-3" upper="3" velocity="9" effort="60"/></joint>"""
URDF = "".join(
    [
        '<robot name="arm"><link name="base"/>', LINK.format("upper", 2.0), LINK.format("fore", 1.5),
        JOINT.format("shoulder", "base", "upper", 0.0, "0 1 0"),
        JOINT.format("elbow", "upper", "fore", -0.4, "0.6 0.8 0"), "</robot>",
    ]
)  # fmt: skip
ROBOT = Robot.from_urdf_text(URDF)
VISCOUS = (0.7, 0.3)
URDF_ALONE = Model(ROBOT)
TRUE = Model(ROBOT, forces=(Actuation(), RigidBodies(), Viscous(VISCOUS)))
GAINS = {"stiffness": 100.0}
STILL = [0.3, -0.4], [0.0, 0.0]


def rnea(q, v, a):
    model = pinocchio.buildModelFromXML(URDF)
    return pinocchio.rnea(model, model.createData(), *(np.asarray(x, float) for x in (q, v, a)))


def test_the_torque_is_that_of_inverse_dynamics_with_friction():
    q, v, q_d, v_d, a_d = np.random.default_rng(0).uniform(-1.0, 1.0, (5, 2))
    control = ComputedTorque(TRUE, stiffness=[100.0, 50.0], damping=[3.0, 4.0])
    wanted = a_d + np.array([100.0, 50.0]) * (q_d - q) + np.array([3.0, 4.0]) * (v_d - v)
    np.testing.assert_allclose(control(q, v, q_d, v_d, a_d), rnea(q, v_d, wanted) + VISCOUS * v_d, rtol=1e-9)


def test_torques_keep_their_limits():
    control = ComputedTorque(URDF_ALONE, **GAINS, torque_limits=[500.0, 1.0])
    assert float(control(*STILL, [2.0, 2.0], [0.0, 0.0], [0.0, 0.0])[1].abs()) == 1.0
    assert control.saturated.tolist() == [False, True]
    assert float(ComputedTorque(URDF_ALONE, **GAINS).torque_limits.max()) == 60.0  # of the URDF


@pytest.fixture(scope="module")
def touching():
    """What was learned of an arm of three joints on a sphere, with friction under load."""
    return quick_fit(arm_model().with_forces((JointFriction(), ContactFriction(load=True, expected=0.2))))


def state(posterior):
    data = arm_data(1, 1)
    return data.q[0], data.v[0]


def test_learned_forces_are_compensated_and_uncertainty_stiffens(touching):
    free = touching.with_contacts([])
    predictor = free.predictor(covariance="exact")
    q, v = state(free)
    e, a_d = np.full(3, 0.01), np.array([1.0, 2.0, -1.0])
    u = ComputedTorque(predictor, **GAINS, torque_limits=1e6)(q, v, q + e, v, a_d)
    np.testing.assert_allclose(free.predict(q, v, u).mean, a_d + 100.0 * e, rtol=1e-7, atol=1e-9)


def test_forces_that_depend_on_the_torque_are_compensated():
    free = quick_fit(arm_model().with_forces(JointForces())).with_contacts([])
    q, v = state(free)
    wanted = np.array([1.0, -2.0, 0.5])
    control = ComputedTorque(free.predictor(covariance="none"), **GAINS, torque_limits=1e6)
    np.testing.assert_allclose(free.predict(q, v, control(q, v, q, v, wanted)).mean, wanted, rtol=1e-6)


def test_motion_and_force_are_those_of_the_dense_equations(touching):
    """[M -A^T; A 0] [a; lambda] = [Q; b] solved for the torque: forwards the wanted force comes out."""
    q, v = state(touching)
    control = HybridForce(touching.predictor(covariance="none"), **GAINS, torque_limits=1e6)
    wanted = np.array([5.0, -3.0, 2.0])
    found = touching.predict(q, v, control(q, v, q, v, wanted, [7.0]))
    assert float(found.multiplier.mean) == pytest.approx(7.0, rel=1e-8)
    at = touching.model.dynamics(*(torch.tensor(x) for x in (q, v)), torch.zeros(3).double())
    M, A, b = (x.numpy() for x in (at.M, at.A, at.b))
    dense = np.linalg.solve(np.block([[M, -A.T], [A, np.zeros((1, 1))]]), np.concatenate([M @ wanted, b]))
    np.testing.assert_allclose(found.mean, dense[:3], rtol=1e-8)


def test_joint_forces_are_those_of_predict_and_of_torch(touching):
    compiled, plain = (touching.predictor(covariance="none", compile=compile) for compile in (True, False))
    q, v = (torch.tensor(x) for x in state(touching))
    u = torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
    found, expected, dynamics = compiled.joint_forces(q, v, u), plain.joint_forces(q, v, u), touching.dynamics(q, v, u)
    for one, other in zip(found, expected, strict=True):
        assert_close(one, other, rtol=1e-8, atol=1e-10)
    assert_close(found.Q, dynamics.Q_K + touching.predict(q, v, u).unknown_force.mean, rtol=1e-8, atol=1e-10)
    step = 1e-5 * torch.eye(3, dtype=torch.float64)
    ahead, back = ([plain.joint_forces(q, v, u + sign * row).Q for row in step] for sign in (1.0, -1.0))
    assert_close(found.dQ_du, (torch.stack(ahead, -1) - torch.stack(back, -1)) / 2e-5, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("force", [None, -1.0, [1.0, 2.0], np.nan])
def test_normal_forces_that_mean_nothing(touching, force):
    q, v = state(touching)
    control = HybridForce(touching.predictor(covariance="none"), **GAINS)
    with pytest.raises(InvalidInput, match=r"one per contact \(1\)"):
        control(q, v, q, v, v, force)


def test_a_force_is_asked_for_only_at_the_surface(touching):
    """Off it by more than the tolerance the controller refuses, or follows the reference in the air."""
    predictor, (q, v) = touching.predictor(covariance="none"), state(touching)
    rest = np.zeros(3), [7.0]
    lifted = q + np.array([0.0, 0.04, 0.0])  # 1 to 2 cm off
    with pytest.raises(ContactError, match="ComputedTorque first"):
        HybridForce(predictor, **GAINS, torque_limits=1e6)(lifted, v, q, v, *rest)
    control = HybridForce(predictor, off_surface="release", **GAINS, torque_limits=1e6)
    free = ComputedTorque(touching.with_contacts([]).predictor(covariance="none"), **GAINS, torque_limits=1e6)
    assert_close(control(lifted, v, q, v, *rest), free(lifted, v, q, v, rest[0]))
    assert control.released
    on = control(q, v, q, v, *rest)
    assert not control.released
    assert_close(on, HybridForce(predictor, **GAINS, torque_limits=1e6)(q, v, q, v, *rest))
    contact, plane = touching.model.contacts[0], touching.model.contacts[0].surface  # a plane
    at = touching.model.robot.kinematics(torch.tensor(lifted))
    away = float(contact.position(at) @ torch.tensor(plane.normal).double()) - plane.offset
    assert float(contact.off(at)) == pytest.approx(away, rel=1e-6)
    HybridForce(predictor, tolerance=1.01 * abs(away), **GAINS, torque_limits=1e6)(lifted, v, q, v, *rest)
    with pytest.raises(ContactError):
        HybridForce(predictor, tolerance=0.99 * abs(away), **GAINS, torque_limits=1e6)(lifted, v, q, v, *rest)
    predicted = touching.predict(lifted, v, on)
    assert float(predicted.off) == pytest.approx(away, rel=1e-6)
    assert f"by up to {abs(away):.3g} m" in str(predicted)


def test_friction_that_remembers_is_that_of_the_positions_seen(touching):
    posterior = fit(arm_model().with_forces(Coulomb([0.4, 0.3, 0.2], memory=True, sigma=200.0)), arm_data(30, 0))
    control = HybridForce(posterior.predictor(covariance="none"), **GAINS, torque_limits=1e6)
    q, v = state(posterior)
    step = np.array([1e-3, -2e-3, 5e-4])
    for back in (step, 2.0 * step, step):
        u = control(q + back, v, q + back, v, np.zeros(3), [7.0])
    z = np.sign(step) * (1.0 - np.exp(-200.0 * 1e-3 * np.array([1.0, 2.0, 0.5])))  # forth, from 0
    z = -np.sign(step) + (z + np.sign(step)) * np.exp(-200.0 * abs(step))  # and back
    at = posterior.model.dynamics(*(torch.tensor(x) for x in (q + step, v)), torch.zeros(6).double())
    M, A, b = (x.numpy() for x in (at.M, at.A, at.b))
    inverse = np.linalg.inv(M)
    a = inverse @ A.T @ np.linalg.solve(A @ inverse @ A.T, b)
    assert_close(u, posterior.predictor(covariance="none").inverse_dynamics(q + step, v, a, [7.0], memory=z).mean)


def test_models_with_and_without_contacts(touching):
    with pytest.raises(InvalidInput, match="use HybridForce"):
        ComputedTorque(touching.predictor(covariance="none"), **GAINS)
    with pytest.raises(InvalidInput, match="this model has none"):
        HybridForce(touching.with_contacts([]).predictor(covariance="none"), **GAINS)
    with pytest.raises(InvalidInput, match=r"give posterior\.predictor\(\)"):
        ComputedTorque(touching, **GAINS)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stiffness": -1.0}, "stiffness is -1.0; give numbers of at least 0"),
        ({"stiffness": [1.0, 2.0, 3.0]}, r"stiffness has shape \(3,\)"),
        ({"damping": np.nan}, "damping"),
        ({"torque_limits": 0.0}, "torque_limits are zero"),
    ],
)
def test_settings_that_mean_nothing(changes, message):
    with pytest.raises(InvalidInput, match=message):
        ComputedTorque(URDF_ALONE, **GAINS | changes)


def test_references_and_states_that_cannot_be():
    control = ComputedTorque(URDF_ALONE, **GAINS)
    with pytest.raises(InvalidInput, match=r"asks elbow to be at 3\.5, and it moves between -3 and 3"):
        control(*STILL, [0.0, 3.5], [0.0, 0.0], [0.0, 0.0])
    with pytest.raises(InvalidInput, match="v_d is"):
        control(*STILL, [0.0, 0.0], [0.0], [0.0, 0.0])
    with pytest.raises(InvalidInput, match="q is"):
        control([np.nan, 0.0], *STILL, *STILL)


def test_it_raises_and_keeps_the_last_torques():
    still, control = [0.0, 0.0], ComputedTorque(URDF_ALONE, stiffness=1e308, damping=0.0)
    safe = control(STILL[0], still, STILL[0], still, [1.0, 0.0])
    with pytest.raises(NumericalError):
        control([2.9, 0.0], still, [-2.9, 0.0], still, still)
    with pytest.raises(InvalidInput, match="give 2 finite numbers"):
        control([np.nan, 0.0], still, *STILL, still)
    assert torch.equal(control.last, safe)


def test_commanded_torques_are_what_they_were(touching):
    free, (q, v) = touching.with_contacts([]), state(touching)
    exact, limits = free.predictor(covariance="exact"), [9.0, 50.0, 5.0]
    computed = ComputedTorque(exact, **GAINS, position_noise=1e-3, torque_limits=limits)
    hybrid = HybridForce(touching.predictor(covariance="exact"), **GAINS, torque_limits=1e6)
    found = {"limits": computed.torque_limits, "damping": computed.damping, "stiffness": computed.stiffness}
    for size in (0.0, 0.01, 0.3):
        aim = q + size, v - size, np.array([1.0, 2.0, -1.0])
        found[f"computed {size}"] = computed(q, v, *aim), computed.saturated
        found[f"hybrid {size}"] = hybrid(q, v, *aim, [5.0]), hybrid(q, v, *aim, 0.0)
    assert_unchanged("control/torques", found, rtol=1e-3)
