"""What a robot is, without its algorithms: joints, links, frames, and the constants of its bodies as tensors."""

from abc import ABC, abstractmethod
from collections.abc import Set
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, NonPhysicalInertia, RobotModelError, UnknownName, require_known
from forcegp.robots.arguments import JointValues, Positions, Vector, checked_tensor, usable_device
from forcegp.robots.inertia import SINGULAR, pseudo_inertia, turns_with_inertia
from forcegp.robots.layout import BASE, WORLD, BaseChoice, Layout
from forcegp.robots.manifold import ConfigurationSpace, Group, pose
from forcegp.robots.urdf import Joint, Link, RobotDescription
from forcegp.summary import Summary, listed

MASSLESS = Link(0.0, np.zeros(3), np.zeros((3, 3)))
DOWN = ("down_x", "down_y", "down_z")
Forces = Float[Tensor, "... nv"]
MassMatrix = Float[Tensor, "... nv nv"]


@dataclass(frozen=True, eq=False)
class Tree:
    """Constants of a tree with n bodies, on one device. Index i is body i and the joint that moves it."""

    groups: tuple[Group, ...]
    positions: Tensor | None  # (nv,) entry of q of each joint of one degree of freedom; None where that is i
    rest: Tensor  # (n, 4, 4, 1) and the next three: local transform = rest + sin q sine + cos q cosine + q slide
    sine: Tensor
    cosine: Tensor
    slide: Tensor
    parents: tuple[int, ...]
    revolute: Tensor  # (n, 1, 1): 1 for revolute and continuous joints, 0 for prismatic ones
    all_revolute: bool
    descendants: Tensor  # (n, n): [i, j] = 1 where body j is moved by joint i, and is not empty
    ancestors: Tensor  # its transpose, empty bodies included
    is_above: Tensor  # (n, n, 1): the same the other way round, as truth values
    related: Tensor  # (n, n, 1): 1 where one of the two joints moves the other
    velocity_sum: Tensor  # (n, n): 2 ancestors - own joint, body velocity plus that of the parent body
    twist_basis: Tensor  # (12, 6): [w; v] -> [[w]x, v], row by row
    inertias: Tensor  # (n, 4, 4, 1): pseudo-inertias of the bodies, their links merged
    gravity: Tensor  # (3,)
    fall: Tensor  # (3, 4, 1): the acceleration T'' T^-1 of free fall
    armature: Tensor  # (nv,)
    coupling: Tensor  # (n, nv): G, the velocity of each body's joint per unit of those with a coordinate
    shift: Tensor  # (n, 1): g, their positions at q = 0
    is_chain: bool
    has_armature: bool
    coupled: bool  # whether some joint mimics another; else G is the identity and g is zero

    def to(self, device: torch.device | str) -> "Tree":
        """The same constants on another device. Raises InvalidInput for one that is not there."""
        device = usable_device(device)
        moved = {key: value.to(device) for key, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **moved)

    def equals(self, other: "Tree") -> bool:
        """Whether both move alike to 1e-9, whatever their URDFs look like."""
        if self.coupling.shape != other.coupling.shape or self.groups != other.groups:
            return False
        constants = ("rest", "sine", "cosine", "slide", "descendants", "inertias", "gravity", "armature", "coupling")
        there = other.to(self.rest.device)
        pairs = ((getattr(self, name), getattr(there, name)) for name in (*constants, "shift"))
        return all(torch.allclose(mine, others, rtol=1e-9, atol=1e-12) for mine, others in pairs)


