"""`forcegp identify`: estimate masses, inertias and friction coefficients along with the unknown forces."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, cast

from tyro.conf import arg

import forcegp
import forcegp.analytical
import forcegp.inference
import forcegp.mechanics
import forcegp.models
import forcegp.priors
from forcegp.atomic_files import write_json
from forcegp.cli.command import DATASET, FIELDS, listed, unless_given
from forcegp.cli.fit import fit_summary, fit_with_progress, motion_report, refined_with_progress
from forcegp.cli.input_options import SYSTEM_FILE
from forcegp.cli.learning_options import PARTS, friction_laws, parse_learn, with_learned_forces
from forcegp.cli.model_choice import PRIORS, FitOptions, resolved_noise
from forcegp.cli.terminal import NONE, ProgressCallback, Terminal, columns, with_option_names
from forcegp.errors import InvalidInput, NonPhysicalInertia


@dataclass(frozen=True, kw_only=True)
class IdentifyOptions(FitOptions):
    """What to identify, by which model, and from how many rows."""

    learn: Annotated[tuple[str, ...], listed("LINK:PARTS|FORCE,...", goes_on=PARTS)] = ()
    """What to estimate. LINK:PARTS: out of mass, com (centre of mass) and inertia. FORCE or FORCE:JOINT,JOINT:
    viscous-joint-friction, coulomb-joint-friction or armature, of all joints or of these. They begin at the URDF's
    coefficients, or at FORCE=START. The models least-squares and consistent estimate all of these instead."""
    model: Literal["structured", "analytical", "least-squares", "consistent"] = "structured"
    """structured: Gaussian processes model the unknown forces. analytical: no unknown forces, noise alone.
    least-squares: regression of joint forces on every inertia. consistent: the same, physically consistent."""
    prior: Annotated[tuple[str, ...], listed(PRIORS, "joint", goes_on=FIELDS)] = ()
    """With structured: what the unknown forces may be, as in forcegp fit, for instance joint-friction or
    payload:frame=LINK."""
    friction: Annotated[tuple[str, ...], listed("LAW,...")] = ("viscous", "coulomb")
    """With the last two models: viscous, coulomb or stribeck or load (grows with |u|), offset, direction (viscous
    friction that depends on the direction); none for no friction."""
    rotors: Literal["armature", "rotor", "none"] = "armature"
    """With the last two models: armature: one rotor inertia per joint. rotor: those of the system's coupled rotors."""
    likelihood: Annotated[
        Literal["torque", "acceleration", "both"] | None,
        unless_given("torque|acceleration|both", "torque; both where the base moves"),
    ] = None
    """With the last two models: torque: residuals of inverse dynamics, where torque sensors are good. acceleration: of
    forward dynamics, where arms are light. both: torque and acceleration are noisy."""
    robust: Annotated[bool, arg(help_behavior_hint="")] = False
    """With the last two models: count outliers by their absolute value."""
    test: Annotated[Path | None, DATASET, unless_given("TEST.h5", "none", Path)] = None
    """With the last two models: score on this recording, too."""
    motions: Annotated[float | None, unless_given("S", "none", float)] = None
    """With consistent: finally refine all parameters on the recorded positions, over windows of S seconds. See
    docs/how-to/motions.md."""
    prior_strength: Annotated[float | None, unless_given("W", "0; 1 for the last two models", float)] = None
    """Weight that holds inertias near the URDF's, w/2 times their squared distance in the geometric metric."""
    points: Annotated[int, arg(metavar="N")] = 200
    """Train on N rows that lie farthest apart (all rows if there are fewer). Time grows with the cube of N."""
    learning_points: Annotated[int | None, unless_given("N", "all points", int)] = None
    """Find the estimates and all other parameters on N of the points; standard errors are those of N points."""
    mean: Literal["analytical", "zero"] = "analytical"
    """analytical: the processes learn what the known forces lack. zero: they learn the known forces, too."""
    iterations: Annotated[int, arg(metavar="N")] = 200
    """Most L-BFGS iterations of each start."""
    restarts: Annotated[int, arg(metavar="R")] = 1
    """Starts of the search; the best is kept. They differ in the kernels only: the physical values begin the same."""


