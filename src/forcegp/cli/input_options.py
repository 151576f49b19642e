"""Which robot a command works with, and how it prepares a raw log."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from typing_extensions import override
from tyro.conf import UseAppendAction, arg

import forcegp
import forcegp.data
import forcegp.posterior
from forcegp.atomic_files import SUMS, require_unchanged
from forcegp.cli.command import (
    FIELDS,
    IDENTIFIED,
    URDF,
    Command,
    listed,
    numbers_of,
    split_list,
    unless_given,
)
from forcegp.cli.terminal import Terminal
from forcegp.errors import FileFormatError, InvalidInput

ROBOT_OPTIONS = ("robot", "inertias", "base", "root", "lock", "armature", "gravity", "identified")
SYSTEM_FILE = "system.json"
"""Where a folder that `forcegp fit` wrote holds robot and known forces."""

BASES = unless_given("fixed|floating|planar|spherical", "fixed; asked where a file looks otherwise")


@dataclass(frozen=True, kw_only=True)
class RobotFileOptions(Command):
    """What every command asks that reads a robot file."""

    inertias: Literal["strict", "nearest"] = "strict"
    """What to do about a physically impossible inertia. strict: refuse the URDF. nearest: use the nearest possible
    one, and warn how far it is."""
    base: Annotated[Literal["fixed", "floating", "planar", "spherical"] | None, BASES] = None
    """How the base is held. fixed: bolted to the world, also where the robot has legs, wheels or rotors.
    floating: free. planar: free in the plane z = 0. spherical: free to turn."""
    root: Annotated[str | None, unless_given("LINK", "that of the file", str)] = None
    """A link that the URDF does not define, such as world, which the base hangs on."""
    lock: Annotated[tuple[str, ...], listed("JOINT=RAD,...", "as recorded")] = ()
    """Hold joints of the URDF at these positions (rad or m), for instance a finger that was not recorded."""
    armature: Annotated[tuple[str, ...], listed("JOINT=VALUE,...", "as recorded, or 0")] = ()
    """Rotor inertias seen at joints, in kg m² (kg for a prismatic one)."""
    gravity: Annotated[str | None, unless_given("X,Y,Z", "as recorded, or 0,0,-9.81", str)] = None
    """Gravitational acceleration in the axes of the base, in m/s²; another one if the base is not mounted upright."""

    def _changes(self) -> dict[str, Any]:
        """Arguments of `Robot.from_file` by name."""
        changes: dict[str, Any] = {name: value for name in ("base", "root") if (value := getattr(self, name))}
        if self.gravity is not None:
            words = self.gravity.split(",")
            if len(words) != 3:
                raise InvalidInput(f"--gravity {self.gravity} holds {len(words)} numbers; write --gravity 0,0,-9.81.")
            changes["gravity"] = [_finite(word, f"--gravity {self.gravity}") for word in words]
        if self.lock:
            changes["locked"] = _named(self.lock, "--lock", "JOINT=RAD")
        if self.armature:
            changes["armature"] = _named(self.armature, "--armature", "JOINT=VALUE")
        return changes


@dataclass(frozen=True, kw_only=True)
class RobotOptions(RobotFileOptions):
    """What every command asks that needs a robot."""

    robot: Annotated[Path | None, URDF, unless_given("ARM.urdf", "the dataset's")] = None
    """Use this robot (URDF or MJCF) instead of the dataset's."""
    identified: Annotated[Path | None, IDENTIFIED, unless_given("FOLDER", "none", Path)] = None
    """Begin with the robot and the known forces that `forcegp fit` estimated, instead of --robot."""

    def chosen(self, recorded: forcegp.Model | None = None) -> forcegp.Model | None:
        """What the options ask for, else `recorded`, whose contacts and forces stay, and what no URDF holds.

        Closed loops of a file come along. None where there is neither. Raises InvalidInput for options that contradict
        each other or make no sense, and what `Robot.from_file` raises.
        """
        found = self._identified_system()
        if found is not None:
            kept = {} if recorded is None else {"contacts": recorded.contacts, "baumgarte": recorded.baumgarte}
            return replace(found, **kept)
        changes = self._changes()
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
            changed = forcegp.Robot.from_urdf_text(text, source=source, inertias=self.inertias, **changes)
            own = forcegp.Model(changed)
        # robots with other joints are refused by their names: clearer than an armature of the wrong length
        if recorded is None or own.robot.joint_names != recorded.robot.joint_names:
            return own
        robot = own.robot
        if self.robot is None or self.armature or not bool(robot.armature.any()):  # else those beside the file count
            rotors = dict(zip(robot.joint_names, recorded.robot.armature.tolist(), strict=True))
            robot = robot.with_armature(rotors | changes.get("armature", {}))
        model = recorded.with_robot(robot)
        if self.robot is not None:  # its damping, dry friction and springs
            there = model.laws
            model = model.with_forces(
                *(law for law in own.laws if not any(law.takes_the_place_of(each) for each in there))
            )
        return model.with_contacts((*model.touching, *own.loops)) if own.loops else model

    def chosen_model(self, dataset: forcegp.Dataset, path: Path) -> forcegp.Model:
        """The dataset's own system, with what is replaced. Raises InvalidInput for none, and where joints differ."""
        model = self.model_if_any(dataset, path)
        if model is None:
            raise InvalidInput(
                f"{path} does not carry its robot; add --robot ARM.urdf, and --contact if it touches something."
            )
        return model

    def model_if_any(self, dataset: forcegp.Dataset, path: Path) -> forcegp.Model | None:
        """The same, or None where there is no robot and no option asks for one."""
        model = self.chosen(dataset.model)
        if model is not None and model.robot.joint_names != tuple(dataset.joint_names):
            raise InvalidInput(
                f"{self.robot or self.identified or 'the robot'} has joints {', '.join(model.robot.joint_names)}; "
                f"{path} has {', '.join(dataset.joint_names)}. Give the robot that was recorded, or "
                "--lock what was not."
            )
        return model

    def _identified_system(self) -> forcegp.Model | None:
        if self.identified is None:
            return None
        given = ("robot", "base", "root", "lock", "armature", "gravity")
        contradicting = [f"--{name}" for name in given if getattr(self, name)]
        if contradicting:
            raise InvalidInput(f"--identified brings its robot along; leave {', '.join(contradicting)} out.")

        path = self.identified / SYSTEM_FILE if self.identified.is_dir() else self.identified
        if (self.identified / SUMS).exists():  # that of `forcegp auto`, which resumes, and one's own have none
            require_unchanged(self.identified, "fit again")
        if path != self.identified and not path.exists() and (self.identified / "model.json").exists():
            from forcegp.posterior import load_posterior  # that of `save_posterior`

            return identified_system(load_posterior(self.identified).model)
        if path.is_fifo():  # to open it would wait for a writer for ever
            raise FileFormatError(f"{path} is not a regular file; give a folder that `forcegp fit` wrote.")
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise FileFormatError(
                f"{path}: cannot be read ({error}); give a folder that `forcegp fit` wrote."
            ) from None
        return forcegp.Model.from_json(text)


