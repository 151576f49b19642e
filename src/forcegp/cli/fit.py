"""`forcegp fit` and `payload`: find what a model leaves open, from a log."""

from __future__ import annotations

import math
import re
import shlex
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import forcegp
import forcegp.checks
import forcegp.data
import forcegp.evidence
import forcegp.mechanics
import forcegp.parallel
import forcegp.posterior
import forcegp.robots
import forcegp.scores
from forcegp.atomic_files import file_digest, write_json, write_text
from forcegp.cli import command, robot_options
from forcegp.cli.command import DATASET, FIELDS, NUMBERS, Command, listed, options_of, unless_given
from forcegp.cli.terminal import Terminal, columns, facts, with_option_names
from forcegp.doubts import Doubts
from forcegp.errors import ContactError, ContactWarning, DatasetError

NEARLY_ALL = 0.995
"""Share of rows in contact from which on the contacts count as closed all the time (impacts and noise take a few)."""
HARDLY_ANY = 0.2  # share below which something is wrong with the contact, rather than the tool in the air
USUAL_FORCES = "gp:joint-friction, in contact gp:tool-friction, in flight gp:aerodynamic"
LEARNED_FROM = "accelerations with gp:, else torques, of a base that moves torques:both"
SHOWN = {"m": ("mm", 1e3), "kg m^2": ("kg m²", 1.0)}
"""Units of files, and those that people read, with the factor between them."""