INERTIAS = {"least-squares": "free", "consistent": "consistent"}
"""Names of models on the command line, and what `identify_analytical` calls their inertias."""


def rounds_reported(report: ProgressCallback) -> Callable[[int, float], None]:
    """What `identify_analytical` calls after each of its rounds."""
    most = forcegp.analytical.ROUNDS
    return lambda done, rms: report(min(done, most), most, f"rms of the residual {rms:.3g}")


def identify_by_regression(command: IdentifyOptions, terminal: Terminal) -> Mapping[str, Any]:
    """Identify, write the folder, and show how far the residuals fell."""
    # the silent neglect of options of the other models would be a surprise
    if given := command.words("learn", "prior", "mean", "points", "learning_points", "noise"):
        option = given[0].partition("=")[0]
        raise InvalidInput(
            f"{option} means nothing to --model {command.model}, which estimates every inertia by regression on all "
            "rows; leave it out, or use --model structured."
        )
    if command.motions is not None and command.model != "consistent":
        raise InvalidInput("--motions refines a robot, which least-squares need not find; use --model consistent.")
    friction = friction_laws(command.friction)
    command.require_free(command.out)

    begin = time.process_time()
    dataset = forcegp.Dataset.load(command.data)
    test = None if command.test is None else forcegp.Dataset.load(command.test)
    system = command._system(dataset)
    with terminal.progress("identifying", may_end_early=True) as report:
        found = forcegp.identify_analytical(
            dataset,
            system,
            friction=friction,
            rotors=None if command.rotors == "none" else cast(Any, command.rotors),
            inertias=cast(Any, INERTIAS[command.model]),
            likelihood=command.likelihood,
            prior_strength=1.0 if command.prior_strength is None else command.prior_strength,
            robust=command.robust,
            progress=rounds_reported(report),
        )
    content = {"model": command.model, **found.to_dict(), "cpu_seconds": time.process_time() - begin}
    for name, rows in (("training", dataset), ("test", test)):
        if rows is not None:
            before = forcegp.analytical.residual_scores(*forcegp.analytical.motion_residuals(rows, system), rows)
            content[name] = {"before": before, "after": found.scores(rows)}
    try:
        identified, why_not = found.system, None
    except NonPhysicalInertia as error:
        identified, why_not = None, str(error)
    content["robot"] = "no" if identified is None else "yes"
    tables: list[Any] = []
    if command.motions is not None and identified is not None:
        model = forcegp.StructuredGP(identified, forcegp.NoForces(), noise=forcegp.Noise(None, learn=True))
        rough = model.fit(dataset, points=min(command.points, len(dataset)), restarts=1)
        refined = refined_with_progress(terminal, rough, dataset, command.motions)
        identified, content["motions"], tables = refined.system, refined.settings["motions"], motion_report(refined)
    with command.folder(command.out, command._given()) as folder:
        write_json(folder / "identification.json", content)
        if identified is not None:
            (folder / SYSTEM_FILE).write_text(identified.to_json() + "\n", encoding="utf-8")
            written = identified
            if found.weak_directions:  # a URDF has no place for standard errors
                held = "; ".join(f"{link}: {count:.0f}" for link, count in found.weak_directions)
                note = f"of each body's ten inertial directions the log holds nothing of: {held}"
                written = identified.with_robot(identified.robot.with_note(note))
            written.to_urdf(folder / "identified.urdf")
    if why_not is not None:
        terminal.warn(f"{why_not} No identified.urdf was written; --model consistent finds a robot.")
    terminal.show(*tables, *_report_of_regression(command, found, content, identified))
    return {"run": str(command.out), "data": str(command.data), **content}


