"""Two light links with dry friction that no model is told: a robot, motions of it, and the truth to judge plans by."""

import numpy as np
import torch

from forcegp import Actuation, Dataset, MechanicalSystem, NoForces, RigidBodyBias, Robot, StructuredGP
from forcegp.integration import integrate, integrator_named
from forcegp.mechanics import StribeckJointFriction

LINK = """<link name="{name}"><inertial><origin xyz="0.1 0 0"/><mass value="0.1"/>
<inertia ixx="0.003" iyy="0.003" izz="0.003" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="continuous"><origin xyz="{x} 0 0"/><parent link="{parent}"/>
<child link="{child}"/><axis xyz="0 1 0"/></joint>"""
URDF = '<robot name="two links"><link name="base"/>' + "".join(
    [
        LINK.format(name="upper"),
        LINK.format(name="fore"),
        JOINT.format(name="shoulder", x=0, parent="base", child="upper"),
        JOINT.format(name="elbow", x=0.2, parent="upper", child="fore"),
    ]
)
ROBOT = Robot.from_urdf_text(URDF + "</robot>")
NOMINAL = MechanicalSystem(ROBOT, (), (Actuation(), RigidBodyBias()))
FRICTION = StribeckJointFriction(coulomb=0.1, static=0.15, stribeck_velocity=0.1, velocity_scale=0.1)  # Nm, rad/s
TRUE = MechanicalSystem(ROBOT, (), (Actuation(), RigidBodyBias(), FRICTION))
HANGING, UPRIGHT = np.array([np.pi / 2, 0.0, 0.0, 0.0]), np.array([-np.pi / 2, 0.0, 0.0, 0.0])  # [q, v]
DT = 0.02  # s
LIMIT = 0.45  # Nm; gravity needs 0.39 Nm at the shoulder where the arm is level


def acceleration(q, v, u):
    """What no model is told, for states (n, 2)."""
    return TRUE.dynamics(q, v, u).acceleration(torch.zeros_like(q))


def motions(q0, v0, u, dt):
    """q, v (n, T + 1, 2) of the true arm under torques u (n, T, 2), each held for dt."""
    q0, v0, u = (torch.as_tensor(x) for x in (q0, v0, u))
    found = integrate(integrator_named("implicit-midpoint", TRUE), acceleration, q0, v0, u.movedim(1, 0), dt)
    return found.q.movedim(0, 1), found.v.movedim(0, 1)


def recorded(count=12, steps=100, noise=0.2):
    """Motions of 2 s under sums of sinusoidal torques, every other row, accelerations with noise."""
    generator = np.random.default_rng(0)
    time = DT * np.arange(steps)
    size = generator.uniform(0.07, 0.17, (count, 1, 2)) * [1.0, 0.6]
    frequency, phase = generator.uniform(0.5, 2.0, (count, 3, 2)), generator.uniform(0.0, 2 * np.pi, (count, 3, 2))
    turns = 2 * np.pi * frequency[:, :, None] * time[:, None] + phase[:, :, None]
    u = (size[:, None] * np.sin(turns)).sum(1)
    q0 = np.stack([generator.uniform(-3, 3, count), generator.uniform(-2, 2, count)], axis=1)
    q, v = motions(q0, np.zeros_like(q0), u, DT)
    rows = [x[:, :steps:2].reshape(-1, 2) for x in (q, v, torch.as_tensor(u))]
    a = acceleration(*rows).numpy() + generator.normal(0.0, noise, rows[0].shape)
    episode = np.repeat(np.arange(count), steps // 2)
    q, v, u = (x.numpy() for x in rows)
    given = {"episode": episode, "system": NOMINAL, "noise_std": np.full(2, noise)}
    return Dataset(q=q, v=v, u=u, a=a, time=np.tile(time[::2], count), **given)


class TrueArm:
    """The arm with its true friction, in steps ten times shorter than those of plans."""

    def __init__(self, data):
        self.predictor = StructuredGP(TRUE, NoForces()).fit(data, points=20, restarts=1).predictor(covariance="none")

    def __call__(self, state, u):
        """States (T + 1, 4) from one under torques (T, 2), each held for DT."""
        state, u = torch.as_tensor(state), torch.as_tensor(u).repeat_interleave(10, dim=0)
        how = {"dt": DT / 10, "integrator": "implicit-midpoint"}
        moved = self.predictor.rollouts(state[:2], state[2:], u, **how)
        return torch.cat([moved.q, moved.v], dim=-1)[::10].numpy()
