"""`forcegp import`: logs of any format become one dataset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import forcegp
import forcegp.data
import forcegp.recordings
from forcegp.atomic_files import atomic_file, write_text
from forcegp.cli.command import LOG, Command, options_of, unless_given
from forcegp.cli.log_options import ColumnOptions, FilterOptions
from forcegp.cli.robot_options import RobotOptions
from forcegp.cli.terminal import Terminal, facts, shown
from forcegp.errors import ForceGPError, InvalidInput


@dataclass(frozen=True, kw_only=True)
class Import(Command):
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

    logs: Positional[Annotated[tuple[Path, ...], LOG, arg(metavar="LOG...", help_behavior_hint="")]]
    """Files, or folders of ROS 2 bags; each is at least one episode."""
    out: Annotated[Path, arg(metavar="FILE.h5")]
    """The dataset to write (HDF5)."""
    write_mapping: Annotated[Path | None, unless_given("FILE.yaml", "not written", Path)] = None
    """Write the mapping that results from flags and --mapping."""
    stance: Literal["log", "auto"] = "log"
    """auto: set the switches of contacts to what motion and forces show, and leave out rows that leave one open."""
    robot: RobotOptions = RobotOptions()
    columns: ColumnOptions = ColumnOptions()
    filter: FilterOptions = FilterOptions()

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Read, check, prepare, write and show."""
        if not self.logs:
            raise InvalidInput("give at least one log.")
        self.require_free_file(self.out)
        self.require_free_file(self.write_mapping, _is_mapping, "a mapping")
        preparation, mapping = replace(self.filter.preparation(), stance=self.stance), None
        if forcegp.data.is_dataset(self.logs[0]):
            raw, done = self._dataset(preparation), {}
        else:
            mapping = self.columns.mapped(self.logs, terminal, self.write_mapping)
            given = {"model": self.columns.model(self.robot), "options": self.columns.options()}
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

    def _dataset(self, preparation: forcegp.data.Preparation) -> forcegp.Dataset:
        """The dataset that is to be prepared. Raises InvalidInput for options that are about logs."""
        path, *others = self.logs
        about_logs = self.words("write_mapping", *options_of(ColumnOptions))
        if others or about_logs:
            what = about_logs[0].partition("=")[0] if about_logs else "more than one file"
            raise InvalidInput(f"{path} is a dataset of forcegp already, of which one is prepared; leave {what} out.")
        if preparation.changes_nothing:
            raise InvalidInput(
                f"{path} is a dataset of forcegp already, so there is nothing to do: give --cutoff, --delay, --lag, "
                "--stance, --every or --trim."
            )
        dataset = forcegp.Dataset.load(path)
        return replace(dataset, model=self.robot.model_if_any(dataset, path))


def _is_mapping(path: Path) -> bool:
    try:
        forcegp.recordings.read_mapping(path)
    except ForceGPError:
        return False
    return True


REPAIRED = {
    "repeated_stamps_dropped": "rows dropped for a repeated time stamp",
    "rows_in_stretches_too_short": "rows left out in stretches of fewer than 5",
}


def _imported(terminal: Terminal, out: Path, done: Mapping[str, Any]) -> str:
    """What was guessed, repaired and left out, as notes, and what came out."""
    for found in done["guessed"]:
        terminal.note(f"found by name: {found}")
    for recording in done["recordings"]:
        notes = [
            *recording["notes"],
            *(f"{text}: {recording[name]}" for name, text in REPAIRED.items() if recording[name]),
        ]
        if gaps := recording["gaps"]:
            notes.append(f"gaps that split it: {len(gaps)}, of up to {max(gaps):.4g} s")
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
    return f"{out}: rows: {done['rows']}, episodes: {len(done['episodes'])} ({seconds:.4g} s); {how}"


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
        if seconds or why is not None:
            values[f"{name} of u"] = f"{1e3 * seconds:.1f} ms{'' if why is None else f'; {why}'}"
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