@dataclass(frozen=True, kw_only=True)
class Fit(Command):
    """Find what a model leaves open, from a log: coefficients of laws, bodies and payloads, and unknown forces.

    The dataset carries its robot, contacts and forces; --robot, --contact and --forces replace or add to them. The
    folder holds the model, its estimates, and of a model without gp: also identified.urdf.

    For example:
      forcegp fit train.h5 --points 100 --out run
      forcegp fit log.h5 --forces bodies,viscous,coulomb,offset,rotor --out identified
      forcegp fit log.h5 --forces viscous,coulomb,rotor --evidence torques,motions:1 --out refined
      forcegp fit log.h5 --identified identified --forces gp:joint-friction --out run
      forcegp fit train.h5 --forces gp:independent --points 100 --out baseline
    """

    log: Annotated[Positional[Path], DATASET, arg(metavar="LOG")]
    """The dataset to learn from (HDF5)."""
    out: Annotated[Path, arg(metavar="FOLDER")]
    """The folder to write."""
    forces: Annotated[tuple[str, ...], listed(goes_on=FIELDS), unless_given("FORCE,...", USUAL_FORCES)] = ()
    """What is found, beside the forces that the model has. Laws: viscous, coulomb, rotor, offset, spring,
    payload:LINK, bodies; their numbers are estimated unless they are given, as in viscous:.1. Unknown forces: gp:joint,
    gp:joint-friction, gp:tool-friction, and others. With "only" as the first word the list is complete.
    gp:independent is without physics, none the noise alone. See docs/how-to/forces.md."""
    evidence: Annotated[tuple[str, ...], listed(), unless_given("EVIDENCE,...", LEARNED_FROM)] = ()
    """What is learned from: accelerations or torques (torques:both where accelerations are noisy, too, torques:mean=.4
    of means). Beside it motions:S refines the numbers on recorded positions, over windows of S seconds."""
    contact: Annotated[
        tuple[str, ...], listed(goes_on=NUMBERS), unless_given(robot_options.CONTACTS, "the dataset's")
    ] = ()
    """Points that stay on surfaces, instead of the dataset's contacts; m, in the axes of the link FRAME. SURFACE is
    plane:nx,ny,nz,offset or sphere:cx,cy,cz,radius; FRAME@x,y,z:held is bolted down. none: no contact."""
    noise: Annotated[str, arg(metavar="learned|dataset|SIGMA")] = "dataset"
    """Noise of the measured acceleration: a standard deviation in rad/s², learned, or the dataset's (else learned)."""
    force_noise: Annotated[float | None, unless_given("SIGMA", "none", float)] = None
    """Noise of the joint forces as well: a standard deviation in Nm, where the search begins with --noise learned."""
    engine: Literal["auto", "exact", "inducing"] = "auto"
    """How the posterior is computed. exact: from the covariance of all points. inducing: through fewer points. auto: by
    their number, the features and the free memory, with the reason. See docs/how-to/large-data.md."""
    checks: Annotated[bool, arg(help_behavior_hint="")] = True
    """Do not look for wrong units, signs, joints, contacts, masses and drop-outs first, as forcegp check does."""
    device: Annotated[str, arg(metavar="cpu|cuda|cuda:K")] = "cpu"
    """Where to compute; see docs/how-to/gpu.md. The folder that is written can be used on any machine."""
    logs_from: Annotated[Path | None, unless_given("LIST", "one log", Path)] = None
    """In the place of LOG a text file with one in each line, and the options that differ for it, such as --robot.
    --out gets a folder for each and fleet.csv; --jobs logs are at work at once. What is finished is kept."""
    robot: robot_options.RobotOptions = robot_options.RobotOptions()
    search: robot_options.SearchOptions = robot_options.SearchOptions()

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Fit, save and show."""
        self.require_free(self.out)
        forcegp.parallel.checked_jobs(self.search.jobs)  # refused now, not after the data are read
        noise = self._noise()
        forcegp.robots.usable_device(self.device)
        evidence = forcegp.evidence.parse_evidence(self.evidence) if self.evidence else ()
        start, notes, dataset = time.monotonic(), [], forcegp.Dataset.load(self.log)
        contacts, given = robot_options.parse_contacts(self.contact), self.robot.chosen_model(dataset, self.log)
        given = given.with_contacts(contacts) if self.contact else given
        self._check(terminal, dataset, given)
        recording = dataset
        dataset, note = self._rows(dataset, given)
        notes += [] if note is None else [note]
        words = self.forces
        if not words:
            usual = forcegp.scores.usual_forces(given)
            words = forcegp.scores.summands(usual)
            notes.append(f"forces: {usual}, the usual ones; forcegp score compares others")
        model = forcegp.scores.named_model(given, words, noise).to(self.device)
        with terminal.progress("fitting"):
            posterior, found = forcegp.scores.learn(
                model, dataset, evidence, recording=recording, **vars(self.search), engine=self.engine
            )
        summary = fit_summary(posterior, time.monotonic() - start)
        tables = fit_report(self.out, posterior, summary)
        self._write(posterior)
        for note in [*robot_options.forces_of(given), *notes, *found]:
            terminal.note(note)
        for doubt in forcegp.scores.unfinished_search(posterior):
            terminal.warn(str(doubt))
        terminal.show(*tables)
        return {"run": str(self.out), "data": str(self.log), **summary, "settings": dict(posterior.settings)}

    def _noise(self) -> forcegp.Noise | None:
        """The noise that the options ask for; None where the dataset states it. Raises InvalidInput."""
        if self.noise == "dataset" and self.force_noise is None:
            return None
        level = None
        if self.noise not in ("learned", "dataset"):
            complaint = f"--noise is {self.noise!r}; give learned, dataset or a number such as 0.1."
            [level] = command.numbers_of(self.noise, complaint, one=True)
        return forcegp.Noise(level, self.force_noise, learn=self.noise == "learned")

    def _check(self, terminal: Terminal, dataset: forcegp.Dataset, model: forcegp.Model) -> None:
        """One line on what would spoil the model; contacts are not warned of again by the fit."""
        if self.checks:
            used = quick_doubts(self.log, dataset, model)
            if used:  # check has no --contact: it would find nothing wrong with the contacts of the data
                words = self.words(*options_of(robot_options.RobotOptions))
                see = f"See {shlex.join(['forcegp', 'check', str(self.log), *words])}"
                see = used[0].advice.rstrip(".") if self.contact else see
                terminal.warn(f"{used.in_one_line()}. {see} (--no-checks does not look)")
        warnings.simplefilter("ignore", ContactWarning)

    def _rows(self, dataset: forcegp.Dataset, model: forcegp.Model) -> tuple[forcegp.Dataset, str | None]:
        """The rows in which all contacts act where the tool leaves a surface at times, and a note for after the fit."""
        if all(isinstance(contact.surface, forcegp.mechanics.Held) for contact in model.contacts):
            return dataset, None  # what is bolted down never leaves
        try:
            touching = forcegp.data.rows_in_contact(replace(dataset, model=model))
        except ContactError:
            return dataset, None  # the fit raises a clearer error
        share = len(touching) / len(dataset)
        if share >= NEARLY_ALL:
            return dataset, None
        text = f"{len(touching)} of {len(dataset)} rows move as a contact demands ({share:.1%})"
        if share < HARDLY_ANY:
            return dataset, f"{text}; all were learned from. Check the contact."
        return replace(touching, model=dataset.model), f"{text}; these alone were learned from"

    def _write(self, posterior: forcegp.posterior.Posterior) -> None:
        """The model, how it was made and what was estimated; what is known also as a robot's file."""
        given = {name: x for name, x in command.values_of(self).items() if name not in ("json", "debug", "overwrite")}
        options = {name: str(x) if isinstance(x, Path) else x for name, x in given.items()}
        data = {"path": str(self.log), "sha256": file_digest(self.log)}
        content = {"options": options, "data": data, "resolved": dict(posterior.settings)}
        with self.folder(self.out, content) as folder:
            forcegp.save_posterior(posterior, folder)
            if posterior.estimates:
                write_estimates(folder, posterior)


