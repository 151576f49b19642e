"""`forcegp payload`: what the robot carries, and the gains of its drives from a load that was weighed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import forcegp
import forcegp.data
import forcegp.evidence
import forcegp.forces
import forcegp.posterior
import forcegp.scores
from forcegp.atomic_files import write_json, write_text
from forcegp.cli.command import DATASET, FIELDS, Command, listed, unless_given
from forcegp.cli.fit import estimates_table, warn_of_wrong, write_estimates
from forcegp.cli.logs import FilterOptions
from forcegp.cli.robot_options import SYSTEM_FILE, RobotOptions, forces_of
from forcegp.cli.terminal import Terminal
from forcegp.doubts import Doubts
from forcegp.errors import LARGEST, InvalidInput, require_number
from forcegp.summary import in_digits

WINDOW = 0.4
"""Seconds that torques are averaged over: it takes noise of the acceleration, and leaves friction as sharp as it is."""
WIDER = 2.3  # where a base moves, times the windows of a fit: a mass needs less of what is fast than rotors do
LAWS = "viscous", "gear", "offset", "rotor"
AT_REST = "offset", "coulomb:memory=true:sigma=1000"  # what a drive stopped against, it still bears
SURE, LEAST_PAYLOAD = 4.0, 0.02  # standard errors from zero, and kg, from which a payload is reported
MOST_OPEN = 0.3  # of the robot's mass in half an interval, from which on a payload is not known
FAR, OPEN = 0.01, 1.0  # m of half an interval, from which on a coordinate of a centre is shown with it; is not known
MOST_FACTORS = 3  # of one cause that a person can look for
SETTLED, MOST_ROWS = 0.005, 2_000  # share of a torque that needs no other cause, and rows that tell it
ROBOTS_OWN = ("lengths", "masses", "centres of mass")  # of which bodies that are identified explain several as well


@dataclass(frozen=True, kw_only=True)
class Payload(Command):
    """Estimate mass, centre of mass and inertia of a payload, together with friction and rotors.

    It is `forcegp fit --forces payload:LINK,... --evidence torques:mean=.4` on a log that is filtered first: a motion
    of 20 s or more that turns every joint in both directions, without contact but for feet that stand. Without
    --baseline, errors of the URDF's links count as payload. With one, the links are estimated from both logs. With
    --mass, a known load calibrates the gains of the drives, which --identified then takes for other loads.

    For example:
      forcegp payload loaded.h5 --robot arm.urdf
      forcegp payload loaded.h5 --baseline empty.h5 --link tool0 --out payload
      forcegp payload known.h5 --robot arm.urdf --mass 2.8 --out calibrated
      forcegp payload other.h5 --identified calibrated
    """

    log: Annotated[Positional[Path], DATASET, arg(metavar="LOG")]
    """The log with the payload (a dataset, raw or prepared)."""
    baseline: Annotated[Path | None, DATASET, unless_given("LOG", "the URDF", Path)] = None
    """A log of the same robot without the payload."""
    link: Annotated[str | None, unless_given("LINK", "a base that moves, else the last link", str)] = None
    """The link that carries the payload; results are in its frame."""
    mass: Annotated[float | None, unless_given("KG", "estimated", float)] = None
    """The mass of the payload, if it was weighed: gains of the drives (`gain`) are estimated from it."""
    forces: Annotated[tuple[str, ...], listed(goes_on=FIELDS), arg(metavar="FORCE,...")] = LAWS
    """What is estimated beside it, as for forcegp fit; gain for factors of u, which is then in any unit."""
    out: Annotated[Path | None, unless_given("FOLDER", "nothing is written", Path)] = None
    """Write payload.json, loaded.urdf (the robot with the payload) and system.json (for --identified) into it."""
    robot: RobotOptions = RobotOptions()
    filter: FilterOptions = FilterOptions(cutoff="auto", delay="auto")

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Prepare, estimate, write and show."""
        self.require_free(self.out)
        if self.mass is not None:
            require_number("--mass", self.mass, f"give kg, above 0 and below {LARGEST:g}", below=LARGEST)
        logs = [(path, forcegp.Dataset.load(path)) for path in (self.log, self.baseline) if path is not None]
        robots = [self.robot.chosen_model(dataset, path) for path, dataset in logs]
        words = ["gain"] * (self.mass is not None and "gain" not in self.forces)
        model = forcegp.scores.named_model(robots[0], [*words, *(word for word in self.forces if word != "none")])
        if model.unknown_forces:
            raise InvalidInput(
                f"--forces is {','.join(self.forces)}, with unknown functions, which would hide a payload; name laws "
                "alone, such as viscous,gear,offset,rotor."
            )
        if model.actuation.learned and self.baseline is not None and self.mass is None:
            seen = "gains and all masses are unknown, so only their products are known"
            raise InvalidInput(f"{seen}; give --mass of the payload, or leave the baseline or the gains out.")
        if self.link is not None:
            model.robot.frame(self.link)
        preparation, notes, prepared = self.filter.preparation(), list[str](), list[forcegp.Dataset]()
        for (path, dataset), robot in zip(logs, robots, strict=True):
            warn_of_wrong(terminal, path, dataset, robot)
            if not forcegp.data.preparation_report(dataset.metadata):  # those that were prepared before are as they are
                with terminal.progress(f"preparing {path}"):
                    dataset = preparation.apply(replace(dataset, model=robot))
                why = forcegp.data.preparation_report(dataset.metadata)["why"]
                notes += [f"{path}: {name}: {why[name]}" for name in ("cutoff", "delay") if name in why]
            prepared.append(dataset)
        rows, baseline = prepared[0], prepared[-1] if self.baseline is not None else None
        notes += forces_of(robots[0])
        if self.forces == LAWS and forcegp.data.views.at_rest(rows):
            model = forcegp.scores.named_model(robots[0], [*words, *AT_REST])
            notes.append(
                "the log is of postures alone: each rest bears friction as the move from the rest before left it"
            )
        with terminal.progress("identifying"):
            found = with_payload(model, rows, self.link, baseline, self.mass)
        content = {"data": str(self.log), **payload_dict(found, baseline is not None)}
        if self.out is not None:
            given = {"command": self.words("baseline", "link", "forces", "cutoff", "delay")}
            with self.folder(self.out, {"data": str(self.log), **given}) as folder:
                write_json(folder / "payload.json", content)
                write_estimates(folder, found, "loaded")
                if self.mass is not None:
                    write_text(folder / SYSTEM_FILE, calibrated(found).to_json() + "\n")
        known, sensors = "torques of the log", forcegp.JointTorques()
        if model.actuation.learned and not sensors.names(rows):
            known = "masses of the URDF"
        if self.mass is not None:
            known = f"{known} and the payload's mass" if baseline is None else "payload's mass"
        notes.append(f"numbers are as right as the {known}: a factor of these is one of all masses")
        content["conditional_on"] = known
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
        terminal.show(estimates_table(title, own), *([estimates_table("joints", others)] if others else []))
        return content


