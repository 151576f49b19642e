"""`forcegp payload`: mass, centre of mass and inertia of what a robot holds, from its log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import forcegp
import forcegp.analytical
from forcegp.atomic_files import write_json, write_text
from forcegp.cli.command import DATASET, Overwriting, listed, unless_given
from forcegp.cli.identify import rounds_reported
from forcegp.cli.input_options import SYSTEM_FILE, PreparationOptions, RobotOptions
from forcegp.cli.learning_options import friction_laws
from forcegp.cli.terminal import Terminal, columns

LABELS = {"mass": ("mass", "kg", 1.0)}
LABELS |= {f"center_of_mass.{x}": (f"centre of mass {x}", "mm", 1e3) for x in "xyz"}
LABELS |= {f"inertia.{x}": (f"inertia {x}", "kg m²", 1.0) for x in ("xx", "yy", "zz")}


@dataclass(frozen=True, kw_only=True)
class Payload(PreparationOptions, RobotOptions, Overwriting):
    """Estimate mass, centre of mass and inertia of a payload, together with friction and rotors.

    The log is a motion of 20 s or more that turns every joint in both directions, without contact but for feet that
    stand. Without --baseline, errors of the URDF's links count as payload. With one, the links are estimated from both
    logs.

    For example:
      forcegp payload loaded.h5 --robot arm.urdf
      forcegp payload loaded.h5 --baseline empty.h5 --link tool0 --out payload
    """

    data: Annotated[Positional[Path], DATASET, arg(metavar="DATA")]
    """The log with the payload (a dataset, raw or prepared)."""
    baseline: Annotated[Path | None, DATASET, unless_given("DATA", "the URDF", Path)] = None
    """A log of the same robot without the payload."""
    link: Annotated[str | None, unless_given("LINK", "the hand or the base that explains most", str)] = None
    """The link that carries the payload; results are in its frame."""
    friction: Annotated[tuple[str, ...], listed("LAW,...")] = ("viscous", "stribeck", "offset")
    """Friction laws to estimate, as for forcegp identify."""
    cutoff: Annotated[str, arg(metavar="HZ|auto|none")] = "auto"
    """Low-pass filter of a raw log. auto: the one that predicts held-out torques best."""
    delay: Annotated[str, arg(metavar="S|auto|each")] = "auto"
    """Delay of u in the log, in s."""
    out: Annotated[Path | None, unless_given("FOLDER", "nothing is written", Path)] = None
    """Write payload.json, loaded.urdf (the robot with the payload) and system.json (for --identified) into it."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Prepare, estimate, write and show."""
        self.require_free(self.out)
        laws = friction_laws(self.friction)
        notes: list[str] = []
        system, rows = self._rows(terminal, self.data, notes)
        baseline = None if self.baseline is None else self._rows(terminal, self.baseline, notes)[1]
        with terminal.progress("identifying", may_end_early=True) as report:
            how: dict[str, Any] = {"link": self.link, "friction": laws, "progress": rounds_reported(report)}
            found = forcegp.analytical.identify_payload(rows, system, baseline=baseline, **how)
        content = {"data": str(self.data), **found.to_dict()}
        if self.out is not None:
            given = {"command": self.words("baseline", "link", "friction", "cutoff", "delay")}
            with self.folder(self.out, {"data": str(self.data), **given}) as folder:
                write_json(folder / "payload.json", content)
                found.system.to_urdf(folder / "loaded.urdf")
                write_text(folder / SYSTEM_FILE, found.system.to_json() + "\n")
        for note in notes:
            terminal.note(note)
        if not found.fit.settled:
            terminal.warn("the search did not converge: take the numbers with care, and record more or faster motion.")
        if found.intervals["mass"][0] <= 0.0:
            terminal.warn("the payload may weigh nothing by this log: centre of mass and inertia mean nothing then.")
        terminal.show(*_tables(found))
        return content

    def _rows(
        self, terminal: Terminal, path: Path, notes: list[str]
    ) -> tuple[forcegp.MechanicalSystem, forcegp.Dataset]:
        """The robot, and rows behind the filter; those of a dataset that was prepared before are as they are."""
        dataset = forcegp.Dataset.load(path)
        system = self.chosen_system(dataset, path)
        if forcegp.data.preparation_report(dataset.metadata):
            return system, dataset
        with terminal.progress(f"preparing {path}"):
            raw = replace(dataset, system=system)
            prepared = self.with_delay_that_shows(terminal, self._preparation(), raw).apply(raw)
        why = prepared.report["why"]
        notes += [f"{path}: {name}: {why[name]}" for name in ("cutoff", "delay") if name in why]
        return system, prepared.dataset


def _tables(found: forcegp.analytical.PayloadEstimate) -> list[Any]:
    rows = []
    for name, (label, unit, factor) in LABELS.items():
        low, high = (factor * end for end in found.intervals[name])
        error = factor * found.standard_errors[name]
        rows.append([label, f"{factor * found.values[name]:.4g}", f"{error:.2g}", f"{low:.4g} … {high:.4g}", unit])
    title = f"payload in the frame of {found.link}, beside {'the baseline' if found.baseline else 'the URDF'}"
    tables: list[Any] = [columns(title, ["", "", "std. error", "95 % interval", ""], rows)]
    joints = list(dict.fromkeys(name.partition(".")[2] for name in found.joints))
    fields = list(dict.fromkeys(name.partition(".")[0] for name in found.joints))
    each = [[found.joints[f"{field}.{joint}"] for field in fields] for joint in joints]
    rows = [[joint, *(f"{x:.3g} ± {e:.2g}" for x, e in row)] for joint, row in zip(joints, each, strict=True)]
    header = ["joint", *(field.replace("_", "\n") for field in fields)]
    slides = any(found.system.robot.joint(joint).type == "prismatic" for joint in joints)
    units = "Nm or N, rad/s or m/s and kg m² or kg" if slides else "Nm, rad/s and kg m²"
    tables += [columns(f"joints, in {units}", header, rows)] if rows else []
    return [*tables, f"{found.rows} rows."]
