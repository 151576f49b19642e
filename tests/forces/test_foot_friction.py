"""Friction under several feet that slide on the ground, each in rows in which it stands."""

import torch
from tests.robots.random_positions import random_positions

from forcegp import Contact, Model, Plane, Robot
from forcegp.forces import ContactFriction
from forcegp.simulation import QuadrupedConfig, simulate_quadruped


def test_feet_that_stand_resist_their_own_sliding_and_no_other():
    held = simulate_quadruped(QuadrupedConfig(seconds=0.1)).model
    robot: Robot = held.robot
    feet = ("front_left", "rear_right")
    contacts = tuple(
        Contact(f"{leg}_foot", (0.0, 0.0, 0.0), Plane((0.0, 0.0, 1.0), 0.0), f"{leg}_stands") for leg in feet
    )
    model, generator = Model(robot, contacts, held.forces), torch.Generator().manual_seed(0)
    q, v = random_positions(robot, generator, 3), torch.randn(3, robot.nv, generator=generator, dtype=torch.float64)
    u = torch.zeros(3, 14, dtype=torch.float64)
    u[:, 12:] = torch.tensor([[1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
    dynamics, feet_forces = model.dynamics(q, v, u), [ContactFriction(contact=k, load=True) for k in (0, 1)]
    for force in feet_forces:
        force.check(model.robot, model.contacts)
    mixing = torch.cat([force.direction(dynamics) for force in feet_forces], dim=-1)
    assert mixing.shape == (3, robot.nv, 2)
    for number, leg in enumerate(feet):
        J = dynamics.state.kinematics.frame_jacobian(f"{leg}_foot")[:, :2]
        sliding = (J @ v[..., None])[..., 0]
        along = -(J.mT @ (sliding / sliding.norm(dim=-1, keepdim=True))[..., None])[..., 0]
        load = dynamics.multiplier_map().offset[:, number].abs()
        torch.testing.assert_close(mixing[..., number], load[:, None] * along, rtol=1e-6, atol=1e-6)
    assert mixing[0].abs().amax(0).min() > 0.0
    assert not mixing[2].any()
    assert mixing[1, :, 0].any()
    assert not mixing[1, :, 1].any()
