"""Options of a subject, shared by commands: the robot, what it touches, models to compare, and the search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import UseAppendAction, arg

import forcegp
import forcegp.mechanics
import forcegp.posterior
from forcegp.atomic_files import SUMS, require_unchanged, unreadable
from forcegp.cli.command import FIELDS, IDENTIFIED, URDF, listed, numbers_of, split_list, unless_given
from forcegp.errors import LARGEST, FileFormatError, InvalidInput

SYSTEM_FILE = "system.json"  # where a folder that `forcegp fit` wrote holds robot and known forces

BASES = unless_given("fixed|floating", "fixed; asked where a file looks otherwise")


@dataclass(frozen=True, kw_only=True)
class RobotFileOptions:
    """How a robot file is read."""

    inertias: Literal["strict", "nearest"] = "strict"
    """For a physically impossible inertia. strict: refuse it. nearest: take the nearest possible, and warn."""
    base: Annotated[Literal["fixed", "floating"] | None, BASES] = None
    """How the base is held. fixed: bolted to the world, also where the robot has legs or rotors. floating: free."""
    lock: Annotated[tuple[str, ...], listed(), unless_given("JOINT=RAD,...", "as recorded")] = ()
    """Hold joints of the URDF at these positions (rad or m), for instance a finger that was not recorded."""
    armature: Annotated[tuple[str, ...], listed(), unless_given("JOINT=VALUE,...", "as recorded, or 0")] = ()
    """Rotor inertias seen at joints, in kg m² (kg for a prismatic one)."""
    gravity: Annotated[tuple[float, ...], listed(float), unless_given("X,Y,Z", "as recorded, or 0,0,-9.81")] = ()
    """Gravitational acceleration in the axes of the base, in m/s²; another one if the base is not mounted upright."""

    def changes(self) -> dict[str, Any]:
        """Arguments of `Robot.from_file` by name."""
        changes: dict[str, Any] = {"base": self.base} if self.base else {}
        if self.gravity:
            if len(self.gravity) != 3:
                raise InvalidInput(f"--gravity holds {len(self.gravity)} numbers; write --gravity 0,0,-9.81.")
            changes["gravity"] = self.gravity
        if self.lock:
            changes["locked"] = _named(self.lock, "--lock", "JOINT=RAD")
        if self.armature:
            changes["armature"] = _named(self.armature, "--armature", "JOINT=VALUE")
        return changes


@dataclass(frozen=True, kw_only=True)
class RobotOptions(RobotFileOptions):
    """Which robot a command works with."""

    robot: Annotated[Path | None, URDF, unless_given("ARM.urdf", "the dataset's or the model's", Path)] = None
    """Use this robot (URDF or MJCF)."""
    identified: Annotated[Path | None, IDENTIFIED, unless_given("FOLDER", "none", Path)] = None
    """In place of --robot: begin with the robot and the known forces that `forcegp fit` estimated."""

    def chosen(self, recorded: forcegp.Model | None = None) -> forcegp.Model | None:
        """What the options ask for, else `recorded`, whose contacts and forces stay, and what no URDF holds."""
        if self.identified is not None:
            found = self._identified_system(self.identified)
            kept = {} if recorded is None else {"contacts": recorded.contacts, "baumgarte": recorded.baumgarte}
            return replace(found, **kept)
        changes = self.changes()
        if self.robot is None and (recorded is None or not changes):
            if changes:
                raise InvalidInput(f"--{next(iter(changes)).replace('locked', 'lock')} needs --robot ARM.urdf.")
            return recorded
        if recorded is not None:
            before = recorded.robot
            changes = {"gravity": before.gravity.tolist(), "locked": before.locked, "base": before.base} | changes
        if self.robot is not None:
            own = forcegp.Model.from_file(self.robot, inertias=self.inertias, **changes)
        else:
            assert recorded is not None, "there is one of both"
            text, source = recorded.robot.urdf_text, recorded.robot.source
            own = forcegp.Model(forcegp.Robot.from_urdf_text(text, source=source, inertias=self.inertias, **changes))
        # robots with other joints are refused by their names: clearer than an armature of the wrong length
        if recorded is None or own.robot.joint_names != recorded.robot.joint_names:
            return own
        robot = own.robot
        if self.robot is None or self.armature or not bool(robot.armature.any()):  # else those of the file count
            rotors = dict(zip(robot.joint_names, recorded.robot.armature.tolist(), strict=True))
            robot = robot.with_armature(rotors | changes.get("armature", {}))
        model = recorded.with_robot(robot)
        if self.robot is not None:  # its damping, dry friction and springs
            new = (law for law in own.laws if not any(law.takes_the_place_of(each) for each in model.laws))
            model = model.with_forces(*new)
        return model

    def chosen_model(self, dataset: forcegp.Dataset, path: Path) -> forcegp.Model:
        """The dataset's own system, with what is replaced. Raises InvalidInput where joints differ."""
        model = self.chosen(dataset.model) or dataset.model
        if model.robot.joint_names != tuple(dataset.joint_names):
            raise InvalidInput(
                f"{self.robot or self.identified or 'the robot'} has joints {', '.join(model.robot.joint_names)}; "
                f"{path} has {', '.join(dataset.joint_names)}. Give the robot that was recorded, or "
                "--lock what was not."
            )
        return model

    def _identified_system(self, place: Path) -> forcegp.Model:
        contradicting = [f"--{each.name}" for each in fields(self) if each.name not in ("identified", "inertias")
                         and getattr(self, each.name)]  # fmt: skip
        if contradicting:
            raise InvalidInput(f"--identified brings its robot along; leave {', '.join(contradicting)} out.")
        if (place / SUMS).exists():  # that of `forcegp auto`, which resumes, and one's own have none
            require_unchanged(place, "fit again")
        path = place / SYSTEM_FILE if place.is_dir() else place
        if not path.exists() and (place / "model.json").exists():
            return identified_system(forcegp.posterior.load_posterior(place).model)  # that of `save_posterior`
        try:
            if why := unreadable(path):
                raise OSError(f"it {why}")
            return forcegp.Model.from_json(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError) as error:
            raise FileFormatError(f"{path} cannot be read ({error}); give a folder that `forcegp fit` wrote.") from None


