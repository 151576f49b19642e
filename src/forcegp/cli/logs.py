"""`forcegp import` and `check`, and the options of a log: its columns, and the filter that makes rows of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import forcegp
import forcegp.checks
import forcegp.data
import forcegp.recordings
from forcegp.atomic_files import atomic_file
from forcegp.cli.command import DATASET, LOG, MAPPING, NUMBERS, Command, listed, numbers_of, options_of, unless_given
from forcegp.cli.robot_options import FEET, RobotOptions, parse_feet
from forcegp.cli.terminal import Terminal, columns, doubts_table, facts, shown
from forcegp.errors import DatasetError, InvalidInput

Columns = Annotated[str | None, unless_given("COLUMNS", "by the names", str)]
MappingFile = Annotated[Path | None, MAPPING, unless_given("FILE.yaml", "log.yaml or forcegp.yaml beside it", Path)]
Text = Annotated[str | None, unless_given("TEXT", "none", str)]
Seconds = Annotated[float | None, unless_given("S", "all", float)]
REPAIRED = {
    "repeated_stamps_dropped": "rows dropped for a repeated time stamp",
    "rows_in_stretches_too_short": "rows left out in stretches of fewer than 5",
}


@dataclass(frozen=True, kw_only=True)
class FilterOptions:
    """How rows to learn from are made of a raw log."""

    cutoff: Annotated[str, arg(metavar="HZ|auto|none")] = "none"
    """Low-pass filter q and u without delay, and recompute v and a. auto: by the spectrum and held-out torques."""
    differentiate: Literal["q", "v"] = "q"
    """q: v and a from filtered positions. v: a from filtered velocities."""
    delay: Annotated[str, arg(metavar="S|auto")] = "0"
    """Delay of u in the log, in s. auto: estimated for all joints together where u are the torques of all joints and
    nothing is touched, else 0; with the lag of a filter, if one shows."""
    lag: Annotated[float, arg(metavar="S")] = 0.0
    """Time constant in s with which actuators of first order follow u, thrusters where a base has them. Below 0, that
    of a filter behind which u was logged, which is undone."""
    every: Annotated[int | None, unless_given("N", "1, or what the filter leaves", int)] = None
    """Keep every N-th row, after the filter."""
    trim: Annotated[float, arg(metavar="S")] = 0.0
    """Drop S seconds at both ends of each episode, after the filter."""

    def preparation(self) -> forcegp.data.Preparation:
        """The preparation that the options describe. Raises InvalidInput, naming the option, for what is no number."""
        cutoff, delay = None if self.cutoff == "none" else self.cutoff, self.delay
        if cutoff not in (None, "auto"):
            complaint = f"--cutoff is {self.cutoff!r}; give a frequency in Hz, auto or none."
            [cutoff] = numbers_of(self.cutoff, complaint, one=True)
        if delay != "auto":
            [delay] = numbers_of(self.delay, f"--delay is {self.delay!r}; give seconds, or auto.", one=True)
        how: dict[str, Any] = {"cutoff": cutoff, "delay": delay, "every": 1 if self.every is None else self.every}
        return forcegp.data.Preparation(differentiate=self.differentiate, lag=self.lag, trim=self.trim, **how)


def prepared_rows(
    terminal: Terminal, preparation: forcegp.data.Preparation, raw: forcegp.Dataset, *, thin: bool
) -> tuple[forcegp.Dataset, forcegp.Dataset]:
    """Rows to learn from, with `thin` as many as the filter leaves, and the same at the full rate."""
    if preparation.changes_nothing and not preparation.why:  # what was looked for and not found is reported
        return raw, raw
    preparation = preparation.resolved(raw)
    for why in (each for each in preparation.why.values() if "taken to" in each):  # assumed without a look
        terminal.note(why)
    every = preparation.thinning(raw) if thin else preparation.every
    rows = replace(preparation, every=every).apply(raw)
    return rows, rows if every == 1 else replace(preparation, every=1).apply(raw)


@dataclass(frozen=True, kw_only=True)
class ColumnOptions:
    """Which columns of a log are what."""

    feet: Annotated[tuple[str, ...], listed(goes_on=NUMBERS), unless_given(FEET, "none")] = ()
    """Frames, or points of them, that stand on the ground at times: 1 or 0 in columns of u after those of the
    actuators, in this order. Without these columns motion and forces decide; rows that leave it open are dropped.
    FRAME:flat is a foot that does not turn while it stands, FRAME:ball=RADIUS (m) a ball that rolls on level ground."""
    mapping: MappingFile = None
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
    force: Annotated[str | None, unless_given("FRAME=COLUMNS,...", "none", str)] = None
    """Force sensors: at a frame of the robot the force on it, x, y, z in the world's axes; with `--axes force=body` in
    those of the frame. For instance foot=fx,fy,fz. And accelerometers, in their own axes, at rest 9.81 upwards:
    imu:hand=ax,ay,az, or imu:hand@x,y,z for a point of the frame, and imu:hand@x,y,z,roll,pitch,yaw.
    And torques between gears and links, which move these: torque=t1,t2,t3 of all joints, torque:lift=t2 of one."""
    joints: Annotated[str | None, unless_given("NAMES", "those of --robot", str)] = None
    """Names of the joints in the order of the columns."""
    orientation: Annotated[Literal["xyzw", "wxyz", "angles"] | None, unless_given("xyzw|wxyz|angles", "xyzw")] = None
    """Of a moving base: a quaternion, w last or first, or angles roll, pitch, yaw (in a plane yaw alone)."""
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
    """Text with one number per line: how many make a row, for all files or for each: 1,7,7."""
    side_by_side: bool = False
    """The files are one recording, with a signal in each; columns are called FILE:column."""
    gap: Annotated[float | None, unless_given("S", "10 median steps", float)] = None
    """A longer pause starts a new episode."""
    rate: Annotated[str, arg(metavar="HZ|auto|log")] = "auto"
    """Rows per second. auto: rows at uneven times get even ones at the median rate, by a spline. log: as they are."""
    start: Seconds = None
    """Leave out what comes earlier, in seconds from the first row of each episode."""
    end: Seconds = None
    """Leave out what comes later."""
    without: Annotated[tuple[float, ...], listed(float), unless_given("S,S,...", "none")] = ()
    """Leave out from one to the other, as of contacts; several pairs one after the other."""
    unwrap: bool = False
    """Continue angles of joints that jump by a turn."""
    bad_rows: Literal["refuse", "skip"] = "refuse"
    """skip: leave out rows that lack a value, up to 5 % of a log; their number is printed. Empty ones do not count."""
    beyond_limits: bool = False
    """Accept positions beyond the limits of the URDF."""

    def options(self) -> forcegp.recordings.ImportOptions:
        """How rows come of columns. Raises InvalidInput."""
        own = {item.name for item in fields(forcegp.recordings.ImportOptions)} - {"stance"}
        given: dict[str, Any] = {name: getattr(self, name) for name in own}
        if self.rate not in ("auto", "log"):
            complaint = f"--rate is {self.rate!r}; give rows per second, auto or log."
            [given["rate"]] = numbers_of(self.rate, complaint, one=True)
        return forcegp.recordings.ImportOptions(stance="auto", **given)

    def model(self, robot: RobotOptions) -> forcegp.Model:
        """The robot, with the known forces and contacts of --identified, or with feet. Raises InvalidInput for none."""
        touching, model = parse_feet(self.feet), robot.chosen()
        if model is None:
            raise InvalidInput("give --robot ARM.urdf, or --identified with a system that carries its robot.")
        if not touching:
            return model
        if robot.identified is not None:
            raise InvalidInput("--identified brings its contacts along; leave --feet out.")
        return model.with_contacts(touching)

    def mapped(self, logs: Sequence[Path], terminal: Terminal) -> forcegp.recordings.ColumnMapping:
        """What the flags state, and for those that are not given the file. Raises InvalidInput, FileFormatError."""
        path = self.mapping
        if path is None:
            found = {forcegp.recordings.beside(log) for log in logs} - {None}
            if len(found) > 1:
                several = ", ".join(sorted(map(str, found)))
                raise InvalidInput(f"the logs have different mappings beside them ({several}); give --mapping.")
            path = next(iter(found), None)
            if path is not None:
                terminal.note(f"the columns are mapped by {path}")
        if path is None:
            return self._stated()
        stored = forcegp.recordings.read_mapping(path, [item.name for item in fields(forcegp.recordings.ColumnMapping)])
        left = {name: value for name, value in stored.items() if getattr(self, name) in (None, False)}
        try:
            return replace(self, **left)._stated()
        except InvalidInput as error:
            raise InvalidInput(f"{path} and the flags: {error}") from None

    def _stated(self) -> forcegp.recordings.ColumnMapping:
        given: Any = {item.name: getattr(self, item.name) for item in fields(forcegp.recordings.ColumnMapping)}
        lists = {name: text for name, text in given.items() if name in (*"qvua", "joints") and text is not None}
        given |= {name: tuple(forcegp.recordings.listed(str(text))) for name, text in lists.items()}
        if self.headerless is not None:
            words = str(self.headerless).split(",")
            if not all(word.strip().isdigit() for word in words):
                raise InvalidInput(f"--headerless is {self.headerless!r}; give whole numbers such as 7 or 1,7,7.")
            given["headerless"] = tuple(int(word) for word in words)
        if self.sign is not None and "=" not in str(self.sign):  # for all signals: it turns the axis of a joint
            given["sign"] = ",".join(f"{name}={self.sign}" for name in "qvua")
        for name in [name for name in forcegp.recordings.EXAMPLES if given[name] is not None]:
            stated = forcegp.recordings.by_quantity(name, given[name])
            complaint = f"--sign is {self.sign!r}; give 1 or -1 for each joint, such as u=-1,1."
            signs = {key: tuple(numbers_of(",".join(own), complaint)) for key, own in stated.items() if name == "sign"}
            given[name] = signs or stated
        return forcegp.recordings.ColumnMapping(**{name: value for name, value in given.items() if value is not None})


@dataclass(frozen=True, kw_only=True)
class Import(Command):
    """Turn logs into a dataset: CSV, TSV and text (also .gz), Parquet, JSON, npz, MATLAB, HDF5, ROS bags.

    State which columns are the time, the positions, velocities and forces of the joints (or of a base that moves), and
    their units: by flags, or in a YAML file. One beside the log, log.yaml or forcegp.yaml, is found by itself. COLUMNS
    are names, patterns such as pos{1..7}, or combinations: "theta2 - theta1, 0.5*b + pi".

    With a --cutoff, --delay, --lag, --stance, --every or --trim, rows are filtered, aligned and thinned out, and what
    that costs is reported; LOG may then be a dataset, too. The low-pass filter runs forwards and backwards, so that
    nothing is delayed; v and a are computed anew.

    For example:
      forcegp import run.csv --time t --q 'pos{1..2}' --u 'tau{1..2}' --robot arm.urdf --out log.h5
      forcegp import run.mcap --q /joint_states:position --u /joint_states:effort --robot arm.urdf --out log.h5
      forcegp import walk.mcap --q '/odom:pose,/joints:position.{joints}' --robot dog.urdf --base floating --out log.h5
      forcegp import walk.csv --mapping dog.yaml --robot dog.urdf --base floating --feet FL_foot,FR_foot --out log.h5
      forcegp import log.h5 --cutoff auto --delay auto --every 10 --out data.h5
    """

    logs: Positional[Annotated[tuple[Path, ...], LOG, arg(metavar="LOG...", help_behavior_hint="")]]
    """Files, or folders of ROS 2 bags; each is at least one episode."""
    out: Annotated[Path, arg(metavar="FILE.h5")]
    """The dataset to write (HDF5)."""
    stance: Literal["log", "auto"] = "log"
    """auto: set the switches of contacts to what motion and forces show, and mark open ones by .5."""
    robot: RobotOptions = RobotOptions()
    columns: ColumnOptions = ColumnOptions()
    filter: FilterOptions = FilterOptions()

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Read, check, prepare, write and show."""
        if not self.logs:
            raise InvalidInput("give at least one log.")
        self.require_free_file(self.out)
        preparation, mapping = replace(self.filter.preparation(), stance=self.stance), None
        if forcegp.data.is_dataset(self.logs[0]):
            raw, done = self._dataset(preparation), {}
        else:
            mapping = self.columns.mapped(self.logs, terminal)
            given = {"model": self.columns.model(self.robot), "options": self.columns.options()}
            with terminal.progress("importing"):
                raw = forcegp.import_recordings(self.logs, mapping, **given)
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
        shown = [] if mapping is None else [_imported(terminal, self.out, done)]
        terminal.show(*shown, *([] if prepared is None else [_price(self.out, raw, prepared)]))
        return {"out": str(self.out), **done}

    def _dataset(self, preparation: forcegp.data.Preparation) -> forcegp.Dataset:
        """The dataset that is to be prepared. Raises InvalidInput for options that are about logs."""
        path, *others = self.logs
        about_logs = self.words(*options_of(ColumnOptions))
        if others or about_logs:
            what = about_logs[0].partition("=")[0] if about_logs else "more than one file"
            raise InvalidInput(f"{path} is a dataset of forcegp already, of which one is prepared; leave {what} out.")
        if preparation.changes_nothing:
            seen = f"{path} is a dataset of forcegp already, so there is nothing to do"
            raise InvalidInput(f"{seen}: give --cutoff, --delay, --lag, --stance, --every or --trim.")
        dataset = forcegp.Dataset.load(path)
        return replace(dataset, model=self.robot.chosen_model(dataset, path))


