"""`forcegp payload`: mass, centre of mass and inertia of what a robot holds, from its log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import forcegp
import forcegp.data
import forcegp.posterior
import forcegp.scores
from forcegp.atomic_files import write_json
from forcegp.cli.command import DATASET, FIELDS, Command, listed, unless_given
from forcegp.cli.fit import estimates_table, write_estimates
from forcegp.cli.log_options import FilterOptions, with_delay_that_shows
from forcegp.cli.robot_options import RobotOptions, forces_of
from forcegp.cli.terminal import Terminal

WINDOW = 0.4
"""Seconds that torques are averaged over: it takes noise of the acceleration, and leaves friction as sharp as it is."""
DRY = "stribeck"
LAWS = "viscous", DRY, "offset", "rotor"


@dataclass(frozen=True, kw_only=True)
class Payload(Command):
    """Estimate mass, centre of mass and inertia of a payload, together with friction and rotors.

    It is `forcegp fit --forces payload:LINK,... --evidence torques:mean=.4` on a log that is filtered first: a motion
    of 20 s or more that turns every joint in both directions, without contact but for feet that stand. Without
    --baseline, errors of the URDF's links count as payload. With one, the links are estimated from both logs.

    For example:
      forcegp payload loaded.h5 --robot arm.urdf
      forcegp payload loaded.h5 --baseline empty.h5 --link tool0 --out payload
    """

    log: Annotated[Positional[Path], DATASET, arg(metavar="LOG")]
    """The log with the payload (a dataset, raw or prepared)."""
    baseline: Annotated[Path | None, DATASET, unless_given("LOG", "the URDF", Path)] = None
    """A log of the same robot without the payload."""
    link: Annotated[str | None, unless_given("LINK", "the hand or the base that explains most", str)] = None
    """The link that carries the payload; results are in its frame."""
    forces: Annotated[tuple[str, ...], listed(goes_on=FIELDS), arg(metavar="FORCE,...")] = LAWS
    """What is estimated beside it, as for forcegp fit."""
    out: Annotated[Path | None, unless_given("FOLDER", "nothing is written", Path)] = None
    """Write payload.json, loaded.urdf (the robot with the payload) and system.json (for --identified) into it."""
    robot: RobotOptions = RobotOptions()
    filter: FilterOptions = FilterOptions(cutoff="auto", delay="auto")

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Prepare, estimate, write and show."""
        self.require_free(self.out)
        notes: list[str] = []
        model, rows = self._rows(terminal, self.log, notes)
        baseline = None if self.baseline is None else self._rows(terminal, self.baseline, notes)[1]
        notes += forces_of(model)
        words = [word for word in self.forces if word != "none"]
        model = forcegp.scores.named_model(model, words)
        with terminal.progress("identifying") as report:
            found = with_payload(model, rows, self.link, baseline, report)
        content = {"data": str(self.log), **payload_dict(found, baseline is not None)}
        if self.out is not None:
            given = {"command": self.words("baseline", "link", "forces", "cutoff", "delay")}
            with self.folder(self.out, {"data": str(self.log), **given}) as folder:
                write_json(folder / "payload.json", content)
                write_estimates(folder, found, "loaded")
        for note in notes:
            terminal.note(note)
        if not found.estimates.settled:
            terminal.warn("the search did not converge: take the numbers with care, and record more or faster motion.")
        if found.estimates["payload.mass"].interval[0] <= 0.0:
            terminal.warn("the payload may weigh nothing by this log: centre of mass and inertia mean nothing then.")
        beside = "the URDF" if baseline is None else "the baseline"
        title = f"payload in the frame of {content['link']}, beside {beside}; {found.estimates.rows} rows"
        own = {name: each for name, each in found.estimates.items() if name.startswith("payload.")}
        others = {name: each for name, each in found.estimates.items() if name not in own and baseline is None}
        tables = [estimates_table("joints", others)] if others else []
        terminal.show(estimates_table(title, own), *tables)
        return content

    def _rows(self, terminal: Terminal, path: Path, notes: list[str]) -> tuple[forcegp.Model, forcegp.Dataset]:
        """The robot, and rows behind the filter; those of a dataset that was prepared before are as they are."""
        dataset = forcegp.Dataset.load(path)
        model = self.robot.chosen_model(dataset, path)
        if forcegp.data.preparation_report(dataset.metadata):
            return model, dataset
        with terminal.progress(f"preparing {path}"):
            raw = replace(dataset, model=model)
            prepared = with_delay_that_shows(terminal, self.filter.preparation(), raw).apply(raw)
        why = forcegp.data.preparation_report(prepared.metadata)["why"]
        notes += [f"{path}: {name}: {why[name]}" for name in ("cutoff", "delay") if name in why]
        return model, prepared


def with_payload(
    model: forcegp.Model,
    rows: forcegp.Dataset,
    link: str | None,
    baseline: forcegp.Dataset | None = None,
    report: Any = None,
) -> Any:
    """The posterior of a model that carries something; with a baseline the links are estimated, too."""
    bodies = () if baseline is None else (forcegp.RigidBodies("all"),)
    noisy = "u" if model.robot.space.is_vector_space else "both"
    evidence = (forcegp.Torques(noisy, mean=WINDOW),)
    loaded = model.with_forces(*bodies, forcegp.Payload(link))
    return forcegp.scores.learn(loaded, rows, evidence, baseline=baseline, report=report)[0]


def payload_dict(found: Any, baseline: bool) -> dict[str, Any]:
    """Payload and other numbers as plain JSON values, with the link that carries it."""
    [payload] = [law for law in found.model.laws if isinstance(law, forcegp.Payload)]
    return {"link": payload.link, "baseline": baseline, **found.estimates.to_dict()}
