"""`forcegp fit`: find what a model leaves open, from a log, and write the model to a folder."""

from __future__ import annotations

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
import forcegp.parallel
import forcegp.posterior
import forcegp.robots
import forcegp.scores
from forcegp.atomic_files import file_digest, write_json, write_text
from forcegp.cli.command import DATASET, FIELDS, NUMBERS, Overwriting, listed, numbers_of, unless_given
from forcegp.cli.contact_syntax import CONTACTS, parse_contacts
from forcegp.cli.estimates import estimates_table, what_is_open
from forcegp.cli.input_options import ROBOT_OPTIONS, SYSTEM_FILE, RobotOptions, forces_of, identified_system
from forcegp.cli.terminal import Terminal, facts, with_option_names
from forcegp.doubts import Doubts
from forcegp.errors import ContactError, ContactWarning, InvalidInput

NEARLY_ALL = 0.995
"""Share of rows in contact from which on the contacts count as closed all the time (impacts and noise take a few)."""
HARDLY_ANY = 0.2
"""Share below which something is wrong with the contact, rather than the tool in the air."""
USUAL_FORCES = "gp:joint-friction, in contact gp:tool-friction, in flight gp:aerodynamic"
LEARNED_FROM = "accelerations with gp:, else torques, of a base that moves torques:both"