def quick_doubts(log: Path, dataset: forcegp.Dataset, model: forcegp.Model) -> Doubts:
    """What would spoil a fit. Raises DatasetError for a motion that needs torques, of which none was measured."""
    used = forcegp.checks.quick_check(dataset, model)
    for doubt in () if dataset.u.any() else used.of("constant channel").at("wrong"):
        raise DatasetError(f"{log}: {doubt.what} Masses and friction do not show; give the columns of the torques.")
    return used


def warn_of_wrong(terminal: Terminal, log: Path, dataset: forcegp.Dataset, model: forcegp.Model) -> None:
    """One line on what would spoil what is made of the log."""
    if used := quick_doubts(log, dataset, model).at("wrong"):
        terminal.warn(f"{log}: {used.in_one_line()}. See forcegp check.")


def write_estimates(folder: Path, posterior: Any, name: str = "identified") -> None:
    """The numbers that were found, and robot and known forces with them: for --identified, and as a URDF."""
    estimates, known = posterior.estimates, robot_options.identified_system(posterior.model)
    write_json(folder / "estimates.json", estimates.to_dict())
    write_text(folder / robot_options.SYSTEM_FILE, known.to_json() + "\n")
    known.to_urdf(folder / f"{name}.urdf")


def fit_summary(posterior: forcegp.posterior.Posterior, wall_seconds: float) -> dict[str, Any]:
    """What a fit came to, as plain values. `objective` is what the search lowered, `nll` the likelihood alone."""
    result, settings, unknown = posterior.result, posterior.settings, posterior.model.unknown_forces
    force_noise = posterior.hyperparameters.get("noise.log_force")
    looked = not {"air", "observe"} & set(settings) and not posterior.model.held_inputs
    return {
        "model": posterior.description, "points": len(posterior.training),
        "learning_points": settings.get("learning_points", len(posterior.training)),
        "objective_is": "negative log likelihood with hyperpriors [nats]", "objective": result.value,
        "nll": posterior.negative_log_likelihood if posterior.engine.name == "exact" else None,
        "iterations": len(result.history) - 1, "converged": result.converged, "status": result.status,
        "noise_std": posterior.noise_std.tolist(),
        "force_noise_std": None if force_noise is None else force_noise.exp().tolist(),
        "wind": settings.get("air", {}).get("wind"),
        "wind_not_found": looked and any(getattr(each, "observe", 0.0) != 0.0 for each in unknown),
        "estimates": posterior.estimates.to_dict()["parameters"], "cpu_seconds": result.cpu_seconds,
        "wall_seconds": wall_seconds,
    }  # fmt: skip