def identified_system(model: forcegp.Model) -> forcegp.Model:
    """What a fit knows of robot and laws, without what the robot carried."""
    known = model.known
    unloaded = tuple(law for law in known.laws if not isinstance(law, forcegp.Payload))
    return replace(known, robot=known.loaded_robot, forces=unloaded)


def forces_of(model: forcegp.Model) -> list[str]:
    """A line on the laws that a file brings beside the usual ones, if it does."""
    titles = [law.title for law in model.laws]
    return [] if set(titles) <= {"actuation", "rigid-bodies"} else [f"forces: {', '.join(titles)}"]


def require_same_joints(posterior: forcegp.posterior.Posterior, dataset: forcegp.Dataset, path: Path) -> None:
    """Refuse a recording of another robot: InvalidInput."""
    if tuple(posterior.joint_names) != dataset.joint_names:
        here, there = (", ".join(each.joint_names) for each in (dataset, posterior))
        seen = f"{path} has joints {here}; the model was trained on {there}"
        raise InvalidInput(f"{seen}. Give a recording of the same robot.")


def _named(words: Sequence[str], option: str, syntax: str) -> dict[str, float]:
    out: dict[str, float] = {}
    for word in words:
        name, _, text = word.rpartition("=")
        if not name:
            raise InvalidInput(f"{option} {word} is not {syntax}.")
        if name in out:
            raise InvalidInput(f"{option} names {name} twice; give each joint once.")
        complaint = f"{option} {word}: {text!r} is not a finite number of at most {LARGEST:g} in SI units."
        [out[name]] = numbers_of(text, complaint, one=True)
        if not abs(out[name]) <= LARGEST:
            raise InvalidInput(complaint)
    return out


@dataclass(frozen=True, kw_only=True)
class CandidateOptions:
    """Which models are compared."""

    forces: Annotated[UseAppendAction[tuple[str, ...]], unless_given("FORCE,...", "some of every kind")] = ()
    """A model to fit, FORCE,...[@EVIDENCE,...] as for forcegp fit; give one --forces per model. given: the robot as
    given. identified: with all inertias, friction and rotors from the log. gp:independent: without physics.
    gp:joint-friction: unknown forces on the robot as given; identified,gp:joint-friction: on it as identified.
    viscous,coulomb@torques: laws alone. identified@motions:1: refined on motions."""

    def names(self) -> tuple[str, ...]:
        """Their names in Python, FORCES[@EVIDENCE] joined by "+"."""
        names = tuple("@".join("+".join(split_list(part, FIELDS)) for part in each.split("@")) for each in self.forces)
        for name in names:
            if names.count(name) > 1:
                raise InvalidInput(f"--forces {name} is named twice; name each model once.")
        return names


