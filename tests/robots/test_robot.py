"""What a Robot shows of its URDF, how its links merge, and what it says about wrong names and inputs."""

import pickle

import numpy as np
import pytest
import torch
from tests.robots.robot_models import CHAIN, MODELS, TREE, loaded

from forcegp.errors import InvalidInput, NumericalError, UnknownName
from forcegp.robots import Robot
from forcegp.robots import inertia as inertias


@pytest.fixture(scope="module")
def tree() -> Robot:
    return Robot.from_urdf_text(TREE)


@pytest.fixture(scope="module")
def chain() -> Robot:
    return Robot.from_urdf_text(CHAIN)


def test_joints_come_depth_first_and_branches_in_file_order(tree):
    assert tree.joint_names == (
        "torso", "right_shoulder", "right_wrist", "left_shoulder", "left_gripper", "second_finger",
    )  # fmt: skip
    assert tree.nv == 6
    assert tree.name == "tree"


def test_locked_joint_is_fixed_where_it_is_locked(tree):
    locked = Robot.from_urdf_text(TREE, locked={"torso": 0.4, "right_wrist": -0.3})
    assert locked.joint_names == ("right_shoulder", "left_shoulder", "left_gripper", "second_finger")
    assert locked.locked == {"torso": 0.4, "right_wrist": -0.3}
    full = dict.fromkeys(tree.joint_names, 0.2) | locked.locked
    q = torch.tensor([full[name] for name in tree.joint_names], dtype=torch.float64)
    free = [tree.joint_names.index(name) for name in locked.joint_names]
    for frame in tree.link_names:
        torch.testing.assert_close(locked.frame_pose(q[free], frame), tree.frame_pose(q, frame), rtol=0, atol=1e-15)
    torch.testing.assert_close(locked.mass_matrix(q[free]), tree.mass_matrix(q)[free][:, free], rtol=1e-13, atol=1e-15)
    kept = loaded(locked.with_armature({"left_shoulder": 0.5}), "left_arm")
    assert (kept.locked, kept.armature.tolist()) == (locked.locked, [0.0, 0.5, 0.0, 0.0])


def test_armature_by_name_and_in_order(chain):
    named, ordered = chain.with_armature({"spin": 0.2}), Robot.from_urdf_text(CHAIN, armature=(0, 0.2, 0, 0))
    assert named.armature.tolist() == ordered.armature.tolist() == [0.0, 0.2, 0.0, 0.0]
    assert named.with_armature({"skew": 0.3}).armature.tolist() == [0.0, 0.2, 0.3, 0.0]
    q = torch.zeros(4, dtype=torch.float64)
    torch.testing.assert_close(named.mass_matrix(q) - chain.mass_matrix(q), torch.diag(named.armature))


def test_robot_is_immutable_and_survives_pickling(chain):
    with pytest.raises(AttributeError):
        chain.urdf_text = ""  # type: ignore[misc]
    chain.gravity.zero_()
    assert chain.gravity.tolist() == [0.0, 0.0, -9.81]
    q = torch.ones(4, dtype=torch.float64)
    torch.func.hessian(lambda q: chain.mass_matrix(q).sum())(q)  # nothing of a transform stays in the robot
    assert torch.equal(pickle.loads(pickle.dumps(chain)).mass_matrix(q), chain.mass_matrix(q))


# ---------------------------------------------------------------------- batches


def test_batches_broadcast(chain):
    generator = torch.Generator().manual_seed(1)
    q = torch.randn(3, 1, 4, generator=generator, dtype=torch.float64)
    v = torch.randn(5, 4, generator=generator, dtype=torch.float64)
    a = torch.randn(4, generator=generator, dtype=torch.float64)
    expanded = [x.expand(3, 5, 4) for x in (q, v, a)]
    for name in ("inverse_dynamics", "forward_dynamics"):
        function = getattr(chain, name)
        torch.testing.assert_close(function(q, v, a), function(*expanded))
    torch.testing.assert_close(chain.bias_forces(q, v), chain.bias_forces(*expanded[:2]))
    with pytest.raises(InvalidInput, match="for states"):
        chain.kinematics(q[0], v[0]).inverse_dynamics(torch.zeros(7, 4).double())
    with pytest.raises(InvalidInput, match="give one point"):
        chain.frame_jacobian(q, "tool", torch.zeros(5, 3).double())


# ---------------------------------------------------------------------- wrong names and inputs


def test_many_states_are_computed_some_at_a_time_with_equal_results(chain):
    q, v, a = torch.linspace(-3.0, 3.0, 3 * 3 * 700 * 4, dtype=torch.float64).sin().view(3, 3, 700, 4)
    tau, (M, bias) = chain.inverse_dynamics(q, v, a), chain.mass_matrix_and_bias(q, v)
    few = torch.stack([chain.inverse_dynamics(*each) for each in zip(q, v, a, strict=True)])
    for found in (tau, (M @ a[..., None])[..., 0] + bias):
        torch.testing.assert_close(found, few, rtol=1e-11, atol=1e-12)


