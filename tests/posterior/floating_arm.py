"""A satellite with an arm, whose joint has friction that no law describes; and its recording."""

import numpy as np
import torch

from forcegp import Dataset, Model, Robot
from forcegp.forces import Actuation, Coulomb, RigidBodies, Thrusters, Viscous
from forcegp.integration import integrate, integrator_named

URDF = """<robot name="satellite"><link name="hull"><inertial><origin xyz="0.02 0 0.01"/><mass value="8"/>
<inertia ixx="0.3" iyy="0.4" izz="0.5" ixy="0.02" ixz="0" iyz="0.01"/></inertial></link>
<link name="arm"><inertial><origin xyz="0.2 0 0"/><mass value="2"/><inertia ixx="0.01" iyy="0.06" izz="0.05" ixy="0"
ixz="0" iyz="0"/></inertial></link><joint name="shoulder" type="revolute"><origin xyz="0.2 0 0.1"/><parent link="hull"/>
<child link="arm"/><axis xyz="0 1 0"/><limit lower="-9" upper="9" effort="9" velocity="9"/></joint></robot>"""
PLACES = [(0.1, 0.2, 0.0), (-0.1, 0.0, 0.2), (0.0, -0.2, 0.1)]
AXES, DT = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)], 0.02


def satellite(viscous: float = 0.2, dry: float = 0.3, mass: float = 8.0, switch: float = 0.3) -> Model:
    """u are the torque of the shoulder and three thrusts."""
    text = URDF.replace('mass value="8"', f'mass value="{mass}"')
    robot = Robot.from_urdf_text(text, base="floating", gravity=(0.0, 0.0, 0.0))
    none = torch.zeros(6, dtype=torch.float64)
    friction = (
        Viscous(torch.cat([none, none.new_tensor([viscous])])),
        Coulomb(torch.cat([none, none.new_tensor([dry])]), switch),
    )
    return Model(robot, (), (Actuation(), Thrusters("hull", PLACES, 1.0, 0.0, AXES), RigidBodies(), *friction))


def recording(seed: int, seconds: float, given: Model, bump: float = 1.0) -> Dataset:
    """Rows of the satellite with friction .2 Nms, .3 Nm and a bump at .5 rad/s, for a model that is `given`."""
    generator, rows = np.random.default_rng(seed), round(seconds / DT)
    time, true = DT * np.arange(rows), satellite()
    rate, phase = generator.uniform(1.0, 4.0, 4), generator.uniform(0.0, 6.0, 4)
    u = torch.tensor(np.array([0.8, 1.5, 1.5, 1.5]) * np.sin(rate * time[:, None] + phase))

    def unknown(v: torch.Tensor) -> torch.Tensor:
        force = torch.zeros_like(v)
        force[..., 6] = -bump * torch.exp(-(((v[..., 6] - 0.5) / 0.2) ** 2))
        return force

    def acceleration(q: torch.Tensor, v: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return true.dynamics(q, v, u).acceleration(unknown(v))

    start = true.robot.neutral()[None], torch.tensor(generator.normal(0.0, 0.2, (1, 7)))
    moved = integrate(integrator_named("rk4", true), acceleration, *start, u[:, None], DT)
    q, v = moved.q[:-1, 0].numpy(), moved.v[:-1, 0].numpy()
    a = moved.a[:, 0].numpy() + 0.05 * generator.standard_normal(v.shape)
    return Dataset(q=q, v=v, u=u.numpy(), a=a, time=time, model=given, noise_std=[0.05] * 7)
