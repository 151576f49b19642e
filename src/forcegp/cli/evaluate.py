"""`forcegp evaluate`: score a fitted model on a dataset that it has not seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import forcegp
import forcegp.evaluation
import forcegp.posterior
import forcegp.report
from forcegp.atomic_files import write_json
from forcegp.cli.command import DATASET, MODEL, NUMBERS, URDF, Overwriting, listed, unless_given
from forcegp.cli.contact_syntax import CONTACTS, parse_contacts
from forcegp.cli.input_options import SystemChoice, model_and_data
from forcegp.cli.terminal import (
    NORMAL_FORCES,
    NORMAL_FORCES_KNOWN,
    NORMAL_FORCES_SEEN,
    Terminal,
    evaluation_table,
    facts,
    force_facts,
    number,
    slip_facts,
)
from forcegp.errors import InvalidInput


@dataclass(frozen=True, kw_only=True)
class Evaluate(Overwriting):
    """Score a fitted model on a dataset that it has not seen: errors, likelihood, coverage, constraint error.

    For example:
      forcegp evaluate run test.h5 --plots figures
      forcegp evaluate run test.h5 --report report.html --shapes arm.urdf
      forcegp evaluate run test.h5 --json | jq .mae
      forcegp evaluate run elsewhere.h5 --contact tool@0,0,0.1:plane:0,0,1,0.05
    """

    run_folder: Annotated[Positional[Path], MODEL, arg(metavar="RUN")]
    """The folder that `forcegp fit --out` wrote."""
    data: Annotated[Positional[Path], DATASET, arg(metavar="DATA")]
    """The dataset to predict (HDF5)."""
    every: Annotated[int, arg(metavar="N")] = 1
    """Take every N-th row only."""
    system: SystemChoice = "model"
    """Robot and contacts to predict for: model, those that it was trained with; data, those of the dataset."""
    contact: Annotated[tuple[str, ...], listed(CONTACTS, "those of --system", goes_on=NUMBERS)] = ()
    """Predict under these contacts instead, for example a stuck joint; same form as for forcegp fit."""
    friction_coefficient: Annotated[float | None, unless_given("F", "no margins", float)] = None
    """Also show how far feet are from slipping on ground of this friction coefficient."""
    plots: Annotated[Path | None, unless_given("FOLDER", "no plots")] = None
    """Also draw predictions, forces, tool path and training into this folder, with the scores as evaluation.json."""
    report: Annotated[Path | None, unless_given("FILE.html", "no report")] = None
    """Also write a report in one file: the robot in motion with its forces, figures and errors."""
    shapes: Annotated[Path | None, URDF, unless_given("ROBOT.urdf", "capsules")] = None
    """A URDF with visual elements for the links in the report, its meshes beside it."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Evaluate, draw if asked to, and show."""
        if self.every < 1:
            raise InvalidInput(f"--every is {self.every}; it must be at least 1.")
        self.require_free(self.plots)
        self.require_free_file(self.report, forcegp.report.is_page, "a report")

        posterior, dataset = model_and_data(terminal, self.run_folder, self.data, self.system)
        dataset = dataset.rows(slice(None, None, self.every))
        if self.contact:
            posterior = posterior.with_model(
                posterior.model.with_contacts([*parse_contacts(self.contact), *posterior.model.loops])
            )
        evaluation = evaluate_with_progress(terminal, posterior, dataset)
        forces = forcegp.evaluation.force_scores(posterior, dataset)
        rests_on_prior = forcegp.evaluation.normal_force_rests_on_prior(posterior)
        scores = {
            "run": str(self.run_folder),
            "data": str(self.data),
            "every": self.every,
            "system": self.system,
            "contact": list(self.contact),
            "model": posterior.description,
            "points": len(posterior.training),
            **evaluation.to_dict(),
            "warnings": [terminal.worded(warning) for warning in evaluation.warnings],
            "forces": forces.to_dict(),
            "normal_force_rests_on_prior": rests_on_prior,
        }
        mu = self.friction_coefficient
        if mu is not None:
            scores["slip"] = forcegp.evaluation.slip_scores(posterior, dataset, mu)
        if self.plots is not None:
            options = {name: scores[name] for name in ("run", "data", "every", "system", "contact")}
            with self.folder(self.plots, {"options": options}) as folder:
                draw(terminal, folder, posterior, dataset, mu)
                write_json(folder / "evaluation.json", scores)
            terminal.note(f"plots: {self.plots}")
        if self.report is not None:
            self._write_report(terminal, posterior, dataset, evaluation, scores)
        known = isinstance(posterior, forcegp.posterior.Posterior) and not posterior.latent_names
        why = NORMAL_FORCES_KNOWN if known else NORMAL_FORCES if rests_on_prior else NORMAL_FORCES_SEEN
        forces_table = force_facts(forces, why) | slip_facts(scores.get("slip", {}))
        terminal.show(*_report(posterior, evaluation, dataset, self.data, forces_table))
        return scores

    def _write_report(
        self,
        terminal: Terminal,
        posterior: forcegp.posterior.Posterior,
        dataset: forcegp.Dataset,
        evaluation: forcegp.Evaluation,
        scores: Mapping[str, Any],
    ) -> None:
        assert self.report is not None
        unit, mu, pictures = acceleration_unit(dataset), self.friction_coefficient, []
        if mu is not None:
            figure = forcegp.evaluation.friction_margins_figure(posterior, dataset, mu)
            caption = "How much more force along the ground every foot could bear."
            pictures.append(forcegp.report.Picture(caption, figure))
        with terminal.progress("writing the report") as progress:
            page = forcegp.report.model_page(
                posterior,
                dataset,
                title=f"{self.run_folder.name} on {self.data.name}: {posterior.description}",
                best=forcegp.report.evaluation_sentence(evaluation, unit),
                findings=[forcegp.report.Finding("warning", each) for each in scores["warnings"]],
                tables=[forcegp.report.evaluation_table(evaluation)],
                pictures=pictures,
                details={**scores, "forcegp": forcegp.__version__},
                shapes=self.shapes,
                progress=progress,
            )
            forcegp.report.write_page(self.report, page, overwrite=self.overwrite)
        terminal.note(f"report: {self.report}")


