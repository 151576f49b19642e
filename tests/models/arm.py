"""A three-joint arm that holds its tool on a plane, and data from it with a friction that nobody told the model."""

import numpy as np
import torch

from forcegp.data import Dataset, units_for
from forcegp.mechanics import Baumgarte, Contact, MechanicalSystem, Plane
from forcegp.robots import Robot

LINK = """<link name="{name}"><inertial><origin xyz="0.02 -0.01 {com}" rpy="0.1 0 0.2"/><mass value="{mass}"/>
<inertia ixx="{i1}" iyy="{i2}" izz="{i3}" ixy="0.001" ixz="0" iyz="-0.001"/></inertial></link>"""
JOINT = """<joint name="{name}" type="revolute"><origin xyz="{xyz}" rpy="{rpy}"/><parent link="{parent}"/>
<child link="{child}"/><axis xyz="{axis}"/><limit lower="-3" upper="3" effort="50" velocity="5"/>
<dynamics damping="0.3" friction="0.1"/></joint>"""
URDF = "\n".join(
    [
        '<robot name="arm"><link name="base"/>',
        LINK.format(name="upper", com=0.15, mass=2.0, i1=0.03, i2=0.032, i3=0.012),
        LINK.format(name="fore", com=0.12, mass=1.2, i1=0.02, i2=0.022, i3=0.008),
        LINK.format(name="hand", com=0.05, mass=0.6, i1=0.01, i2=0.011, i3=0.006),
        JOINT.format(name="pan", xyz="0 0 0.3", rpy="0 0 0", parent="base", child="upper", axis="0 0 1"),
        JOINT.format(name="lift", xyz="0 0 0.3", rpy="0 0 0", parent="upper", child="fore", axis="0 1 0"),
        JOINT.format(name="bend", xyz="0 0 0.25", rpy="0 0 0", parent="fore", child="hand", axis="0 1 0"),
        "</robot>",
    ]
)
NOISE = 0.05


def arm_system(contacts: int = 1, **changes) -> MechanicalSystem:
    """The arm with its tool on up to one plane."""
    robot = Robot.from_urdf_text(URDF)
    contact = Contact("hand", (0.0, 0.0, 0.2), Plane((0.2, 0.0, 1.0), 0.4))
    return MechanicalSystem(robot, (contact,) * contacts, **{"baumgarte": Baumgarte(5.0), **changes})


def unknown_force(v: torch.Tensor) -> torch.Tensor:
    """Dry and viscous friction of every joint."""
    return -0.8 * torch.tanh(v / 0.4) - 0.3 * v


def on_the_plane(system: MechanicalSystem, q: np.ndarray) -> np.ndarray:
    """The nearest postures with the tool on the first contact's surface, by Newton's method."""
    at = torch.tensor(q)
    rest = torch.zeros_like(at)
    for _ in range(20 if system.contacts else 0):
        A = system.dynamics(at, rest, rest).A[:, :1]
        distance = system.contacts[0].distance(system.robot.kinematics(at))
        at = at - (torch.linalg.pinv(A) @ distance[:, None, None])[..., 0]
    return at.numpy()


def arm_data(rows: int, seed: int, system: MechanicalSystem | None = None) -> Dataset:
    """Random states, the exact constrained acceleration and noise of standard deviation NOISE on it."""
    system = system or arm_system()
    generator = np.random.default_rng(seed)
    q = on_the_plane(system, generator.uniform([-1.0, 0.3, 0.3], [1.0, 1.2, 1.2], (rows, 3)))
    v = generator.normal(0.0, 0.7, (rows, 3))
    u = generator.normal(0.0, 3.0, (rows, 3))
    states = [torch.tensor(x) for x in (q, v, u)]
    dynamics = system.dynamics(*states)
    Q_U = unknown_force(states[1])
    a = dynamics.acceleration(Q_U).numpy()
    return Dataset(
        q=q,
        v=v,
        u=u,
        a=a + generator.normal(0.0, NOISE, a.shape),
        time=np.arange(rows) * 0.01,
        joint_names=system.robot.joint_names,
        units=units_for(system.robot),
        system=system,
        noise_std=np.full(3, NOISE),
        truth={"a": a, "lambda": dynamics.multiplier(Q_U).numpy(), "Q_U": Q_U.numpy()},
    )
