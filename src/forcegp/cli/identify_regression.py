"""`forcegp identify`: its options, and regression instead of Gaussian processes (--model least-squares|consistent)."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, cast

from rich.text import Text
from tyro.conf import UseAppendAction, arg

import forcegp
import forcegp.analytical
from forcegp.atomic_files import write_json
from forcegp.cli.command import DATASET, unless_given
from forcegp.cli.input_options import SYSTEM_FILE
from forcegp.cli.model_choice import FitOptions
from forcegp.cli.output_folders import output_folder, require_free_folder
from forcegp.cli.syntax import friction_laws
from forcegp.cli.tables import columns
from forcegp.cli.terminal import Terminal
from forcegp.errors import InvalidInput, NonPhysicalInertia


@dataclass(frozen=True, kw_only=True)
class IdentifyOptions(FitOptions):
    """What to identify, by which model, and from how many rows."""

    learn: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="LINK:PARTS|FORCE", help_behavior_hint="")] = ()
    """What to estimate (repeatable): LINK:PARTS with parts out of mass, com (centre of mass) and inertia, or
    viscous-joint-friction, coulomb-joint-friction, armature: of all joints, or of FORCE:JOINT,JOINT; from the URDF's
    coefficients, or from FORCE=START. The next two models estimate all of it instead."""
    model: Literal["structured", "analytical", "least-squares", "consistent"] = "structured"
    """structured: Gaussian processes model the unknown forces. analytical: there are none but noise.
    least-squares: regression of joint forces on every inertia. consistent: the same with inertias that bodies can have.
    """
    friction: Annotated[str, arg(metavar="NAME,NAME")] = "viscous,coulomb"
    """With the last two models: viscous, coulomb or stribeck or load (grows with |u|), offset; none for no friction."""
    rotors: Literal["armature", "rotor", "none"] = "armature"
    """With the last two models: armature: one rotor inertia per joint. rotor: those of the system's coupled rotors."""
    likelihood: Literal["torque", "acceleration"] = "torque"
    """With the last two models: torque: residuals of inverse dynamics, where torque sensors are good. acceleration: of
    forward dynamics, where arms are light."""
    robust: Annotated[bool, arg(help_behavior_hint="")] = False
    """With the last two models: count outliers by their absolute value."""
    test: Annotated[Path | None, DATASET, unless_given("TEST.h5", "none", Path)] = None
    """With the last two models: score on this recording, too."""
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


def identify_by_regression(command: IdentifyOptions, terminal: Terminal, kind: str) -> Mapping[str, Any]:
    """Identify, write the folder, and show how far the residuals fell."""
    _refuse_what_does_nothing(command)
    friction = friction_laws(command.friction)
    require_free_folder(command.out, kind=kind, overwrite=command.overwrite)

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
            progress=lambda done, rms: report(
                min(done, forcegp.analytical.ROUNDS), forcegp.analytical.ROUNDS, f"rms of the residual {rms:.3g}"
            ),
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
    with output_folder(command.out, kind, command._given(), overwrite=command.overwrite) as folder:
        write_json(folder / "identification.json", content)
        if identified is not None:
            (folder / SYSTEM_FILE).write_text(identified.to_json() + "\n", encoding="utf-8")
            (folder / "identified.urdf").write_bytes(identified.robot.to_urdf().encode("utf-8"))
    if why_not is not None:
        terminal.warn(f"{why_not} No identified.urdf was written; --model consistent finds a robot.")
    terminal.show(*_report(command, found, content, identified))
    return {"run": str(command.out), "data": str(command.data), **content}


def _refuse_what_does_nothing(command: IdentifyOptions) -> None:
    """Options of the other models, whose silent neglect would be a surprise. Raises InvalidInput."""
    given = {"learn": (), "mean": "analytical", "points": 200, "learning_points": None, "noise": "dataset"}
    changed = [name for name, default in given.items() if getattr(command, name) != default]
    if changed:
        option = changed[0].replace("_", "-")
        raise InvalidInput(
            f"--{option} means nothing to --model {command.model}, which estimates every inertia by regression on all "
            "rows; leave it out, or use --model structured."
        )


def _report(
    command: IdentifyOptions,
    found: forcegp.AnalyticalIdentification,
    content: Mapping[str, Any],
    identified: forcegp.MechanicalSystem | None,
) -> list[Any]:
    joints = found.given.robot.joint_names
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
        header = ["joint", "force rms\nbefore [Nm]", "\nafter", "nRMSE of a\nbefore", "\nafter"]
        tables.append(columns(f"{command.out}: residuals of the {name} data", header, rows))
    errors, values, units = found.standard_errors, found.values, found.units
    rows = []
    for field in dict.fromkeys(name.partition(".")[0] for name in found.terms.names):
        rows.append([f"{field.replace('_', ' ')} [{units[f'{field}.{joints[0]}']}]"])
        for name in (f"{field}.{joint}" for joint in joints):
            rows.append([f"  {name.partition('.')[2]}", f"{values[name]:.4g}", f"{errors[name]:.2g}"])
    if rows:
        tables.append(columns("friction and rotors", ["", "identified", "std. error"], rows))
    base = found.base
    summary = (
        f"{base.rank} base parameters, condition number {base.condition:.3g}; "
        f"{content['rows']} rows, {content['cpu_seconds']:.1f} s CPU"
        f"{'' if content['converged'] else ', not converged'}."
    )
    weak = ", ".join(f"{name} ({count:.0f} of 10)" for name, count in found.weak_directions)
    lines = [summary, f"Directions that the prior decides, not the data: {weak or 'none'}."]
    if found.thickened:
        lines.append(f"Links that were lines, plates or points got some thickness: {', '.join(found.thickened)}.")
    if identified is not None:
        lines.append(f"Wrote {command.out / 'identified.urdf'}. Next: forcegp fit LOG.h5 --identified {command.out}")
    return [*tables, *(Text(line) for line in lines)]