@dataclass(frozen=True, kw_only=True)
class Fit(RobotOptions, Overwriting):
    """Find what a model leaves open, from a log: coefficients of laws, bodies and payloads, and unknown forces.

    The dataset carries its robot, contacts and forces; --robot, --contact and --forces replace or add to them. The
    folder holds the model, its estimates, and of a model without gp: also identified.urdf.

    For example:
      forcegp fit train.h5 --points 100 --out run
      forcegp fit log.h5 --forces bodies,viscous,coulomb,offset,rotor --out identified
      forcegp fit log.h5 --identified identified --forces gp:joint-friction --evidence accelerations,motions:1 --out run
      forcegp fit log.h5 --forces viscous,gp:joint-friction --robot arm.urdf --noise learned --out run
      forcegp fit train.h5 --forces gp:independent --points 100 --out baseline
      forcegp fit raw.h5 --forces gp:joint --evidence windows:.1 --points 100 --out run
    """

    data: Annotated[Positional[Path], DATASET, arg(metavar="LOG")]
    """The dataset to learn from (HDF5)."""
    out: Annotated[Path, arg(metavar="FOLDER")]
    """The folder to write."""
    forces: Annotated[tuple[str, ...], listed("FORCE,...", USUAL_FORCES, goes_on=FIELDS)] = ()
    """What is found, beside the forces that the model has. Laws: viscous, coulomb, rotor, offset, spring,
    payload:LINK, bodies; their numbers are estimated unless they are given, as in viscous:.1. Unknown forces: gp:joint,
    gp:joint-friction, gp:tool-friction, and others. With "only" as the first word the list is complete.
    gp:independent is without physics, none the noise alone. See docs/how-to/forces.md."""
    evidence: Annotated[tuple[str, ...], listed("EVIDENCE,...", LEARNED_FROM)] = ()
    """What is learned from: accelerations, torques (torques:both where accelerations are noisy, too, torques:mean=.4
    of means), or windows:S of raw positions, where nothing is differentiated. Beside it motions:S refines the
    numbers on recorded positions, over windows of S seconds."""
    baseline: Annotated[Path | None, DATASET, unless_given("LOG", "none", Path)] = None
    """A second log, of the same robot without the payloads that are estimated."""
    contact: Annotated[tuple[str, ...], listed(CONTACTS, "the dataset's", goes_on=NUMBERS)] = ()
    """Points that stay on surfaces, instead of the dataset's contacts; m, in the axes of the link FRAME.
    SURFACE is plane:nx,ny,nz,offset or sphere:cx,cy,cz,radius or cylinder:px,py,pz,ax,ay,az,radius.
    none is no contact at all."""
    noise: Annotated[str, arg(metavar="learned|dataset|SIGMA")] = "dataset"
    """Noise of the measured acceleration: a standard deviation in rad/s², learned, or as the dataset states it (learned
    where it does not)."""
    force_noise: Annotated[float | None, unless_given("SIGMA", "none", float)] = None
    """Noise of the joint forces as well: a standard deviation in Nm, where the search begins with --noise learned."""
    measured_torque: bool = False
    """u comes from sensors as noisy as --force-noise, and predictions account for it. Not for commanded torques."""
    points: Annotated[int | None, unless_given("N", "200; all for functions of one or two inputs", int)] = None
    """Learn unknown forces from N rows that lie farthest apart (all rows if there are fewer). Time grows with the cube
    of N as far as --engine is exact. Numbers of laws are found from all rows."""
    engine: Literal["auto", "exact", "inducing"] = "auto"
    """How the posterior is computed. exact: from the covariance of all points. inducing: through fewer points. auto: by
    their number, the features and the free memory, with the reason. See docs/how-to/large-data.md."""
    learning_points: Annotated[int | None, unless_given("N", "all points up to 1500, else 600", int)] = None
    """Find the hyper-parameters on N of the points; the posterior is that of all points."""
    iterations: Annotated[int, arg(metavar="N")] = 200
    """Most L-BFGS iterations of each start."""
    restarts: Annotated[int | None, unless_given("R", "4 up to 400 points, else 1")] = None
    """Starts of the search; the best is kept."""
    seed: Annotated[int, arg(metavar="K")] = 0
    """Draws the starts of the search after the first."""
    jobs: Annotated[int, arg(metavar="J")] = 1
    """Restarts at once, each on one core."""
    hyperprior: Annotated[bool, arg(help_behavior_hint="")] = True
    """Plain maximum likelihood, without the priors on kernels and learned noise that keep few points calibrated."""
    rows: Literal["auto", "in-contact", "all"] = "auto"
    """in-contact: learn from rows in which positions, velocities and accelerations show the contact to act. all: from
    every row. auto: in-contact where the tool leaves the surface at times, with a note."""
    checks: Annotated[bool, arg(help_behavior_hint="")] = True
    """Do not look for wrong units, signs, joints, contacts, masses and drop-outs first, as forcegp check does."""
    device: Annotated[str, arg(metavar="cpu|cuda|cuda:K")] = "cpu"
    """Where to compute; see docs/how-to/gpu.md. The folder that is written can be used on any machine."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Fit, save and show."""
        self.require_free(self.out)
        forcegp.parallel.checked_jobs(self.jobs)  # refused now, not after the data are read
        noise = self._noise()
        forcegp.robots.usable_device(self.device)
        evidence = forcegp.evidence.parse_evidence(self.evidence) if self.evidence else ()
        start, notes = time.monotonic(), []
        dataset = forcegp.Dataset.load(self.data)
        given = self._known(dataset)
        windows = any(isinstance(each, forcegp.evidence.Windows) for each in evidence)
        self._check(terminal, dataset, given, not windows)
        recording = dataset
        if self.rows != "auto" or not windows:  # raw accelerations show no contact
            dataset, note = self._rows(dataset, given)
            notes += [] if note is None else [note]
        words = self.forces
        if not words:
            usual = forcegp.scores.usual_forces(given)
            words = forcegp.scores.summands(usual)
            notes.append(f"forces: {usual}, the usual ones; forcegp score compares others")
        if windows and noise is None:  # no dataset states the noise of windows
            noise = forcegp.Noise(None, learn=True)
        model = forcegp.scores.named_model(given, words, noise).to(self.device)
        with terminal.progress("fitting") as report:
            posterior, found = forcegp.scores.learn(
                model,
                dataset,
                evidence,
                recording=recording,
                baseline=None if self.baseline is None else forcegp.Dataset.load(self.baseline),
                report=report,
                **{name: getattr(self, name) for name in SAME},
            )
        summary = fit_summary(posterior, time.monotonic() - start)
        tables = fit_report(self.out, posterior, summary)
        self._write(posterior)
        for note in [*forces_of(given), *notes, *found]:
            terminal.note(note)
        for doubt in forcegp.scores.unfinished_search(posterior):
            terminal.warn(str(doubt))
        terminal.show(*tables)
        return {"run": str(self.out), "data": str(self.data), **summary, "settings": dict(posterior.settings)}

    def _noise(self) -> forcegp.Noise | None:
        """The noise that the options ask for; None where the dataset states it. Raises InvalidInput."""
        if self.measured_torque and self.force_noise is None:
            raise InvalidInput("--measured-torque needs the noise of the torque sensors; add --force-noise SIGMA.")
        how = {"measured_torque": self.measured_torque}
        if self.noise == "learned":
            return forcegp.Noise(None, self.force_noise, learn=True, **how)
        if self.noise == "dataset":
            return None if self.force_noise is None else forcegp.Noise(None, self.force_noise, **how)
        complaint = f"--noise is {self.noise!r}; give learned, dataset or a number such as 0.1."
        return forcegp.Noise(numbers_of(self.noise, complaint, one=True)[0], self.force_noise, **how)

    def _known(self, dataset: forcegp.Dataset) -> forcegp.Model:
        """The dataset's own model, with the robot and contacts that the options give."""
        contacts = parse_contacts(self.contact)
        model = self.chosen_model(dataset, self.data)
        return model.with_contacts((*contacts, *model.loops)) if self.contact else model

    def _check(self, terminal: Terminal, dataset: forcegp.Dataset, model: forcegp.Model, accelerations: bool) -> None:
        """One line on what would spoil the model; contacts are not warned of again by the fit.

        Without `accelerations` nobody has measured `a`: nothing is compared with it.
        """
        if self.checks:
            # without a model it compares no torques; those of moving bases are never compared
            without = not (accelerations or model.robot.layout.groups)
            looked_at = (replace(dataset, model=None), None) if without else (dataset, model)
            found = forcegp.checks.quick_check(*looked_at)
            of_accelerations = () if accelerations else ("acceleration", "base acceleration", "base force", "noise_std")
            used = Doubts(each for each in found if each.about not in of_accelerations)
            if used:  # check has no --contact: it would find nothing wrong with the contacts of the data
                see = f"See {shlex.join(['forcegp', 'check', str(self.data), *self.words(*ROBOT_OPTIONS)])}"
                see = used[0].advice.rstrip(".") if self.contact else see
                terminal.warn(f"{used.in_one_line()}. {see} (--no-checks does not look)")
        warnings.simplefilter("ignore", ContactWarning)

    def _rows(self, dataset: forcegp.Dataset, model: forcegp.Model) -> tuple[forcegp.Dataset, str | None]:
        """The rows in which all contacts act (`forcegp.data.rows_in_contact`), or all, as --rows asks.

        And a note to print after the fit, so that an error before it stands alone. Raises ContactError with in-contact
        if there are none.
        """
        if self.rows == "all" or not model.contacts:
            return dataset, None
        try:
            touching = forcegp.data.rows_in_contact(replace(dataset, model=model))
        except ContactError:
            if self.rows == "in-contact":
                raise
            return dataset, None  # the fit raises a clearer error
        share = len(touching) / len(dataset)
        if self.rows == "auto" and share >= NEARLY_ALL:
            return dataset, None
        text = f"{len(touching)} of {len(dataset)} rows move as a contact demands ({share:.1%})"
        if self.rows == "auto" and share < HARDLY_ANY:
            return dataset, f"{text}; all were learned from. Check the contact, or give --rows in-contact."
        note = f"{text}; these alone were learned from (--rows all takes every row)"
        return replace(touching, model=dataset.model), note

    def _write(self, posterior: forcegp.posterior.Posterior) -> None:
        """The model, how it was made and what was estimated; what is known also as a robot's file."""
        options = {
            name: str(value) if isinstance(value, Path) else value
            for name, value in ((name, getattr(self, name)) for name in self.__dataclass_fields__)
            if name not in ("json", "debug", "overwrite")
        }
        data = {"path": str(self.data), "sha256": file_digest(self.data)}
        content = {"options": options, "data": data, "resolved": dict(posterior.settings)}
        with self.folder(self.out, content) as folder:
            forcegp.save_posterior(posterior, folder)
            if posterior.estimates:
                write_estimates(folder, posterior)


