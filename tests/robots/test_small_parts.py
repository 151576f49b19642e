"""Parts that every algorithm of a robot builds on, each against its definition."""

import numpy as np
import pytest
import torch
from tests.robots.robot_models import MODELS

from forcegp.robots import Robot
from forcegp.robots.inertia import (
    pseudo_inertia_of_standard,
    rotation_from_rpy,
    rpy_from_rotation,
    standard_of_pseudo_inertia,
)

LINK = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'


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
    torch.testing.assert_close(pseudo_inertia_of_standard(parameters), expected, rtol=0.0, atol=1e-15)
    torch.testing.assert_close(standard_of_pseudo_inertia(expected), parameters, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("model", MODELS)
def test_the_regressor_times_any_parameters_is_the_joint_force(model):
    robot = Robot.from_urdf_text(MODELS[model]())
    rng = np.random.default_rng(1)
    q, v, a = torch.tensor(rng.normal(size=(3, 4, robot.nv)))
    parameters = torch.tensor(rng.normal(size=(robot.nv, 10)))
    kinematics = robot.kinematics(q, v)
    mass, bias = kinematics.dynamics_of_bodies(parameters)
    expected = (mass @ a[..., None])[..., 0] + bias
    found = torch.einsum("...ikp,kp->...i", kinematics.torque_regressor(a), parameters)
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("pitch", [0.3, np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9, 2.5])
def test_angles_of_a_rotation_give_it_back(pitch):
    for roll, yaw in ((0.0, 0.0), (1.0, -2.0), (-3.0, 0.4)):
        rotation = rotation_from_rpy((roll, pitch, yaw))
        np.testing.assert_allclose(rotation_from_rpy(rpy_from_rotation(rotation)), rotation, atol=1e-15)
