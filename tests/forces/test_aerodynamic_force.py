"""What the functions of air depend on, written out in NumPy."""

import numpy as np
import torch
from tests.data.test_wind import flight

from forcegp import AerodynamicForce, Model, Robot
from forcegp.data import with_wind


def test_features_are_those_of_the_formulas():
    rows, wind = flight([(3.0, -2.0, 0.0)], rows=40), np.array([3.0, -2.0, 0.0])
    seen = with_wind(rows, np.broadcast_to(wind, (40, 3)))
    dynamics = seen.model.dynamics(*map(torch.tensor, (seen.q, seen.v, seen.u)))
    rotation = dynamics.state.kinematics.frame_pose("body")[:, :3, :3].numpy()
    air = rows.v[:, :3] - np.einsum("nji,nj->ni", rotation, np.broadcast_to(wind, (40, 3)))
    thrust = rows.u.sum(1, keepdims=True)
    sides = np.stack([rows.u @ [-0.1, 0.1, 0.1, -0.1], -rows.u @ [0.1, -0.1, 0.1, -0.1]], axis=1)
    yaw = 0.02 * rows.u @ [1.0, 1.0, -1.0, -1.0]
    expected = {
        "velocity": air, "drag": np.linalg.norm(air, axis=1, keepdims=True) * air, "rotor-drag": np.sqrt(thrust) * air,
        "angular-velocity": rows.v[:, 3:], "thrust": np.concatenate([thrust, sides, yaw[:, None]], axis=1),
        "height": rows.q[:, 2:3], "attitude": rotation.reshape(-1, 9),
    }  # fmt: skip
    prior = AerodynamicForce()
    assert prior.inputs == tuple(expected)
    features = prior.features(dynamics)
    assert len(features) == 6
    np.testing.assert_allclose(features[0], np.concatenate(list(expected.values()), axis=1), rtol=1e-5, atol=1e-9)


def test_rotors_of_a_body_that_does_not_fly():
    """Which has no force along z: all that actuators deliver counts."""
    inertial = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    joint = '<joint name="j" type="continuous"><parent link="body"/><child link="blade"/><axis xyz="0 0 1"/></joint>'
    links = "".join(f'<link name="{name}">{inertial}</link>' for name in ("body", "blade"))
    robot = Robot.from_urdf_text(f'<robot name="r">{links}{joint}</robot>', base="fixed")
    model, q, v = Model(robot), robot.neutral()[None], torch.full((1, robot.nv), 0.3, dtype=torch.float64)
    dynamics = model.dynamics(q, v, torch.full((1, len(model.inputs)), 2.0, dtype=torch.float64))
    velocity, drag = AerodynamicForce("blade", ("velocity", "rotor-drag")).features(dynamics)[0].split(3, dim=-1)
    torch.testing.assert_close(drag, (dynamics.state.delivered.norm() ** 2 + 1e-4) ** 0.25 * velocity)