def _report_of_regression(
    command: IdentifyOptions,
    found: forcegp.AnalyticalIdentification,
    content: Mapping[str, Any],
    identified: forcegp.MechanicalSystem | None,
) -> list[Any]:
    joints = found.given.robot.joint_names
    kinds = ("N" if joint.type == "prismatic" else "Nm" for joint in found.given.robot.joints)
    unit = ", ".join(dict.fromkeys(kinds))
    tables: list[Any] = []
    for name in ("training", "test"):
        if name not in content:
            continue
        before, after = content[name]["before"], content[name]["after"]
        rows = [
            [
                joint,
                *(f"{scores['force_rms'][k]:.4g}" for scores in (before, after)),
                *(f"{scores['acceleration_nrmse'][k]:.3g}" for scores in (before, after)),
            ]
            for k, joint in enumerate(joints)
        ]
        header = ["joint", f"force rms\nbefore [{unit}]", "\nafter", "nRMSE of a\nbefore", "\nafter"]
        tables.append(columns(f"{command.out}: residuals of the {name} data", header, rows))
    errors, values, units = found.standard_errors, found.values, found.units
    centers, center_errors = found.centers_of_mass
    weak_bodies = dict(found.weak_directions)
    rows = []
    for body, link in enumerate(forcegp.analytical.body_names(found.given.robot)):
        mass, center, spread = f"{link}.m", 1e3 * centers[body], 1e3 * center_errors[body]
        rows.append(
            [
                link,
                f"{found.start[mass]:.4g}",
                f"{values[mass]:.4g} ± {errors[mass]:.2g}",
                ", ".join(f"{x:.1f} ± {e:.2g}" for x, e in zip(center, spread, strict=True)),
                f"{10 - weak_bodies.get(link, 0):.0f} of 10",
            ]
        )
    header = ["body", "mass [kg]\ngiven", "\nidentified", "centre of mass [mm]\nx, y, z", "directions\nin the data"]
    tables.append(columns("bodies, ± standard errors; the URDF decides what the data do not hold", header, rows))
    rows = []
    for field in dict.fromkeys(name.partition(".")[0] for name in found.terms.names):
        names = [name for name in found.terms.names if name.startswith(f"{field}.")]
        rows.append([f"{field.replace('_', ' ')} [{', '.join(dict.fromkeys(units[name] for name in names))}]"])
        for name in names:
            rows.append([f"  {name.partition('.')[2]}", f"{values[name]:.4g}", f"{errors[name]:.2g}"])
    if rows:
        tables.append(columns("friction and rotors", ["", "identified", "std. error"], rows))
    base = found.base
    summary = (
        f"{base.rank} base parameters, condition number {base.condition:.3g}; {content['rows']} rows, "
        f"{content['cpu_seconds']:.1f} s CPU{'' if content['converged'] else ', not converged'}."
    )
    weak = ", ".join(f"{name} ({count:.0f} of 10)" for name, count in found.weak_directions)
    numbers = 10 * len(forcegp.analytical.body_names(found.given.robot))
    lines = [summary, f"Directions of single bodies that the prior decides, not the data: {weak or 'none'}."]
    if base.rank < numbers:
        shared = "mass on the axis of a joint may belong to either of its links"
        lines.append(f"Of all bodies' {numbers} numbers together it decides {numbers - base.rank}: {shared}.")
    if found.given.robot.base != "fixed":
        lines.append("Mass of all bodies: {:.4g} ± {:.2g} kg, ± standard error.".format(*found.total_mass))
    if found.thickened:
        lines.append(f"Links that were lines, plates or points got some thickness: {', '.join(found.thickened)}.")
    if identified is not None:
        lines.append(f"Wrote {command.out / 'identified.urdf'}. Next: forcegp fit LOG.h5 --identified {command.out}")
    return [*tables, *lines]


