"""Identification on simulated motions of a small arm whose truth is known."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.models.arm import arm_data, arm_system

from forcegp.analytical import base_parameters, identify_analytical, motion_residuals, standard_parameters
from forcegp.data import Dataset
from forcegp.errors import InvalidInput, NonPhysicalInertia, RobotFileWarning
from forcegp.mechanics import (
    Actuation,
    Armature,
    ConstantJointForce,
    CoulombJointFriction,
    MechanicalSystem,
    RigidBodyBias,
    ViscousJointFriction,
)
from forcegp.robots import Robot

TRUE_FORCES = (
    Actuation(),
    RigidBodyBias(),
    ViscousJointFriction([0.3, 0.2, 0.1]),
    CoulombJointFriction([0.8, 0.5, 0.3], 0.2),
    ConstantJointForce([0.2, -0.1, 0.05]),
    Armature([0.05, 0.04, 0.03]),
)
FRICTION = ("viscous", "coulomb", "offset")


def recorded(rows: int, seed: int, noise: float = 0.0, torque_noise: float = 0.0) -> Dataset:
    """Random states of the arm in the air with all true forces; noise on a and on u."""
    data = arm_data(rows, seed, arm_system(0, known_forces=TRUE_FORCES))
    states = [torch.tensor(np.array(x)) for x in (data.q, data.v, data.u)]
    a = data.system.dynamics(*states).acceleration_map().offset.numpy()
    generator = np.random.default_rng(seed + 100)
    a = a + noise * generator.normal(size=a.shape)
    u = data.u + torque_noise * generator.normal(size=a.shape)
    return replace(data, a=a, u=u, truth={}, noise_std=None)


def given() -> MechanicalSystem:
    """A URDF that is wrong about every mass and knows no friction."""
    system = arm_system(0)
    parameters = system.robot.inertial_parameters("upper", "fore", "hand")
    wrong = {name: value + 0.1 * torch.sin(torch.arange(10.0).double()) for name, value in parameters.items()}
    return system.with_robot(system.robot.with_inertials(wrong))


@pytest.mark.parametrize("likelihood", ["torque", "acceleration"])
def test_exact_data_give_the_truth(likelihood):
    found = identify_analytical(
        recorded(300, 0), given(), friction=FRICTION, likelihood=likelihood, prior_strength=1e-6
    )
    test = recorded(100, 1)
    force, acceleration = motion_residuals(test, found.system)
    assert abs(force).max() < 2e-3 * abs(test.u).max()
    assert abs(acceleration).max() < 2e-3 * abs(test.a).max()
    base = base_parameters(found.given.robot)
    truth, ours = standard_parameters(test.system.robot).numpy(), found.parameters.ravel()
    # rotor inertias stand in for an inertia about each axis, so only the others have one value
    clear = [k for k, expression in enumerate(base.expressions) if "zz" not in expression and "yy" not in expression]
    np.testing.assert_allclose(base.values(ours)[clear], base.values(truth)[clear], atol=5e-3)
    for name, value in (
        ("viscous.pan", 0.3),
        ("coulomb.lift", 0.5),
        ("offset.bend", 0.05),
        ("velocity_scale.pan", 0.2),
    ):
        assert found.values[name] == pytest.approx(value, rel=0.02, abs=2e-3)


def test_centres_of_mass_and_their_errors_follow_from_the_parameters():
    found = identify_analytical(recorded(60, 2, noise=0.1), given(), friction=FRICTION)
    centers, errors = found.centers_of_mass
    small, spread = 1e-6, found._spread[: found.parameters.size].reshape(*found.parameters.shape, -1)
    moved = found.parameters[..., None] + small * spread
    slopes = (moved[:, 1:4] / moved[:, :1] - centers[..., None]) / small
    np.testing.assert_allclose(np.linalg.norm(slopes, axis=-1), errors, rtol=1e-4)
    robot = found.system.robot
    for body, link in enumerate(("upper", "fore", "hand")):
        np.testing.assert_allclose(centers[body], robot.link(link).center_of_mass, atol=1e-12)


def test_what_predicts_is_what_is_written_down():
    found = identify_analytical(recorded(60, 2, noise=0.1), given(), friction=FRICTION)
    test = recorded(20, 3)
    again = MechanicalSystem.from_json(found.system.to_json())
    force, acceleration = motion_residuals(test, again)
    np.testing.assert_allclose(found.torque_residual(test), force, atol=1e-9)
    np.testing.assert_allclose(test.a - found.accelerations(test.q, test.v, test.u), acceleration, atol=1e-7)
    joints = again.robot.joints
    assert [joint.damping for joint in joints] == [found.values[f"viscous.{joint.name}"] for joint in joints]
    assert [joint.friction for joint in joints] == [found.values[f"coulomb.{joint.name}"] for joint in joints]


def test_free_inertias_explain_the_training_torques_best_and_may_belong_to_no_robot():
    train = recorded(40, 4, torque_noise=0.5)
    free, consistent = (
        identify_analytical(train, given(), friction=FRICTION, inertias=kind, prior_strength=0.01)
        for kind in ("free", "consistent")
    )
    sizes = [(kind.fit.residual**2).sum() for kind in (free, consistent)]
    assert sizes[0] <= 1.001 * sizes[1]
    M = consistent.system.robot.mass_matrix(torch.tensor(np.array(train.q)))
    assert bool((torch.linalg.eigvalsh(M) > 0.0).all())
    with pytest.raises(NonPhysicalInertia, match="inertias='consistent'"):
        _ = free.system
    assert np.isfinite(free.torque_residual(train)).all()


def test_standard_errors_cover_the_truth():
    """Of 40 recordings, about 95 % of the intervals of two standard errors hold the truth."""
    truth = {"viscous.pan": 0.3, "viscous.lift": 0.2, "coulomb.pan": 0.8, "coulomb.bend": 0.3, "offset.lift": -0.1}
    held = []
    for seed in range(12):
        train = recorded(150, 10 + seed, torque_noise=0.2)
        found = identify_analytical(train, train.system, friction=FRICTION)
        held += [abs(found.values[n] - value) < 2.0 * found.standard_errors[n] for n, value in truth.items()]
    assert 0.8 <= np.mean(held) <= 1.0


def test_outliers_move_a_robust_identification_less():
    train = recorded(150, 5, torque_noise=0.05)
    u = np.array(train.u)
    u[::15] += 20.0
    bad = replace(train, u=u)
    errors = [
        identify_analytical(bad, train.system, friction=FRICTION, robust=robust).torque_residual(train)
        for robust in (True, False)
    ]
    assert np.sqrt((errors[0] ** 2).mean()) < 0.3 * np.sqrt((errors[1] ** 2).mean())


def test_the_report_is_plain_json_and_says_what_the_data_do_not():
    train = recorded(60, 6, noise=0.1)
    still = replace(train, v=np.zeros_like(train.v), a=np.zeros_like(train.a))
    found = identify_analytical(still, given())
    told = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert dict(found.weak_directions)["upper"] == 10  # never lifted, never turned
    assert told["parameters"]["hand.m"]["unit"] == "kg"
    assert told["parameters"]["viscous.pan"]["unit"] == "Nm s/rad"
    assert len(told["base_parameters"]) == found.base.rank < 15


def test_progress_and_a_limit_on_rows():
    seen = []
    found = identify_analytical(recorded(60, 7), given(), rows=20, progress=lambda *told: seen.append(told))
    assert len(found.episode) == 20
    assert [number for number, _ in seen] == list(range(1, len(seen) + 1))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"inertias": "free", "likelihood": "acceleration"}, "inertias='consistent' with likelihood"),
        ({"prior_strength": 0.0}, "must be > 0"),
        ({"rows": 0}, "at least 1"),
    ],
)
def test_choices_that_make_no_sense(changes, said):
    with pytest.raises(InvalidInput, match=said):
        identify_analytical(recorded(5, 8), given(), **changes)


def test_systems_that_cannot_be_identified_so():
    data = recorded(5, 9)
    with pytest.raises(InvalidInput, match="touches something with hand"):
        identify_analytical(data, arm_system(1))
    with pytest.raises(InvalidInput, match="list it"):
        identify_analytical(data, arm_system(0, known_forces=(Actuation(),)))


def test_standard_errors_are_those_of_the_posterior():
    """Gauss-Newton's information, of independent residuals, inverted densely; and finite where there is hardly any."""
    train = recorded(200, 30, torque_noise=0.2)
    found = identify_analytical(train, train.system, friction=("viscous",), rotors=None)
    information = found.fit.information + found.fit.prior_information
    split = found.bodies.size
    in_terms = np.sqrt(np.diag(np.linalg.inv(information)))[split:] * found.terms.slopes(found.fit.x[split:]).ravel()
    ours = [found.standard_errors[f"viscous.{joint}"] for joint in ("pan", "lift", "bend")]
    np.testing.assert_allclose(ours, in_terms, rtol=0.3)
    poor = identify_analytical(recorded(4, 31), given(), inertias="free", prior_strength=1e-6)
    assert np.isfinite(list(poor.standard_errors.values())).all()