def identified_system(model: forcegp.Model) -> forcegp.Model:
    """What a fit knows of robot and laws, without what the robot carried."""
    known = model.known
    unloaded = tuple(law for law in known.laws if not isinstance(law, forcegp.Payload))
    return replace(known, robot=known.loaded_robot, forces=unloaded)


def forces_of(model: forcegp.Model) -> list[str]:
    """A line on the laws that a file brings beside the usual ones, if it does."""
    titles = [law.title for law in model.laws]
    return [] if set(titles) <= {"actuation", "rigid-bodies"} else [f"forces: {', '.join(titles)}"]


def _named(words: Sequence[str], option: str, syntax: str) -> dict[str, float]:
    """Words NAME=NUMBER as a mapping, each name once."""
    out: dict[str, float] = {}
    for word in words:
        name, _, text = word.rpartition("=")
        if not name:
            raise InvalidInput(f"{option} {word} is not {syntax}.")
        if name in out:
            raise InvalidInput(f"{option} names {name} twice; give each joint once.")
        out[name] = _finite(text, f"{option} {word}")
    return out


def _finite(text: str, what: str) -> float:
    complaint = f"{what}: {text!r} is not a finite number."
    [value] = numbers_of(text, complaint, one=True)
    if not math.isfinite(value):
        raise InvalidInput(complaint)
    return value


SystemChoice = Literal["model", "data"]


def for_system(
    terminal: Terminal, posterior: forcegp.posterior.Posterior, log: forcegp.Dataset, choice: SystemChoice
) -> forcegp.posterior.Posterior:
    """A fitted model for the chosen system; what was changed is reported on stderr.

    A robot whose inertias or friction coefficients were identified stays, and only the contacts are those of the log.
    Raises InvalidInput where the log carries no system, and where the model cannot move there.
    """
    if choice == "model":
        return posterior
    if log.model is None:
        raise InvalidInput("--system data: the data carry no robot and contacts; leave the option out.")
    model = log.model
    if posterior.parameters:
        model = replace(posterior.model, contacts=model.contacts, baumgarte=model.baumgarte)
        terminal.note("--system data: contacts of the data; the robot stays the identified one")
    return posterior.with_model(model)


