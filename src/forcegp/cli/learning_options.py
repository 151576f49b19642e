"""What every command asks that learns from a dataset: data, robot and search; and what options say in short."""

from __future__ import annotations

import shlex
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import forcegp
import forcegp.checks
import forcegp.data
import forcegp.mechanics
import forcegp.models
import forcegp.robots
from forcegp.atomic_files import file_digest
from forcegp.cli.command import DATASET, FIELDS, NUMBERS, BackendOptions, Overwriting, listed, numbers_of, unless_given
from forcegp.cli.contact_syntax import CONTACTS, parse_contacts
from forcegp.cli.input_options import ROBOT_OPTIONS, RobotOptions
from forcegp.cli.terminal import Terminal
from forcegp.errors import ContactError, ContactWarning, InvalidInput, require_known

PARTS = r"(?!((viscous|coulomb|load)-joint-friction|armature|rotor-inertia)(=.*)?$)[^:]*"
"""What continues an entry of --learn: a part of a link or a joint, but no force."""
MODEL_PARTS = rf"{FIELDS}|(viscous|coulomb|stribeck|load|offset|direction)(/motions)?"
"""What continues the name of a model: FIELD=VALUE of a prior, or a law of friction."""


def parse_learn(words: Sequence[str]) -> tuple[forcegp.models.Learned, ...]:
    """`LINK:mass,com,inertia`, or `FORCE`, `FORCE:joint,joint`, either with `=START`. Raises InvalidInput."""
    if not words:
        raise InvalidInput("nothing to estimate; add --learn LINK:mass,com, or another that --help names.")
    forces = [name for name, kind in forcegp.mechanics.KNOWN_FORCES.items() if kind.learned is not None]
    learned: list[forcegp.models.Learned] = []
    for word in words:
        what, _, start = word.partition("=")
        name, _, listed = what.rpartition(":") if ":" in what else (what, "", "")
        entries = tuple(entry for entry in listed.split(",") if entry)
        if name in forces:
            complaint = f"--learn {word}: {start!r} is not a number; give a start value such as =0.1."
            value = numbers_of(start, complaint, one=True)[0] if start else None
            learned.append(forcegp.Coefficients(name, entries or None, value))
        elif entries and not start:
            learned.append(forcegp.robots.LinkInertia(name, entries))
        else:
            raise InvalidInput(
                f"--learn {word} is not LINK:PARTS, with parts out of mass,com,inertia, nor one of {', '.join(forces)} "
                "with :JOINTS or =START as you wish."
            )
    return tuple(learned)


def with_learned_forces(
    system: forcegp.MechanicalSystem, learn: Sequence[forcegp.models.Learned]
) -> tuple[forcegp.MechanicalSystem, list[str]]:
    """The system with every learned force in its list, from the URDF's coefficients, and the names that were added."""
    added: dict[str, None] = {}
    for name in (entry.force for entry in learn if isinstance(entry, forcegp.Coefficients)):
        if not any(type(force) is forcegp.mechanics.KNOWN_FORCES[name] for force in system.known_forces):
            system = replace(system, known_forces=(*system.known_forces, _known_force(name, system)))
            added[name] = None
    return system, list(added)


def _known_force(name: str, system: forcegp.MechanicalSystem) -> forcegp.mechanics.KnownForce:
    """The force of that name, with the coefficients of the URDF, or else values from which an estimate begins."""
    kind: Any = forcegp.mechanics.KNOWN_FORCES[name]
    begin = {"load-joint-friction": (0.0, 0.0, 0.1), "armature": (0.0,), "rotor-inertia": (0.0,)}
    return kind.from_robot(system.robot) if hasattr(kind, "from_robot") else kind(*begin.get(name, ()))


def friction_laws(given: Sequence[str]) -> tuple[str, ...]:
    """The laws; `none` is no friction. Names are checked by `forcegp.analytical`."""
    return tuple(law for law in given if law != "none")


NEARLY_ALL = 0.995
"""Share of rows in contact from which on the contacts count as closed all the time (impacts and noise take a few)."""
HARDLY_ANY = 0.2
"""Share below which something is wrong with the contact, rather than the tool in the air."""


MOST = 3
"""Findings whose text is shown; the others by their subject."""


def findings_in_one_line(
    findings: Sequence[forcegp.checks.Finding], data: Path, words: Sequence[str] = (), advise: bool = False
) -> str | None:
    """The worst findings, the subjects of the others, and where to read more; None if there are none.

    `words` are the options of forcegp check that show the same findings; `advise` names what to do about the worst
    finding instead, where no options do.
    """
    if not findings:
        return None
    shown = [f"{each.subject}: {each.seen.rstrip('.')}" for each in findings[:MOST]]
    more = dict.fromkeys(each.subject for each in findings[MOST:])
    others = [f"further {', '.join(more)}"] if more else []
    see = f"See {shlex.join(['forcegp', 'check', str(data), *words])}"
    following = findings[0].remedy.rstrip(".") if advise else see
    return f"{'; '.join([*shown, *others])}. {following} (--no-checks does not look)"


KNOWN = ("actuation", "rigid-body-bias", "viscous-joint-friction", "coulomb-joint-friction")
"""What --known-force takes."""


