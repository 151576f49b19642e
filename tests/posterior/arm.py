"""A three-joint arm that holds its tool on a plane, and data from it with a friction that nobody told the model."""

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from forcegp.data import Dataset
from forcegp.fit import fit
from forcegp.forces import Actuation, JointFriction, RigidBodies, Unknown, kernel_of
from forcegp.forces.joint_laws import GearFriction
from forcegp.inference import OptimizerOptions
from forcegp.mechanics import Baumgarte, Contact, Plane
from forcegp.model import Model
from forcegp.posterior import Posterior
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


@dataclass(frozen=True)
class Weight(Unknown):
    """The weight of an unknown mass at the origin of `frame`: a constant, which has no features."""

    frame: str = "hand"

    def latent_names(self, robot):
        return ("mass",)

    def latent_units(self, robot):
        return ("kg",)

    def direction(self, dynamics):
        return -9.81 * dynamics.state.kinematics.frame_jacobian(self.frame, (0.0, 0.0, 0.0))[..., 2, :, None]

    def point_force(self, dynamics):
        return torch.tensor([[0.0], [0.0], [-9.81]], dtype=torch.float64).expand(*dynamics.state.q.shape[:-1], 3, 1)

    def features(self, dynamics):
        return (dynamics.state.v[..., :0],)

    def feature_names(self, robot):
        return ((),)

    def kernels(self, robot, dimensions, variances):
        return tuple(kernel_of("constant", d, s) for d, s in zip(dimensions, variances, strict=True))


def arm_model(contacts: int = 1, **changes) -> Model:
    """The arm with its tool on up to one plane, without the damping and dry friction of its file."""
    robot, contact = Robot.from_urdf_text(URDF), Contact("hand", (0.0, 0.0, 0.2), Plane((0.2, 0.0, 1.0), 0.4))
    return Model(
        robot, (contact,) * contacts, **{"forces": (Actuation(), RigidBodies()), "baumgarte": Baumgarte(5.0), **changes}
    )


def unknown_force(v: torch.Tensor) -> torch.Tensor:
    """Dry and viscous friction of every joint."""
    return -0.8 * torch.tanh(v / 0.4) - 0.3 * v


def on_the_plane(model: Model, q: np.ndarray) -> np.ndarray:
    """The nearest postures with the tool on the first contact's surface, by Newton's method."""
    at = torch.tensor(q)
    rest = torch.zeros_like(at)
    for _ in range(20 if model.contacts else 0):
        A, distance = model.dynamics(at, rest, rest).A[:, :1], model.contacts[0].distance(model.robot.kinematics(at))
        at = at - (torch.linalg.pinv(A) @ distance[:, None, None])[..., 0]
    return at.numpy()


def arm_data(rows: int, seed: int, model: Model | None = None) -> Dataset:
    """Random states, the exact constrained acceleration and noise of standard deviation NOISE on it."""
    model, generator = model or arm_model(), np.random.default_rng(seed)
    q = on_the_plane(model, generator.uniform([-1.0, 0.3, 0.3], [1.0, 1.2, 1.2], (rows, 3)))
    v, u = generator.normal(0.0, 0.7, (rows, 3)), generator.normal(0.0, 3.0, (rows, 3))
    states = [torch.tensor(x) for x in (q, v, u)]
    dynamics, Q_U = model.dynamics(*states), unknown_force(states[1])
    a = dynamics.acceleration(Q_U).numpy()
    return Dataset(
        q=q, v=v, u=u, a=a + generator.normal(0.0, NOISE, a.shape), time=np.arange(rows) * 0.01, model=model,
        noise_std=np.full(3, NOISE), truth={"a": a, "lambda": dynamics.multiplier(Q_U).numpy(), "Q_U": Q_U.numpy()},
    )  # fmt: skip


def quick_fit(model: Model, data: Dataset | None = None, iterations: int = 3, **options: Any) -> Posterior:
    """What a short search finds, of which nothing is asked; by default of 30 rows with the tool on the plane."""
    search = OptimizerOptions(iterations=iterations)
    with warnings.catch_warnings(action="ignore"):
        return fit(model, arm_data(30, 0) if data is None else data, restarts=1, options=search, **options)


def arm_that_remembers() -> tuple[Posterior, Dataset]:
    """The arm in the air with friction that remembers, and learned friction beside it; and its rows."""
    gear, free = GearFriction(0.8, 0.1, 0.05, 0.2, 0.3, 0.1, sigma=40.0, memory=True), arm_model().with_contacts([])
    data = replace(arm_data(30, 0), model=free, truth={})
    return quick_fit(free.with_forces(gear, JointFriction()), data), data
