"""`forcegp import`: logs of any format become one dataset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from typing_extensions import override
from tyro.conf import Positional, arg

import forcegp
import forcegp.data
import forcegp.recordings
from forcegp.atomic_files import atomic_file, write_text
from forcegp.cli.command import LOG, MAPPING, NUMBERS, URDF, Overwriting, listed, numbers_of, unless_given
from forcegp.cli.contact_syntax import FEET, WHEELS, parse_feet, parse_wheels
from forcegp.cli.input_options import PreparationOptions, RobotOptions
from forcegp.cli.terminal import Terminal, facts, shown
from forcegp.errors import ForceGPError, InvalidInput

NOT_ABOUT_LOGS = {"logs", "out", "stance", "json", "debug"}

Columns = Annotated[str | None, unless_given("COLUMNS", "by the names", str)]
Text = Annotated[str | None, unless_given("TEXT", "none", str)]
Seconds = Annotated[float | None, unless_given("S", "all", float)]


@dataclass(frozen=True, kw_only=True)
class LogOptions(PreparationOptions, RobotOptions, Overwriting):
    """What every command asks that begins with logs: which columns are what, and how rows come of them."""

    robot: Annotated[Path | None, URDF, unless_given("ARM.urdf", "none", Path)] = None
    """The robot that was recorded: joints are found by its names and put into its order; the dataset carries it."""
    feet: Annotated[tuple[str, ...], listed(FEET, "none", goes_on=NUMBERS)] = ()
    """Frames, or points of them, that stand on the ground at times: 1 or 0 in columns of u after those of the
    actuators, in this order. Without these columns motion and forces decide; rows that leave it open are dropped.
    FRAME:flat is a foot that does not turn while it stands, FRAME:ball=RADIUS (m) a ball that rolls on level ground."""
    wheels: Annotated[tuple[str, ...], listed(WHEELS, "none")] = ()
    """Wheels that roll about the y axes of these frames without slipping, on level ground; radius in m."""
    logs: Positional[Annotated[tuple[Path, ...], LOG, arg(metavar="LOG...", help_behavior_hint="")]]
    """Files, or folders of ROS 2 bags; each is at least one episode."""
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
    stance: Literal["log", "auto"] = "log"
    """auto: set the switches of contacts to what motion and forces show, and leave out rows that leave one open."""

    @override
    def _preparation(self) -> forcegp.Preparation:
        return replace(super()._preparation(), stance=self.stance)

    def _options(self) -> forcegp.ImportOptions:
        same = ("gap", "start", "end", "unwrap", "beyond_limits")
        given: dict[str, Any] = {name: getattr(self, name) for name in same} | {"rate": self.rate}
        if self.rate not in ("auto", "log"):
            complaint = f"--rate is {self.rate!r}; give rows per second, auto or log."
            [given["rate"]] = numbers_of(self.rate, complaint, one=True)
        return forcegp.ImportOptions(stance="auto", **given)

    def _model(self) -> forcegp.Model | None:
        """The robot of the options, with the known forces and contacts of --identified, or with feet and wheels."""
        touching = [*parse_feet(self.feet), *parse_wheels(self.wheels)]
        model = self.chosen()
        if not touching:
            return model
        option = "--feet" if self.feet else "--wheels"
        if self.identified is not None:
            raise InvalidInput(f"--identified brings its contacts along; leave {option} out.")
        if model is None:
            raise InvalidInput(f"{option} needs --robot ROBOT.urdf.")
        return model.with_contacts((*touching, *model.loops))

    def _mapping(self, terminal: Terminal, written: Path | None = None) -> forcegp.ColumnMapping:
        """That of the file, changed by the flags. Raises InvalidInput for one that is to be `written`, too."""
        path = self.mapping
        if path is None:
            found = {forcegp.recordings.beside(log) for log in self.logs} - {None}
            if len(found) > 1:
                listed = ", ".join(sorted(map(str, found)))
                raise InvalidInput(f"the logs have different mappings beside them ({listed}); give --mapping.")
            path = next(iter(found), None)
            if path is not None:
                if written is not None and path.resolve() == written.resolve():
                    raise InvalidInput(f"{path} is read by this command; give --write-mapping another name.")
                terminal.note(f"the columns are mapped by {path}")
        stored = forcegp.ColumnMapping() if path is None else forcegp.recordings.read_mapping(path)
        return stored.changed_by(self._flags())

    def _flags(self) -> forcegp.ColumnMapping:
        given: dict[str, Any] = {item.name: getattr(self, item.name) for item in fields(forcegp.ColumnMapping)}
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


@dataclass(frozen=True, kw_only=True)
class Import(LogOptions):
    """Turn logs into a dataset: CSV, TSV and text (also .gz), Parquet, npz, MATLAB, HDF5, ROS bags.

    State which columns are the time, the positions, velocities and forces of the joints (or of a base that moves), and
    their units: by flags, or in a YAML file. One beside the log, log.yaml or forcegp.yaml, is found by itself. COLUMNS
    are names, patterns such as pos{1..7}, or linear combinations: "theta2 - theta1, 0.5*b + pi".

    With a --cutoff, --delay, --lag, --stance, --every or --trim, rows are filtered, aligned and thinned out, and what
    that costs is reported; LOG may then be a dataset, too. The low-pass filter runs forwards and backwards, so that
    nothing is delayed; v and a are computed anew.

    For example:
      forcegp import run.csv --time t --q 'pos{1..2}' --u 'tau{1..2}' --robot arm.urdf --out log.h5
      forcegp import run.mcap --q /joint_states:position --u /joint_states:effort --joints a,b --out log.h5
      forcegp import *.csv --mapping columns.yaml --unit q=deg,time=ms --out log.h5
      forcegp import walk.mcap --q '/odom:pose,/joints:position.{joints}' --robot dog.urdf --base floating --out log.h5
      forcegp import walk.csv --mapping dog.yaml --robot dog.urdf --base floating --feet FL_foot,FR_foot --out log.h5
      forcegp import log.h5 --cutoff auto --delay auto --every 10 --out data.h5
    """

    out: Annotated[Path, arg(metavar="FILE.h5")]
    """The dataset to write (HDF5)."""
    write_mapping: Annotated[Path | None, unless_given("FILE.yaml", "not written", Path)] = None
    """Write the mapping that results from flags and --mapping."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Read, check, prepare, write and show."""
        if not self.logs:
            raise InvalidInput("give at least one log.")
        self.require_free_file(self.out)
        self.require_free_file(self.write_mapping, _is_mapping, "a mapping")
        preparation, mapping = self._preparation(), None
        if forcegp.data.is_dataset(self.logs[0]):
            raw, done = self._dataset(preparation), {}
        else:
            mapping, model = self._mapping(terminal, self.write_mapping), self._model()
            given = {"model": model, "options": self._options()}
            with terminal.progress("importing") as report:
                raw = forcegp.import_recordings(self.logs, mapping, **given, report=report)
            done = dict(raw.metadata["import"])
            if done["open_switches"]:
                preparation = replace(preparation, stance="auto")
        dataset, prepared = raw, None
        if not preparation.changes_nothing:
            with terminal.progress("preparing"):
                prepared = preparation.apply(raw)
            dataset = prepared
            done |= {"rows": len(dataset), "preparation": prepared.metadata["preparation"]}
        with atomic_file(self.out, overwrite=self.overwrite) as temporary:
            dataset.save(temporary)
            if self.write_mapping is not None and mapping is not None:
                write_text(self.write_mapping, forcegp.recordings.mapping_text(mapping))
        shown = [] if mapping is None else [_imported(terminal, self.out, done)]
        terminal.show(*shown, *([] if prepared is None else [_price(self.out, raw, prepared)]))
        return {"out": str(self.out), **done}

    def _dataset(self, preparation: forcegp.Preparation) -> forcegp.Dataset:
        """The dataset that is to be prepared. Raises InvalidInput for options that are about logs."""
        path, *others = self.logs
        own = {each.name for each in fields(PreparationOptions) + fields(RobotOptions) + fields(Overwriting)}
        about_logs = self.words(*(name for name in self.options if name not in own | NOT_ABOUT_LOGS))
        if others or about_logs:
            what = about_logs[0].partition("=")[0] if about_logs else "more than one file"
            raise InvalidInput(f"{path} is a dataset of forcegp already, of which one is prepared; leave {what} out.")
        if preparation.changes_nothing:
            raise InvalidInput(
                f"{path} is a dataset of forcegp already, so there is nothing to do: give --cutoff, --delay, --lag, "
                "--stance, --every or --trim."
            )
        dataset = forcegp.Dataset.load(path)
        return replace(dataset, model=self.model_if_any(dataset, path))


