"""The torque regressor against Pinocchio and against the robot's own inverse dynamics."""

import numpy as np
import pytest
import torch
from tests.posterior.arm import URDF
from tests.robots.pinocchio_oracle import Oracle
from tests.robots.robot_models import CHAIN, TREE

from forcegp.errors import InvalidInput
from forcegp.evidence import standard_parameters, torque_regressor
from forcegp.robots import Robot

ROBOTS = {"arm": (URDF, {}), "tree": (TREE, {}), "chain": (CHAIN, {}), "locked": (TREE, {"right_shoulder": 0.4})}


def states(robot: Robot, rows: int, seed: int) -> torch.Tensor:
    return torch.tensor(np.random.default_rng(seed).normal(size=(3, rows, robot.nv)))


@pytest.fixture(params=ROBOTS)
def case(request):
    text, locked = ROBOTS[request.param]
    armature = None if request.param != "arm" else [0.1, 0.2, 0.3]
    robot = Robot.from_urdf_text(text, locked=locked, gravity=(1.0, -2.0, -9.0), armature=armature)
    return robot, Oracle(text, robot)


def test_columns_are_those_of_pinocchio(case):
    robot, oracle = case
    q, v, a = states(robot, 3, 0)
    ours = torque_regressor(robot, q, v, a).unflatten(-1, (robot.nv, 10))
    for row in range(3):
        theirs = oracle.torque_regressor(*(x[row].numpy() for x in (q, v, a)))
        theirs = theirs[:, [joint - 1 for joint in oracle.ids]]  # their joint 0 is the universe
        np.testing.assert_allclose(ours[row].numpy(), theirs, atol=1e-11 * np.abs(theirs).max())


def test_regressor_times_parameters_is_inverse_dynamics_without_armature(case):
    robot, _ = case
    q, v, a = states(robot, 4, 1)
    ours = torque_regressor(robot, q, v, a) @ standard_parameters(robot) + robot.armature * a
    torch.testing.assert_close(ours, robot.inverse_dynamics(q, v, a), atol=1e-10, rtol=1e-10)


def test_dynamics_of_any_parameters_are_linear_in_them(case):
    robot, _ = case
    q, v, a = states(robot, 4, 2)
    anything = torch.tensor(np.random.default_rng(3).normal(size=(robot.nv, 10)))  # belongs to no body
    M, bias = robot.kinematics(q, v).dynamics_of_bodies(anything)
    wanted = torque_regressor(robot, q, v, a) @ anything.flatten() + robot.armature * a
    torch.testing.assert_close((M @ a[..., None])[..., 0] + bias, wanted, atol=1e-10, rtol=1e-10)
    torch.testing.assert_close(M, M.mT)


def test_dynamics_of_the_urdf_parameters_are_the_robots(case):
    robot, _ = case
    q, v, _ = states(robot, 2, 4)
    ours = robot.kinematics(q, v).dynamics_of_bodies(standard_parameters(robot).unflatten(0, (robot.nv, 10)))
    torch.testing.assert_close(ours, robot.mass_matrix_and_bias(q, v), atol=1e-11, rtol=1e-11)


def test_derivative_in_the_acceleration_is_the_mass_matrix():
    robot = Robot.from_urdf_text(URDF)
    q, v, a = states(robot, 1, 5)[:, 0]
    jacobian = torch.autograd.functional.jacobian(
        lambda given: torque_regressor(robot, q, v, given) @ standard_parameters(robot), a
    )
    torch.testing.assert_close(jacobian, robot.mass_matrix(q))


def test_wrong_shapes_are_named():
    robot = Robot.from_urdf_text(URDF)
    with pytest.raises(InvalidInput, match="last dimension must be 3"):
        torque_regressor(robot, *torch.zeros(3, 2).double())
