"""`Model`: a robot, its contacts and all forces, as one immutable value that files can carry."""

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
from forcegp.forces import Actuation, Force, Law, Payload, RigidBodies, Rotor, Thrusters, Viscous
from forcegp.forces.actuation import OBSERVED, forces_of_file, forces_of_mjcf
from forcegp.forces.force import Memory
from forcegp.forces.registry import force_from_dict, force_to_dict
from forcegp.forces.rigid_bodies import carrying
from forcegp.mechanics.gauss_principle import OPEN, Baumgarte, ConstrainedDynamics, Contact, State
from forcegp.mechanics.surfaces import Held
from forcegp.noise import Noise
from forcegp.robots import Kinematics, Robot
from forcegp.robots.arguments import JointValues, Positions, broadcast_batch, checked_tensor, is_sequence
from forcegp.robots.mjcf import is_mjcf
from forcegp.robots.urdf_file import read_text
from forcegp.summary import Summary, listed

FORMAT_VERSION = 1
STORED_PARTS = {"urdf": str, "gravity": list, "locked": dict, "contacts": list, "forces": list}
CONSISTENCY_TOLERANCE = 1e-6
"""|A a - b| above this fraction of 1 + |b| means that redundant contacts contradict each other."""


@dataclass(frozen=True, eq=False, repr=False)
class Model(Summary):
    """What is known of a robot, with priors on what is not: M a = Q_K + Q_U + A^T lambda, A a = b.

    robot: its kinematics and inertia.
    contacts: points that stay on surfaces; also what `fixed_point` and `fixed_frame` give, several each.
    forces: everything that acts: laws add up to Q_K, unknown ones to Q_U. None: what the robot's file states
        (actuation, rigid bodies, damping, dry friction, springs). Unknown forces carry what has no law, also gravity.
    noise: of the measured acceleration, a `Noise` or its standard deviation. None: as a log states, or learned.
    baumgarte: stabilisation, if the motion has it.

    Raises InvalidInput, UnknownName or ContactError for parts that do not fit the robot.
    """

    robot: Robot
    contacts: tuple[Contact, ...] = ()
    forces: tuple[Force, ...] = None  # type: ignore[assignment]  # the constructor reads it from the file
    noise: Noise | None = None
    baumgarte: Baumgarte | None = None

    @usable_arguments("Model")
    def __post_init__(self) -> None:
        require_type("robot", self.robot, Robot, ", for example Robot.from_urdf(path)")
        if self.baumgarte is not None:
            require_type("baumgarte", self.baumgarte, Baumgarte)
        if self.noise is not None and not isinstance(self.noise, Noise):
            object.__setattr__(self, "noise", Noise(self.noise))
        if self.forces is None:
            object.__setattr__(self, "forces", forces_of_file(self.robot))
        for name, kind in (("contacts", Contact), ("forces", Force)):
            given = getattr(self, name)
            values = tuple(given) if is_sequence(given) else (given,)
            nested = (value if isinstance(value, tuple | list) else (value,) for value in values)
            values = tuple(each for several in nested for each in several)
            if not is_sequence(given) or not all(isinstance(value, kind) for value in values):
                raise InvalidInput(f"{name} is {given!r}; give a sequence of {kind.__name__} objects.")
            object.__setattr__(self, name, values)
        object.__setattr__(self, "forces", tuple(force.bound_to(self.robot) for force in self.forces))
        if sum(isinstance(force, Actuation) for force in self.forces) > 1:
            raise InvalidInput("forces lists Actuation twice; u acts once: put both into one matrix.")
        if not all(isinstance(name, str) for name in self.inputs):
            raise InvalidInput(f"columns of u are called {self.inputs}; give each a name that is text.")
        if len(set(self.inputs)) < len(self.inputs):
            raise InvalidInput(f"columns of u are called {', '.join(self.inputs)}; give each input its own name.")
        for contact in self.contacts:
            contact.check(self.robot)
        for force in self.forces:
            force.check(self.robot, self.contacts)
        if self.unknown_forces:
            self.unknown  # noqa: B018  # refuses two that are equal

    def with_forces(self, *forces: Force | Sequence[Force], noise: Any = None) -> "Model":
        """The same with these forces as well, in the place of laws of the same part; and with this noise, if given.

        All laws of dry friction are of one part: that of the robot's file goes where another one is added.
        """
        added = tuple(each for some in forces for each in (some if isinstance(some, tuple | list) else (some,)))
        how = {"matrix": self.actuation.matrix, "names": self.actuation.names}
        added = tuple(replace(x, **how) if isinstance(x, Actuation) and x.matrix is None else x for x in added)
        laws = [force for force in added if isinstance(force, Law)]
        kept = tuple(force for force in self.forces if not any(law.takes_the_place_of(force) for law in laws))
        return replace(self, forces=(*kept, *added), noise=self.noise if noise is None else noise)

    def without_mean(self) -> "Model":
        """The same, where unknown forces carry gravity, actuation and all that laws do; M keeps its rotors."""
        silent = (replace(force, known=False) for force in self.forces if isinstance(force, Actuation | Thrusters))
        inertia = (force for force in self.forces if isinstance(force, Rotor))
        return replace(self, forces=(*silent, *inertia, *self.unknown.terms))

    def black_box(self, noise: Any = None) -> "Model":
        """One Gaussian process per joint acceleration, without physics and contacts: the baseline "GP" of the paper."""
        from forcegp.forces import IndependentAccelerations

        bare = replace(self, contacts=(), forces=self.laws, noise=None).without_mean()
        return bare.with_forces(IndependentAccelerations(), noise=noise)

    @cached_property
    def laws(self) -> tuple[Law, ...]:
        """The forces that add up to Q_K."""
        return tuple(force for force in self.forces if isinstance(force, Law))

    @cached_property
    def unknown(self) -> Any:
        """The other forces, as one `UnknownForces`."""
        from forcegp.forces import UnknownForces  # gpytorch, which models of laws alone do not need

        return UnknownForces(self.unknown_forces)

    @property
    def unknown_forces(self) -> tuple[Any, ...]:
        """Those whose functions a fit learns."""
        return tuple(force for force in self.forces if not isinstance(force, Law))

    @property
    def is_open(self) -> bool:
        """Whether numbers of laws or bodies are to be estimated."""
        opened = (law.learned or (isinstance(law, RigidBodies) and law.learn) for law in self.laws)
        return any(opened) or any(isinstance(law, Payload) and not law.known for law in self.laws)

    @property
    def known(self) -> "Model":
        """The same without unknown forces and noise: what a log carries."""
        return replace(self, forces=self.laws, noise=None)

    @property
    def carries_known_forces(self) -> bool:
        """Whether the unknown forces carry gravity and actuation, since no law does."""
        return not any(isinstance(force, RigidBodies) for force in self.forces)

    @classmethod
    @usable_arguments("Model.from_mjcf")
    def from_mjcf(cls, path: str | Path, **options: Any) -> "Model":
        """The robot of an MJCF file with the forces that the file states.

        `options` are those of `Robot.from_mjcf`, which this raises the errors of. Damping, dry friction and springs of
        the file are forces of the model. u are joint forces; where motors act at sites of bodies,
        such as rotors, u are the inputs of all motors, those of bodies that are not free last.
        """
        robot, found = Robot.read_mjcf(read_text(path), str(path), Path(path), for_system=True, **options)
        return cls(robot, forces=forces_of_mjcf(robot, found))

    def to_mjcf(self, path: str | Path | None = None) -> str:
        """`Robot.to_mjcf` with what files can hold of the forces, as `to_urdf`; contacts are left out."""
        return self._robot_of_files().to_mjcf(path)

    def to_urdf(self, path: str | Path | None = None) -> str:
        """`Robot.to_urdf` with what files can hold of the forces: rotors, payloads, viscous and dry friction."""
        return self._robot_of_files().to_urdf(path)

    def _robot_of_files(self) -> Robot:
        robot, found = self.loaded_robot, {type(force): force.values for force in self.laws}
        if Rotor in found:
            robot = robot.with_armature((robot.armature + found[Rotor]["inertia"]).tolist())
        viscous = [values["damping"] for kind, values in found.items() if kind is Viscous]
        dry = [values["level"] for values in found.values() if "level" in values]
        damping, friction = (torch.stack(each).sum(0) if each else None for each in (viscous, dry))
        return robot.with_joint_dynamics(damping, friction)

    @cached_property
    def loaded_robot(self) -> Robot:
        """The robot with the payloads that are known."""
        return carrying(self.robot, (law for law in self.laws if isinstance(law, Payload)))

    @classmethod
    @usable_arguments("Model.from_file")
    def from_file(cls, path: str | Path, **options: Any) -> "Model":
        """The robot of a file, with the forces that it states; `options` are those of `Robot.from_file`."""
        return cls.from_mjcf(path, **options) if is_mjcf(read_text(path)) else cls(Robot.from_urdf(path, **options))

    @override
    def facts(self) -> dict[str, object]:
        """Robot, contacts and forces."""
        return {
            "robot": f"{self.robot.name!r}, {self.robot.nv} joints",
            "contacts": listed(f"{contact.frame} on {type(contact.surface).__name__}" for contact in self.contacts),
            "forces": listed((type(force).__name__ for force in self.forces), most=8),
            "baumgarte": self.baumgarte or "none",
        }

    @cached_property
    def actuation(self) -> Actuation:
        """How u acts; that of one actuator per joint where no known force is an Actuation."""
        own = (force for force in self.forces if isinstance(force, Actuation))
        return next(own, None) or Actuation().bound_to(self.robot)

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """Names of the columns of u: actuators, what is observed, memory, then switches of contacts (1 or 0)."""
        observed = (force.names for force in self.forces if isinstance(force, OBSERVED))
        return (*self.actuators, *(name for names in observed for name in names), *self.memory.names, *self.switches)

    @cached_property
    def switches(self) -> tuple[str, ...]:
        """Names of the last columns of u: 1 or 0, or `OPEN` in rows of a log that leave it open."""
        return tuple(dict.fromkeys(contact.switch for contact in self.contacts if contact.switch is not None))

    def bearing(self, u: Float[Tensor, "*batch nu"]) -> Float[Tensor, "*batch nu"]:
        """The inputs with all contacts that may bear a force, also where the log leaves them open."""
        last = torch.arange(u.shape[-1], device=u.device) >= u.shape[-1] - len(self.switches)
        return torch.where(last & (u == OPEN), 1.0, u)

    @cached_property
    def memory(self) -> Memory:
        """What its laws remember of the motion before, as columns of u."""
        return Memory(self.forces, self.robot)

    @property
    def memory_column(self) -> int:
        """The first column of u that holds what laws remember."""
        return self.inputs.index(self.memory.names[0]) if self.memory.names else 0

    @property
    def actuators(self) -> tuple[str, ...]:
        """Names of the first columns of u, those that are commanded: of `Actuation`, then of `Thrusters`."""
        thrusters = (force.names for force in self.forces if isinstance(force, Thrusters))
        return (*self.actuation.names, *(name for names in thrusters for name in names))

    @property
    def held_inputs(self) -> tuple[int, ...]:
        """Columns of u that are observed, not commanded: predicted motions follow from those of their start."""
        held = {name for force in self.forces if isinstance(force, OBSERVED) for name in force.names}
        return tuple(index for index, name in enumerate(self.inputs) if name in held)

    def foreseen(self, u: Float[Tensor, "*batch rows nu"]) -> Float[Tensor, "*batch rows nu"]:
        """u of a motion: what observers report stays as in its first row."""
        if held := list(self.held_inputs):
            u = u.clone()
            u[..., held] = u[..., :1, held]
        return u

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Sizes of q, v and u."""
        return self.robot.nq, self.robot.nv, len(self.inputs)

    def state(self, q: Tensor, v: Tensor, u: Tensor) -> State:
        """Checked, broadcast states (q, v, u), each of its size. InvalidInput for wrong shapes, dtypes, devices."""
        robot, by = self.loaded_robot, None if self._u_is_delivered else self._delivered
        q, v = robot.checked_input("q", q), robot.checked_input("v", v)
        meaning = f"one value per input: {', '.join(self.inputs)}"
        u = checked_tensor("u", u, len(self.inputs), meaning, robot.device) if by else robot.checked_input("u", u)
        batch = broadcast_batch({"q": q.shape[:-1], "v": v.shape[:-1], "u": u.shape[:-1]})
        q, v, u = (x.expand(*batch, -1) for x in (q, v, u))
        return State(q, v, u, robot, self.inputs, by)

    @cached_property
    def _u_is_delivered(self) -> bool:  # u is the force of every joint, and nothing else
        own = self.actuation
        return own.is_exact and own.matrix is None and len(self.inputs) == len(own.names)

    def _delivered(self, state: State) -> Tensor:
        pushing = (force.delivered(state) for force in self.laws if isinstance(force, Thrusters))
        return sum(pushing, self.actuation.delivered(state))

    def dynamics(self, q: Positions, v: JointValues, u: Float[Tensor, "*#batch nu"]) -> ConstrainedDynamics:
        """A, b, H and Q_K at states (q, v, u), each (..., nv), from one kinematics pass; differentiable."""
        state = self.state(q, v, u)
        Q_K = sum((force.force(state) for force in self.laws), torch.zeros_like(state.v))
        A, b, normals = self.constraint(state)
        return ConstrainedDynamics(state, self.mass_matrix(state), A, b, normals, Q_K, self.contacts)

    def mass_matrix_at(self, kinematics: Kinematics) -> Float[Tensor, "*batch nv nv"]:
        """M of positions alone, made by `loaded_robot.kinematics(q)`."""
        return self._with_rotors(kinematics.mass_matrix())

    def mass_matrix(self, state: State) -> Float[Tensor, "*batch nv nv"]:
        """M of the robot and of what laws add to it, such as rotors."""
        return self._with_rotors(state.mass_matrix)

    def _with_rotors(self, M: Tensor) -> Tensor:
        for force in self.laws:
            if (inertia := force.added_inertia(self.robot)) is not None:
                M = M + inertia
        return M

    def constraint(self, state: State) -> tuple[Tensor, Tensor, Tensor]:
        """A (..., m, nv), b (..., m) and the surface gradients (..., m, 3)."""
        if not self.contacts:
            *batch, nv = state.v.shape
            return state.q.new_zeros(*batch, 0, nv), state.q.new_zeros(*batch, 0), state.q.new_zeros(*batch, 0, 3)
        each = (contact.constraint(state, self.baumgarte) for contact in self.contacts)
        rows, right, normals = zip(*each, strict=True)
        return torch.stack(rows, dim=-2), torch.stack(right, dim=-1), torch.stack(normals, dim=-2)

    def check_states(self, q: Float[Tensor, "N nq"], v: Float[Tensor, "N nv"], u: Float[Tensor, "N nu"]) -> None:
        """Raise ContactError, naming row and contact, where contacts cannot constrain or contradict each other."""
        A, b, _ = self.constraint(self.state(q, v, u))
        size = torch.linalg.vector_norm(A, dim=-1) + 0.0 * b  # NaN where b is not finite
        for index, contact in enumerate(self.contacts):
            if isinstance(contact.surface, Held):  # in a plane some directions of a held point constrain nothing
                alike = [k for k, x in enumerate(self.contacts) if (x.frame, x.point) == (contact.frame, contact.point)]
                size[..., index] = torch.linalg.vector_norm(A[..., alike, :], dim=(-2, -1)) + 0.0 * b[..., index]
            size[..., index] += ~contact.acts(u, self.inputs)  # where it does not act it needs no direction
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
        violation = ((dynamics.A @ dynamics.acceleration_map().offset[..., None])[..., 0] - dynamics.b).abs()
        return violation, violation / (1.0 + dynamics.b.abs())

    def to(self, device: torch.device | str) -> "Model":
        """The same on `device`, for instance "cuda". Raises InvalidInput for a device that is not there."""
        return replace(self, robot=self.robot.to(device))  # forces are bound to the robot's device again

    def with_robot(self, robot: Robot) -> "Model":
        """The same contacts and forces on another robot with the same joints."""
        return replace(self, robot=robot)

    def with_contacts(self, contacts: Sequence[Contact | Sequence[Contact]]) -> "Model":
        """The same robot and forces under other contacts."""
        return replace(self, contacts=contacts)  # type: ignore[arg-type]  # the constructor makes a tuple, or refuses

    def to_dict(self) -> dict[str, Any]:
        """All as plain JSON values, the robot as URDF text. Raises ContactError for a surface that holds code."""
        return {
            "format": FORMAT_VERSION,
            **self.robot.to_stored(),
            "contacts": [contact.to_dict() for contact in self.contacts],
            "forces": [force_to_dict(force) for force in self.forces],
            "noise": None if self.noise is None else self.noise.to_dict(),
            "baumgarte": None if self.baumgarte is None else asdict(self.baumgarte),
        }

    def to_json(self) -> str:
        """`to_dict` as JSON text."""
        return json.dumps(self.to_dict())

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> "Model":
        """The model that `to_dict` stored. Raises FileFormatError for anything else."""
        if stored.get("format") != FORMAT_VERSION:
            raise FileFormatError(f"stored model has format {stored.get('format')!r}; forcegp reads {FORMAT_VERSION}")
        try:
            for key, kind in STORED_PARTS.items():
                if not isinstance(stored[key], kind):
                    raise FileFormatError(f"stored model is damaged: {key} is {stored[key]!r}")
            robot = Robot.from_stored(stored)
            contacts = [Contact.from_dict(entry) for entry in stored["contacts"]]
            baumgarte = None if stored["baumgarte"] is None else Baumgarte(**stored["baumgarte"])
            forces = tuple(force_from_dict(entry) for entry in stored["forces"])
            noise = None if stored["noise"] is None else Noise.from_dict(stored["noise"])
        except FileFormatError:
            raise
        except (ForceGPError, KeyError, TypeError, ValueError, AttributeError) as error:
            raise FileFormatError(f"stored model is incomplete or damaged: {type(error).__name__}: {error}") from error
        return cls(robot, tuple(contacts), forces, noise, baumgarte)

    @classmethod
    def from_json(cls, text: str) -> "Model":
        """The model that `to_json` stored."""
        try:
            stored = json.loads(text)
        except (ValueError, RecursionError) as error:  # also numbers of 5000 digits
            raise FileFormatError(f"stored model is not JSON: {error}") from None
        if not isinstance(stored, dict):
            raise FileFormatError(f"stored model is a {type(stored).__name__}, expected a JSON object")
        return cls.from_dict(stored)