SAME = ("points", "engine", "learning_points", "iterations", "restarts", "seed", "jobs", "hyperprior")
"""Options that `forcegp.scores.learn` takes by the same names."""


def write_estimates(folder: Path, posterior: Any, name: str = "identified") -> None:
    """The numbers that were found, and robot and known forces with them: for --identified, and as a URDF."""
    estimates, known = posterior.estimates, identified_system(posterior.model)
    write_json(folder / "estimates.json", estimates.to_dict())
    write_text(folder / SYSTEM_FILE, known.to_json() + "\n")
    if estimates.by_body:  # a URDF has no place for intervals
        held = "; ".join(f"{link}: {count}" for link, count in estimates.by_body.items())
        note = f"of each body's ten inertial directions the log holds nothing of: {held}"
        known = known.with_robot(known.robot.with_note(note))
    known.to_urdf(folder / f"{name}.urdf")


def fit_summary(posterior: forcegp.posterior.Posterior, wall_seconds: float) -> dict[str, Any]:
    """What a fit came to, as plain values. `objective` is what the search lowered, `nll` the likelihood alone."""
    result, settings = posterior.result, posterior.settings
    force_noise, unknown = posterior.hyperparameters.get("noise.log_force"), posterior.model.unknown_forces
    air = [each for each in unknown if isinstance(each, forcegp.AerodynamicForce)]
    looked = not {"air", "observe"} & set(settings) and not posterior.model.held_inputs  # not for wind in windows
    return {
        "model": posterior.description,
        "objective_is": posterior.objective,
        "points": len(posterior.training),
        "learning_points": settings.get("learning_points", len(posterior.training)),
        "objective_start": result.history[0],
        "objective": result.value,
        "nll": posterior.negative_log_likelihood,
        **({"engine": settings["engine_reason"]} if "engine_reason" in settings else {}),
        **({"refined": settings["refined"]} if "refined" in settings else {}),
        "restarts": settings.get("restarts", 1),
        "iterations": len(result.history) - 1,
        "evaluations": result.evaluations,
        "converged": result.converged,
        "status": result.status,
        "noise_std": posterior.noise_std.tolist(),
        "wind": settings.get("air", {}).get("wind"),
        "wind_not_found": looked and any(each.observe != 0.0 for each in air),
        "steady_forces": settings.get("steady_forces"),
        "force_noise_std": None if force_noise is None else force_noise.exp().tolist(),
        "estimates": posterior.estimates.to_dict()["parameters"],
        "cpu_seconds": result.cpu_seconds,
        "wall_seconds": wall_seconds,
    }


