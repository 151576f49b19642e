"""Every quantity against Pinocchio at 1e-9 relative, on an arm, a tree and a chain with all kinds of joints."""

import numpy as np
import pytest
import torch
from tests.robots.pinocchio_oracle import Oracle
from tests.robots.robot_models import CHAIN, FRAMES, MODELS, TREE
from torch.autograd import gradcheck, gradgradcheck
from torch.func import jacfwd, jacrev

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


FUNCTIONS = {
    "mass_matrix": "q", "bias_forces": "qv", "gravity_forces": "q", "inverse_dynamics": "qva", "forward_dynamics": "qvt"
}  # fmt: skip


@pytest.mark.parametrize("function", FUNCTIONS)
def test_dynamics(case, function):
    robot, oracle, _, *states = case
    given = [dict(zip("qvat", states, strict=True))[name] for name in FUNCTIONS[function]]
    theirs = [getattr(oracle, function)(*x) for x in zip(*given, strict=True)]
    ours = getattr(robot, function)(*map(torch.tensor, given))
    assert relative_error(ours, theirs) < (1e-9 if function == "forward_dynamics" else 1e-12)


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
    assert relative_error(robot.kinematics(q, v).frame_bias_acceleration(frame, point), acceleration) < 1e-11


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
        np.testing.assert_allclose(robot.kinematics(*args).frame_bias_acceleration(frame), acceleration, atol=1e-12)


@pytest.fixture(params=[*MODELS])
def at_one_state(request):
    text = MODELS[request.param]()
    robot = Robot.from_urdf_text(text, armature=0.1 * np.arange(1, 1 + Robot.from_urdf_text(text).nv))
    return robot, Oracle(text, robot), *np.random.default_rng(11).normal(size=(3, robot.nv))


@pytest.mark.parametrize("jacobian", [jacrev, jacfwd])
def test_forward_dynamics_with_respect_to_state_and_force(at_one_state, jacobian):
    robot, oracle, *states = at_one_state
    ours = jacobian(robot.forward_dynamics, argnums=(0, 1, 2))(*map(torch.tensor, states))
    for mine, theirs in zip(ours, oracle.forward_dynamics_derivatives(*states), strict=True):
        assert abs(mine.numpy() - theirs).max() < 1e-8 * abs(theirs).max()


@pytest.fixture(scope="module")
def chain():
    robot = Robot.from_urdf_text(CHAIN)
    return robot, *torch.tensor(np.random.default_rng(5).normal(size=(3, 2, robot.nv)))


def test_first_and_second_derivatives_by_finite_differences(chain):
    robot, q, v, tau = chain
    inputs = [x.clone().requires_grad_() for x in (q, v, tau)]
    assert gradcheck(robot.forward_dynamics, inputs, rtol=1e-5, check_forward_ad=True)
    assert gradgradcheck(robot.forward_dynamics, inputs, rtol=1e-4, atol=1e-4, fast_mode=True)


def test_frame_functions_are_differentiable(chain):
    robot, q, v, _ = chain
    point = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64).requires_grad_()
    q, v = q.clone().requires_grad_(), v.clone().requires_grad_()
    assert gradcheck(lambda q: robot.frame_pose(q, "tool"), [q])
    assert gradcheck(lambda q, p: robot.frame_jacobian(q, "tool", p), [q, point])
    assert gradcheck(lambda q, v, p: robot.kinematics(q, v).frame_bias_acceleration("tool", p), [q, v, point])
