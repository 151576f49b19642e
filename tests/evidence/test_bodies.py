"""Coordinates of bodies: derivatives by finite differences, distances by their definition, links that share a body."""

import numpy as np
import pytest
import torch
from tests.posterior.arm import URDF
from tests.robots.robot_models import TREE

from forcegp.errors import NonPhysicalInertia
from forcegp.evidence import bodies as of_bodies
from forcegp.forces import Body
from forcegp.robots import Robot
from forcegp.robots.inertia import pseudo_inertia_of_standard


def bodies(robot=None):
    references = list(of_bodies.body_pseudo_inertias(robot or Robot.from_urdf_text(URDF)).numpy())
    return of_bodies.Bodies(references, [Body()] * len(references))


def derivatives(ours, x):
    """Of the standard parameters of every body in its own coordinates."""
    return [
        ours.chained(x, np.eye(30)[10 * k : 10 * k + 10].reshape(10, 1, 3, 10))[:, 0, 10 * k : 10 * k + 10]
        for k in range(3)
    ]


def difference(function, x, step=1e-6):
    return np.stack([(function(x + step * e) - function(x - step * e)) / (2 * step) for e in np.eye(len(x))], -1)


def test_zero_is_the_reference():
    ours, robot = bodies(), Robot.from_urdf_text(URDF)
    np.testing.assert_allclose(ours.parameters(np.zeros(30)).ravel(), of_bodies.standard_parameters(robot), atol=1e-13)
    np.testing.assert_allclose(ours.distance(np.zeros(30))[0], 0.0, atol=1e-14)


def test_derivatives():
    ours, x = bodies(), 0.4 * np.random.default_rng(0).normal(size=30)
    wanted, found = difference(lambda at: ours.parameters(at).ravel(), x), np.zeros((30, 30))
    for body, block in enumerate(derivatives(ours, x)):
        found[10 * body : 10 * body + 10, 10 * body : 10 * body + 10] = block
    np.testing.assert_allclose(found, wanted, atol=1e-8)
    np.testing.assert_allclose(ours.distance(x)[1], difference(lambda at: ours.distance(at)[0], x), atol=1e-7)


def test_steps_are_straight_in_the_parameters_while_a_body_has_them():
    ours, rng = bodies(), np.random.default_rng(2)
    x, step = 0.4 * rng.normal(size=30), 0.1 * rng.normal(size=30)
    wanted = ours.parameters(x) + np.einsum("bpk,bk->bp", derivatives(ours, x), step.reshape(3, 10))
    np.testing.assert_allclose(ours.parameters(ours.moved(x, step)), wanted, rtol=1e-10, atol=1e-12)


def test_a_step_to_parameters_of_no_body_ends_at_a_body():
    ours, step = bodies(), np.zeros(30)
    step[[0, 15]] = -0.6, 0.1  # a mass of 1 - 2 * .6 times the first
    there = ours.moved(np.zeros(30), step)
    np.testing.assert_array_equal(there[:10], step[:10])
    assert ours.parameters(there)[0, 0] == pytest.approx(np.exp(-1.2) * ours.parameters(0.0 * step)[0, 0])
    change = derivatives(ours, 0.0 * step)[1] @ step[10:20]
    np.testing.assert_allclose(ours.parameters(there)[1], ours.parameters(0.0 * step)[1] + change, atol=1e-12)


def test_distance_is_that_of_the_metric():
    ours, x, wanted = bodies(), 0.5 * np.random.default_rng(1).normal(size=30), 0.0
    for found, start in zip(ours.pseudo_inertias(x), ours.pseudo_inertias(np.zeros(30)), strict=True):
        wanted += np.square(np.log(np.linalg.eigvals(np.linalg.solve(start, found)).real)).sum()
    assert (ours.distance(x)[0] ** 2).sum() == pytest.approx(wanted, rel=1e-9)


def test_equal_eigenvalues_have_a_derivative():
    """At zero, and where a body is only scaled, all eigenvalues are equal and divided differences are 0/0."""
    ours, x = bodies(), np.tile([0.3, *np.zeros(9)], 3)
    np.testing.assert_allclose(ours.distance(x)[1], difference(lambda at: ours.distance(at)[0], x), atol=1e-6)


@pytest.mark.parametrize("text", [URDF, TREE], ids=["arm", "tree"])
def test_a_robot_with_other_bodies(text):
    robot, _ = of_bodies.thickened(Robot.from_urdf_text(text))
    ours = bodies(robot)
    x, numbers = 0.3 * np.random.default_rng(2).normal(size=ours.size), of_bodies.carrying(robot)
    changed = of_bodies.with_bodies(robot, dict(zip(numbers, ours.pseudo_inertias(x), strict=True)))
    found = of_bodies.standard_parameters(changed)
    np.testing.assert_allclose(found, ours.parameters(x).ravel(), atol=1e-12, rtol=1e-12)
    same = of_bodies.with_bodies(robot, dict(zip(numbers, ours.pseudo_inertias(np.zeros(ours.size)), strict=True)))
    for name in robot.link_names:
        np.testing.assert_allclose(same.link(name).inertia, robot.link(name).inertia, atol=1e-12)


def test_no_robot_has_impossible_bodies():
    robot = Robot.from_urdf_text(URDF)
    wanted = of_bodies.body_pseudo_inertias(robot).numpy()
    wanted[1, 3, 3] = -1.0
    with pytest.raises(NonPhysicalInertia, match=r"found for fore, .*more motion, or a prior"):
        of_bodies.with_bodies(robot, dict(enumerate(wanted)))


def test_points_are_given_some_thickness():
    hand = 'ixx="0.01" iyy="0.011" izz="0.006" ixy="0.001" ixz="0" iyz="-0.001"'
    text = URDF.replace(hand, 'ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"')
    robot, changed = of_bodies.thickened(Robot.from_urdf_text(text))
    assert changed == ("hand",)
    of_bodies.upper_cholesky(of_bodies.body_pseudo_inertias(robot).numpy())
    same, none = of_bodies.thickened(Robot.from_urdf_text(URDF))
    assert none == ()
    assert same.urdf_text == URDF


def test_joint_dynamics_stand_in_the_urdf():
    robot = Robot.from_urdf_text(TREE)
    damping = torch.arange(robot.nv, dtype=torch.float64) + 0.1
    changed = robot.with_joint_dynamics(damping, None)
    assert [joint.damping for joint in changed.joints] == damping.tolist()
    assert [joint.friction for joint in changed.joints] == [joint.friction for joint in robot.joints]
    again = changed.with_joint_dynamics(None, damping)
    assert [joint.friction for joint in again.joints] == damping.tolist()
    assert [joint.damping for joint in again.joints] == damping.tolist()


def test_pseudo_inertias_of_standard_parameters():
    robot = Robot.from_urdf_text(TREE)
    found = pseudo_inertia_of_standard(of_bodies.standard_parameters(robot).reshape(-1, 10)).numpy()
    np.testing.assert_allclose(found, of_bodies.body_pseudo_inertias(robot), atol=1e-13)
