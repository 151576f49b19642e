"""Coordinates of bodies: derivatives by finite differences, distances by their definition, links that share a body."""

import numpy as np
import pinocchio as pin
import pytest
import torch
from scipy.optimize import minimize_scalar
from tests.models.arm import URDF
from tests.robots.robot_models import TREE

from forcegp.analytical.bodies import (
    ConsistentBodies,
    FreeBodies,
    thickened,
    upper_cholesky,
    with_bodies,
    with_joint_dynamics,
)
from forcegp.analytical.identifiability import body_pseudo_inertias, standard_parameters
from forcegp.errors import NonPhysicalInertia
from forcegp.models.structured.search import squared_distance
from forcegp.robots import Robot
from forcegp.robots.inertia import parameters_from_physical, pseudo_inertia_of_standard

KINDS = [FreeBodies, ConsistentBodies]


def bodies(kind):
    return kind(body_pseudo_inertias(Robot.from_urdf_text(URDF)).numpy())


def difference(function, x, step=1e-6):
    return np.stack([(function(x + step * e) - function(x - step * e)) / (2 * step) for e in np.eye(len(x))], -1)


@pytest.mark.parametrize("kind", KINDS)
def test_zero_is_the_reference(kind):
    ours = bodies(kind)
    robot = Robot.from_urdf_text(URDF)
    np.testing.assert_allclose(ours.parameters(np.zeros(30)).ravel(), standard_parameters(robot), atol=1e-13)
    np.testing.assert_allclose(ours.distance(np.zeros(30))[0], 0.0, atol=1e-14)


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives(kind):
    ours, x = bodies(kind), 0.4 * np.random.default_rng(0).normal(size=30)
    wanted = difference(lambda at: ours.parameters(at).ravel(), x)
    found = np.zeros((30, 30))
    for body, block in enumerate(ours.derivatives(x)):
        found[10 * body : 10 * body + 10, 10 * body : 10 * body + 10] = block
    np.testing.assert_allclose(found, wanted, atol=1e-8)
    np.testing.assert_allclose(ours.distance(x)[1], difference(lambda at: ours.distance(at)[0], x), atol=1e-7)


def test_distance_is_that_of_the_metric():
    ours, x = bodies(ConsistentBodies), 0.5 * np.random.default_rng(1).normal(size=30)
    wanted = 0.0
    for found, start in zip(ours.pseudo_inertias(x), ours.pseudo_inertias(np.zeros(30)), strict=True):
        wanted += float(squared_distance(log_cholesky(found), log_cholesky(start)))
    assert (ours.distance(x)[0] ** 2).sum() == pytest.approx(wanted, rel=1e-9)


def test_mass_that_no_motion_shows_lies_where_the_distance_is_least():
    """A point of mass between two links, as Pinocchio writes it, against a search along this one line."""
    ours, x = bodies(ConsistentBodies), 0.3 * np.random.default_rng(2).normal(size=30)
    points = np.array([0.1, 0.02, -0.05]), np.array([0.0, -0.03, 0.04])
    unseen = np.zeros((30, 1))
    for body, (sign, point) in enumerate(zip((1, -1), points, strict=True)):
        mass = pin.Inertia(1.0, point, np.zeros((3, 3))).toDynamicParameters()
        unseen[10 * body : 10 * body + 10, 0] = sign * mass
    start, reference = ours.pseudo_inertias(x), ours.pseudo_inertias(np.zeros(30))

    def cost(mass):
        total = 0.0
        for body, sign in ((0, 1), (1, -1)):
            at = np.append(points[body], 1.0)
            pseudo = start[body] + sign * mass * np.outer(at, at)
            if np.linalg.eigvalsh(pseudo)[0] <= 0.0:
                return 1e9
            total += float(squared_distance(log_cholesky(pseudo), log_cholesky(reference[body])))
        return total

    wanted = min(np.linspace(-3, 3, 601), key=cost)
    wanted = minimize_scalar(cost, bounds=(wanted - 0.01, wanted + 0.01), method="bounded").x
    found = ours.parameters(ours.nearest(x, unseen)) - ours.parameters(x)
    assert abs(wanted) > 0.01
    np.testing.assert_allclose(found.ravel(), wanted * unseen[:, 0], atol=1e-4 * abs(wanted))


def test_equal_eigenvalues_have_a_derivative():
    """At zero, and where a body is only scaled, all eigenvalues are equal and divided differences are 0/0."""
    ours, x = bodies(ConsistentBodies), np.tile([0.3, *np.zeros(9)], 3)
    np.testing.assert_allclose(ours.distance(x)[1], difference(lambda at: ours.distance(at)[0], x), atol=1e-6)


@pytest.mark.parametrize("text", [URDF, TREE], ids=["arm", "tree"])
def test_a_robot_with_other_bodies(text):
    robot, _ = thickened(Robot.from_urdf_text(text))
    ours = ConsistentBodies(body_pseudo_inertias(robot).numpy())
    x = 0.3 * np.random.default_rng(2).normal(size=ours.size)
    changed = with_bodies(robot, ours.pseudo_inertias(x))
    np.testing.assert_allclose(standard_parameters(changed), ours.parameters(x).ravel(), atol=1e-12, rtol=1e-12)
    same = with_bodies(robot, ours.pseudo_inertias(np.zeros(ours.size)))
    for name in robot.link_names:
        np.testing.assert_allclose(same.link(name).inertia, robot.link(name).inertia, atol=1e-12)


def test_no_robot_has_impossible_bodies():
    robot = Robot.from_urdf_text(URDF)
    wanted = body_pseudo_inertias(robot).numpy()
    wanted[1, 3, 3] = -1.0
    with pytest.raises(NonPhysicalInertia, match=r"found for fore, .*inertias='consistent'"):
        with_bodies(robot, wanted)


def test_points_are_given_some_thickness():
    hand = 'ixx="0.01" iyy="0.011" izz="0.006" ixy="0.001" ixz="0" iyz="-0.001"'
    text = URDF.replace(hand, 'ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"')
    robot, changed = thickened(Robot.from_urdf_text(text))
    assert changed == ("hand",)
    upper_cholesky(body_pseudo_inertias(robot).numpy())
    same, none = thickened(Robot.from_urdf_text(URDF))
    assert none == ()
    assert same.urdf_text == URDF


def test_joint_dynamics_stand_in_the_urdf():
    robot = Robot.from_urdf_text(TREE)
    damping = np.arange(robot.nv) + 0.1
    changed = with_joint_dynamics(robot, damping, None)
    assert [joint.damping for joint in changed.joints] == damping.tolist()
    assert [joint.friction for joint in changed.joints] == [joint.friction for joint in robot.joints]
    again = with_joint_dynamics(changed, None, damping)
    assert [joint.friction for joint in again.joints] == damping.tolist()
    assert [joint.damping for joint in again.joints] == damping.tolist()


def test_pseudo_inertias_of_standard_parameters():
    robot = Robot.from_urdf_text(TREE)
    found = pseudo_inertia_of_standard(standard_parameters(robot).reshape(-1, 10)).numpy()
    np.testing.assert_allclose(found, body_pseudo_inertias(robot), atol=1e-13)


def log_cholesky(pseudo: np.ndarray) -> torch.Tensor:
    mass = pseudo[3, 3]
    center = pseudo[:3, 3] / mass
    second = pseudo[:3, :3] - mass * np.outer(center, center)
    inertia = np.trace(second) * np.eye(3) - second
    return parameters_from_physical(torch.tensor(mass), torch.tensor(center), torch.tensor(inertia))