def _imported(terminal: Terminal, out: Path, done: Mapping[str, Any]) -> str:
    for found in done["guessed"]:
        terminal.note(f"found by name: {found}")
    for each in done["recordings"]:
        notes = [*each["notes"], *(f"{text}: {each[name]}" for name, text in REPAIRED.items() if each[name])]
        if gaps := each["gaps"]:
            notes.append(f"gaps that split it: {len(gaps)}, of up to {max(gaps):.4g} s")
        if notes:
            terminal.note(f"{each['name']}: {'; '.join(notes)}")
    if (step := done["resampled_to_step"]) is not None:
        worst = max(each["largest_deviation_of_a_step"] for each in done["recordings"])
        terminal.note(f"resampled to {1 / step:.6g} Hz: steps deviate by up to {worst:.0%} from their median")
    how = ", ".join(f"{name} {text}" for name, text in done["signals"].items())
    if done.get("preparation", {}).get("cutoff") is not None:
        how = "filtered and differentiated anew"
    seconds = sum(each["seconds"] for each in done["recordings"])
    return f"{out}: rows: {done['rows']}, episodes: {len(done['episodes'])} ({seconds:.4g} s); {how}"


def _price(out: Path, dataset: forcegp.Dataset, prepared: forcegp.Dataset) -> Any:
    """What was done, and the noise of every joint before and after; what the filter removed is in the report."""
    report = prepared.metadata["preparation"]
    cutoff, why, values = report["cutoff"], report["why"], {"rows": " -> ".join(map(str, report["rows"]))}
    if "sample_rate" in report:
        values["sample rate"] = " -> ".join(f"{rate:.4g} Hz" for rate in report["sample_rate"])
    filtered = "none" if cutoff is None else f"{cutoff:.3g} Hz, order 4, forwards and backwards"
    values["filter"] = "; ".join([filtered, *([why["cutoff"]] if "cutoff" in why else [])])
    for name in ("delay", "lag"):
        if report[name] or name in why:
            values[f"{name} of u"] = "; ".join([f"{1e3 * report[name]:.1f} ms", *([why[name]] if name in why else [])])
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
    return f"{shares}; {report['stance']['open_rows']} rows leave one open, of which torques alone are used"


