"""Derivatives against Pinocchio at 1e-8, against finite differences, and through every transform of torch.func."""

import numpy as np
import pytest
import torch
from tests.robots.pinocchio_oracle import Oracle
from tests.robots.robot_models import CHAIN, MODELS
from torch.autograd import gradcheck, gradgradcheck
from torch.func import jacfwd, jacrev

from forcegp.robots import Robot


def relative_error(ours: torch.Tensor, theirs: np.ndarray) -> float:
    return float(abs(ours.numpy() - theirs).max() / abs(theirs).max())


@pytest.fixture(params=[*MODELS])
def case(request):
    text = MODELS[request.param]()
    armature = 0.1 * np.arange(1, 1 + Robot.from_urdf_text(text).nv)
    robot = Robot.from_urdf_text(text, armature=armature)
    states = np.random.default_rng(11).normal(size=(3, robot.nv))
    return robot, Oracle(text, robot), *states


@pytest.mark.parametrize("jacobian", [jacrev, jacfwd])
def test_forward_dynamics_with_respect_to_state_and_force(case, jacobian):
    robot, oracle, *states = case
    ours = jacobian(robot.forward_dynamics, argnums=(0, 1, 2))(*map(torch.tensor, states))
    for mine, theirs in zip(ours, oracle.forward_dynamics_derivatives(*states), strict=True):
        assert relative_error(mine, theirs) < 1e-8


@pytest.fixture(scope="module")
def chain():
    robot = Robot.from_urdf_text(CHAIN)
    states = torch.tensor(np.random.default_rng(5).normal(size=(3, 2, robot.nv)))
    return robot, *states


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
    assert gradcheck(lambda q, v, p: robot.frame_bias_acceleration(q, v, "tool", p), [q, v, point])
