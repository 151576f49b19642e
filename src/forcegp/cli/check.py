"""`forcegp check`: what would spoil a model of this log, and what to do about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import forcegp
import forcegp.checks
import forcegp.scores
from forcegp.atomic_files import write_json
from forcegp.cli.command import DATASET, Command, unless_given
from forcegp.cli.log_options import CutoffOptions
from forcegp.cli.robot_options import RobotOptions
from forcegp.cli.terminal import Terminal, columns, doubts_table, shown
from forcegp.errors import DatasetError


@dataclass(frozen=True, kw_only=True)
class Check(Command):
    """Look for what would spoil a model: wrong units, signs, joints and delays, dead channels, poor motion, noise.

    Each doubt is ok, look (judge yourself) or wrong (results would be wrong), and what to do. Nothing is changed.

    For example:
      forcegp check log.h5 --robot arm.urdf
      forcegp check log.h5 --robot arm.urdf --out look --strict
    """

    log: Annotated[Positional[Path], DATASET, arg(metavar="LOG")]
    """The dataset to check (HDF5)."""
    out: Annotated[Path | None, unless_given("FOLDER", "no plots", Path)] = None
    """Also draw torques and spectra into this folder, with the doubts as check.json."""
    strict: bool = False
    """Exit with code 2 if anything is wrong."""
    robot: RobotOptions = RobotOptions()
    filter: CutoffOptions = CutoffOptions(cutoff="auto")

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Check, draw if asked to, and show. Raises DatasetError with `strict` where something is wrong."""
        self.require_free(self.out)
        preparation = self.filter.preparation()
        dataset = forcegp.Dataset.load(self.log)
        model = self.robot.model_if_any(dataset, self.log)
        with terminal.progress("checking"):
            report = forcegp.check(dataset, model, preparation=preparation)
        content = {"data": str(self.log), **report.to_dict()}
        if self.out is not None:
            with self.folder(self.out, {"data": str(self.log)}) as folder:
                forcegp.scores.save_figure(forcegp.scores.check_figure(report), folder / "check.png")
                write_json(folder / "check.json", content)
            terminal.note(f"plots: {self.out}")
        terminal.show(*_shown(terminal, self.log, report))
        wrong = report.doubts.at("wrong")
        if self.strict and wrong:
            raise DatasetError(
                f"{self.log}: {len(wrong)} things are wrong ({wrong.subjects}); without --strict this is no error."
            )
        return content


def _shown(terminal: Terminal, data: Path, report: forcegp.checks.CheckReport) -> list[Any]:
    """One paragraph per doubt, worst first, and the numbers of every joint."""
    from rich.text import Text

    content = report.to_dict()
    counts = content["counts"]
    heading = Text(f"{data}: {counts['wrong']} wrong, {counts['look']} to look at, {counts['ok']} ok", style="bold")
    doubts = doubts_table(report.doubts, terminal.worded)
    measured = any(value is not None for each in content["joints"] for name, value in each.items() if name != "joint")
    return [heading, doubts, _numbers(report, content)] if measured else [heading, doubts]


def _numbers(report: forcegp.checks.CheckReport, content: Mapping[str, Any]) -> Any:
    cutoff = content["cutoff"]
    filtered = "not\nfiltered" if cutoff is None else f"filtered\nat {cutoff:.3g} Hz"
    header = ["joint", "torque un-\nexplained", "rms", "factor", "noise of a\nas logged", filtered, "times M"]
    rows = [
        [
            each["joint"],
            shown(each["unexplained"], "{:.2g} %", 100.0),
            *(shown(each[name]) for name in ("residual", "factor", "noise_before", "noise_after", "noise_torque")),
        ]
        for each in content["joints"]
    ]
    units = report.inputs.log.units
    unit = f"{units['u']} and {units['a']}" if isinstance(units["u"], str) else "the units of each joint"
    return columns(f"Every joint; in {unit}".replace("^2", "²"), header, rows)