def with_payload(
    model: forcegp.Model,
    rows: forcegp.Dataset,
    link: str | None,
    baseline: forcegp.Dataset | None = None,
    mass: float | None = None,
) -> Any:
    """The posterior of a model that carries something, of this `mass`; with a baseline links are estimated, too."""
    from forcegp.fit.sensors import usual_evidence  # PyTorch is not needed for a page of help

    bodies = () if baseline is None else (forcegp.RigidBodies("all"),)
    loaded = model.with_forces(*bodies, forcegp.Payload(link, mass, None))
    torques: Any
    torques, *sensors = usual_evidence(loaded, rows)
    evidence = (replace(torques, mean=round(WIDER * torques.mean, 4) if torques.mean else WINDOW), *sensors)
    return forcegp.scores.learn(loaded, rows, evidence, baseline=baseline)[0]


def calibrated(found: Any) -> forcegp.Model:
    """The robot without payload, with gains as they were found: priors of the fits to come."""
    estimates, robot = found.estimates, found.model.robot
    gains = [estimates.get(f"gain.{joint}") for joint in robot.joint_names]
    median = [1.0 if each is None else each.value for each in gains]
    spread = [0.0 if each is None else each.std / each.value for each in gains]
    actuation = replace(found.model.actuation, gain=forcegp.LogNormal(median, spread))
    return replace(found.model.known, forces=(actuation, forcegp.RigidBodies()))