@dataclass(frozen=True, kw_only=True)
class SearchOptions:
    """How functions are learned."""

    points: Annotated[int | None, unless_given("N", "200, 100 to compare; all for few inputs", int)] = None
    """Learn functions from N rows that lie farthest apart (all rows if there are fewer). Time grows with the cube of N
    as far as --engine is exact. Numbers of laws are found from all rows."""
    restarts: Annotated[int | None, unless_given("R", "4 up to 400 points, else 1", int)] = None
    """Starts of every search for hyper-parameters; the best is kept."""
    iterations: Annotated[int | None, unless_given("N", "200", int)] = None
    """Most L-BFGS iterations of each start."""
    jobs: Annotated[int, arg(metavar="J")] = 1
    """Pieces of work at once, each on one core."""


# ---------------------------------------------------------------------- what the robot touches

SYNTAX = {"plane": "nx,ny,nz,offset", "sphere": "cx,cy,cz,radius"}  # numbers of each surface in m: plane n . p = offset
CONTACTS = "FRAME@x,y,z:SURFACE,..."
EXAMPLE = "lbr_iiwa_link_7@0,0,0.1:plane:0,0,1,0.055"
FEET, FLAT, BALL = "FRAME@x,y,z,...", ":flat", ":ball="  # behind the frame: does not turn; rolls, with its radius in m
HELD = ":held"  # behind a point that is bolted down
STANDS = "{}_stands"  # the input that switches the contact of a foot


def parse_contacts(texts: Sequence[str]) -> tuple[forcegp.Contact, ...]:
    """One contact per text, three of a point that is held; `none` alone is no contact. Raises InvalidInput."""
    if "none" in texts:
        if len(texts) > 1:
            raise InvalidInput("--contact none stands alone; the other contacts contradict it.")
        return ()
    return tuple(contact for text in texts for contact in parse_contact(text))


def parse_contact(text: str) -> tuple[forcegp.Contact, ...]:
    """`FRAME@x,y,z:SURFACE:numbers`, without `@x,y,z` at the frame's origin. Raises InvalidInput with an example."""
    if text.endswith(HELD):
        frame, point = _frame_and_point(text.removesuffix(HELD), f"--contact {text!r} is not FRAME@x,y,z{HELD}")
        return forcegp.mechanics.fixed_point(frame, point)
    place, kind, numbers = [*text.rsplit(":", 2), "", ""][:3]
    forms = ", ".join(f"{name}:{form}" for name, form in SYNTAX.items())
    needs = f"--contact {text!r} is not FRAME@x,y,z:SURFACE with a SURFACE of {forms} (m); for example {EXAMPLE}"
    if kind not in SYNTAX or not place:
        raise InvalidInput(needs)
    frame, point = _frame_and_point(place, needs)
    values = numbers_of(numbers, needs)
    if len(values) != SYNTAX[kind].count(",") + 1:
        raise InvalidInput(needs)
    *vector, size = values
    surface: Any = {"plane": forcegp.Plane, "sphere": forcegp.Sphere}[kind]
    return (forcegp.Contact(frame, point, surface(tuple(vector), size)),)


def parse_feet(texts: Sequence[str]) -> tuple[forcegp.Contact, ...]:
    """Points `FRAME@x,y,z`, balls `FRAME:ball=RADIUS`, flat feet `FRAME:flat`, all switched. Raises InvalidInput."""
    feet: dict[str, tuple[forcegp.Contact, ...]] = {}
    for text in texts:
        complaint = (
            f"--feet {text!r} is not FRAME, FRAME@x,y,z (m), FRAME{BALL}RADIUS (m) or FRAME{FLAT}; for example "
            "FL_foot@0,0,-0.02"
        )
        flat, (named, ball, size) = text.endswith(FLAT), text.removesuffix(FLAT).partition(BALL)
        frame, point = _frame_and_point(named, complaint)
        radius = numbers_of(size, complaint) if ball else [0.0]
        if not frame or (flat and (ball or "@" in named)) or len(radius) != 1:
            raise InvalidInput(complaint)
        if frame in feet:
            raise InvalidInput(f"--feet names {frame} twice; a frame has one foot.")
        switch = STANDS.format(frame)
        feet[frame] = forcegp.mechanics.fixed_point(frame, point, switch, radius[0])
        if flat:
            feet[frame] = forcegp.mechanics.fixed_frame(frame, switch)
    return tuple(contact for points in feet.values() for contact in points)


def _frame_and_point(place: str, complaint: str) -> tuple[str, tuple[float, float, float]]:
    """Of `FRAME@x,y,z`, or of a FRAME at its origin. Raises InvalidInput as complained."""
    frame, _, point = place.rpartition("@") if "@" in place else (place, "", "0,0,0")
    values = numbers_of(point, complaint)
    if len(values) != 3:
        raise InvalidInput(complaint)
    return frame, (values[0], values[1], values[2])
