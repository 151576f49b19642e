"""`Robot`: a URDF as an immutable value with batched, differentiable rigid-body functions."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.atomic_files import write_text
from forcegp.errors import InvalidInput, RobotFileWarning, require_plausible, usable_arguments
from forcegp.robots import arguments as checks
from forcegp.robots import urdf_file
from forcegp.robots.compiled import CompiledRobot
from forcegp.robots.inertia import SINGULAR
from forcegp.robots.kinematics import Kinematics
from forcegp.robots.layout import BaseChoice, Loops, check_base, check_tree, lay_out
from forcegp.robots.mjcf import MjcfWriter, is_mjcf, translate
from forcegp.robots.mjcf_model import Translation
from forcegp.robots.structure import RigidBodyDynamics, RobotStructure, bodies_without_inertia, compile_tree
from forcegp.robots.urdf import parse_urdf

GRAVITY = (0.0, 0.0, -9.81)
STRONGEST_GRAVITY = 1000.0  # m/s^2; the Sun has 274
AT_ONCE = 2000  # states, in a third of the time of 50,000, which no cache holds


@dataclass(frozen=True, eq=False, repr=False)
class Robot(RobotStructure, RigidBodyDynamics):
    """A tree of joints on a base that is fixed or moves. Make one with :meth:`from_urdf`.

    ``q, v, a, tau`` are float64 tensors (..., nv), batches broadcast, in rad or m, per s, per s^2, and Nm or N, in the
    order of :attr:`joint_names`: depth first, branches in file order. On a base that moves q has `nq` entries,
    :attr:`position_names` (:mod:`forcegp.robots.manifold`). A joint that mimics another has no coordinate: limits are
    those of the joints with one, whose rotors, damping and friction include those that follow.

    InvalidInput for wrong shapes, dtypes and devices; subclasses of UnknownName for unknown names.
    """

    @classmethod
    @usable_arguments("Robot.from_urdf")
    def from_urdf(cls, path: str | Path, **options: Any) -> "Robot":
        """Read a URDF file, or a .xacro file where the package xacro is installed. Meshes are not looked for.

        ``options`` are those of :meth:`from_urdf_text`, and so are errors. MissingExtra for .xacro without the package.
        """
        return cls.from_urdf_text(urdf_file.read_robot_file(path), source=str(path), **options)

    @classmethod
    @usable_arguments("Robot.from_urdf_text")
    def from_urdf_text(
        cls,
        text: str,
        *,
        source: str = "<text>",
        gravity: checks.Vector = GRAVITY,
        armature: checks.Armature | None = None,
        locked: Mapping[str, float | int] | None = None,
        inertias: urdf_file.InertiaChoice = "strict",
        base: BaseChoice | None = None,
    ) -> "Robot":
        """Read URDF text; ``source`` is what error messages call it.

        ``gravity`` (3,) in m/s^2; ``armature`` (rotor inertia at the joint, kg m^2 or kg), one per joint or by joint
        name, by default as in the text; ``locked`` joints and their positions; ``inertias`` of "nearest" replaces
        impossible ones; ``base`` says how the root is held, which files of robots that do not look bolted are asked. A
        RobotFileWarning names what was ignored or repaired.

        Raises a subclass of RobotModelError with all that is wrong, and the arguments that mend it (its ``remedy``).
        """
        given = {"locked": locked, "inertias": inertias, "base": base}
        return cls._made(text.lstrip(), checks.Problems(source, given), gravity, armature)

    @classmethod
    @usable_arguments("Robot.from_mjcf")
    def from_mjcf(cls, path: str | Path, **options: Any) -> "Robot":
        """Read an MJCF file by MuJoCo's own compiler: masses may follow from shapes, and files may include others.

        Bodies, and named sites, are links; joints follow in MuJoCo's order, with armature, damping, dry friction and
        limits; a linear equality of two is a mimic joint. q is `qpos` with quaternions x, y, z, w; the linear velocity
        of a free body is in its axes. Parameters and errors are those of :meth:`from_urdf_text`, by default as in the
        file; RobotModelError has MuJoCo's reason, or names what closes a loop (lock its joints). A RobotFileWarning
        names what acts in MuJoCo only (`Model.from_mjcf` has springs).
        """
        return cls.read_mjcf(urdf_file.read_text(path), str(path), Path(path), **options)[0]

    @classmethod
    @usable_arguments("Robot.from_mjcf_text")
    def from_mjcf_text(cls, text: str, *, source: str = "<text>", **options: Any) -> "Robot":
        """As :meth:`from_mjcf`, from text that names no other files; ``source`` is what error messages call it."""
        return cls.read_mjcf(text, source, None, **options)[0]

    @classmethod
    @usable_arguments("Robot.from_file")
    def from_file(cls, path: str | Path, **options: Any) -> "Robot":
        """:meth:`from_mjcf` where the root element is <mujoco>, else :meth:`from_urdf`; ``options`` are theirs."""
        return (cls.from_mjcf if is_mjcf(urdf_file.read_text(path)) else cls.from_urdf)(path, **options)

    @classmethod
    def read_mjcf(
        cls,
        text: str,
        source: str,
        path: Path | None,
        *,
        gravity: checks.Vector | None = None,
        armature: checks.Armature | None = None,
        locked: Mapping[str, float | int] | None = None,
        inertias: urdf_file.InertiaChoice = "strict",
        base: BaseChoice | None = None,
        for_system: bool = False,
    ) -> "tuple[Robot, Translation]":
        """The robot of MJCF text, and what a model takes from it, which is noted as left out unless ``for_system``."""
        problems = checks.Problems(source, {"locked": locked, "inertias": inertias, "base": base}, "Robot.from_mjcf")
        found = translate(text, path, for_system, problems)
        problems.given["locked"] = found.locked | dict(locked or {})
        gravity = found.gravity if gravity is None else gravity
        return cls._made(found.urdf, problems, gravity, armature, found.loops), found

    @classmethod
    def _made(
        cls,
        text: str,
        problems: checks.Problems,
        gravity: checks.Vector,
        armature: checks.Armature | None,
        loops: Loops = (),
        quiet: bool = False,
    ) -> "Robot":
        """The robot of URDF text; `problems` has the arguments and what is wrong already, `loops` are refused."""
        base, inertias = problems.given["base"], problems.given["inertias"]
        if base is not None and base not in get_args(BaseChoice):
            raise InvalidInput(f"base is {base!r}; give one of {', '.join(get_args(BaseChoice))}.")
        locked = checks.locked_positions(problems.given["locked"] or {})
        named = problems.given | {"locked": locked, "inertias": inertias if inertias != "strict" else None}
        problems.given = {name: value for name, value in named.items() if value}
        down, robot = checks.finite_vector("gravity", gravity, 3), None
        if np.linalg.norm(down) > STRONGEST_GRAVITY:
            raise InvalidInput(f"gravity is {gravity!r}; give m/s^2, {STRONGEST_GRAVITY:g} at most.")
        description = parse_urdf(text, problems)
        if not description.complete:  # nothing can be said of a tree that lacks joints
            problems.raise_all()
        with problems.collected():
            layout = lay_out(description, locked, base, problems)
            if armature is not None:
                text = urdf_file.with_armature(text, layout, armature, description.name, source=problems.source)
                description = parse_urdf(text, checks.Problems(problems.source, problems.given))
                layout = lay_out(description, locked, base, checks.Problems(problems.source, problems.given))
            text, description = urdf_file.with_chosen_inertias(inertias, text, description, layout, problems)
            tree = compile_tree(description, layout, down)
            robot = cls(description, layout, tree, text, tuple(locked.items()), layout.base)
            without = bodies_without_inertia(description, layout, tree, problems.broken)
            limp = robot._limp() if without and not problems.broken else range(robot.nv)
            problems.errors += [error for coordinate, error in without if coordinate in limp]
            check_base(description, layout.standing, problems)
            check_tree(layout, loops, problems)
        problems.raise_all()
        assert robot is not None, "a problem was collected otherwise"
        if not quiet:
            problems.warn(stacklevel=5)
        return robot

    @classmethod
    def from_stored(cls, stored: Mapping[str, Any]) -> "Robot":
        """The robot that :meth:`to_stored` gave, in what `Model.to_dict` gave. ValueError for implausible numbers."""
        require_plausible(stored)
        return cls._again(stored["urdf"], "stored URDF", stored)

    @classmethod
    def _again(cls, text: str, source: str, stored: Mapping[str, Any], armature: Any = None) -> "Robot":
        """Of a text that was warned of before."""
        given = {"locked": stored["locked"], "inertias": "strict", "base": stored["base"]}
        return cls._made(text.lstrip(), checks.Problems(source, given), stored["gravity"], armature, quiet=True)

    def to_stored(self) -> dict[str, Any]:
        """The robot as plain JSON values."""
        return {"urdf": self.urdf_text, "gravity": self.gravity.tolist(), "locked": self.locked, "base": self.base}

    def _limp(self) -> set[int]:  # coordinates that nothing resists at a position without symmetry
        step = torch.linspace(0.3, 1.1, self.nv, dtype=torch.float64).sin()
        M = self.mass_matrix(self.space.integrate(self.space.neutral(), step))
        own = M.diagonal()
        scale = own.rsqrt().where(own > SINGULAR * own.max(), 0.0)  # less is rounding
        values, vectors = torch.linalg.eigh(scale[:, None] * M * scale)
        return set((vectors[:, values <= SINGULAR].abs() > 1e-6).any(1).nonzero()[:, 0].tolist())

    def with_armature(self, armature: checks.Armature) -> "Robot":
        """A robot with other rotor inertias (kg m^2 or kg), one per joint or by joint name (the others keep theirs)."""
        if isinstance(armature, Mapping):
            armature = dict(zip(self.joint_names, self.armature.tolist(), strict=True)) | dict(armature)
        return self.with_text(self.urdf_text, armature)

    def to(self, device: torch.device | str) -> "Robot":
        """The same robot with its constants on ``device``, for instance "cuda"."""
        return replace(self, tree=self.tree.to(device))

    def compile(self, folder: str | Path | None = None) -> CompiledRobot:
        """Its dynamics as machine code, kept in ``folder``: see :class:`~forcegp.robots.compiled.CompiledRobot`."""
        return CompiledRobot(self, folder)

    def with_text(self, text: str, armature: checks.Armature | None = None) -> "Robot":
        """A robot of another URDF text, with its rotor inertias if none are given: same gravity, base and device."""
        robot = Robot._again(text, self.source, self.to_stored(), armature)
        return robot if self.device.type == "cpu" else robot.to(self.device)

    def with_joint_dynamics(self, damping: Tensor | None, friction: Tensor | None) -> "Robot":
        """A robot whose URDF has this damping and friction (nv,) of every joint; None: as they are."""
        values = {"damping": damping, "friction": friction}
        given = {name: value.tolist() for name, value in values.items() if value is not None}
        return self.with_text(urdf_file.with_joint_values(self.urdf_text, self.layout, given, source=self.source))

    def to_urdf(self, path: str | Path | None = None) -> str:
        """The URDF text, written to ``path`` if given, with a RobotFileWarning about rotor inertias.

        They are attributes ``armature`` of ``<dynamics>``, which other programs leave out. Joints have the limits
        without which urdfdom refuses a file: ``LARGEST`` where the robot's file states none.
        """
        if rotors := [joint.name for joint in self.joints if joint.armature]:
            source, owners = self.source if path is None else Path(path).name, ", ".join(rotors)
            seen = f"{source}: only forcegp reads rotor inertias from URDF, those of {owners}; give them to others."
            warnings.warn(seen, RobotFileWarning, stacklevel=2)
        text = urdf_file.with_limits(self.urdf_text)
        if path is not None:
            write_text(path, text)
        return text

    @usable_arguments("Robot.to_mjcf")
    def to_mjcf(self, path: str | Path | None = None) -> str:
        """MJCF text with armature, damping, friction and motors; written to ``path`` if given.

        A RobotFileWarning names frames that move without mass, which are left out. Raises RobotModelError for what
        MuJoCo cannot hold, such as a last link without mass.
        """
        writer = MjcfWriter(self)
        text = writer.text()
        if writer.left_out:
            seen = f"{self.source}: MJCF has no frames that move without mass; left out: {', '.join(writer.left_out)}."
            warnings.warn(seen, RobotFileWarning, stacklevel=3)
        if path is not None:
            write_text(path, text)
        return text

    def kinematics(self, q: checks.Positions, v: checks.JointValues | None = None) -> Kinematics:
        """One kinematics pass, to ask for several quantities at the same states; ``v`` only if they need it."""
        q = self.checked_input("q", q)
        if v is None:
            return Kinematics.of(self, q, None)
        v = self.checked_input("v", v)
        if q.shape[:-1] != v.shape[:-1]:
            batch = checks.broadcast_batch({"q": q.shape[:-1], "v": v.shape[:-1]})
            q, v = q.expand(*batch, -1), v.expand(*batch, -1)
        return Kinematics.of(self, q, v)

    def integrate(self, q: checks.Positions, step: checks.JointValues) -> Float[Tensor, "... nq"]:
        """q after the constant velocity ``step`` (..., nv) has acted for one second: ``q + step`` on a fixed base."""
        return self.space.integrate(self.checked_input("q", q), self.checked_input("step", step))

    def difference(self, q0: checks.Positions, q1: checks.Positions) -> Float[Tensor, "... nv"]:
        """The constant velocity (..., nv) that leads from ``q0`` to ``q1`` in one second, by the shorter turn."""
        return self.space.difference(self.checked_input("q", q0), self.checked_input("q", q1))

    def neutral(self) -> Float[Tensor, "nq"]:
        """q with all joints at 0, whatever their limits are, and moving bases upright at the origin."""
        return self.space.neutral().to(self.device)

    def normalized(self, q: Float[Tensor, "*batch nq"]) -> Float[Tensor, "*batch nq"]:
        """q with quaternions divided by their lengths. Raises InvalidInput for length 0."""
        unit = self.space.normalized(checks.checked_tensor("q", q, self.nq, f"positions of {self.name}", self.device))
        self.space.check(unit)
        return unit

    @override
    def _dynamics(self, function: str, *arguments: Any) -> Any:
        q, *others = arguments
        if len(others) == 2 and len({getattr(x, "shape", ())[:-1] for x in arguments}) > 1:
            names = "q", "v", "tau" if function == "forward_dynamics" else "a"
            given = {name: self.checked_input(name, x) for name, x in zip(names, arguments, strict=True)}
            batch = checks.broadcast_batch({name: x.shape[:-1] for name, x in given.items()})
            q, *others = (x.expand(*batch, -1) for x in given.values())
        [batch, *more] = {x.shape[:-1] if isinstance(x, Tensor) else torch.Size() for x in (q, *others)}
        if not more and batch.numel() > AT_ONCE:
            parts = zip(*(x.flatten(0, -2).split(AT_ONCE) for x in (q, *others)), strict=True)
            made = [self._dynamics(function, *some) for some in parts]
            several = isinstance(made[0], tuple)
            found = [torch.cat(each).unflatten(0, batch) for each in (zip(*made, strict=True) if several else [made])]
            return tuple(found) if several else found[0]
        return getattr(self.kinematics(q, *others[:1]), function)(*others[1:])

    def frame_pose(self, q: Float[Tensor, "*batch nq"], frame: str) -> Float[Tensor, "*batch 4 4"]:
        """Pose (..., 4, 4) of a link frame in the world, position in m."""
        return self.kinematics(q).frame_pose(frame)

    def frame_jacobian(
        self, q: checks.Positions, frame: str, point: checks.Vector | None = None
    ) -> Float[Tensor, "... 6 nv"]:
        """Jacobian (..., 6, nv) of a ``point`` (3,) fixed in ``frame`` (m), world axes, rows [linear; angular]."""
        return self.kinematics(q).frame_jacobian(frame, point)