def _is_mapping(path: Path) -> bool:
    try:
        forcegp.recordings.read_mapping(path)
    except ForceGPError:
        return False
    return True


def _imported(terminal: Terminal, out: Path, done: Mapping[str, Any]) -> str:
    """What was guessed, repaired and left out, as notes, and what came out."""
    for found in done["guessed"]:
        terminal.note(f"found by name: {found}")
    for recording in done["recordings"]:
        notes = list(recording["notes"])
        if recording["repeated_stamps_dropped"]:
            notes.append(f"{_counted(recording['repeated_stamps_dropped'], 'row')} with a repeated time stamp dropped")
        if recording["gaps"]:
            count, longest = len(recording["gaps"]), max(recording["gaps"])
            notes.append(f"{_counted(count, 'gap')} of up to {longest:.4g} s {'splits' if count == 1 else 'split'} it")
        if recording["rows_in_stretches_too_short"]:
            notes.append(
                f"{_counted(recording['rows_in_stretches_too_short'], 'row')} in stretches of fewer than 5 left out"
            )
        if notes:
            terminal.note(f"{recording['name']}: {'; '.join(notes)}")
    if done["resampled_to_step"] is not None:
        worst = max(recording["largest_deviation_of_a_step"] for recording in done["recordings"])
        terminal.note(
            f"resampled to {1 / done['resampled_to_step']:.6g} Hz: steps deviate by up to {worst:.0%} from their median"
        )
    how = ", ".join(f"{name} {text}" for name, text in done["signals"].items())
    if done.get("preparation", {}).get("cutoff") is not None:
        how = "filtered and differentiated anew"
    seconds = sum(recording["seconds"] for recording in done["recordings"])
    rows, episodes = _counted(done["rows"], "row"), _counted(len(done["episodes"]), "episode")
    return f"{out}: {rows} in {episodes} ({seconds:.4g} s); {how}"


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def _price(out: Path, dataset: forcegp.Dataset, prepared: forcegp.Dataset) -> Any:
    """What was done, and the noise of every joint before and after; what the filter removed is in the report."""
    report = prepared.metadata["preparation"]
    before, after = report["rows"]
    values = {"rows": f"{before} -> {after}"}
    if "sample_rate" in report:
        values["sample rate"] = " -> ".join(f"{rate:.4g} Hz" for rate in report["sample_rate"])
    cutoff = report["cutoff"]
    filtered = "none" if cutoff is None else f"{cutoff:.3g} Hz, order 4, forwards and backwards"
    values["filter"] = filtered + (f"; {report['why']['cutoff']}" if "cutoff" in report["why"] else "")
    for name in ("delay", "lag"):
        seconds, why = report[name], report["why"].get(name)
        if any(seconds) or why is not None:
            milliseconds = ", ".join(
                f"{1e3 * each:.1f}" for each in (seconds if len(set(seconds)) > 1 else seconds[:1])
            )
            values[f"{name} of u"] = f"{milliseconds} ms{'' if why is None else f'; {why}'}"
    if "stance" in report:
        values["stance"] = stance_text(report)
    if cutoff is not None:
        noise, unit = report["acceleration_noise"], dataset.units["a"]
        each = zip(dataset.joint_names, noise["before"], noise["after"], strict=True)
        found = ", ".join(f"{name} {shown(before)} -> {shown(after)}" for name, before, after in each)
        values["noise of a"] = f"{found}, in {unit if isinstance(unit, str) else 'the units of each joint'}"
    return facts(f"{out}: prepared", values)


def stance_text(report: Mapping[str, Any]) -> str:
    """How long each foot stands, and how many rows leave it open, of a report of `Preparation`."""
    shares = ", ".join(f"{name} {share:.0%}" for name, share in report["stance"]["standing"].items())
    return f"{shares}; {report['stance']['open_rows']} rows left out, which leave one open"
