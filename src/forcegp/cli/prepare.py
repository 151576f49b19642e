"""`forcegp prepare`: filter, align, differentiate and thin out a raw log, and report what that costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import forcegp
import forcegp.data
import forcegp.scores
from forcegp.atomic_files import atomic_file
from forcegp.cli.command import DATASET, Overwriting, unless_given
from forcegp.cli.import_log import stance_text
from forcegp.cli.input_options import PreparationOptions, RobotOptions
from forcegp.cli.terminal import Terminal, columns, facts, shown
from forcegp.errors import InvalidInput


@dataclass(frozen=True, kw_only=True)
class Prepare(PreparationOptions, RobotOptions, Overwriting):
    """Filter, align, differentiate and thin out a raw log, and report what that costs.

    The low-pass filter runs forwards and backwards, so that nothing is delayed; v and a are computed anew.

    For example:
      forcegp prepare log.h5 --cutoff auto --every 10 --out data.h5 --plots spectra
      forcegp prepare dog.h5 --stance auto --out data.h5
      forcegp prepare log.h5 --cutoff 20 --delay auto --robot arm.urdf --trim 0.1 --out data.h5
    """

    data: Annotated[Positional[Path], DATASET, arg(metavar="DATA")]
    """The dataset to prepare (HDF5), as forcegp import wrote it."""
    out: Annotated[Path, arg(metavar="FILE.h5")]
    """The dataset to write."""
    stance: Literal["log", "auto"] = "log"
    """auto: set the switches of contacts to what motion and forces show, and leave out rows that leave one open."""
    plots: Annotated[Path | None, unless_given("FOLDER", "no plots", Path)] = None
    """Also draw the spectra before and after, with the cut-off, into this folder."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Prepare, save, draw if asked to, and show."""
        if not self.words("cutoff", "delay", "lag", "stance", "every", "trim"):
            raise InvalidInput("nothing to do: give --cutoff, --delay, --lag, --stance, --every or --trim.")
        self.require_free_file(self.out)
        self.require_free(self.plots)

        preparation = replace(self._preparation(), stance=self.stance)
        dataset = forcegp.Dataset.load(self.data)
        dataset = replace(dataset, model=self.model_if_any(dataset, self.data))
        with terminal.progress("preparing"):
            prepared = preparation.apply(dataset)
        with atomic_file(self.out, overwrite=self.overwrite) as temporary:
            prepared.dataset.save(temporary)
            if self.plots is not None:  # plots that fail leave no dataset behind
                content = {"data": str(self.data), "preparation": prepared.report}
                with self.folder(self.plots, content) as folder:
                    figure = forcegp.scores.preparation_figure(dataset, prepared.preparation)
                    forcegp.scores.save_figure(figure, folder / "spectra.png")
                terminal.note(f"plots: {self.plots}")
        terminal.show(*_report(self.out, dataset, prepared))
        return {"out": str(self.out), "data": str(self.data), **prepared.report}


def _report(out: Path, dataset: forcegp.Dataset, prepared: forcegp.data.Prepared) -> list[Any]:
    """The price, joint by joint."""
    report = prepared.report
    before, after = report["rows"]
    values = {"rows": f"{before} -> {after}"}
    if "sample_rate" in report:
        values["sample rate"] = " -> ".join(f"{rate:.4g} Hz" for rate in report["sample_rate"])
    cutoff = report["cutoff"]
    filtered = "none" if cutoff is None else f"{cutoff:.3g} Hz, order {report['order']}, forwards and backwards"
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
    tables: list[Any] = [facts(f"{out}: prepared", values)]
    if cutoff is None:
        return tables

    noise, removed = report["acceleration_noise"], report["power_removed"]
    own = dataset.joint_names
    inputs = own if dataset.model is None else dataset.model.actuators
    forces = dict(zip(inputs, removed["u"], strict=False))
    header = ["joint", "noise of a\nbefore", "after", "removed\nof q", "v", "a", "u"]
    rows = [
        [name, shown(noise["before"][joint]), shown(noise["after"][joint])]
        + [shown(removed[signal][joint], "{:.2g} %", 100.0) for signal in ("q", "v", "a")]
        + [shown(forces.get(name), "{:.2g} %", 100.0)]
        for joint, name in enumerate(own)
    ]
    rows += [[name, *5 * [shown(None)], shown(forces[name], "{:.2g} %", 100.0)] for name in forces if name not in own]
    unit = dataset.units["a"]
    title = f"What it costs; noise in {unit if isinstance(unit, str) else 'the units of each joint'}, shares of power"
    tables.append(columns(title.replace("^2", "²"), header, rows))
    tables.append("Noise is that of differenced positions above the noise floor; – where the log shows no floor.")
    return tables
