"""Points that are held, contacts that act row by row, and actuators that are a map, against dense linear algebra."""

import json

import numpy as np
import pinocchio as pin
import pytest
import torch
from tests.robots.random_positions import random_positions
from tests.robots.test_moving_bases import LIMBS
from torch.testing import assert_close

from forcegp.errors import ContactError, InvalidInput
from forcegp.forces import Actuation
from forcegp.mechanics import Contact, ImplicitSurface, Plane, Sphere, fixed_frame, fixed_point
from forcegp.model import Model
from forcegp.robots import Robot

POINT = (0.05, -0.02, 0.1)


@pytest.fixture(scope="module")
def robot():
    return Robot.from_urdf_text(LIMBS, base="floating")


@pytest.fixture(scope="module")
def walker(robot):
    feet = (*fixed_point("a_foot", POINT, "a_stands"), *fixed_point("b_foot", (0.0, 0.0, 0.1), "b_stands"))
    return Model(robot, feet)


def states(robot, inputs, rows=6):
    generator = torch.Generator().manual_seed(1)
    v = torch.randn(rows, robot.nv, dtype=torch.float64, generator=generator)
    u = torch.randn(rows, inputs, dtype=torch.float64, generator=generator)
    return random_positions(robot, generator, rows), v, u


def test_inputs_are_actuators_then_switches(walker):
    assert walker.inputs == ("a_hip", "a_knee", "b_slide", "a_stands", "b_stands")
    assert walker.sizes == (10, 9, 5)


def test_accelerations_and_foot_forces_are_those_of_the_equations_of_motion(walker, robot):
    """The saddle-point system of each row with only the contacts that act there, by a dense solve."""
    q, v, u = states(robot, 5)
    u[:, 3:] = torch.tensor([[1, 1], [1, 0], [0, 1], [0, 0], [1, 1], [0, 1]])
    found = walker.dynamics(q, v, u)
    a, forces = found.acceleration(torch.zeros_like(v)), found.multiplier(torch.zeros_like(v))
    assert pin.buildModelFromXML(LIMBS, pin.JointModelFreeFlyer()).nv == robot.nv
    for k in range(len(q)):
        M, bias = robot.mass_matrix_and_bias(q[k], v[k])
        tau, rows = torch.cat([torch.zeros(6), u[k, :3]]).double(), []
        for stands, frame, point in ((u[k, 3], "a_foot", POINT), (u[k, 4], "b_foot", (0.0, 0.0, 0.1))):
            if stands:
                J = robot.frame_jacobian(q[k], frame, point)[:3]
                rows.append((J, robot.kinematics(q[k], v[k]).frame_bias_acceleration(frame, point)[:3]))
        A = torch.cat([J for J, _ in rows]) if rows else torch.zeros(0, robot.nv).double()
        drift = torch.cat([each for _, each in rows]) if rows else torch.zeros(0).double()
        whole = torch.cat([torch.cat([M, -A.mT], 1), torch.cat([A, torch.zeros(len(A), len(A)).double()], 1)])
        solution = torch.linalg.solve(whole, torch.cat([tau - bias, -drift]))
        assert_close(a[k], solution[: robot.nv], rtol=1e-7, atol=1e-7)
        acting = torch.repeat_interleave(u[k, 3:] > 0, 3)
        assert_close(forces[k][acting], solution[robot.nv :], rtol=1e-7, atol=1e-7)
        assert (forces[k][~acting].abs() < 1e-12).all()
    assert_close(found.force_at("b_foot")(torch.zeros_like(v)), forces[:, 3:])
    assert torch.equal(found.as_measured("a_foot", forces[:, :3]), forces[:, :3])
    assert torch.equal(found.state.positions, torch.nn.functional.pad(q[:, -3:], (6, 0)))
    assert_close(found.state.delivered, torch.nn.functional.pad(u[:, :3], (6, 0)))
    swinging = Contact("b_foot", POINT, ImplicitSurface(lambda p: 2.0 * p[2] - 0.6), switch="b_stands")
    off = Model(robot, (swinging,)).dynamics(q, v, u[:, [0, 1, 2, 4]]).off()[:, 0]
    assert_close(off, torch.where(u[:, 4] > 0, swinging.position(found.state.kinematics)[:, 2] - 0.3, 0.0))


