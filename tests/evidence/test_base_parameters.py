"""Base parameters against singular values and known counts."""

import numpy as np
import pytest
import torch
from tests.posterior.arm import URDF
from tests.recordings.broken_logs import urdf
from tests.robots.robot_models import TREE

from forcegp.evidence import base_parameters, torque_regressor
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
    assert len(base) == (values > 1e-9 * values[0]).sum()
    assert np.linalg.matrix_rank(Y[:, list(base)], tol=1e-8) == len(base)


def test_an_arm_of_three_turning_joints_has_fifteen():
    """Gautier & Khalil, "Direct calculation of minimum set of inertial parameters", T-RO 1990."""
    # A joint about the direction of gravity shows one inertia, each joint that is not parallel to the one before seven
    base = base_parameters(Robot.from_urdf_text(URDF))
    assert len(base) == 15
    assert 0 not in base  # it is never lifted


def test_many_joints_take_little_memory_or_are_refused(monkeypatch):
    robot = Robot.from_urdf_text(urdf(*map("j{}".format, range(40))).replace("<axis", '<origin xyz="0 0 1"/><axis'))
    monkeypatch.setattr("forcegp.inference.memory.free_memory", lambda _: 2**29)
    assert len(base_parameters(robot)) == 3 * 40, "in a plane an inertia and two moments each (ibid.)"
    monkeypatch.setattr("forcegp.inference.memory.free_memory", lambda _: 2**20)
    with pytest.raises(MemoryError, match=r"40 joints .* fewer joints"):
        base_parameters(robot)