def test_friction_under_load_does_not_explain_the_torque_by_itself():
    """A wrist whose torque is friction of a changing level: from the measured |u| its mu came out as 1.

    The first joint has friction under load, and its mu is found.
    """
    robot = arm_system(0).robot
    generator = np.random.default_rng(0)
    q, v, a = generator.normal(size=(3, 400, 3))
    torque = robot.inverse_dynamics(*(torch.tensor(x) for x in (q, v, a))).numpy()
    sign = np.tanh(v / 0.05)
    u = torque + 0.02 * generator.normal(size=a.shape)
    u[:, 0] = torque[:, 0] / (1.0 - 0.15 * sign[:, 0] * np.sign(torque[:, 0]))  # u = torque + 0.15 |u| sign
    u[:, 2] += 20.0 * sign[:, 2] * generator.uniform(0.5, 1.5, 400)
    log = Dataset(q=q, v=v, u=u, a=a, time=0.01 * np.arange(400.0), system=arm_system(0))
    found = identify_analytical(log, friction=("load",), rotors=None)
    mu = found.system.known_forces[-1].coefficients
    assert float(mu[0]) == pytest.approx(0.15, abs=0.01)
    assert float(mu[2]) < 0.5
    force, _ = motion_residuals(log, found.system)
    assert force[:, 2].std() > 4.0  # of 5.8 that no model can know


def test_rotor_inertias_are_whole_in_reports_and_in_files(tmp_path):
    """The robot has a part of its rotors already; the estimate adds the rest."""
    data, system = recorded(300, 40), arm_system(0)
    system = system.with_robot(system.robot.with_armature([0.02, 0.0, 0.01]))
    found = identify_analytical(data, system, friction=FRICTION)
    for joint, (start, truth) in zip(system.robot.joint_names, ((0.02, 0.05), (0, 0.04), (0.01, 0.03)), strict=True):
        assert found.start[f"armature.{joint}"] == pytest.approx(start)
        assert found.values[f"armature.{joint}"] == pytest.approx(truth, rel=0.02)
    with pytest.warns(RobotFileWarning, match="^found.urdf: URDF has no element for rotor inertias"):
        found.system.to_urdf(tmp_path / "found.urdf")
    written = Robot.from_urdf(tmp_path / "found.urdf")
    np.testing.assert_allclose(written.armature, [0.05, 0.04, 0.03], rtol=0.02)
    q, v, _ = (torch.tensor(np.array(x)) for x in (data.q, data.v, data.u))
    kinematics = found.system.robot.kinematics(q, v)
    torch.testing.assert_close(written.mass_matrix(q), found.system.mass_matrix(kinematics))
