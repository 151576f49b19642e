"""The page of one model on one recording: the robot, the friction curves, motions ahead, and errors."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from forcegp.data import Dataset
from forcegp.errors import ForceGPError, MissingExtra
from forcegp.posterior.posterior import Posterior
from forcegp.report.motion import RecordedScene, recorded_scene
from forcegp.report.page import Finding, Page, Picture, Table
from forcegp.report.scene import recording
from forcegp.scores import Scores, figures_of, model_figures, overall, unit_of

SECONDS = 10.0
"""Of the recording in the scene."""

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
    robot, and motions of a recording with uneven time steps. `shapes` is a URDF with
    visual elements.
    """
    steps, drawn, notes = model_figures(posterior, dataset), list(pictures), []
    for done, (name, (caption, draw)) in enumerate(steps.items()):
        if progress is not None:
            progress(done, len(steps) + 1, name)
        try:
            drawn.append(Picture(caption, draw()))
        except ForceGPError as error:
            notes.append(f"{name.replace('_', ' ')}: not drawn, because {error}")
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


def scores_sentence(scores: Scores) -> str:
    """What was found of one model, in one sentence."""
    error, known = scores.value("mae") or 0.0, scores.value("known_physics_mae") or 0.0
    better = f", a factor {known / error:.3g} less than known physics alone" if known > error > 0.0 else ""
    held, unit = 100.0 * (scores.value("coverage_95") or 0.0), unit_of(scores, "a")
    return (
        f"On unseen rows, the mean absolute error of the acceleration is {error:.3g} {unit}{better}; "
        f"95 % intervals contain {held:.0f} %."
    )


def scores_pictures(scores: Scores) -> list[Picture]:
    """The figures of several models that are worth a page: errors of motions, and by joint."""
    figures = figures_of(scores)
    captions = {
        "motions": "How the error of predicted positions grows, on time that no model has seen.",
        "errors": "Errors of every model by joint, on time that none has seen.",
    }
    return [Picture(caption, figures[name]) for name, caption in captions.items() if name in figures]


def scores_table(scores: Scores, names: Mapping[str, str] | None = None) -> Table:
    """Models side by side, by these names if given."""
    header, rows = overall(scores)
    shown = [[(names or {}).get(name, name), *(cell.partition(" (")[0] for cell in cells)] for name, *cells in rows]
    return Table("Models on time that none of them has seen", header, shown)
