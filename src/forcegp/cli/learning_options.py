"""What every command asks that learns from a dataset: the data, what is known about the robot, and how to search."""

from __future__ import annotations

import hashlib
import shlex
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg

import forcegp
import forcegp.checks
import forcegp.data
from forcegp.cli.command import DATASET, BackendOptions, unless_given
from forcegp.cli.input_options import ROBOT_OPTIONS, RobotOptions
from forcegp.cli.syntax import parse_contacts
from forcegp.cli.terminal import Terminal
from forcegp.errors import ContactError, ContactWarning

RowsChoice = Literal["auto", "in-contact", "all"]

NEARLY_ALL = 0.995
"""Share of rows in contact from which on the contacts count as closed all the time (impacts and noise take a few)."""
HARDLY_ANY = 0.2
"""Share below which something is wrong with the contact, rather than the tool in the air."""


def rows_to_learn(
    dataset: forcegp.Dataset, system: forcegp.MechanicalSystem, choice: RowsChoice
) -> tuple[forcegp.Dataset, str | None]:
    """The rows in which all contacts of `system` act (`forcegp.data.rows_in_contact`), or all; and a note on it.

    "auto" leaves rows out where a plausible share of them is not in contact, and else takes all, with a note.
    The note is printed after the fit, so that an error before it stands alone. Raises ContactError with "in-contact" if
    there are none.
    """
    if choice == "all" or not system.contacts:
        return dataset, None
    try:
        touching = forcegp.data.rows_in_contact(replace(dataset, system=system))
    except ContactError:
        if choice == "in-contact":
            raise
        return dataset, None  # the fit raises a clearer error
    share = len(touching) / len(dataset)
    if choice == "auto" and share >= NEARLY_ALL:
        return dataset, None
    text = f"{len(touching)} of {len(dataset)} rows move as a contact demands ({share:.1%})"
    if choice == "auto" and share < HARDLY_ANY:
        return dataset, f"{text}; all were learned from. Check the contact, or give --rows in-contact."
    return replace(
        touching, system=dataset.system
    ), f"{text}; these alone were learned from (--rows all takes every row)"


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


KnownForceName = Literal["actuation", "rigid-body-bias", "viscous-joint-friction", "coulomb-joint-friction"]


@dataclass(frozen=True, kw_only=True)
class LearningOptions(BackendOptions, RobotOptions):
    """What every command asks that learns from a dataset."""

    data: Annotated[Positional[Path], DATASET, arg(metavar="DATA")]
    """The dataset to learn from (HDF5)."""
    out: Annotated[Path | None, unless_given("FOLDER", "none")] = None
    """The folder to write."""
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
    adam_steps: Annotated[int, arg(metavar="N")] = 0
    """Adam steps before them."""
    hyperprior: Annotated[bool, arg(help_behavior_hint="")] = True
    """Plain maximum likelihood, without the priors on kernels and learned noise that keep few points calibrated."""
    contact: Annotated[
        UseAppendAction[tuple[str, ...]],
        arg(metavar="FRAME@x,y,z:SURFACE", help_behavior_hint="(repeatable; default: the dataset's)"),
    ] = ()
    """A point that stays on a surface, instead of the dataset's contacts; m, in the axes of the link FRAME.
    SURFACE is plane:nx,ny,nz,offset or sphere:cx,cy,cz,radius or cylinder:px,py,pz,ax,ay,az,radius.
    none is no contact at all."""
    known_force: Annotated[
        UseAppendAction[tuple[KnownForceName, ...]],
        arg(metavar="NAME", help_behavior_hint="(repeatable; default: the dataset's)"),
    ] = ()
    """The complete list of known forces, instead of the dataset's: actuation, rigid-body-bias,
    viscous-joint-friction, coulomb-joint-friction (both with the coefficients of the URDF)."""
    rows: Annotated[RowsChoice, arg(metavar="auto|in-contact|all")] = "auto"
    """in-contact: learn from rows in which positions, velocities and accelerations show the contact to act. all: from
    every row. auto: in-contact where the tool leaves the surface at times, with a note."""
    checks: Annotated[bool, arg(help_behavior_hint="")] = True
    """Do not look for wrong units, signs, joints, contacts, masses and drop-outs first, as forcegp check does."""
    overwrite: bool = False
    """Replace the folder if forcegp wrote it."""

    def _check(
        self, terminal: Terminal, dataset: forcegp.Dataset, system: forcegp.MechanicalSystem, accelerations: bool = True
    ) -> None:
        """One line on what would spoil the model; contacts are not warned of again by the fit.

        Without `accelerations` nobody has measured `a`: nothing is compared with it.
        """
        if self.checks:
            # without a system it compares no torques
            looked_at = (dataset, system) if accelerations else (replace(dataset, system=None), None)
            found = forcegp.checks.quick_check(*looked_at)
            used = [each for each in found if accelerations or each.subject not in ("acceleration", "noise_std")]
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
            system = system.with_contacts(contacts)
        if self.known_force:
            system = _with_known_forces(system, self.known_force)
        return system

    def _rows(self, dataset: forcegp.Dataset, system: forcegp.MechanicalSystem) -> tuple[forcegp.Dataset, str | None]:
        """The rows to learn from, and a note to print after the fit."""
        return rows_to_learn(dataset, system, self.rows)

    def _given(self) -> dict[str, Any]:
        """Options and data, as a folder remembers them."""
        options = {
            name: str(value) if isinstance(value, Path) else value
            for name, value in ((name, getattr(self, name)) for name in self.__dataclass_fields__)
            if name not in ("json", "debug", "overwrite")
        }
        data = {"path": str(self.data), "sha256": hashlib.sha256(self.data.read_bytes()).hexdigest()}
        return {"options": options, "data": data}


def _with_known_forces(system: forcegp.MechanicalSystem, names: tuple[str, ...]) -> forcegp.MechanicalSystem:
    made = {
        "actuation": lambda: forcegp.Actuation(),
        "rigid-body-bias": lambda: forcegp.RigidBodyBias(),
        "viscous-joint-friction": lambda: forcegp.ViscousJointFriction.from_robot(system.robot),
        "coulomb-joint-friction": lambda: forcegp.CoulombJointFriction.from_robot(system.robot),
    }
    return replace(system, known_forces=tuple(made[name]() for name in dict.fromkeys(names)))
