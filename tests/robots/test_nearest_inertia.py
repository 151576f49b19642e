"""Inertias that no body has, replaced by the nearest possible one when asked for."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from forcegp.errors import NonPhysicalInertia, RobotFileWarning
from forcegp.model import Model
from forcegp.robots import Robot
from forcegp.robots.inertia import physical_objection
from forcegp.robots.urdf_file import MARGIN, nearest_inertia

URDF = """<robot name="one"><link name="base"/>
<!-- rounded to death --><link name="arm"><inertial><origin xyz="0 0 0.1"/><mass value="{mass}"/>
<inertia ixx="{ixx}" iyy="0.02" izz="0.01" ixy="0.001" ixz="0" iyz="0"/></inertial></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
BROKEN = URDF.format(mass=1.0, ixx=0.04)


def symmetric(seed: int) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(3, 3))
    return root + root.T


@given(st.integers(0, 10_000))
def test_the_nearest_is_possible_and_no_possible_one_is_nearer(seed):
    inertia = symmetric(seed) + np.eye(3)
    nearest = nearest_inertia(inertia)
    assert physical_objection(1.0, np.zeros(3), nearest) is None
    # independent: constrained minimisation over the principal moments in the same axes
    moments = np.linalg.eigvalsh(inertia)
    second = 0.5 * moments.sum() - moments
    least = MARGIN * np.maximum(second, 0.0).sum()
    start = np.full(3, 1.0 + abs(moments).max())
    found = minimize(
        lambda m: ((m - moments) ** 2).sum(),
        start,
        jac=lambda m: 2.0 * (m - moments),
        constraints={"type": "ineq", "fun": lambda m: 0.5 * m.sum() - m - least, "jac": lambda m: 0.5 - np.eye(3)},
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 300},
    )
    ours = np.linalg.norm(nearest - inertia) ** 2
    assert ours == pytest.approx(found.fun, rel=1e-5, abs=1e-9)
    # the optimality condition of a projection onto a convex set, whatever the axes of the other point
    root = np.random.default_rng(seed + 1).normal(size=(3, 3))
    other_second = root @ root.T + least * np.eye(3)
    other = np.trace(other_second) * np.eye(3) - other_second
    assert np.sum((inertia - nearest) * (other - nearest)) < 1e-8


def test_the_repaired_robot_says_so_and_can_be_stored():
    with pytest.warns(RobotFileWarning, match=r"link 'arm'.*triangle.* \d+(\.\d+)? %"):
        robot = Robot.from_urdf_text(BROKEN, inertias="nearest")
    assert "<!-- rounded to death -->" in robot.to_urdf()
    again = Model.from_json(Model(robot).to_json()).robot
    q = torch.zeros(1).double()
    assert again.mass_matrix(q).equal(robot.mass_matrix(q))


def test_a_frame_without_mass_loses_its_inertia():
    frame = """<link name="tip"><inertial><mass value="0"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>
    </inertial></link><joint name="hold" type="fixed"><parent link="arm"/><child link="tip"/></joint></robot>"""
    text = URDF.format(mass=1.0, ixx=0.02).replace("</robot>", frame)
    with pytest.raises(NonPhysicalInertia, match="'tip'") as caught:
        Robot.from_urdf_text(text)
    assert caught.value.remedy == {"inertias": "nearest"}
    with pytest.warns(RobotFileWarning, match=r"'tip'.* changed by 1e\+02 %"):
        robot = Robot.from_urdf_text(text, **caught.value.remedy)
    plain = Robot.from_urdf_text(URDF.format(mass=1.0, ixx=0.02))
    q = torch.zeros(1).double()
    assert robot.mass_matrix(q).equal(plain.mass_matrix(q))


@pytest.mark.parametrize(("mass", "why"), [(-1.0, "negative"), (math.inf, "not finite")])
def test_an_impossible_mass_is_not_mended(mass, why):
    with pytest.raises(NonPhysicalInertia, match=why):
        Robot.from_urdf_text(URDF.format(mass=mass, ixx=0.02), inertias="nearest")