def test_a_frame_that_is_held_neither_moves_nor_turns(robot):
    model = Model(robot, fixed_frame("a_foot"))
    q, v, u = states(robot, 3)
    v = v - v  # at rest, so that the frame has to stay without acceleration of any kind
    a = model.dynamics(q, v, u).acceleration(torch.zeros_like(v))
    assert (robot.frame_jacobian(q, "a_foot") @ a[..., None])[..., 0].abs().max() < 1e-9 * a.abs().max()


def test_the_point_of_a_ball_that_touches_level_ground_rests(robot):
    """Its velocity is that of the material point below the centre; the drift is the change of A v, by differences."""
    radius, ball = 0.03, fixed_point("a_foot", POINT, radius=0.03)
    model = Model(robot, ball)
    q, v, u = states(robot, len(model.inputs), rows=5)

    def rates(at):
        return model.dynamics(at, v, u).A @ v[..., None]

    touching, kinematics = rates(q)[..., 0], robot.kinematics(q, v)
    below = (
        -radius * kinematics.frame_pose("a_foot")[..., 2, :3]
    ).tolist()  # of the world's z, in the axes of the foot
    for k, offset in enumerate(below):
        velocity = robot.frame_jacobian(q[k], "a_foot", tuple(np.add(POINT, offset)))[:3] @ v[k]
        assert_close(touching[k], velocity, rtol=1e-12, atol=1e-12)
    step = 1e-6
    change = (rates(robot.integrate(q, step * v)) - rates(robot.integrate(q, -step * v)))[..., 0] / (2.0 * step)
    assert_close(-model.dynamics(q, v, u).b, change, rtol=1e-6, atol=1e-6)
    with pytest.raises(InvalidInput, match="must be a Held"):
        Contact("a_foot", POINT, Plane((0.0, 0.0, 1.0), 0.0), radius=radius)
    assert Contact.from_dict(json.loads(json.dumps(ball[0].to_dict()))) == ball[0]


def test_matrices_that_do_not_fit_are_refused(robot):
    with pytest.raises(InvalidInput, match=r"9\s*rows, one per degree of freedom"):
        Model(robot, forces=(Actuation(np.eye(3)),))
    with pytest.raises(InvalidInput, match="give 2 different ones"):
        Model(robot, forces=(Actuation(np.eye(9)[:, :2], ("one", "one")),))
    with pytest.raises(InvalidInput, match="lists Actuation twice"):
        Model(robot, forces=(Actuation(), Actuation()))


def test_noise_of_velocities_is_no_contradiction_of_a_flat_foot(robot):
    """Three points of a link that turns by noise have centripetal accelerations that no motion of the link has."""
    model = Model(robot, fixed_frame("a_foot"))
    q, v, u = states(robot, 3)
    noisy = 0.1 * v
    dynamics = model.dynamics(q, noisy, u)
    a = dynamics.acceleration_map().offset
    assert float(((dynamics.A @ a[..., None])[..., 0] - dynamics.b).abs().max()) > 1e-3
    model.check_states(q, noisy, u)


def test_two_feet_that_hold_one_link_are_legal_and_a_sphere_through_a_held_point_is_not(robot):
    feet = (*fixed_point("a_foot", POINT), *fixed_point("a_foot", POINT))
    q, v, u = states(robot, 3)
    Model(robot, feet).check_states(q, 0.1 * v, u)  # redundant
    sphere = Contact("a_foot", POINT, Sphere((0.0, 0.0, -9.0), 3.0))
    plane = Contact("a_foot", POINT, Plane((0.0, 0.0, 1.0), 0.0))
    q[:, :3] = 0.0
    kinematics = robot.kinematics(q)
    q[:, :3] = torch.tensor([0.0, 0.0, 1.0]) - sphere.position(kinematics)  # above the centre: both normals are up
    with pytest.raises(ContactError, match=r"contradict each other.*'a_foot'"):
        Model(robot, (sphere, plane)).check_states(q, v, u)
