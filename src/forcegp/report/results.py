"""The page of one model on one recording: the robot, the friction curves, motions ahead, and errors."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from forcegp.data import Dataset
from forcegp.errors import ForceGPError, MissingExtra
from forcegp.evaluation import (
    Evaluation,
    curve_panels,
    friction_curves_figure,
    motion_bands_figure,
    normal_force_figure,
    prediction_figure,
)
from forcegp.posterior.posterior import Posterior
from forcegp.report.motion import RecordedScene, recorded_scene
from forcegp.report.page import Finding, Page, Picture, Table
from forcegp.report.scene import recording
from forcegp.validation.figures import figures_of

SECONDS = 10.0
"""Of the recording in the scene."""
PICTURED = 6.0
"""Seconds of it in figures over time."""

Progress = Callable[[int, int, str], None]


def model_page(
    posterior: Posterior,
    dataset: Dataset,
    *,
    title: str,
    best: str,
    findings: Sequence[Finding] = (),
    tables: Sequence[Table] = (),
    pictures: Sequence[Picture] = (),
    next_steps: Sequence[Finding] = (),
    details: Mapping[str, Any] | None = None,
    shapes: str | Path | None = None,
    progress: Progress | None = None,
) -> Page:
    """A page with the robot in motion and the pictures that this model and recording allow.

    `pictures` of the caller come first. What cannot be drawn is named on the page with the reason: without viser the
    robot, and motions of a recording with uneven time steps. `shapes` is a URDF with visual elements.
    """
    steps: dict[str, Callable[[], tuple[str, Figure]]] = {}
    if curve_panels(posterior):
        steps["friction curves"] = lambda: (
            "Forces over velocity, with 95 % bands: the friction laws of the model and what was learned beside them. "
            "Ticks are the velocities of the training data.",
            friction_curves_figure(posterior, dataset),
        )
    steps["motions ahead"] = lambda: (
        "Every half second a prediction begins at the recorded state and follows the recorded u. The line is its "
        "error, the band its 95 % interval.",
        motion_bands_figure(posterior, dataset, seconds=PICTURED),
    )
    if posterior.model.contacts:
        steps["normal force"] = lambda: (
            "The forces of contacts, which no sensor measured.",
            normal_force_figure(posterior, dataset),
        )
    steps["accelerations"] = lambda: (
        "Accelerations over time, and their errors on the right.",
        prediction_figure(posterior, dataset),
    )
    drawn, notes = list(pictures), []
    for done, (name, step) in enumerate(steps.items()):
        if progress is not None:
            progress(done, len(steps) + 1, name)
        try:
            drawn.append(Picture(*step()))
        except ForceGPError as error:
            notes.append(f"{name}: not drawn, because {error}")
    if progress is not None:
        progress(len(steps), len(steps) + 1, "the robot")
    scene = ""
    try:
        recorded = recorded_scene(dataset, posterior, seconds=SECONDS, shapes=shapes)
        scene = recording(recorded)
        notes = [*scene_notes(recorded), *notes]
    except MissingExtra as error:
        notes.insert(0, f"The robot is not shown: {error}.")
    return Page(title, best, findings, scene, notes, drawn, tables, next_steps, details or {})


def scene_notes(recorded: RecordedScene) -> list[str]:
    """What the arrows of a scene mean, and what of the robot could not be drawn."""
    arrows = [
        f"{group.title}: {group.largest:.3g} {group.unit} would be {recorded.arrow_length:.2g} m long"
        for group in recorded.arrows
        if group.largest > 0.0
    ]
    meaning = "Arrows are forces that the model found, torques along the axes of joints; pale ends are 95 % intervals"
    return ([f"{meaning}. {'; '.join(arrows)}."] if arrows else []) + recorded.doubts


def evaluation_sentence(evaluation: Evaluation, unit: str) -> str:
    """The result of an evaluation in one sentence."""
    error, known = evaluation.mae, evaluation.known_physics_mae
    better = f", a factor {known / error:.3g} less than known physics alone" if known > error > 0.0 else ""
    held, unit = 100.0 * evaluation.coverage_95, f"in {unit}" if unit.startswith("the ") else unit
    return (
        f"On unseen rows, the mean absolute error of the acceleration is {error:.3g} {unit}{better}; "
        f"95 % intervals contain {held:.0f} %."
    )


def evaluation_table(evaluation: Evaluation) -> Table:
    """Errors by joint."""
    header = ["joint", "MAE", "known physics alone", "RMSE", "inside the 95 % interval"]
    columns = (
        evaluation.mae_per_joint,
        evaluation.known_physics_mae_per_joint,
        evaluation.rmse_per_joint,
        evaluation.coverage_95_per_joint,
    )
    rows = []
    for name, *values, covered in zip(evaluation.joint_names, *columns, strict=True):
        rows.append([name, *(f"{value:.3g}" for value in values), f"{100.0 * covered:.0f} %"])
    return Table("Errors of the acceleration by joint", header, rows)


def validation_pictures(document: Mapping[str, Any]) -> list[Picture]:
    """The figures of a validation that are worth a page: errors of motions, and by joint."""
    figures = figures_of(document)
    captions = {
        "motions": "How the error of predicted positions grows, on time that no model has seen.",
        "errors": "Errors of every model by joint, on time that none has seen.",
    }
    return [Picture(caption, figures[name]) for name, caption in captions.items() if name in figures]


def validation_table(document: Mapping[str, Any], names: Mapping[str, str]) -> Table:
    """Models side by side from the document of a validation (`Validation.document`)."""

    def cell(score: Mapping[str, float] | None) -> str:
        return "–" if score is None else f"{score['median']:.3g}"

    rows = []
    for name, model in document["models"].items():
        motions = model.get("motions")
        last = motions["rms"][-1] if motions and motions["rms"] else None
        covered = model.get("coverage_95")  # a model that failed has no score
        inside = "–" if covered is None else f"{100.0 * covered['median']:.0f} %"
        rows.append([names.get(name, name), cell(model.get("nrmse")), cell(last), inside])
    header = ["model", "nRMSE of the acceleration", "RMS of q at the longest horizon", "inside the 95 % interval"]
    return Table("Models on time that none of them has seen", header, rows)