def fit_report(run: Path, posterior: Any, found: Mapping[str, Any]) -> list[Any]:
    """What was learned from what, and the numbers that were estimated."""
    settings, learned, air = posterior.settings, found["learning_points"], found["wind"]
    starts = f"; {settings['restarts']} starts" if "restarts" in settings else ""
    fewer = "" if learned == found["points"] else f" (parameters: from {learned} of them{starts})"
    told = with_option_names(found["status"], ("iterations",))
    values = {
        "engine": settings.get("engine_reason"),
        "negative log likelihood": None if found["nll"] is None else f"{found['nll']:.1f} nats",
        "search": f"{found['iterations']} iterations; {'' if found['converged'] else 'not converged: '}{told}",
        "noise std": _per_joint(found["noise_std"]),
        "noise std of forces": found["force_noise_std"] and _per_joint(found["force_noise_std"]),
        "wind of these rows": None if air is None else f"{air[0]:.1f} m/s along x, {air[1]:.1f} m/s along y",
        "time": f"{found['cpu_seconds']:.1f} s CPU for the search, {found['wall_seconds']:.1f} s in all",
    }
    if found["wind_not_found"]:
        values["wind of these rows"] = "not found; learned as still air"
    title = f"{run}: {found['model']}, learned from {found['points']} points{fewer}"
    shown: list[Any] = [facts(title, {name: text for name, text in values.items() if text is not None})]
    if posterior.estimates:
        shown.append(estimates_table("estimates", posterior.estimates))
    if bodies := posterior.estimates.by_body:
        weak = ", ".join(f"{name} ({number} of 10)" for name, number in bodies.items())
        shown.append(f"Directions of single bodies that the prior decides: {weak}.")
    if thick := posterior.estimates.thickened:
        shown.append(f"Links that were lines, plates or points got some thickness: {', '.join(thick)}.")
    if motions := settings.get("motions"):
        units = ["mm" if joint.type == "prismatic" else "mrad" for joint in posterior.model.robot.joints]
        error = ", ".join(f"{1e3 * rms:.3g} {unit}" for rms, unit in zip(motions["rms"], units, strict=False))
        told = f"{motions['windows']} windows of {motions['seconds']:g} s, whose initial states are estimated, too"
        shown.append(f"{told}; rms of q by joint: {error}.")
    return [*shown, f"Next: forcegp score {run} TEST.h5"]


def _per_joint(values: list[float]) -> str:
    return f"{values[0]:.4g}" if len(set(values)) == 1 else " ".join(f"{value:.3g}" for value in values)


def estimates_table(title: str, estimates: Mapping[str, forcegp.posterior.Estimate]) -> Any:
    """Start, value, 95 % interval and what decides it, below the law or body that has them."""
    rows, owner = [], None
    for name, each in estimates.items():
        unit, factor = SHOWN.get(each.unit, (each.unit, 1.0))
        low, high = (factor * end for end in each.interval)
        # decimals that show two digits of the interval, and four of the value where there is none
        size = factor * each.std if 0.0 < each.std < math.inf else 1e-3 * abs(factor * each.value)
        digits = max(0, 1 - math.floor(math.log10(size))) if size > 0.0 else 4
        show = (f"{{:.{digits}f}}" if digits < 10 else "{:.2g}").format
        # law or body, and number: viscous and elbow, tool0 and center_of_mass.x
        split = re.fullmatch(r"(.*?)\.((?:mass|center_of_mass|inertia).*)", name)
        of, _, part = (split[1], "", split[2]) if split else name.partition(".")
        rows += [[of]] if of != owner else []
        owner = of
        numbers = show(factor * each.start), show(factor * each.value), f"{show(low)} … {show(high)}"
        rows.append([f"  {part}", *numbers, "" if unit == "1" else unit, each.decided_by])
    return columns(title, ["parameter", "start", "estimate", "95 % interval", "unit", "decided\nby the"], rows)