def payload_dict(found: Any, baseline: bool) -> dict[str, Any]:
    """Payload and other numbers as plain JSON values, with the link that carries it."""
    [payload] = [law for law in found.model.laws if isinstance(law, forcegp.Payload)]
    return {"link": payload.link, "baseline": baseline, "doubts": found.settings["doubts"], **found.estimates.to_dict()}


def without_explained(doubts: Doubts, found: Any, rows: forcegp.Dataset) -> Doubts:
    """Without factors of joints of which a payload, that was not known before, leaves next to nothing."""
    mass, some = found.estimates["payload.mass"], rows.rows(slice(None, None, max(1, len(rows) // MOST_ROWS)))
    if mass.value < max(SURE * mass.std, LEAST_PAYLOAD):
        return doubts
    q, v, u, _ = forcegp.data.tensors(forcegp.data.with_memory(some, found.model))
    size = found.model.state(q, v, u).delivered.var(0).clip(1e-300).numpy()
    left = forcegp.evidence.motion_residuals(some, found.model)[0].var(axis=0) / size
    settled = {name for name, share in zip(rows.joint_names, left, strict=True) if share < SETTLED}
    hidden = [
        x
        for x in doubts.of("torque constant", "masses", "offset")
        if x.level == "look" and settled.issuperset(x.joints)
    ]
    return Doubts(doubt for doubt in doubts if doubt not in hidden)


def payload_text(found: Any) -> str:
    """Mass with its 95 % interval and place; or that there is none."""
    parts = {name: found.estimates[f"payload.{name}"] for name in ("mass", *(f"center_of_mass.{x}" for x in "xyz"))}
    mass, *center = parts.values()
    error, *widths = (0.5 * (each.interval[1] - each.interval[0]) for each in parts.values())
    size = f"{in_digits(mass.value, 2)} ± {in_digits(error, 1)} kg"
    if error > MOST_OPEN * found.model.robot.mass:
        return f"not known from this log ({size})"
    if mass.value < max(SURE * mass.std, LEAST_PAYLOAD):
        most = in_digits(max(mass.value + error, 0.0), 2)
        return f"none, or {size}" if mass.value > mass.std else f"none, or at most {most} kg"
    both = [(round(1e3 * x.value), width) for x, width in zip(center, widths, strict=True)]
    place = ", ".join("?" if width > OPEN else f"{x}" + f" ± {1e3 * width:.0f}" * (width > FAR) for x, width in both)
    [held] = [law for law in found.model.laws if isinstance(law, forcegp.Payload)]
    links = f"if the URDF's links{' and ' * bool(drives := drives_of(found.model))}{drives} are right"
    return f"{mass.value:.3g} ± {in_digits(error, 1)} kg at ({place}) mm of {held.link}, {links}"


def drives_of(model: forcegp.Model) -> str:
    """What the masses of a base that moves are as right as."""
    thrusters = forcegp.data.thruster_columns(model)
    return "" if model.robot.base == "fixed" else "thrust coefficients" if thrusters else "torques"


def other_causes(payload: Mapping[str, Any]) -> dict[str, str]:
    """What would explain more than this payload, by cause; beside none, what one link, drives or encoders do."""
    mass = payload.get("parameters", {}).get("payload.mass", {"value": 1.0, "std": 0.0})
    doubts = [each for each in payload.get("doubts", ()) if each["about"] == "payload"]
    causes = ((cause, len(own), f"{x['what']} {x['do']}") for x in doubts for cause, own in x["numbers"].items())
    return {
        cause: what
        for cause, factors, what in causes
        if factors <= (MOST_FACTORS if mass["value"] > mass["std"] or cause not in ROBOTS_OWN else 1)
    }