def require_same_joints(posterior: forcegp.posterior.Posterior, dataset: forcegp.Dataset, path: Path) -> None:
    """Refuse a recording of another robot: InvalidInput."""
    if tuple(posterior.joint_names) != dataset.joint_names:
        raise InvalidInput(
            f"{path} has joints {', '.join(dataset.joint_names)}; the model was trained on "
            f"{', '.join(posterior.joint_names)}. Give a recording of the same robot."
        )


@dataclass(frozen=True, kw_only=True)
class CandidateOptions(Command):
    """What every command asks that compares models."""

    forces: Annotated[UseAppendAction[tuple[str, ...]], unless_given("FORCE,...", "some of every kind")] = ()
    """A model to fit, FORCE,...[@EVIDENCE,...] as for forcegp fit; give one --forces per model. given: the robot as
    given. identified: with all inertias, friction and rotors from the log. gp:independent: without physics.
    gp:joint-friction: unknown forces on the robot as given; identified,gp:joint-friction: on it as identified.
    viscous,coulomb@torques: laws alone. identified@motions:1: refined on motions."""

    def candidates(self) -> tuple[str, ...]:
        """Their names in Python, FORCES[@EVIDENCE] joined by "+"."""
        names = tuple("@".join("+".join(split_list(part, FIELDS)) for part in each.split("@")) for each in self.forces)
        for name in names:
            if names.count(name) > 1:
                raise InvalidInput(f"--forces {name} is named twice; name each model once.")
        return names


@dataclass(frozen=True, kw_only=True)
class CutoffOptions(Command):
    """What every command asks that filters a log."""

    cutoff: Annotated[str, arg(metavar="HZ|auto|none")] = "none"
    """Low-pass filter q and u without delay, and recompute v and a. auto: chosen by the spectrum and held-out
    torques."""
    differentiate: Literal["q", "v"] = "q"
    """q: v and a from filtered positions. v: a from filtered velocities. Only with --cutoff."""

    def _preparation(self) -> forcegp.Preparation:
        """The preparation that the options describe. Raises InvalidInput, naming the option, for what is no number."""
        if self.cutoff in ("none", "auto"):
            cutoff = None if self.cutoff == "none" else "auto"
        else:
            complaint = f"--cutoff is {self.cutoff!r}; give a frequency in Hz, auto or none."
            [cutoff] = numbers_of(self.cutoff, complaint, one=True)
        return forcegp.Preparation(cutoff=cutoff, differentiate=self.differentiate)


@dataclass(frozen=True, kw_only=True)
class PreparationOptions(CutoffOptions):
    """What every command asks that makes rows to learn from out of a raw log."""

    delay: Annotated[str, arg(metavar="S|auto")] = "0"
    """Delay of u in the log, in s: one number, or one per joint with commas. auto: estimated for all joints together,
    which needs the robot."""
    lag: Annotated[str, arg(metavar="S|auto")] = "0"
    """Time constant in s with which actuators of first order follow u. auto: estimated, for thrusters alone."""
    every: Annotated[int | None, unless_given("N", "1", int)] = None
    """Keep every N-th row, after the filter."""
    trim: Annotated[float, arg(metavar="S")] = 0.0
    """Drop S seconds at both ends of each episode, after the filter."""

    @override
    def _preparation(self) -> forcegp.Preparation:
        late: dict[str, Any] = {}
        for name in ("delay", "lag"):
            given = getattr(self, name)
            wrong = f"--{name} is {{!r}}; give seconds, one per joint with commas, or auto.".format
            if given != "auto":
                each = tuple(numbers_of(word, wrong(word), one=True)[0] for word in given.split(","))
                given = each[0] if len(each) == 1 else each
            late[name] = given
        return replace(super()._preparation(), every=1 if self.every is None else self.every, trim=self.trim, **late)

    def with_delay_that_shows(
        self, terminal: Terminal, preparation: forcegp.Preparation, dataset: forcegp.Dataset
    ) -> forcegp.Preparation:
        """The same with a delay of 0 instead of "auto" where a log shows none, which is reported on stderr."""
        contacts = dataset.model is not None and dataset.model.contacts
        if preparation.delay != "auto" or (forcegp.data.torques_of_joints(dataset) and not contacts):
            return preparation
        terminal.note(
            "u is taken to be on time: delays are estimated where it holds the torques of all joints and nothing is "
            "touched; give --delay in s where it is late"
        )
        return replace(preparation, delay=0.0)