def compile_tree(description: RobotDescription, layout: Layout, gravity: np.ndarray) -> Tree:
    """Batched constants for :mod:`forcegp.robots.kinematics`, on the CPU."""
    n, revolute = len(layout.bodies), np.array([joint.type != "prismatic" for joint in layout.bodies])
    rest, sine, cosine, slide = local = np.zeros((4, n, 4, 4))
    own, positions = np.eye(n), np.arange(len(layout.joints))
    for group in layout.groups:
        own[group.bodies, group.bodies] = 1.0
        positions[group.rows] = group.place
        positions[group.rows.stop :] += 1  # quaternions have an entry more
    moves = own.copy()  # [i, j] = 1 where body j is moved by joint i
    for i, (parent, origin) in enumerate(zip(layout.parents, layout.origins, strict=True)):
        x, y, z, translation = origin.T
        if own[i].sum() > 1.0:  # moved by `Group`
            rest[i] = origin
        elif revolute[i]:  # origin @ Rz(q)
            rest[i].T[2:] = z, translation
            sine[i].T[:2] = y, -x
            cosine[i].T[:2] = x, y
        else:  # origin @ translation by q along z
            rest[i] = origin
            slide[i].T[3] = z
        if parent != WORLD:
            moves[:, i] += moves[:, parent]
    descendants = moves.copy()
    descendants[:, list(layout.empty)] = 0.0
    twist_basis = np.zeros((6, 3, 4))
    twist_basis[:3, :, :3] = [np.cross(axis, np.eye(3)).T for axis in np.eye(3)]  # [w]x
    twist_basis[3:, :, 3] = np.eye(3)
    inertias = np.zeros((n, 4, 4))
    for name in layout.moving:
        placement, inertial = layout.links[name], description.links[name]
        if inertial is not None:
            own_frame = pseudo_inertia(inertial.mass, inertial.center_of_mass, inertial.inertia)
            inertias[placement.body] += placement.offset @ own_frame @ placement.offset.T
    coupling = np.zeros((n, len(layout.joints)))
    coupling[range(n), [drive.joint for drive in layout.drives]] = [drive.multiplier for drive in layout.drives]
    armature = np.array([joint.armature for joint in layout.joints])
    constants: dict[str, Any] = {
        **dict(zip(("rest", "sine", "cosine", "slide"), local[..., None], strict=True)),
        "revolute": revolute[:, None, None],
        "descendants": descendants,
        "ancestors": moves.T,
        "related": np.maximum(moves, moves.T)[..., None],
        "velocity_sum": 2.0 * moves.T - own,
        "twist_basis": twist_basis.reshape(6, 12).T,
        "inertias": inertias[..., None],
        "gravity": gravity,
        "fall": np.pad(gravity[:, None], ((0, 0), (3, 0)))[..., None],
        "armature": armature,
        "coupling": coupling,
        "shift": [[drive.offset] for drive in layout.drives],
    }
    return Tree(
        groups=layout.groups,
        positions=torch.as_tensor(positions) if layout.groups else None,
        parents=layout.parents,
        all_revolute=bool(revolute.all()),
        is_above=torch.tensor(moves[..., None]) > 0,
        coupled=len(layout.joints) < n,
        is_chain=bool(constants["related"].all()),
        has_armature=bool(armature.any()),
        **{name: torch.tensor(array, dtype=torch.float64) for name, array in constants.items()},
    )


class RigidBodyDynamics(ABC):
    """The dynamics of a robot, however they are computed."""

    @abstractmethod
    def _dynamics(self, function: str, *arguments: Any) -> Any:
        """What the method of that name returns."""

    def mass_matrix(self, q: Positions) -> MassMatrix:
        """Mass matrix M (..., nv, nv) in kg m^2 or kg, armature on the diagonal."""
        return self._dynamics("mass_matrix", q)

    def bias_forces(self, q: Positions, v: JointValues) -> Forces:
        """Coriolis, centrifugal and gravity forces (..., nv) in Nm or N: ``M a + bias = tau``."""
        return self._dynamics("bias_forces", q, v)

    def mass_matrix_and_bias(self, q: Positions, v: JointValues) -> tuple[MassMatrix, Forces]:
        """:meth:`mass_matrix` and :meth:`bias_forces` at once."""
        return self._dynamics("mass_matrix_and_bias", q, v)

    def gravity_forces(self, q: Positions) -> Forces:
        """Joint forces (..., nv) in Nm or N that hold the robot still."""
        return self._dynamics("gravity_forces", q)

    def inverse_dynamics(self, q: Positions, v: JointValues, a: JointValues) -> Forces:
        """Joint forces tau (..., nv) in Nm or N that give the accelerations ``a``: ``tau = M a + bias``."""
        return self._dynamics("inverse_dynamics", q, v, a)

    def forward_dynamics(self, q: Positions, v: JointValues, tau: JointValues) -> Forces:
        """Accelerations (..., nv) ``M^-1 (tau - bias)``. Raises NumericalError where M is not positive definite."""
        return self._dynamics("forward_dynamics", q, v, tau)

    def frame_motion(
        self, q: Positions, v: JointValues, frame: str, point: Vector
    ) -> tuple[Float[Tensor, "... 4 4"], Float[Tensor, "... 6 nv"], Float[Tensor, "... 6"]]:
        """Pose of a ``frame``, and Jacobian and ``Jdot v`` of a ``point`` (3,) fixed in it (m), as of `Kinematics`."""
        return self._dynamics("frame_motion", q, v, frame, point)