@dataclass(frozen=True, kw_only=True)
class Identify(IdentifyOptions):
    """Estimate physical parameters of the robot along with the unknown forces, and report their standard errors.

    The estimates start from the URDF. Except for least-squares, they are physically consistent. The
    folder holds identified.urdf, identification.json, and the model as `forcegp fit` writes it, or system.json for
    --identified.

    For example:
      forcegp identify log.h5 --robot arm.urdf --model consistent --friction viscous,coulomb,offset --out identified
      forcegp identify log.h5 --robot arm.urdf --model consistent --motions 1 --out identified
      forcegp identify train.h5 --learn lbr_iiwa_link_7:mass,com --points 100 --out identified
      forcegp identify log.h5 --learn tool:mass,com,armature=0.1 --prior joint-friction --out identified
    """

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Identify and save."""
        if self.model == "analytical" and self.mean == "zero":
            raise InvalidInput("--model analytical has nothing but its mean; leave --mean zero out.")
        if self.model in INERTIAS:
            return identify_by_regression(self, terminal)
        if self.model == "analytical" and self.prior:
            raise InvalidInput(
                "--model analytical has no unknown forces; leave --prior out, or use --model structured."
            )
        if self.motions is not None:
            raise InvalidInput("--motions goes with --model consistent; for the processes use forcegp fit --motions.")
        self.require_free(self.out)
        learn = parse_learn(self.learn)

        begin = time.monotonic()
        dataset = forcegp.Dataset.load(self.data)
        system, added = with_learned_forces(self._system(dataset), learn)
        self._check(terminal, dataset, system)
        dataset, rows_note = self._rows(dataset, system)
        prior = "none" if self.model == "analytical" else " + ".join(self.prior or ("joint",))
        model = forcegp.StructuredGP(
            system,
            forcegp.priors.named_prior(prior, system),
            self.mean,
            resolved_noise(self.noise, self.force_noise),
        )
        posterior = fit_with_progress(
            terminal,
            model,
            dataset,
            name="identifying",
            points=min(self.points, len(dataset)),
            restarts=self.restarts if self.model == "structured" else 1,  # without processes all starts are the same
            seed=self.seed,
            backend=self._backend(),
            hyperprior=self.hyperprior,
            options=forcegp.inference.OptimizerOptions(iterations=self.iterations),
            learn=learn,
            prior_strength=self.prior_strength or 0.0,
            learning_points=self.learning_points,
        )
        assert posterior.identification is not None
        with terminal.progress("standard errors") as report:
            found = replace(posterior.identification, progress=report)
            content = found.to_dict()
        summary = fit_summary(posterior, time.monotonic() - begin)
        self._write(posterior, content)
        for name in added:
            terminal.note(f"{name} was not among the known forces, and is now.")
        if rows_note is not None:
            terminal.note(rows_note)
        terminal.show(*_report(self, found, summary))
        del content["history"]
        return {"run": str(self.out), "data": str(self.data), **summary, **content}


def _report(command: Identify, found: forcegp.models.Identification, summary: Mapping[str, Any]) -> list[Any]:
    rows, owner = [], None
    for name, unit in found.units.items():
        unit, factor = ("mm", 1e3) if unit == "m" else (unit, 1.0)
        start, value, error = (factor * each[name] for each in (found.start, found.values, found.standard_errors))
        # decimals that show two digits of the standard error, and four of the value where there is none
        size = error if 0.0 < error < math.inf else 1e-3 * abs(value)
        digits = min(9, max(0, 1 - math.floor(math.log10(size)))) if size > 0.0 else 4
        low, high = (factor * end for end in found.intervals[name])
        interval = f"{low:.{digits}f} … {high:.{digits}f}" if math.isfinite(error) else NONE
        of, part = _owner_and_part(name)
        rows += [[of]] if of != owner else []
        owner = of
        rows.append([f"  {part}", f"{start:.{digits}f}", f"{value:.{digits}f}", f"{error:.2g}", interval, unit])
    points, learning = summary["points"], summary["learning_points"]
    used = f"{points} points" if learning == points else f"{learning} of {points} points"
    title = f"{command.out}: identified from {used}, with kernels and noise free to follow"
    table = columns(title, ["parameter", "start", "identified", "std.\nerror", "95 % interval", "unit"], rows)
    status = with_option_names(summary["status"], ("iterations",))
    state = status if summary["converged"] else f"not converged: {status}"
    search = f"{summary['iterations']} iterations, {summary['cpu_seconds']:.1f} s CPU, {state}."
    last = f"Wrote {command.out / 'identified.urdf'}. Next: forcegp evaluate {command.out} TEST.h5"
    return [table, found.verdict, search, last]


def _owner_and_part(name: str) -> tuple[str, str]:
    """Link or force, and part or joint."""
    owner, _, part = name.partition(".")
    if owner in forcegp.mechanics.KNOWN_FORCES:
        return owner, part
    pieces = name.rsplit(".", 1 if name.endswith(".mass") else 2)
    return pieces[0], ".".join(pieces[1:])