@dataclass(frozen=True, kw_only=True)
class LearningOptions(BackendOptions, RobotOptions, Overwriting):
    """What every command asks that learns from a dataset."""

    data: Annotated[Positional[Path], DATASET, arg(metavar="DATA")]
    """The dataset to learn from (HDF5)."""
    noise: Annotated[str, arg(metavar="learned|dataset|SIGMA")] = "dataset"
    """Noise of the measured acceleration: a standard deviation in rad/s², learned, or as the dataset states it (learned
    where it does not)."""
    force_noise: Annotated[float | None, unless_given("SIGMA", "none", float)] = None
    """Noise of the joint forces as well: a standard deviation in Nm, where the search begins with --noise learned."""
    restarts: Annotated[int | None, unless_given("R", "4 up to 400 points, else 1")] = None
    """Starts of the search; the best is kept."""
    seed: Annotated[int, arg(metavar="K")] = 0
    """Draws the starts of the search after the first."""
    jobs: Annotated[int | None, unless_given("J", "1, or all that --backend has", int)] = None
    """Restarts at once."""
    hyperprior: Annotated[bool, arg(help_behavior_hint="")] = True
    """Plain maximum likelihood, without the priors on kernels and learned noise that keep few points calibrated."""
    contact: Annotated[tuple[str, ...], listed(CONTACTS, "the dataset's", goes_on=NUMBERS)] = ()
    """Points that stay on surfaces, instead of the dataset's contacts; m, in the axes of the link FRAME.
    SURFACE is plane:nx,ny,nz,offset or sphere:cx,cy,cz,radius or cylinder:px,py,pz,ax,ay,az,radius.
    none is no contact at all."""
    known_force: Annotated[tuple[str, ...], listed("NAME,...", "the dataset's")] = ()
    """The complete list of known forces, instead of the dataset's: actuation, rigid-body-bias,
    viscous-joint-friction, coulomb-joint-friction (both with the coefficients of the URDF)."""
    rows: Literal["auto", "in-contact", "all"] = "auto"
    """in-contact: learn from rows in which positions, velocities and accelerations show the contact to act. all: from
    every row. auto: in-contact where the tool leaves the surface at times, with a note."""
    checks: Annotated[bool, arg(help_behavior_hint="")] = True
    """Do not look for wrong units, signs, joints, contacts, masses and drop-outs first, as forcegp check does."""

    def _check(
        self, terminal: Terminal, dataset: forcegp.Dataset, system: forcegp.MechanicalSystem, accelerations: bool = True
    ) -> None:
        """One line on what would spoil the model; contacts are not warned of again by the fit.

        Without `accelerations` nobody has measured `a`: nothing is compared with it.
        """
        if self.checks:
            # without a system it compares no torques; those of moving bases are never compared
            without = not (accelerations or system.robot.layout.groups)
            looked_at = (replace(dataset, system=None), None) if without else (dataset, system)
            found = forcegp.checks.quick_check(*looked_at)
            of_accelerations = () if accelerations else ("acceleration", "base acceleration", "base force", "noise_std")
            used = [each for each in found if each.subject not in of_accelerations]
            # check has no --contact: it would find nothing wrong with the contacts of the data
            line = findings_in_one_line(used, self.data, self.words(*ROBOT_OPTIONS), advise=bool(self.contact))
            if line is not None:
                terminal.warn(line)
        warnings.simplefilter("ignore", ContactWarning)

    def _system(self, dataset: forcegp.Dataset) -> forcegp.MechanicalSystem:
        """What is known: the dataset's own system, with what the options replace."""
        contacts = parse_contacts(self.contact)
        system = self.chosen_system(dataset, self.data)
        if self.contact:
            system = system.with_contacts((*contacts, *system.loops))
        if self.known_force:
            for name in self.known_force:
                require_known("force", name, "--known-force", KNOWN)
            names = dict.fromkeys(self.known_force)
            system = replace(system, known_forces=tuple(_known_force(name, system) for name in names))
        return system

    def _rows(self, dataset: forcegp.Dataset, system: forcegp.MechanicalSystem) -> tuple[forcegp.Dataset, str | None]:
        """The rows in which all contacts act (`forcegp.data.rows_in_contact`), or all, as --rows asks.

        And a note to print after the fit, so that an error before it stands alone. Raises ContactError with in-contact
        if there are none.
        """
        if self.rows == "all" or not system.contacts:
            return dataset, None
        try:
            touching = forcegp.data.rows_in_contact(replace(dataset, system=system))
        except ContactError:
            if self.rows == "in-contact":
                raise
            return dataset, None  # the fit raises a clearer error
        share = len(touching) / len(dataset)
        if self.rows == "auto" and share >= NEARLY_ALL:
            return dataset, None
        text = f"{len(touching)} of {len(dataset)} rows move as a contact demands ({share:.1%})"
        if self.rows == "auto" and share < HARDLY_ANY:
            return dataset, f"{text}; all were learned from. Check the contact, or give --rows in-contact."
        note = f"{text}; these alone were learned from (--rows all takes every row)"
        return replace(touching, system=dataset.system), note

    def _given(self) -> dict[str, Any]:
        """Options and data, as a folder remembers them."""
        options = {
            name: str(value) if isinstance(value, Path) else value
            for name, value in ((name, getattr(self, name)) for name in self.__dataclass_fields__)
            if name not in ("json", "debug", "overwrite")
        }
        data = {"path": str(self.data), "sha256": file_digest(self.data)}
        return {"options": options, "data": data}