def fit_report(run: Path, posterior: Any, summary: Mapping[str, Any]) -> list[Any]:
    """What was learned from what, and the numbers that were estimated."""
    forces, air = summary["force_noise_std"], summary["wind"]
    still = "learned as still air" + (", with a force in each episode" if summary["steady_forces"] else "")
    points, learning = summary["points"], summary["learning_points"]
    refined = " and refined on all" if "refined" in summary else ""
    fewer = f" (parameters: from {learning} of them{refined})" if learning != points else ""
    # the status counts failed evaluations, too, and the starts
    status = with_option_names(summary["status"], ("iterations",))
    unit = summary["objective_is"].partition(" [")[2].removesuffix("]")
    objective = f"{_short(summary['objective_start'])} → {_short(summary['objective'])} {unit}"
    values = {
        **({"engine": summary["engine"]} if "engine" in summary else {}),
        **({"objective": objective} if posterior.model.unknown_forces else {}),
        "negative log likelihood": f"{summary['nll']:.1f} nats",
        "iterations": f"{summary['iterations']} ({summary['evaluations']} evaluations)",
        "search": status if summary["converged"] else f"not converged: {status}",
        "noise std": _per_joint(summary["noise_std"]),
        **({} if forces is None else {"noise std of forces": _per_joint(forces)}),
        **({} if air is None else {"wind of these rows": f"{air[0]:.1f} m/s along x, {air[1]:.1f} m/s along y"}),
        **({"wind of these rows": f"not found; {still}"} if summary["wind_not_found"] else {}),
        "time": f"{summary['cpu_seconds']:.1f} s CPU for the search, {summary['wall_seconds']:.1f} s in all",
    }
    shown: list[Any] = [facts(f"{run}: {summary['model']}, learned from {points} points{fewer}", values)]
    if posterior.estimates:
        shown.append(estimates_table("estimates", posterior.estimates))
        shown += what_is_open(posterior.estimates)
    motions = posterior.settings.get("motions")
    if motions is not None:
        units = ["mm" if joint.type == "prismatic" else "mrad" for joint in posterior.model.robot.joints]
        each = zip(motions["rms"], units, strict=False)
        error = ", ".join(f"{1e3 * rms:.3g} {unit}" for rms, unit in each)
        shown.append(
            f"{motions['windows']} windows of {motions['seconds']:g} s, whose initial states are estimated, too; "
            f"rms of q by joint: {error}."
        )
    return [*shown, f"Next: forcegp score {run} TEST.h5"]


def _per_joint(values: list[float]) -> str:
    return f"{values[0]:.4g}" if len(set(values)) == 1 else " ".join(f"{value:.3g}" for value in values)


def _short(value: float) -> str:
    """One decimal for nats of a likelihood, three digits for small losses."""
    return f"{value:.1f}" if abs(value) >= 10.0 else f"{value:.3g}"