@dataclass(frozen=True, eq=False, repr=False)
class RobotStructure(Summary):
    """The constants of a :class:`~forcegp.robots.Robot`, for code that its algorithms are made of."""

    description: RobotDescription
    layout: Layout
    tree: Tree
    urdf_text: str
    _locked: tuple[tuple[str, float], ...]
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
        return tuple(self.joint_names[row] for row in self.space.single_rows)

    @property
    def posture_names(self) -> tuple[str, ...]:
        """Names of the entries of :meth:`posture`."""
        names = [f"{group.name}.{part}" for group in self.layout.groups for part in (*DOWN, "height")]
        return (*names, *self.single_joint_names)

    def posture(self, q: Float[Tensor, "*batch nq"]) -> Float[Tensor, "*batch postures"]:
        """What forces may depend on of q; of a base that moves, gravity in its axes and its height in m."""
        if not self.layout.groups:
            return q
        strength = torch.linalg.vector_norm(self.tree.gravity)
        down = self.tree.gravity / strength if bool(strength > 0.0) else q.new_tensor([0.0, 0.0, -1.0])
        parts: list[Tensor] = []
        for group in self.layout.groups:
            rotation, origin = pose(q[..., group.places])
            parts += [(rotation.mT @ down[:, None])[..., 0], -(origin @ down)[..., None]]
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
        """One link by name; one that is a mere frame has mass 0."""
        require_known("link", name, self.name, self.layout.links, UnknownName)
        return self.description.links[name] or MASSLESS

    def joint(self, name: str) -> Joint:
        """One movable joint by name."""
        require_known("joint", name, self.name, self.joint_names, UnknownName)
        return self.joints[self.joint_names.index(name)]

    @override
    def facts(self) -> dict[str, object]:
        """Name, sizes and joints."""
        kinds = listed((f"{joint.name} ({joint.type})" for joint in self.layout.joints), most=7)
        sizes = {"nv": self.nv} | ({"nq": self.nq} if self.layout.groups else {})
        return {"name": repr(self.name), **sizes, "links": len(self.layout.links), "joints": kinds}

    def frame(self, name: str) -> tuple[int, Float[Tensor, "4 4"]]:
        """Body (``WORLD`` = -1) that carries a frame, and the frame's pose in that body's frame."""
        require_known("frame", name, self.name, self.layout.links, UnknownName)
        body, offset = self.layout.links[name]
        return body, torch.tensor(offset, device=self.device)

    def checked_input(self, name: str, value: object) -> Tensor:
        """In float64; :class:`~forcegp.errors.InvalidInput` unless it is (..., nv), or a possible q, on its device."""
        if name != "q" or not self.layout.groups:
            return checked_tensor(name, value, self.nv, f"one value per joint of {self.name}", self.device)
        meaning = f"positions of {self.name}: {', '.join(self.position_names)}"
        q = checked_tensor(name, value, self.nq, meaning, self.device)
        self.space.check(q)
        return q

    def require_vectors(self, what: str) -> None:
        """Raise InvalidInput where positions do not add up; `what` needs that, in the plural: "filters"."""
        if self.layout.groups:
            group = self.layout.groups[0]
            seen = f"{what} need a base that is fixed; {self.name} has the floating joint {group.name!r}"
            advice = "Fitting, prediction, identification, predictors and `posterior.rollout` work without."
            raise InvalidInput(f"{seen}. {advice}")


def bodies_without_inertia(
    description: RobotDescription, layout: Layout, tree: "Tree", broken: Set[str]
) -> list[tuple[int, RobotModelError]]:
    """Bodies that resist their joint neither by inertia nor by armature, as coordinate and error."""
    pseudo, found = tree.inertias[..., 0].numpy(), []
    whole = {group.bodies.stop - 1: group for group in layout.groups}
    carried: list[list[str]] = [[] for _ in layout.bodies]
    for name, placement in layout.links.items():
        if placement.body != WORLD and name != layout.bodies[placement.body].child:
            carried[placement.body].append(name)
    for body, (joint, drive) in enumerate(zip(layout.bodies, layout.drives, strict=True)):
        if body in layout.empty:
            continue
        own = layout.joints[drive.joint].name == joint.name and float(tree.armature[drive.joint]) > 0.0
        if own or not broken.isdisjoint((joint.child, *carried[body])):
            continue
        others = f" and the links fixed to it ({', '.join(map(repr, carried[body]))})" if carried[body] else ""
        name = whole[body].name if body in whole else joint.name
        link, remedy = f"{description.source}: link {joint.child!r}{others}", {"locked": {name: 0.0}}
        if name == BASE and body in whole:
            remedy = {"base": "fixed"}
        moments = pseudo[body].diagonal()[:3]  # second ones; the axis is z
        if pseudo[body, 3, 3] == 0.0:
            seen = f"{link} moves with joint {name!r} but has no mass, and nor has what it carries"
            advice = "; add an <inertial> element, make the joint fixed, or lock it."
            found.append((drive.joint, RobotModelError(seen, advice, remedy)))
        elif body in whole and not turns_with_inertia(pseudo[body]):
            seen = f"{link} turns with joint {name!r} but has no rotational inertia about some axis"
            found.append((drive.joint, NonPhysicalInertia(seen, "; correct its <inertial> element.", remedy)))
        elif body not in whole and joint.type != "prismatic" and moments[:2].sum() <= SINGULAR * moments.sum():
            seen = f"{link} turns with joint {name!r} but has no rotational inertia about its axis"
            rotor = "give the joint the inertia of its rotor (`armature`, in kg m^2)"
            advice = f": any force would accelerate it infinitely. Correct its <inertial> element, {rotor}, or lock it."
            found.append((drive.joint, NonPhysicalInertia(seen, advice, remedy)))
    return found
