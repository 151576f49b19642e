"""Base parameters against singular values and known counts, and the regrouped regressor against the full one."""

import numpy as np
import pytest
import torch
from tests.posterior.arm import URDF
from tests.robots.robot_models import TREE

from forcegp.errors import InvalidInput
from forcegp.evidence import BaseParameters, base_parameters, parameter_names, torque_regressor
from forcegp.evidence.bodies import excitation
from forcegp.robots import Robot


@pytest.mark.parametrize("text", [URDF, TREE], ids=["arm", "tree"])
def test_rank_and_columns(text):
    robot = Robot.from_urdf_text(text)
    base = base_parameters(robot)
    q, v, a = torch.tensor(np.random.default_rng(1).normal(size=(3, 40 * robot.nv, robot.nv)))
    Y = torque_regressor(robot, q, v, a).flatten(0, 1).numpy()
    norms = np.linalg.norm(Y, axis=0)
    seen = norms > 1e-9 * norms.max()  # the others are zero up to rounding
    values = np.linalg.svd(Y[:, seen] / norms[seen], compute_uv=False)
    assert base.rank == (values > 1e-9 * values[0]).sum()
    assert np.linalg.matrix_rank(Y[:, list(base.independent)], tol=1e-8) == base.rank


def test_an_arm_of_three_turning_joints_has_fifteen():
    """Gautier & Khalil, "Direct calculation of minimum set of inertial parameters", T-RO 1990.

    A joint about the direction of gravity shows one inertia, each joint that is not parallel to the one before seven.
    """
    robot = Robot.from_urdf_text(URDF)
    base = base_parameters(robot)
    assert base.rank == 15
    assert parameter_names(robot).index("upper.m") not in base.independent  # it is never lifted


def test_a_motion_of_one_joint_excites_less():
    robot = Robot.from_urdf_text(URDF)
    q, v, a = np.zeros((3, 50, 3))
    q[:, 1] = np.linspace(0.0, 2.0, 50)
    v[:, 1] = 1.0
    poor = excitation(robot, q, v, a)
    assert poor.rank < base_parameters(robot).rank
    generator = np.random.default_rng(0)
    rich = excitation(robot, *generator.normal(size=(3, 50, 3)))
    assert rich.rank == 15
    scaled = torque_regressor(robot, *torch.tensor(generator.normal(size=(3, 50, 3)))).flatten(0, 1).numpy()
    chosen = scaled[:, list(rich.independent)]
    assert BaseParameters.of(chosen).condition == pytest.approx(np.linalg.cond(chosen / np.linalg.norm(chosen, axis=0)))


def test_regressors_that_say_nothing():
    with pytest.raises(InvalidInput, match="nothing moves"):
        BaseParameters.of(np.zeros((4, 2)))
    with pytest.raises(InvalidInput, match="not finite"):
        BaseParameters.of(np.full((4, 2), np.nan))
