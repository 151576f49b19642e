"""What a robot is, without its algorithms: joints, links, frames, inertias, checks of inputs."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, UnknownFrame, UnknownJoint, UnknownLink, require_known
from forcegp.robots.arguments import JointValues, Positions, checked_tensor
from forcegp.robots.layout import WORLD, BaseChoice, Layout
from forcegp.robots.manifold import ConfigurationSpace, pose
from forcegp.robots.tree import Tree
from forcegp.robots.urdf import InertialDescription, Joint, RobotDescription
from forcegp.summary import Summary, listed

MASSLESS = InertialDescription(0.0, np.zeros(3), np.zeros((3, 3)))
DOWN = ("down_x", "down_y", "down_z")


class RigidBodyDynamics(ABC):
    """The dynamics of a robot, however they are computed."""

    @abstractmethod
    def _dynamics(self, function: str, *arguments: Tensor) -> Any:
        """What the method of that name returns."""

    def mass_matrix(self, q: Positions) -> Float[Tensor, "... nv nv"]:
        """Mass matrix M (..., nv, nv) in kg m^2 or kg, armature on the diagonal."""
        return self._dynamics("mass_matrix", q)

    def bias_forces(self, q: Positions, v: JointValues) -> Float[Tensor, "... nv"]:
        """Coriolis, centrifugal and gravity forces (..., nv) in Nm or N: ``M a + bias = tau``."""
        return self._dynamics("bias_forces", q, v)

    def mass_matrix_and_bias(
        self, q: Positions, v: JointValues
    ) -> tuple[Float[Tensor, "... nv nv"], Float[Tensor, "... nv"]]:
        """:meth:`mass_matrix` and :meth:`bias_forces` at once."""
        return self._dynamics("mass_matrix_and_bias", q, v)

    def gravity_forces(self, q: Positions) -> Float[Tensor, "... nv"]:
        """Joint forces (..., nv) in Nm or N that hold the robot still."""
        return self._dynamics("gravity_forces", q)

    def inverse_dynamics(self, q: Positions, v: JointValues, a: JointValues) -> Float[Tensor, "... nv"]:
        """Joint forces tau (..., nv) in Nm or N that give the accelerations ``a``: ``tau = M a + bias``."""
        return self._dynamics("inverse_dynamics", q, v, a)

    def forward_dynamics(self, q: Positions, v: JointValues, tau: JointValues) -> Float[Tensor, "... nv"]:
        """Accelerations (..., nv) under the joint forces ``tau``: ``M^-1 (tau - bias)``.

        Raises :class:`~forcegp.errors.NumericalError` where the mass matrix is not positive definite.
        """
        return self._dynamics("forward_dynamics", q, v, tau)


@dataclass(frozen=True)
class Link:
    """A link with the inertia that the URDF gives it; ``joint`` moves it (None: fixed in the world)."""

    name: str
    joint: str | None
    mass: float  # kg; 0 for a massless frame
    center_of_mass: tuple[float, float, float]  # m, in the link frame
    inertia: tuple[tuple[float, float, float], ...]  # kg m^2 about the centre of mass, in the axes of the link frame


@dataclass(frozen=True, eq=False, repr=False)
class RobotStructure(Summary):
    """The constants of a :class:`~forcegp.robots.Robot`, for code that its algorithms are made of."""

    description: RobotDescription
    layout: Layout
    tree: Tree
    urdf_text: str
    _locked: tuple[tuple[str, float], ...]
    _frames: dict[str, tuple[int, Tensor]]
    base: BaseChoice = "fixed"
    """How the root link is held."""

    @property
    def name(self) -> str:
        """Name of the robot in the URDF."""
        return self.description.name

    @property
    def source(self) -> str:
        """Where the URDF came from, as error messages name it."""
        return self.description.source

    @property
    def nv(self) -> int:
        """Number of degrees of freedom, the size of v and a: of the movable joints that mimic none."""
        return len(self.layout.joints)

    @property
    def nq(self) -> int:
        """Size of q: `nv`, and more where a base or joint turns freely (:mod:`forcegp.robots.manifold`)."""
        return self.space.nq

    @property
    def space(self) -> ConfigurationSpace:
        """The positions that q can have."""
        return ConfigurationSpace(self.nv, self.layout.groups)

    @property
    def position_names(self) -> tuple[str, ...]:
        """Names of the entries of q; `joint_names` where all joints have one degree of freedom."""
        return self.layout.position_names

    @property
    def joints(self) -> tuple[Joint, ...]:
        """Movable joints in the order of v, without those that mimic one; one for each degree of freedom."""
        return self.layout.joints

    @property
    def all_joints(self) -> tuple[Joint, ...]:
        """Every joint of the file, fixed ones included, parents before children."""
        places = {name: place for place, name in enumerate(self.layout.links)}
        return tuple(sorted(self.description.joints, key=lambda joint: places[joint.child]))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the movable joints in the order of v, such as "base.x" for a degree of freedom of a base."""
        return tuple(joint.name for joint in self.layout.joints)

    @property
    def single_joint_names(self) -> tuple[str, ...]:
        """Names of the joints of one degree of freedom: where there are actuators and friction."""
        names = self.joint_names
        return tuple(names[row] for row in self.space.single_rows)

    @property
    def posture_names(self) -> tuple[str, ...]:
        """Names of the entries of :meth:`posture`."""
        parts = {"floating": (*DOWN, "height"), "spherical": DOWN, "planar": ()}
        names = [f"{group.name}.{part}" for group in self.layout.groups for part in parts[group.kind]]
        return (*names, *self.single_joint_names)

    def posture(self, q: Float[Tensor, "*batch nq"]) -> Float[Tensor, "*batch postures"]:
        """What of q forces may depend on: q itself on a fixed base.

        Of a base that moves, the direction of gravity in its axes and its height in m along gravity: neither where it
        stands nor where it looks changes a force.
        """
        if not self.layout.groups:
            return q
        strength = torch.linalg.vector_norm(self.tree.gravity)
        down = self.tree.gravity / strength if bool(strength > 0.0) else q.new_tensor([0.0, 0.0, -1.0])
        parts: list[Tensor] = []
        for group in self.layout.groups:
            rotation, origin = pose(group.kind, q[..., group.places])
            if group.kind != "planar":
                parts.append((rotation.mT @ down[:, None])[..., 0])
            if group.kind == "floating":
                parts.append(-(origin @ down)[..., None])
        return torch.cat([*parts, self.space.singles(q)], -1)

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of all links in file order."""
        return tuple(self.description.links)

    @property
    def gravity(self) -> Float[Tensor, "3"]:
        """Gravitational acceleration in m/s^2."""
        return self.tree.gravity.clone()

    @property
    def armature(self) -> Float[Tensor, "nv"]:
        """Rotor inertia per joint in kg m^2 or kg."""
        return self.tree.armature.clone()

    @property
    def locked(self) -> dict[str, float]:
        """Movable joints of the URDF that are fixed here, and their positions in rad or m."""
        return dict(self._locked)

    @property
    def device(self) -> torch.device:
        """Device that inputs must be on."""
        return self.tree.rest.device

    @property
    def mass(self) -> float:
        """Of all links, in kg."""
        return sum(self.link(name).mass for name in self.link_names)

    def link(self, name: str) -> Link:
        """One link by name."""
        require_known("link", name, self.name, self.layout.links, UnknownLink)
        body = self.layout.links[name].body
        joint = None if body == WORLD else self.layout.bodies[body].name
        inertial = self.description.links[name] or MASSLESS
        rows = tuple(tuple(row) for row in inertial.inertia.tolist())
        return Link(name, joint, inertial.mass, tuple(inertial.center_of_mass.tolist()), rows)

    def joint(self, name: str) -> Joint:
        """One movable joint by name."""
        require_known("joint", name, self.name, self.joint_names, UnknownJoint)
        return self.joints[self.joint_names.index(name)]

    @override
    def facts(self) -> dict[str, object]:
        """Name, sizes and joints."""
        kinds = listed((f"{joint.name} ({joint.type})" for joint in self.layout.joints), most=7)
        return {
            "name": repr(self.name),
            "nv": self.nv,
            **({"nq": self.nq} if self.layout.groups else {}),
            "links": len(self.layout.links),
            "joints": kinds,
        }

    def frame(self, name: str) -> tuple[int, Float[Tensor, "4 4"]]:
        """Body (``WORLD`` = -1) that carries a frame, and the frame's pose in that body's frame."""
        require_known("frame", name, self.name, self._frames, UnknownFrame)
        body, offset = self._frames[name]
        return body, offset.clone()

    def checked_input(self, name: str, value: object) -> Tensor:
        """In float64; :class:`~forcegp.errors.InvalidInput` unless it is (..., nv), or a possible q, on its device."""
        if name != "q" or not self.layout.groups:
            return checked_tensor(name, value, self.nv, f"one value per joint of {self.name}", self.device)
        q = checked_tensor(
            name, value, self.nq, f"positions of {self.name}: {', '.join(self.position_names)}", self.device
        )
        self.space.check(q)
        return q

    def require_vectors(self, what: str) -> None:
        """Raise InvalidInput where positions do not add up; `what` needs that, in the plural: "filters"."""
        if self.layout.groups:
            group = self.layout.groups[0]
            raise InvalidInput(
                f"{what} need a base that is fixed; {self.name} has the {group.kind} joint {group.name!r}. Fitting, "
                "prediction, identification, predictors and `posterior.rollout` work without."
            )
