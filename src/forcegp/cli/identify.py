"""`forcegp identify`: estimate masses, inertias and friction coefficients along with the unknown forces."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from rich.text import Text

import forcegp
import forcegp.inference
import forcegp.models
from forcegp.cli.command import Debug, Json
from forcegp.cli.fit import fit_summary, fit_with_progress
from forcegp.cli.identify_regression import INERTIAS, IdentifyOptions, identify_by_regression
from forcegp.cli.model_choice import resolved_noise
from forcegp.cli.output_folders import require_free_folder
from forcegp.cli.syntax import parse_learn, with_learned_forces
from forcegp.cli.tables import NONE, columns
from forcegp.cli.terminal import Terminal, with_option_names
from forcegp.errors import InvalidInput

KIND = "forcegp identify"
COEFFICIENT_NAMES = (
    "viscous-joint-friction.",
    "coulomb-joint-friction.",
    "load-joint-friction.",
    "armature.",
    "rotor-inertia.",
)


@dataclass(frozen=True, kw_only=True)
class Identify(IdentifyOptions):
    """Estimate physical parameters of the robot along with the unknown forces, and report their standard errors.

    The estimates start from the URDF and always belong to a body that can exist (but those of least-squares). The
    folder holds identified.urdf, identification.json, and the model as `forcegp fit` writes it, or system.json for
    --identified.

    For instance:
      forcegp identify log.h5 --robot arm.urdf --model consistent --friction viscous,coulomb,offset --out identified
      forcegp identify train.h5 --learn lbr_iiwa_link_7:mass,com --points 100 --out identified
      forcegp identify log.h5 --robot arm.urdf --learn tool:mass,com,inertia --learn viscous-joint-friction=0.1
        --noise learned --out identified
    """

    json: Json = False
    debug: Debug = False

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Identify and save."""
        if self.seed < 0:
            raise InvalidInput(f"--seed is {self.seed}; it must be at least 0.")
        if self.model == "analytical" and self.mean == "zero":
            raise InvalidInput("--model analytical has nothing but its mean; leave --mean zero out.")
        if self.model in INERTIAS:
            return identify_by_regression(self, terminal, KIND)
        require_free_folder(self.out, kind=KIND, overwrite=self.overwrite)
        learn = parse_learn(self.learn)

        begin = time.monotonic()
        dataset = forcegp.Dataset.load(self.data)
        system, added = with_learned_forces(self._system(dataset), learn)
        self._check(terminal, dataset, system)
        dataset, rows_note = self._rows(dataset, system)
        prior = forcegp.NoForces() if self.model == "analytical" else forcegp.JointForces()
        model = forcegp.StructuredGP(system, prior, self.mean, resolved_noise(self.noise, dataset, self.force_noise))
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
            options=forcegp.inference.OptimizerOptions(iterations=self.iterations, adam_steps=self.adam_steps),
            learn=learn,
            prior_strength=self.prior_strength or 0.0,
            learning_points=self.learning_points,
        )
        assert posterior.identification is not None
        with terminal.progress("standard errors") as report:
            found = replace(posterior.identification, progress=report)
            content = found.to_dict()
        summary = fit_summary(posterior, time.monotonic() - begin)
        identification = json.dumps(content, indent=1, allow_nan=False) + "\n"
        urdf = posterior.system.robot.to_urdf()
        self._write(posterior, KIND, {"identification.json": identification, "identified.urdf": urdf})
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
        digits = _digits(error, value)
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
    return [table, Text(found.verdict), Text(search), Text(last)]


def _owner_and_part(name: str) -> tuple[str, str]:
    """Link or force, and part or joint."""
    if name.startswith(COEFFICIENT_NAMES):
        owner, _, part = name.partition(".")
        return owner, part
    pieces = name.rsplit(".", 1 if name.endswith(".mass") else 2)
    return pieces[0], ".".join(pieces[1:])


def _digits(error: float, value: float) -> int:
    """Decimals that show two digits of the standard error, and four of the value where there is none."""
    size = error if 0.0 < error < math.inf else 1e-3 * abs(value)
    return min(9, max(0, 1 - math.floor(math.log10(size)))) if size > 0.0 else 4
