"""Base parameters against singular values and known counts, and the regrouped regressor against the full one."""

import numpy as np
import pytest
import torch
from tests.posterior.arm import URDF
from tests.robots.robot_models import TREE

from forcegp.errors import InvalidInput
from forcegp.evidence import BaseParameters, base_parameters, standard_parameters, torque_regressor
from forcegp.evidence.bodies import excitation
from forcegp.robots import Robot


@pytest.mark.parametrize("text", [URDF, TREE], ids=["arm", "tree"])
def test_rank_and_regrouped_torques(text):
    robot = Robot.from_urdf_text(text)
    base = base_parameters(robot)
    q, v, a = torch.tensor(np.random.default_rng(1).normal(size=(3, 40 * robot.nv, robot.nv)))
    Y = torque_regressor(robot, q, v, a).flatten(0, 1).numpy()
    norms = np.linalg.norm(Y, axis=0)
    seen = norms > 1e-9 * norms.max()  # the others are zero up to rounding
    values = np.linalg.svd(Y[:, seen] / norms[seen], compute_uv=False)
    assert base.rank == (values > 1e-9 * values[0]).sum()
    pi = standard_parameters(robot).numpy()
    np.testing.assert_allclose(Y[:, list(base.independent)] @ base.values(pi), Y @ pi, atol=1e-9)
    assert sorted((*base.independent, *base.dependent, *base.unseen)) == list(range(10 * robot.nv))


def test_an_arm_of_three_turning_joints_has_fifteen():
    """Gautier & Khalil, "Direct calculation of minimum set of inertial parameters", T-RO 1990.

    A joint about the direction of gravity shows one inertia, each joint that is not parallel to the one before seven.
    """
    base = base_parameters(Robot.from_urdf_text(URDF))
    assert base.rank == 15
    assert "upper.m" in {base.names[k] for k in base.unseen}  # it is never lifted
    assert any("+" in expression for expression in base.expressions)


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
    assert BaseParameters.of(chosen, tuple("abcdefghijklmno")).condition == pytest.approx(
        np.linalg.cond(chosen / np.linalg.norm(chosen, axis=0))
    )


def test_regressors_that_say_nothing():
    with pytest.raises(InvalidInput, match="nothing moves"):
        BaseParameters.of(np.zeros((4, 2)), ("a", "b"))
    with pytest.raises(InvalidInput, match="not finite"):
        BaseParameters.of(np.full((4, 2), np.nan), ("a", "b"))