def evaluate_with_progress(
    terminal: Terminal, posterior: forcegp.posterior.Posterior, dataset: forcegp.Dataset, name: str = "predicting"
) -> forcegp.Evaluation:
    """`forcegp.evaluation.evaluate` with a progress bar; warnings go to stderr."""
    with terminal.progress(f"{name}: {len(dataset)} rows") as report:
        evaluation = forcegp.evaluation.evaluate(posterior, dataset, progress=report)
    for warning in evaluation.warnings:
        terminal.warn(warning)
    return evaluation


def draw(
    terminal: Terminal,
    folder: Path,
    posterior: forcegp.posterior.Posterior,
    dataset: forcegp.Dataset,
    mu: float | None = None,
) -> list[str]:
    """Write every plot that these data allow to `folder`; returns the names of the files."""
    figures = {"prediction.png": lambda: forcegp.evaluation.prediction_figure(posterior, dataset)}
    if posterior.model.contacts:
        figures["normal_force.png"] = lambda: forcegp.evaluation.normal_force_figure(posterior, dataset)
    if mu is not None:
        figures["friction_margins.png"] = lambda: forcegp.evaluation.friction_margins_figure(posterior, dataset, mu)
    if forcegp.evaluation.curve_panels(posterior):
        figures["forces.png"] = lambda: forcegp.evaluation.friction_curves_figure(posterior, dataset)
    with terminal.progress("drawing") as report:
        for done, (name, figure) in enumerate(figures.items()):
            report(done, len(figures), name)
            forcegp.evaluation.save_figure(figure(), folder / name)
    return list(figures)


def acceleration_unit(dataset: forcegp.Dataset) -> str:
    """Of all joints, or that each has its own."""
    units = dataset.units["a"]
    return units.replace("^2", "²") if isinstance(units, str) else "the units of each joint"


def _report(
    posterior: forcegp.posterior.Posterior,
    evaluation: forcegp.Evaluation,
    dataset: forcegp.Dataset,
    data: Path,
    forces: Mapping[str, str],
) -> list[Any]:
    points = len(posterior.training)
    unit = acceleration_unit(dataset)
    # what an observer reports is neither robot nor contact
    models = [{**x.to_dict(), "forces": None} for x in (posterior.trained, posterior.model)]
    where = ", carried to another robot or contacts" if models[0] != models[-1] else ""
    title = (
        f"{points} training points, {posterior.description}{where}; {evaluation.rows} rows of {data}; errors in {unit}"
    )
    floor = "" if evaluation.noise_floor is None else f" (a perfect model has {number(evaluation.noise_floor)})"
    values = {
        "MAE": f"{number(evaluation.mae)}{floor}",
        "known physics alone": f"{number(evaluation.known_physics_mae)}",
        "constraint error |A a - b|": f"mean {number(evaluation.constraint_error)}, "
        f"largest {number(evaluation.constraint_error_max)}",
    }
    if evaluation.force_mae is not None:
        values["force that moves the robot"] = f"MAE {number(evaluation.force_mae)} against the truth"
    return [evaluation_table(title, evaluation), facts("", {**values, **forces})]