def test_unknown_names_list_the_valid_ones(tree):
    q = torch.zeros(6, dtype=torch.float64)
    with pytest.raises(UnknownName, match=r"'left_fingr' .*'left_finger'"):
        tree.frame_pose(q, "left_fingr")
    with pytest.raises(UnknownName, match="no link 'boddy' in tree; did you mean 'body'"):
        tree.link("boddy")
    with pytest.raises(UnknownName, match="did you mean 'torso'"):
        tree.joint("torsoo")
    with pytest.raises(UnknownName, match="did you mean 'torso'"):
        Robot.from_urdf_text(TREE, armature={"torsoo": 1.0})
    with pytest.raises(UnknownName, match="did you mean 'torso'"):
        Robot.from_urdf_text(TREE, locked={"torsoo": 1.0})


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros(4), "q is a ndarray; give a tensor"),
        (torch.zeros(3, dtype=torch.float64), r"q has shape \(3,\); its last dimension must be 4"),
        (torch.zeros((), dtype=torch.float64), r"q has shape \(\); its last dimension must be 4"),
        (torch.zeros(4, dtype=torch.bool), r"q must be a tensor of real numbers; given: torch.bool"),
        (torch.zeros(4, dtype=torch.complex128), r"q must be a tensor of real numbers; given: torch.complex128"),
        (torch.zeros(4, dtype=torch.float64, device="meta"), r"q is on meta but the robot on cpu; use .*to\('meta'\)"),
    ],
)
def test_wrong_inputs(chain, value, message):
    with pytest.raises(InvalidInput, match=message):
        chain.mass_matrix(value)
    good = torch.zeros(4, dtype=torch.float64)
    for name, function in [("v", chain.bias_forces), ("a", chain.inverse_dynamics), ("tau", chain.forward_dynamics)]:
        arguments = (good, value) if name == "v" else (good, good, value)
        with pytest.raises(InvalidInput, match=message.replace("q", name, 1)):
            function(*arguments)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gravity": (0, 0)}, "gravity is .*; give 3 finite numbers"),
        ({"gravity": (0, 0, np.nan)}, "give 3 finite numbers"),
        ({"armature": (1, 2, 3)}, "armature is .*; give 4 finite numbers"),
        ({"armature": {"spin": -1.0}}, "armature of joint 'spin' is -1; a rotor inertia cannot be negative"),
        ({"locked": {"flange": 0.0}}, "joint 'flange' is fixed already"),
        ({"locked": {"spin": np.inf}}, r"locked\['spin'\] is inf; give a finite position"),
    ],
)
def test_wrong_options(options, message):
    with pytest.raises(InvalidInput, match=message):
        Robot.from_urdf_text(CHAIN, **options)


def test_singular_mass_matrix_is_an_error():
    body = """<robot name="r"><link name="a"/><link name="b"><inertial><mass value="1"/>
      <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
      <joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint></robot>"""
    one, nowhere = torch.tensor([[1.0], [torch.nan]], dtype=torch.float64)
    with pytest.raises(NumericalError, match=r"mass matrix is not positive definite.*armature"):
        Robot.from_urdf_text(body).forward_dynamics(nowhere, one, one)


def test_pseudo_inertia_of_standard_parameters():
    """[[Sigma, h], [h^T, m]] with Sigma = tr(I)/2 - I and h = m c (Wensing, Kim & Slotine 2018, eq. 5)."""
    m, hx, hy, hz, xx, xy, yy, xz, yz, zz = parameters = torch.randn(
        10, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    inertia = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz]).reshape(3, 3)
    expected = torch.zeros(4, 4, dtype=torch.float64)
    expected[:3, :3] = 0.5 * inertia.trace() * torch.eye(3, dtype=torch.float64) - inertia
    expected[:3, 3] = expected[3, :3] = torch.stack([hx, hy, hz])
    expected[3, 3] = m
    torch.testing.assert_close(inertias.pseudo_inertia_of_standard(parameters), expected, rtol=0.0, atol=1e-15)
    torch.testing.assert_close(inertias.standard_of_pseudo_inertia(expected), parameters, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("model", MODELS)
def test_the_regressor_times_any_parameters_is_the_joint_force(model):
    robot, rng = Robot.from_urdf_text(MODELS[model]()), np.random.default_rng(1)
    q, v, a = torch.tensor(rng.normal(size=(3, 4, robot.nv)))
    parameters, kinematics = torch.tensor(rng.normal(size=(robot.nv, 10))), robot.kinematics(q, v)
    mass, bias = kinematics.dynamics_of_bodies(parameters)
    expected = (mass @ a[..., None])[..., 0] + bias
    found = torch.einsum("...ikp,kp->...i", kinematics.torque_regressor(a), parameters)
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("pitch", [0.3, np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9, 2.5])
def test_angles_of_a_rotation_give_it_back(pitch):
    for roll, yaw in ((0.0, 0.0), (1.0, -2.0), (-3.0, 0.4)):
        rotation = inertias.rotation_from_rpy((roll, pitch, yaw))
        again = inertias.rotation_from_rpy(inertias.rpy_from_rotation(rotation))
        np.testing.assert_allclose(again, rotation, atol=1e-15)
