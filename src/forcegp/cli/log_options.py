"""Options of a log, shared by commands: what its columns are, and the filter that makes rows of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

import forcegp
import forcegp.data
import forcegp.recordings
from forcegp.cli.command import MAPPING, NUMBERS, listed, numbers_of, unless_given
from forcegp.cli.robot_options import FEET, RobotOptions, parse_feet
from forcegp.cli.terminal import Terminal
from forcegp.errors import InvalidInput

Columns = Annotated[str | None, unless_given("COLUMNS", "by the names", str)]
Text = Annotated[str | None, unless_given("TEXT", "none", str)]
Seconds = Annotated[float | None, unless_given("S", "all", float)]


@dataclass(frozen=True, kw_only=True)
class CutoffOptions:
    """How a log is filtered."""

    cutoff: Annotated[str, arg(metavar="HZ|auto|none")] = "none"
    """Low-pass filter q and u without delay, and recompute v and a. auto: chosen by the spectrum and held-out
    torques."""
    differentiate: Literal["q", "v"] = "q"
    """q: v and a from filtered positions. v: a from filtered velocities."""

    def preparation(self) -> forcegp.data.Preparation:
        """The preparation that the options describe. Raises InvalidInput, naming the option, for what is no number."""
        if self.cutoff in ("none", "auto"):
            cutoff = None if self.cutoff == "none" else "auto"
        else:
            complaint = f"--cutoff is {self.cutoff!r}; give a frequency in Hz, auto or none."
            [cutoff] = numbers_of(self.cutoff, complaint, one=True)
        return forcegp.data.Preparation(cutoff=cutoff, differentiate=self.differentiate)


@dataclass(frozen=True, kw_only=True)
class FilterOptions(CutoffOptions):
    """How rows to learn from are made of a raw log."""

    delay: Annotated[str, arg(metavar="S|auto")] = "0"
    """Delay of u in the log, in s. auto: estimated for all joints together where u are the torques of all joints and
    nothing is touched, else 0."""
    lag: Annotated[str, arg(metavar="S|auto")] = "0"
    """Time constant in s with which actuators of first order follow u, thrusters where a base has them. auto: estimated
    for thrusters."""
    every: Annotated[int | None, unless_given("N", "1, or what the filter leaves", int)] = None
    """Keep every N-th row, after the filter."""
    trim: Annotated[float, arg(metavar="S")] = 0.0
    """Drop S seconds at both ends of each episode, after the filter."""

    def preparation(self) -> forcegp.data.Preparation:
        """As above."""
        late: dict[str, Any] = {"delay": self.delay, "lag": self.lag}
        for name in [name for name, given in late.items() if given != "auto"]:
            [late[name]] = numbers_of(late[name], f"--{name} is {late[name]!r}; give seconds, or auto.", one=True)
        return replace(super().preparation(), every=1 if self.every is None else self.every, trim=self.trim, **late)


def with_delay_that_shows(
    terminal: Terminal, preparation: forcegp.data.Preparation, dataset: forcegp.Dataset
) -> forcegp.data.Preparation:
    """The same with a delay of 0 instead of "auto" where a log shows none, which is reported on stderr."""
    contacts = dataset.model is not None and dataset.model.contacts
    if preparation.delay != "auto" or (forcegp.data.torques_of_joints(dataset) and not contacts):
        return preparation
    terminal.note(
        "u is taken to be on time: delays are estimated where it holds the torques of all joints and nothing is "
        "touched; give --delay in s where it is late"
    )
    return replace(preparation, delay=0.0)


@dataclass(frozen=True, kw_only=True)
class ColumnOptions:
    """Which columns of a log are what."""

    feet: Annotated[tuple[str, ...], listed(goes_on=NUMBERS), unless_given(FEET, "none")] = ()
    """Frames, or points of them, that stand on the ground at times: 1 or 0 in columns of u after those of the
    actuators, in this order. Without these columns motion and forces decide; rows that leave it open are dropped.
    FRAME:flat is a foot that does not turn while it stands."""
    mapping: Annotated[Path | None, MAPPING, unless_given("FILE.yaml", "log.yaml or forcegp.yaml beside it", Path)] = (
        None
    )
    """What the columns mean; flags replace its entries."""
    time: Columns = None
    """Time stamps; of a bag with several topics, those of the messages that become rows."""
    step: Annotated[float | None, unless_given("S", "by the time stamps", float)] = None
    """Seconds between two rows, for a log without time stamps."""
    q: Columns = None
    """Positions, one per joint; of a moving base x, y, z and its orientation."""
    v: Annotated[str | None, unless_given("COLUMNS", "by the names, else central differences of q", str)] = None
    """Velocities, one per joint; of a moving base linear, then angular. derive: differentiate this one."""
    u: Columns = None
    """Forces or torques of the actuators, or what motors of the robot take; a constant such as 0 is for all."""
    a: Annotated[str | None, unless_given("COLUMNS", "by the names, else central differences of v", str)] = None
    """Accelerations, one per joint."""
    joints: Annotated[str | None, unless_given("NAMES", "those of --robot", str)] = None
    """Names of the joints in the order of the columns."""
    orientation: Annotated[Literal["xyzw", "wxyz", "angles"] | None, unless_given("xyzw|wxyz|angles", "xyzw")] = None
    """Orientation of a base that moves: a quaternion with w last or first, or angles roll, pitch, yaw (in a plane yaw
    alone)."""
    axes: Text = None
    """Axes of a moving base's v and a, of the linear and the angular part: body, world, or imu, which is what an
    accelerometer at its origin measures. For instance v=world,body,a=imu; body unless stated."""
    ned: bool = False
    """World axes are north, east, down and base axes forward, right, down (PX4); y and z change sign."""
    unit: Text = None
    """Units that are not SI, for instance q=deg,time=ms,u=mNm; several for one signal are one per joint: q=deg,mm.
    With a moving base, each is for the columns of its kind."""
    sign: Text = None
    """1 or -1 per joint, for all signals (--sign=1,-1) or for one (u=-1)."""
    episode: Text = None
    """A column that numbers the episodes."""
    episodes: Text = None
    """A pattern for arrays or groups of one file, each of which is an episode: piece*, data/demo_*."""
    headerless: Text = None
    """Text without names of columns: how many numbers make a row, for all files or for each: 1,7,7."""
    delimiter: Annotated[str | None, unless_given("comma|tab|semicolon|blanks|LETTER", "detected", str)] = None
    """What separates the columns of a text."""
    side_by_side: bool = False
    """The files are one recording, with a signal in each; columns are called FILE:column."""
    gap: Annotated[float | None, unless_given("S", "10 median steps", float)] = None
    """A longer pause starts a new episode."""
    rate: Annotated[str, arg(metavar="HZ|auto|log")] = "auto"
    """Rows per second. auto: rows at uneven times are given even ones at the median rate, by a cubic spline. log: every
    stamp is kept."""
    start: Seconds = None
    """Leave out what comes earlier, in seconds from the first row of each episode."""
    end: Seconds = None
    """Leave out what comes later."""
    unwrap: bool = False
    """Continue angles of joints that jump by a turn."""
    beyond_limits: bool = False
    """Accept positions beyond the limits of the URDF."""

    def options(self) -> forcegp.recordings.ImportOptions:
        """How rows come of columns. Raises InvalidInput."""
        same = ("gap", "start", "end", "unwrap", "beyond_limits")
        given: dict[str, Any] = {name: getattr(self, name) for name in same} | {"rate": self.rate}
        if self.rate not in ("auto", "log"):
            complaint = f"--rate is {self.rate!r}; give rows per second, auto or log."
            [given["rate"]] = numbers_of(self.rate, complaint, one=True)
        return forcegp.recordings.ImportOptions(stance="auto", **given)

    def model(self, robot: RobotOptions) -> forcegp.Model | None:
        """The robot, with the known forces and contacts of --identified, or with feet."""
        touching = parse_feet(self.feet)
        model = robot.chosen()
        if not touching:
            return model
        if robot.identified is not None:
            raise InvalidInput("--identified brings its contacts along; leave --feet out.")
        if model is None:
            raise InvalidInput("--feet needs --robot ROBOT.urdf.")
        return model.with_contacts((*touching, *model.loops))

    def mapped(
        self, logs: Sequence[Path], terminal: Terminal, written: Path | None = None
    ) -> forcegp.recordings.ColumnMapping:
        """The mapping of the file, changed by the flags. Raises InvalidInput for one that is to be `written`, too."""
        path = self.mapping
        if path is None:
            found = {forcegp.recordings.beside(log) for log in logs} - {None}
            if len(found) > 1:
                several = ", ".join(sorted(map(str, found)))
                raise InvalidInput(f"the logs have different mappings beside them ({several}); give --mapping.")
            path = next(iter(found), None)
            if path is not None:
                if written is not None and path.resolve() == written.resolve():
                    raise InvalidInput(f"{path} is read by this command; give --write-mapping another name.")
                terminal.note(f"the columns are mapped by {path}")
        stored = forcegp.recordings.ColumnMapping() if path is None else forcegp.recordings.read_mapping(path)
        return stored.changed_by(self._flags())

    def _flags(self) -> forcegp.recordings.ColumnMapping:
        given: dict[str, Any] = {
            item.name: getattr(self, item.name) for item in fields(forcegp.recordings.ColumnMapping)
        }
        if self.delimiter is not None:
            given["delimiter"] = forcegp.recordings.DELIMITERS.get(self.delimiter, self.delimiter)
        if self.headerless is not None:
            words = self.headerless.split(",")
            if not all(word.strip().isdigit() for word in words):
                raise InvalidInput(f"--headerless is {self.headerless!r}; give whole numbers such as 7 or 1,7,7.")
            given["headerless"] = [int(word) for word in words]
        readers = dict.fromkeys(("unit", "axes", "sign"), forcegp.recordings.by_quantity)
        if self.sign is not None and "=" not in self.sign:
            given["sign"] = self.sign.split(",")
            del readers["sign"]
        given |= {name: read(name, given[name]) for name, read in readers.items() if given[name] is not None}
        return forcegp.recordings.mapping_of(given)