@dataclass(frozen=True, kw_only=True)
class Check(Command):
    """Look for what would spoil a model: wrong units, signs, joints and delays, dead channels, poor motion, noise.

    Each doubt is ok, look (judge yourself) or wrong (results would be wrong), and what to do. Nothing is changed.

    For example:
      forcegp check log.h5 --robot arm.urdf
      forcegp check log.h5 --robot arm.urdf --strict --json
    """

    log: Annotated[Positional[Path], DATASET, arg(metavar="LOG")]
    """The dataset to check (HDF5)."""
    strict: bool = False
    """Exit with code 2 if anything is wrong."""
    robot: RobotOptions = RobotOptions()

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Check, and show. Raises DatasetError with `strict` where something is wrong."""
        dataset = forcegp.Dataset.load(self.log)
        model = self.robot.chosen_model(dataset, self.log)
        with terminal.progress("checking"):
            report = forcegp.check(dataset, model)
        content = {"data": str(self.log), **report.to_dict()}
        terminal.show(*_shown(terminal, self.log, report))
        wrong = report.doubts.at("wrong")
        if self.strict and wrong:
            raise DatasetError(
                f"{self.log}: {len(wrong)} things are wrong ({wrong.subjects}); without --strict this is no error."
            )
        return content


def _shown(terminal: Terminal, data: Path, report: forcegp.checks.CheckReport) -> list[Any]:
    from rich.text import Text

    content = report.to_dict()
    counts = content["counts"]
    heading = Text(f"{data}: {counts['wrong']} wrong, {counts['look']} to look at, {counts['ok']} ok", style="bold")
    told = [heading, doubts_table(report.doubts, terminal.worded)]
    if report.comparison is not None:
        joints = (each.values() for each in content["joints"])
        rows = [[name, shown(left, "{:.2g} %", 100.0), shown(rms), shown(factor)] for name, left, rms, factor in joints]
        unit = report.inputs.log.units["u"]
        title = f"Torque of every joint; in {unit if isinstance(unit, str) else 'the unit of each joint'}"
        told.append(columns(title, ["joint", "unexplained", "rms", "factor"], rows))
    return told
