"""Motions of bases that move: order of the integrators, and what a body in free fall keeps."""

import pytest
import torch
from tests.robots.test_moving_bases import LIMBS

from forcegp.integration import integrate, integrator_named, violation
from forcegp.model import Model
from forcegp.robots import Robot
from forcegp.simulation import QuadrupedConfig, simulate_quadruped

BODY = """<robot name="body"><link name="body"><inertial><origin xyz="0.02 -0.03 0.05"/><mass value="3"/>
<inertia ixx="0.06" ixy="0.002" ixz="-0.004" iyy="0.09" iyz="0.003" izz="0.1"/></inertial></link></robot>"""
CENTER = torch.tensor([0.02, -0.03, 0.05], dtype=torch.float64)


def moved(robot, name, dt, seconds, speed=1.0):
    generator = torch.Generator().manual_seed(1)
    q = robot.random(generator)
    v = speed * torch.randn(1, robot.nv, dtype=torch.float64, generator=generator)
    steps = torch.zeros(round(seconds / dt), 1, robot.nv, dtype=torch.float64)
    method = integrator_named(name, Model(robot))
    with torch.no_grad():
        return integrate(method, robot.forward_dynamics, q, v, steps, dt)


@pytest.mark.nightly
def test_a_tumbling_body_in_free_fall_keeps_energy_and_momentum():
    robot = Robot.from_urdf_text(BODY, base="floating")
    motion, seconds, mass = moved(robot, "implicit-midpoint", 0.02, 4.0), 4.0, 3.0

    def kept(q, v):
        pose, h = robot.frame_pose(q, "body"), (robot.mass_matrix(q) @ v[..., None])[..., :6, 0]
        rotation, center = pose[:, :3, :3], (pose[:, :3, :3] @ CENTER) + pose[:, :3, 3]
        momentum = (rotation @ h[:, :3, None])[..., 0]
        spin = (rotation @ h[:, 3:, None])[..., 0] + torch.linalg.cross(pose[:, :3, 3] - center, momentum)
        energy = 0.5 * (v * h).sum(-1) + 9.81 * mass * center[:, 2]
        return momentum, spin, energy

    (p0, s0, e0), (p1, s1, e1) = kept(motion.q[0], motion.v[0]), kept(motion.q[-1], motion.v[-1])
    fallen = torch.tensor([0.0, 0.0, -9.81 * mass * seconds], dtype=torch.float64)
    torch.testing.assert_close(p1, p0 + fallen, rtol=0, atol=1e-7 * float(fallen.abs().max()))
    torch.testing.assert_close(s1, s0, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(e1, e0, rtol=0, atol=1e-7 * float(p1.norm()) ** 2 / mass)
    turn = motion.q[-1][:, 3:]
    torch.testing.assert_close(torch.linalg.vector_norm(turn, dim=-1), torch.ones(1).double())


def test_steps_have_their_order_on_the_manifold():
    robot = Robot.from_urdf_text(LIMBS, base="floating")
    seconds, coarse = 0.06, 0.02
    reference = moved(robot, "rk4", coarse / 8, seconds, 0.5)
    for name, order in (("symplectic-euler", 1), ("implicit-midpoint", 2), ("rk4", 4)):
        ends = [moved(robot, name, dt, seconds, 0.5).q[-1] for dt in (coarse, coarse / 2)]
        errors = [float(robot.difference(reference.q[-1], end).norm()) for end in ends]
        assert errors[1] < errors[0] / 2 ** (order - 0.4), name


def test_a_motion_that_is_lost_has_no_distance_from_its_contacts_and_no_error():
    data = simulate_quadruped(QuadrupedConfig(seconds=0.1))
    q, v = (torch.tensor(x[:3]) for x in (data.q, data.v))
    lost = q.clone()
    lost[1] = torch.nan
    (c, rate), (known, known_rate) = (violation(data.model, each, v) for each in (lost, q))
    assert torch.isnan(c[1]).all()
    assert torch.isnan(rate[1]).all()
    torch.testing.assert_close(c[[0, 2]], known[[0, 2]], rtol=0.0, atol=0.0)
    torch.testing.assert_close(rate[[0, 2]], known_rate[[0, 2]], rtol=0.0, atol=0.0)
