"""Every quantity against Pinocchio at 1e-9 relative, on an arm, a tree and a chain with all kinds of joints."""

import numpy as np
import pytest
import torch
from tests.robots.pinocchio_oracle import Oracle
from tests.robots.robot_models import CHAIN, FRAMES, MODELS, TREE

from forcegp.robots import Robot

COUNT = 12
POINT = (0.07, -0.11, 0.23)


def relative_error(ours: torch.Tensor, theirs: np.ndarray) -> float:
    """Largest deviation per state in units of the state's largest value."""
    ours, theirs = ours.numpy().reshape(COUNT, -1), np.asarray(theirs).reshape(COUNT, -1)
    return float((abs(ours - theirs).max(1) / abs(theirs).max(1)).max())


@pytest.fixture(params=[*MODELS, "tree with armature", "tree locked", "chain in odd gravity"])
def case(request):
    """A robot, its oracle and random states as tensors (COUNT, nv)."""
    options = {
        "tree with armature": {"armature": {"torso": 0.3, "left_gripper": 1.7, "right_wrist": 0.02}},
        "tree locked": {"locked": {"right_shoulder": 2.3, "left_gripper": 0.03}},
        "chain in odd gravity": {"gravity": (1.0, -7.0, 3.0), "armature": (0.5, 0.1, 0.2, 0.05)},
    }.get(request.param, {})
    model = request.param.split()[0]
    text = MODELS[model]()
    robot = Robot.from_urdf_text(text, **options)
    states = np.random.default_rng(7).normal(scale=1.5, size=(4, COUNT, robot.nv))
    return robot, Oracle(text, robot), FRAMES[model], *states


def test_mass_matrix(case):
    robot, oracle, _, q, *_ = case
    theirs = [oracle.mass_matrix(x) for x in q]
    assert relative_error(robot.mass_matrix(torch.tensor(q)), theirs) < 1e-12


def test_bias_forces(case):
    robot, oracle, _, q, v, *_ = case
    theirs = [oracle.bias_forces(*x) for x in zip(q, v, strict=True)]
    assert relative_error(robot.bias_forces(torch.tensor(q), torch.tensor(v)), theirs) < 1e-12


def test_gravity_forces(case):
    robot, oracle, _, q, *_ = case
    assert relative_error(robot.gravity_forces(torch.tensor(q)), [oracle.gravity_forces(x) for x in q]) < 1e-12


def test_inverse_dynamics(case):
    robot, oracle, _, q, v, a, _ = case
    theirs = [oracle.inverse_dynamics(*x) for x in zip(q, v, a, strict=True)]
    assert relative_error(robot.inverse_dynamics(*map(torch.tensor, (q, v, a))), theirs) < 1e-12


def test_forward_dynamics(case):
    robot, oracle, _, q, v, _, tau = case
    theirs = [oracle.forward_dynamics(*x) for x in zip(q, v, tau, strict=True)]
    assert relative_error(robot.forward_dynamics(*map(torch.tensor, (q, v, tau))), theirs) < 1e-9


@pytest.mark.parametrize("point", [None, POINT, torch.tensor(POINT, dtype=torch.float64)])
def test_frame_at_a_point(case, point):
    robot, oracle, frame, q, v, *_ = case
    index = oracle.with_point(frame, np.zeros(3) if point is None else np.asarray(point))
    pose, jacobian, acceleration = (
        np.stack(x) for x in zip(*(oracle.frame(*s, index) for s in zip(q, v, strict=True)), strict=True)
    )
    q, v = torch.tensor(q), torch.tensor(v)
    ours = robot.frame_pose(q, frame)
    assert relative_error(ours[:, :3, :3], pose[:, :3, :3]) < 1e-12
    offset = torch.zeros(3).double() if point is None else torch.as_tensor(point, dtype=torch.float64)
    assert relative_error(ours[:, :3, :3] @ offset + ours[:, :3, 3], pose[:, :3, 3]) < 1e-12
    assert relative_error(robot.frame_jacobian(q, frame, point), jacobian) < 1e-12
    assert relative_error(robot.frame_bias_acceleration(q, v, frame, point), acceleration) < 1e-11


@pytest.mark.parametrize("text", [TREE, CHAIN], ids=["tree", "chain"])
def test_every_frame(text):
    robot = Robot.from_urdf_text(text)
    oracle = Oracle(text, robot)
    q, v = np.random.default_rng(3).normal(size=(2, robot.nv))
    for frame in robot.link_names:
        pose, jacobian, acceleration = oracle.frame(q, v, oracle.with_point(frame, np.zeros(3)))
        args = torch.tensor(q), torch.tensor(v)
        np.testing.assert_allclose(robot.frame_pose(args[0], frame), pose, atol=1e-13)
        np.testing.assert_allclose(robot.frame_jacobian(args[0], frame), jacobian, atol=1e-13)
        np.testing.assert_allclose(robot.frame_bias_acceleration(*args, frame), acceleration, atol=1e-12)
