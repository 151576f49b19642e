"""Motions of bases that move: order of the integrators, and what a body in free fall keeps."""

import torch
from tests.robots.test_moving_bases import LIMBS

from forcegp.integration import integrate, integrator_named, violation
from forcegp.model import Model
from forcegp.robots import Robot
from forcegp.simulation import QuadrupedConfig, simulate_quadruped


def moved(robot, name, dt, seconds, speed=1.0):
    generator = torch.Generator().manual_seed(1)
    q = robot.random(generator)
    v = speed * torch.randn(1, robot.nv, dtype=torch.float64, generator=generator)
    steps = torch.zeros(round(seconds / dt), 1, robot.nv, dtype=torch.float64)
    method = integrator_named(name, Model(robot))
    with torch.no_grad():
        return integrate(method, robot.forward_dynamics, q, v, steps, dt)


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
