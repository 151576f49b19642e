"""Identities of mechanics that hold whatever the implementation."""

import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from tests.robots.robot_models import FRAMES, MODELS
from torch.func import grad, jvp

from forcegp.robots import Robot


@pytest.fixture(params=[*MODELS])
def case(request):
    robot = Robot.from_urdf_text(MODELS[request.param]())
    states = torch.tensor(np.random.default_rng(2).normal(size=(3, 20, robot.nv)))
    return robot, FRAMES[request.param], *states


def test_gravity_is_the_gradient_of_potential_energy(case):
    robot, _, q, *_ = case

    def energy(q):
        total = torch.zeros(()).double()
        for link in map(robot.link, robot.link_names):
            if link.joint is not None:
                center = robot.frame_pose(q, link.name)[:3] @ torch.tensor(
                    [*link.center_of_mass, 1.0], dtype=torch.float64
                )
                total = total - link.mass * (robot.gravity @ center)
        return total

    torch.testing.assert_close(robot.gravity_forces(q[0]), grad(energy)(q[0]), rtol=1e-11, atol=1e-11)


def test_velocity_forces_keep_the_energy(case):
    # v . C v = v . (dM/dt) v / 2
    robot, _, q, v, _ = case
    coriolis = robot.bias_forces(q, v) - robot.gravity_forces(q)
    _, rate = jvp(robot.mass_matrix, (q,), (v,))
    power = 0.5 * torch.einsum("bi,bij,bj->b", v, rate, v)
    torch.testing.assert_close((v * coriolis).sum(-1), power, rtol=1e-10, atol=1e-10)


def test_bias_acceleration_is_the_rate_of_the_jacobian(case):
    robot, frame, q, v, _ = case
    point = (0.2, -0.1, 0.3)
    _, rate = jvp(lambda q: robot.frame_jacobian(q, frame, point), (q,), (v,))
    expected = (rate @ v[..., None]).squeeze(-1)
    ours = robot.frame_bias_acceleration(q, v, frame, point)
    torch.testing.assert_close(ours, expected, rtol=1e-11, atol=1e-11)
    step = 1e-6
    ahead, behind = (robot.frame_jacobian(q + s * v, frame, point) @ v[..., None] for s in (step, -step))
    torch.testing.assert_close(ours, ((ahead - behind) / (2 * step)).squeeze(-1), rtol=1e-6, atol=1e-6)


def test_jacobian_is_the_rate_of_the_pose(case):
    robot, frame, q, v, _ = case
    pose, rate = jvp(lambda q: robot.frame_pose(q, frame), (q,), (v,))
    linear, angular = (robot.frame_jacobian(q, frame) @ v[..., None]).squeeze(-1).split(3, dim=-1)
    torch.testing.assert_close(rate[..., :3, 3], linear, rtol=1e-11, atol=1e-11)
    spin = rate[..., :3, :3] @ pose[..., :3, :3].mT
    vee = torch.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], dim=-1)
    torch.testing.assert_close(vee, angular, rtol=1e-11, atol=1e-11)


angles = st.lists(st.floats(-1e3, 1e3), min_size=6, max_size=6)
