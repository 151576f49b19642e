"""Thrusters and observed wrenches against Pinocchio's external forces, by hand, and through files."""

import math

import numpy as np
import pinocchio as pin
import pytest
import torch
from tests.robots.random_positions import random_positions

from forcegp import Model, Robot
from forcegp.errors import InvalidInput
from forcegp.forces import Actuation, ObservedWind, ObservedWrench, RigidBodies, Thrusters

INERTIA = '<inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0.001" ixz="0" iyz="0.002"/>'
DRONE = f"""<robot name="drone"><link name="body"><inertial><origin xyz="0.01 -0.02 0.03"/><mass value="1.5"/>{INERTIA}
</inertial></link><joint name="tilt" type="revolute"><origin xyz="0.1 0 0.05" rpy="0.2 0 0.1"/><parent link="body"/>
<child link="pod"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="5" velocity="9"/></joint><link name="pod">
<inertial><origin xyz="0 0 0.02"/><mass value="0.4"/>{INERTIA}</inertial></link></robot>"""
PLACES = [(0.1, 0.05, 0.02), (-0.1, 0.0, 0.03)]
AXES = [(0.0, 0.2, 1.0), (0.0, 0.0, 2.0)]


@pytest.fixture(scope="module")
def robot():
    return Robot.from_urdf_text(DRONE, base="floating")


def states(robot, rows=5):
    generator = torch.Generator().manual_seed(3)
    q = random_positions(robot, generator, rows)
    return q, *(torch.randn(rows, size, generator=generator, dtype=torch.float64) for size in (robot.nv, 3))


@pytest.mark.parametrize("power", [1, 2])
def test_accelerations_are_those_of_external_forces_in_pinocchio(robot, power):
    pushing = Thrusters("pod", PLACES, (2.0, 3.0), (0.1, -0.2), AXES, power)
    model = Model(robot, (), (Actuation(), pushing, RigidBodies()))
    assert model.inputs == ("tilt", "rotor_1", "rotor_2")
    q, v, u = states(robot)
    a = model.dynamics(q, v, u).acceleration_map().offset
    model = pin.buildModelFromXML(DRONE, pin.JointModelFreeFlyer())
    data = model.createData()
    for k in range(len(q)):
        wrench = np.zeros(6)
        for place, axis, size, turn, s in zip(PLACES, AXES, (2.0, 3.0), (0.1, -0.2), u[k, 1:].tolist(), strict=True):
            unit, signal = np.array(axis) / np.linalg.norm(axis), s if power == 1 else s * abs(s)
            wrench[:3] += size * signal * unit
            wrench[3:] += np.cross(place, size * signal * unit) + turn * signal * unit
        outside = [pin.Force.Zero()] * 2 + [pin.Force(wrench)]  # the pod's frame is that of its joint
        tau = np.concatenate([np.zeros(6), u[k, :1].numpy()])
        expected = pin.aba(model, data, q[k].numpy(), v[k].numpy(), tau, outside)
        np.testing.assert_allclose(a[k].numpy(), expected, rtol=1e-9, atol=1e-9)


def test_an_observed_wrench_acts_along_the_axes_of_the_world(robot):
    model = Model(robot, (), (Actuation(), RigidBodies(), ObservedWrench("pod")))
    assert model.inputs[:3] == ("tilt", "observed_force_x", "observed_force_y")
    assert model.held_inputs == (1, 2, 3, 4, 5, 6)
    q, v, u = states(robot)
    u = torch.cat([u[:, :1], torch.ones(5, 6).double() * torch.tensor([1.0, -2.0, 0.5, 0.3, 0.1, -0.7])], -1)
    calm = Model(robot).dynamics(q, v, u[:, :1])
    push = calm.state.kinematics.frame_jacobian("pod").mT @ u[0, 1:]
    torch.testing.assert_close(model.dynamics(q, v, u).Q_K - calm.Q_K, push)


def test_motions_keep_the_wrench_of_their_start(robot):
    model = Model(robot, (), (Actuation(), RigidBodies(), ObservedWind(), ObservedWrench("pod")))
    assert model.held_inputs == tuple(range(1, 10))
    u = torch.randn(3, 5, 10, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    found = model.foreseen(u)
    torch.testing.assert_close(found[..., :1], u[..., :1])  # commanded
    torch.testing.assert_close(found[..., 1:], u[:, :1, 1:].expand(3, 5, 9))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Thrusters("pod", [(0.0, 1.0)]), "x, y, z in m"),
        (lambda: Thrusters("pod", PLACES, (1.0, 2.0, 3.0)), "one for all, or 2"),
        (lambda: Thrusters("pod", PLACES, math.nan), "finite numbers"),
        (lambda: Thrusters("pod", PLACES, axes=(0.0, 0.0, 0.0)), "a direction"),
        (lambda: Thrusters("pod", PLACES, power=3), "1 for thrusts or 2"),
        (lambda: Thrusters("pod", PLACES, names=("a", "a")), "2 different ones"),
        (lambda: Thrusters("pod", PLACES, names=("tilt", "b")), "its own name"),
        (lambda: ObservedWrench("pod", ("a", "b")), "6 different ones"),
    ],
)
def test_what_does_not_fit_is_refused(robot, make, words):
    with pytest.raises(InvalidInput, match=words):
        Model(robot, (), (Actuation(), make(), RigidBodies()))
