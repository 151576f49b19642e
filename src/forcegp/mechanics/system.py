"""`MechanicalSystem`: a robot, its contacts and the known forces, as one immutable value that files can carry."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import ContactError, FileFormatError, ForceGPError, InvalidInput, require_type, usable_arguments
from forcegp.mechanics.gauss_principle import Baumgarte, ConstrainedDynamics, Contact, State
from forcegp.mechanics.known_forces import (
    KNOWN_FORCES,
    Actuation,
    Armature,
    KnownForce,
    RigidBodyBias,
    known_force_to_dict,
)
from forcegp.mechanics.loops import SECOND, LoopClosure, loop_frame, loop_point
from forcegp.mechanics.surfaces import SURFACES, Held, object_from_dict, surface_to_dict
from forcegp.mechanics.thrusters import FADES, OBSERVED, ObservedWrench, Thrusters
from forcegp.mechanics.wheels import WHEEL, RollingContact
from forcegp.robots import Kinematics, Robot
from forcegp.robots.arguments import Inertials, JointValues, Positions, is_sequence
from forcegp.robots.mjcf import is_mjcf
from forcegp.robots.mjcf_model import LoopDescription
from forcegp.robots.urdf_file import read_text
from forcegp.summary import Summary, listed

FORMAT_VERSION = 1
STORED_PARTS = {"urdf": str, "gravity": list, "armature": list, "locked": dict, "contacts": list, "known_forces": list}
CONSISTENCY_TOLERANCE = 1e-6
"""|A a - b| above this fraction of 1 + |b| means that redundant contacts contradict each other."""


@dataclass(frozen=True, eq=False, repr=False)
class MechanicalSystem(Summary):
    """What is known: the robot, its contacts, the known forces, and Baumgarte's terms if the motion has them.

    `contacts` may also hold what `fixed_point`, `fixed_frame` and `rolling` give, several contacts each.
    `known_forces` is the complete list; the default is actuation and rigid-body bias. Joint damping and friction of the
    URDF enter only where listed, for example `ViscousJointFriction.from_robot(robot)`.
    Raises InvalidInput, UnknownFrame or ContactError for parts that do not fit the robot.
    """

    robot: Robot
    contacts: tuple[Contact, ...] = ()
    known_forces: tuple[KnownForce, ...] = (Actuation(), RigidBodyBias())
    baumgarte: Baumgarte | None = None

    @usable_arguments("MechanicalSystem")
    def __post_init__(self) -> None:
        require_type("robot", self.robot, Robot, ", for example Robot.from_urdf(path)")
        if self.baumgarte is not None:
            require_type("baumgarte", self.baumgarte, Baumgarte)
        for name, kind in (("contacts", Contact), ("known_forces", KnownForce)):
            given = getattr(self, name)
            values = tuple(given) if is_sequence(given) else (given,)
            nested = (value if isinstance(value, tuple | list) else (value,) for value in values)
            values = tuple(each for several in nested for each in several)
            if not is_sequence(given) or not all(isinstance(value, kind) for value in values):
                raise InvalidInput(f"{name} is {given!r}; give a sequence of {kind.__name__} objects.")
            object.__setattr__(self, name, values)
        object.__setattr__(self, "known_forces", tuple(force.bound_to(self.robot) for force in self.known_forces))
        if sum(isinstance(force, Actuation) for force in self.known_forces) > 1:
            raise InvalidInput("known_forces lists Actuation twice; u acts once: put both into one matrix.")
        if not all(isinstance(name, str) for name in self.inputs):
            raise InvalidInput(f"columns of u are called {self.inputs}; give each a name that is text.")
        if len(set(self.inputs)) < len(self.inputs):
            raise InvalidInput(f"columns of u are called {', '.join(self.inputs)}; give each input its own name.")
        for contact in self.contacts:
            body, _ = self.robot.frame(contact.frame)
            if isinstance(contact, LoopClosure):
                if body == self.robot.frame(contact.second_frame)[0]:
                    raise ContactError(
                        f"frames {contact.frame!r} and {contact.second_frame!r} of {self.robot.name} do not move "
                        "against each other, so they close no loop; name frames of two bodies."
                    )
            elif body < 0:
                raise ContactError(
                    f"frame {contact.frame!r} of {self.robot.name} is fixed in the world, so a contact there "
                    "constrains nothing; name a frame that moves."
                )

    @classmethod
    @usable_arguments("MechanicalSystem.from_mjcf")
    def from_mjcf(
        cls,
        path: str | Path,
        known_forces: tuple[KnownForce, ...] | None = None,
        baumgarte: Baumgarte | None = None,
        **options: Any,
    ) -> "MechanicalSystem":
        """The robot of an MJCF file with its equalities of type connect and weld as closed loops, which are exact here.

        `options` are those of `Robot.from_mjcf`, which this raises the errors of. Damping and dry friction of the file
        enter as known forces only where listed. By default u are joint forces; where motors act at sites of bodies,
        such as rotors, or turn a ball joint, u are the inputs of all motors, those of bodies that are not free last.
        """
        robot, found = Robot.read_mjcf(read_text(path), str(path), Path(path), for_system=True, **options)
        contacts = [
            contact
            for loop in found.loops
            for contact in (
                loop_frame(*loop.frames)
                if loop.turning
                else loop_point(loop.frames[0], loop.points[0], loop.frames[1], loop.points[1])
            )
        ]
        if known_forces is None:
            actuation, moving = Actuation(), set(robot.joint_names)  # without those that are locked
            motors = [each for each in found.motors if moving & set(each.column)]
            pushing = [each for each in found.motors if each.link and robot.frame(each.link)[0] >= 0]
            if pushing or any(moving & set(each.column) - set(robot.single_joint_names) for each in motors):
                matrix = [[each.column.get(joint, 0.0) for each in motors] for joint in robot.joint_names]
                actuation = Actuation(matrix, tuple(each.name for each in motors))
            thrusters = (Thrusters.of_wrench(each.link, each.wrench, each.name) for each in pushing)
            known_forces = (actuation, *thrusters, RigidBodyBias())
        return cls(robot, tuple(contacts), known_forces, baumgarte)

    def to_mjcf(self, path: str | Path | None = None) -> str:
        """`Robot.to_mjcf` with its closed loops as equalities, which MuJoCo holds softly; contacts are left out."""
        ends: dict[Any, bool] = {}
        for loop in self.loops:
            key = (loop.frame, loop.second_frame), (loop.point, loop.second_point)
            ends[key] = ends.get(key, False) or loop.turning
        named = enumerate(ends.items(), 1)
        loops = [LoopDescription(f"loop_{k}", x, y, turning) for k, ((x, y), turning) in named]
        return self._with_rotors().to_mjcf(path, loops)

    def to_urdf(self, path: str | Path | None = None) -> str:
        """`Robot.to_urdf` with the rotor inertias of each `Armature` that is listed; other forces are left out."""
        return self._with_rotors().to_urdf(path)

    def _with_rotors(self) -> Robot:
        listed = [torch.as_tensor(force.inertia) for force in self.known_forces if isinstance(force, Armature)]
        return self.robot.with_armature((self.robot.armature + sum(listed)).tolist()) if listed else self.robot

    @classmethod
    @usable_arguments("MechanicalSystem.from_file")
    def from_file(cls, path: str | Path, **options: Any) -> "MechanicalSystem":
        """The robot of a file with its closed loops, if it is MJCF; `options` are those of `Robot.from_file`."""
        return cls.from_mjcf(path, **options) if is_mjcf(read_text(path)) else cls(Robot.from_urdf(path, **options))

    @override
    def facts(self) -> dict[str, object]:
        """Robot, contacts, closed loops and known forces."""
        ends = dict.fromkeys(f"{loop.frame} and {loop.second_frame}" for loop in self.loops)
        return {
            "robot": f"{self.robot.name!r}, {self.robot.nv} joints",
            "contacts": listed(f"{contact.frame} on {type(contact.surface).__name__}" for contact in self.touching),
            **({"closed loops": listed(ends)} if ends else {}),
            "known forces": listed(type(force).__name__ for force in self.known_forces),
            "baumgarte": self.baumgarte or "none",
        }

    @cached_property
    def actuation(self) -> Actuation:
        """How u acts; that of one actuator per joint where no known force is an Actuation."""
        own = (force for force in self.known_forces if isinstance(force, Actuation))
        return next(own, None) or Actuation().bound_to(self.robot)

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """Names of the columns of u: actuators, observed wrenches and wind, then switches of contacts (1 or 0)."""
        switches = dict.fromkeys(contact.switch for contact in self.contacts if contact.switch is not None)
        observed = (force.names for force in self.known_forces if isinstance(force, OBSERVED))
        return (*self.actuators, *(name for names in observed for name in names), *switches)

    @property
    def actuators(self) -> tuple[str, ...]:
        """Names of the first columns of u, those that are commanded: of `Actuation`, then of `Thrusters`."""
        thrusters = (force.names for force in self.known_forces if isinstance(force, Thrusters))
        return (*self.actuation.names, *(name for names in thrusters for name in names))

    @property
    def held_inputs(self) -> tuple[int, ...]:
        """Columns of u that are observed, not commanded: predicted motions follow from those of their start."""
        held = {name for force in self.known_forces if isinstance(force, OBSERVED) for name in force.names}
        return tuple(index for index, name in enumerate(self.inputs) if name in held)

    def foreseen(self, u: Float[Tensor, "*batch rows nu"], dt: float) -> Float[Tensor, "*batch rows nu"]:
        """u of a motion: what observers report stays as in its first row, or fades to what lasts (`ObservedWrench`)."""
        if not (held := list(self.held_inputs)):
            return u
        u = u.clone()
        u[..., held] = u[..., :1, held]
        fade = torch.exp(-dt / FADES * torch.arange(u.shape[-2], dtype=u.dtype, device=u.device))[:, None]
        for force in self.known_forces:
            if isinstance(force, ObservedWrench) and len(force.names) == 12:
                first = self.inputs.index(force.names[0])
                now, lasting = u[..., first : first + 6], u[..., first + 6 : first + 12]
                u[..., first : first + 6] = lasting + fade * (now - lasting)
        return u

    @property
    def loops(self) -> tuple[LoopClosure, ...]:
        """The contacts that hold frames of the robot together."""
        return tuple(contact for contact in self.contacts if isinstance(contact, LoopClosure))

    @property
    def touching(self) -> tuple[Contact, ...]:
        """The other contacts: those with surfaces in the world."""
        return tuple(contact for contact in self.contacts if not isinstance(contact, LoopClosure))

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Sizes of q, v and u."""
        return self.robot.nq, self.robot.nv, len(self.inputs)

    def state(self, q: Tensor, v: Tensor, u: Tensor, inertials: Inertials | None = None) -> State:
        """Checked states (q, v, u), each with its own size. Raises InvalidInput."""
        return State.of(self.robot, q, v, u, inertials, self.inputs, None if self._u_is_delivered else self._delivered)

    @cached_property
    def _u_is_delivered(self) -> bool:
        """Whether u is the force of every joint, and nothing else."""
        return self.actuation.matrix is None and len(self.inputs) == len(self.actuation.names)

    def _delivered(self, state: State) -> Tensor:
        """Joint forces of all actuators."""
        pushing = (force.force(state) for force in self.known_forces if isinstance(force, Thrusters))
        return sum(pushing, self.actuation.force(state))

    def dynamics(
        self, q: Positions, v: JointValues, u: Float[Tensor, "*#batch nu"], inertials: Inertials | None = None
    ) -> ConstrainedDynamics:
        """A, b, H, Q_b and Q_K at states (q, v, u), each (..., nv), from one kinematics pass.

        Differentiable in all arguments. `inertials` maps link names to log-Cholesky parameters (..., 10). Contact
        points are kinematic: no inertial parameter moves them.
        """
        state = self.state(q, v, u, inertials)
        M = self.mass_matrix(state.kinematics, inertials)
        Q_K = torch.zeros_like(state.v)
        for force in self.known_forces:
            Q_K = Q_K + force.force(state)
        A, b, normals = self.constraint(state)
        batch = M.shape[:-2]  # inertials may carry batch dimensions of their own
        A, normals = (part.expand(*batch, *part.shape[-2:]) for part in (A, normals))
        b, Q_K = b.expand(*batch, -1), Q_K.expand(*batch, -1)
        return ConstrainedDynamics.from_constraint(state, M, A, b, normals, Q_K, self.contacts)

    def mass_matrix(
        self, kinematics: Kinematics, inertials: Mapping[str, Tensor] | None = None
    ) -> Float[Tensor, "*batch nv nv"]:
        """M of the robot and of what known forces add to it, such as rotors."""
        M = kinematics.mass_matrix(inertials)
        for force in self.known_forces:
            inertia = force.added_inertia()
            if inertia is not None:
                M = M + inertia
        return M

    def constraint(self, state: State) -> tuple[Tensor, Tensor, Tensor]:
        """A (..., m, nv), b (..., m) and the surface gradients (..., m, 3)."""
        if not self.contacts:
            *batch, nv = state.v.shape
            return state.q.new_zeros(*batch, 0, nv), state.q.new_zeros(*batch, 0), state.q.new_zeros(*batch, 0, 3)
        rows, right, normals = zip(
            *(contact.constraint(state, self.baumgarte) for contact in self.contacts), strict=True
        )
        return torch.stack(rows, dim=-2), torch.stack(right, dim=-1), torch.stack(normals, dim=-2)

    def check_states(self, q: Float[Tensor, "N nq"], v: Float[Tensor, "N nv"], u: Float[Tensor, "N nu"]) -> None:
        """Raise ContactError, naming row and contact, where contacts cannot constrain or contradict each other."""
        A, b, _ = self.constraint(self.state(q, v, u))
        size = torch.linalg.vector_norm(A, dim=-1) + 0.0 * b  # NaN where b is not finite
        for index, contact in enumerate(self.contacts):
            if isinstance(contact, LoopClosure | RollingContact):  # in a plane some of its rows constrain nothing
                size[..., index] = 1.0 + 0.0 * size[..., index]
            elif isinstance(contact.surface, Held):  # neither do all directions of a held point
                alike = [k for k, x in enumerate(self.contacts) if (x.frame, x.point) == (contact.frame, contact.point)]
                size[..., index] = torch.linalg.vector_norm(A[..., alike, :], dim=(-2, -1)) + 0.0 * b[..., index]
            if contact.switch is not None:  # where it does not act it needs no direction
                size[..., index] += 1.0 - (u[..., self.inputs.index(contact.switch)] > 0.5).to(size.dtype)
        bad = torch.nonzero(~(size > 1e-12))
        if len(bad):
            row, index = (int(entry) for entry in bad[0])
            raise ContactError(
                f"contact {index} (frame {self.contacts[index].frame!r}) has no direction at row {row}: the gradient "
                "of its surface vanishes or the point cannot move along it; check the surface, the contact point and q."
            )
        violation, relative = self._contradiction(self.dynamics(q, v, u))
        doubtful = torch.nonzero(~(relative <= CONSISTENCY_TOLERANCE).all(-1))[:, 0]
        if len(doubtful):
            # measured velocities leave centripetal accelerations where two points of one link stand still
            dynamics = self.dynamics(q[doubtful], v[doubtful], u[doubtful])
            moving = dynamics.pseudo_inverse @ (dynamics.A @ v[doubtful][..., None])
            allowed = v[doubtful] - (dynamics.inverse_lower.mT @ moving)[..., 0]
            again = self._contradiction(self.dynamics(q[doubtful], allowed, u[doubtful]))
            violation[doubtful], relative[doubtful] = again
        if not bool((relative <= CONSISTENCY_TOLERANCE).all()):
            row, index = divmod(int(relative.argmax()), relative.shape[-1])
            contact = self.contacts[index]
            raise ContactError(
                f"the contacts contradict each other, most at row {row}: |A a - b| = "
                f"{float(violation[row, index]):.2e} for contact {index} (frame {contact.frame!r}), although redundant "
                "contacts are solved in the least-squares sense; remove one of them or check their surfaces."
            )

    @staticmethod
    def _contradiction(dynamics: ConstrainedDynamics) -> tuple[Tensor, Tensor]:
        """|A a - b| (..., m) of the constrained acceleration, in m/s^2 and relative to 1 + |b|."""
        a = dynamics.acceleration_map().offset
        violation = ((dynamics.A @ a[..., None])[..., 0] - dynamics.b).abs()
        return violation, violation / (1.0 + dynamics.b.abs())

    def to(self, device: torch.device | str) -> "MechanicalSystem":
        """The same system with its robot and the numbers of its known forces on `device`, for instance "cuda".

        Raises InvalidInput for a device that is not there.
        """
        return replace(self, robot=self.robot.to(device))  # known forces are bound to the robot's device again

    def with_robot(self, robot: Robot) -> "MechanicalSystem":
        """The same contacts and forces on another robot with the same joints."""
        return replace(self, robot=robot)

    def with_contacts(self, contacts: Sequence[Contact | Sequence[Contact]]) -> "MechanicalSystem":
        """The same robot and forces under other contacts."""
        return replace(self, contacts=contacts)  # type: ignore[arg-type]  # the constructor makes a tuple, or refuses

    def force_index(self, name: str) -> int:
        """Position of the one known force that files call `name`, among those whose coefficients can be estimated.

        Raises InvalidInput where there is none, or more than one.
        """
        kinds = {key: kind for key, kind in KNOWN_FORCES.items() if kind.learned is not None}
        if name not in kinds:
            raise InvalidInput(f"no coefficients are called {name!r}; there are {', '.join(kinds)}")
        found = [index for index, force in enumerate(self.known_forces) if type(force) is kinds[name]]
        if len(found) != 1:
            kind = kinds[name].__name__
            raise InvalidInput(
                f"the system lists {len(found)} known forces {name!r}; to learn its coefficients list {kind}(...) once "
                "in known_forces"
            )
        return found[0]

    def with_coefficients(self, coefficients: Mapping[str, Tensor]) -> "MechanicalSystem":
        """The same system where the known forces of these names have other coefficients (nv,), which keep their graph.

        Raises InvalidInput for names that `force_index` refuses.
        """
        forces = list(self.known_forces)
        for name, values in coefficients.items():
            index = self.force_index(name)
            forces[index] = replace(forces[index], **{str(forces[index].learned): values})  # type: ignore[type-var]  # known forces are dataclasses
        return replace(self, known_forces=tuple(forces))

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain JSON values, the robot as URDF text.

        Raises ContactError for a surface that holds code.
        """
        return {
            "format": FORMAT_VERSION,
            **self.robot.to_stored(),
            "contacts": [
                {
                    **{"frame": contact.frame, "point": list(contact.point)},
                    **({} if contact.switch is None else {"switch": contact.switch}),
                    "surface": surface_to_dict(contact.surface),
                    **contact.more(),
                }
                for contact in self.contacts
            ],
            "known_forces": [known_force_to_dict(force) for force in self.known_forces],
            "baumgarte": None if self.baumgarte is None else asdict(self.baumgarte),
        }

    def to_json(self) -> str:
        """`to_dict` as JSON text."""
        return json.dumps(self.to_dict())

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any], contacts: Sequence[Contact] | None = None) -> "MechanicalSystem":
        """The system that `to_dict` stored; `contacts` replaces the stored ones.

        Raises FileFormatError for anything else.
        """
        if stored.get("format") != FORMAT_VERSION:
            raise FileFormatError(
                f"stored system has format {stored.get('format')!r}; this forcegp reads {FORMAT_VERSION}"
            )
        try:
            for key, kind in STORED_PARTS.items():
                if not isinstance(stored[key], kind):
                    raise FileFormatError(f"stored system is damaged: {key} is {stored[key]!r}")
            robot = Robot.from_stored(stored)
            if contacts is None:
                contacts = [_stored_contact(entry) for entry in stored["contacts"]]
            baumgarte = None if stored["baumgarte"] is None else Baumgarte(**stored["baumgarte"])
            forces = tuple(object_from_dict("known force", KNOWN_FORCES, entry) for entry in stored["known_forces"])
        except FileFormatError:
            raise
        except (ForceGPError, KeyError, TypeError, ValueError, AttributeError) as error:
            raise FileFormatError(f"stored system is incomplete or damaged: {type(error).__name__}: {error}") from error
        return cls(robot, tuple(contacts), forces, baumgarte)

    @classmethod
    def from_json(cls, text: str) -> "MechanicalSystem":
        """The system that `to_json` stored."""
        try:
            stored = json.loads(text)
        except (ValueError, RecursionError) as error:  # also numbers of 5000 digits
            raise FileFormatError(f"stored system is not JSON: {error}") from None
        if not isinstance(stored, dict):
            raise FileFormatError(f"stored system is a {type(stored).__name__}, expected a JSON object")
        return cls.from_dict(stored)


def _stored_contact(entry: Mapping[str, Any]) -> Contact:
    entry = {name: tuple(value) if isinstance(value, list) else value for name, value in entry.items()}
    place, switch = (entry["frame"], tuple(entry["point"])), entry.get("switch")
    surface = object_from_dict("surface", SURFACES, entry["surface"])
    for kind, names in ((LoopClosure, SECOND), (RollingContact, WHEEL)):
        if names[0] in entry:
            return kind(*place, surface, switch, **{name: entry[name] for name in names if name in entry})  # type: ignore[arg-type]  # the constructors check
    return Contact(*place, surface, switch)
