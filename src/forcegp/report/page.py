"""One self-contained HTML page: what was found, the robot in motion, pictures, tables, and how it was made."""

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from forcegp import __version__
from forcegp.atomic_files import MARK, atomic_file
from forcegp.data import Dataset
from forcegp.data.views import decided
from forcegp.errors import MissingExtra
from forcegp.posterior.posterior import Posterior
from forcegp.report.motion import RecordedScene, recorded_scene, recording
from forcegp.scores import Picture, Scores, model_pictures, overall, unit_of

Table = tuple[str, Sequence[str], Sequence[Sequence[str]]]
"""Title, header, and rows of text."""


@dataclass(frozen=True, eq=False)
class Page:
    """What a page shows, from top to bottom. What is empty is left out."""

    title: str
    best: str
    """The one sentence to remember."""
    findings: Sequence[tuple[str, str]] = ()
    """Subjects, and what was found."""
    scene: str = ""
    """An HTML document with the robot (`recording`)."""
    scene_notes: Sequence[str] = ()
    """What the arrows are; or why there is no robot."""
    pictures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()
    next_steps: Sequence[tuple[str, str]] = ()
    """What to do next, and the command for it."""
    details: Mapping[str, Any] = field(default_factory=dict)
    """The resolved configuration, for those who want to repeat it."""


def write_page(path: str | Path, page: Page, *, overwrite: bool = True) -> None:
    """Write the page. Raises InvalidInput if the folder does not exist, or the file may not be replaced."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters["base64"] = lambda png: base64.b64encode(png).decode()
    template = environment.from_string(files("forcegp.report").joinpath("page.html").read_text(encoding="utf-8"))
    details = json.dumps(page.details, indent=1, default=str) if page.details else ""
    with atomic_file(path, overwrite=overwrite) as temporary:
        text = template.render(page=page, details=details, version=__version__, mark=MARK)
        temporary.write_text(text + "\n", encoding="utf-8")


SECONDS = 10.0  # of the recording in the scene


def model_page(posterior: Posterior, dataset: Dataset, *, shapes: str | Path | None = None, **texts: Any) -> Page:
    """A page of `texts`, with the robot in motion, and pictures of the model (`scores.model_pictures`).

    What cannot be drawn is named on the page with the reason. `shapes` is a URDF with visual elements.
    """
    dataset = decided(dataset)
    drawn, missing = model_pictures(posterior, dataset)
    try:
        recorded = recorded_scene(dataset, posterior, seconds=SECONDS, shapes=shapes)
        scene, notes = recording(recorded), scene_notes(recorded)
    except MissingExtra as error:
        scene, notes = "", [f"The robot is not shown: {error}."]
    return Page(**texts, scene=scene, scene_notes=[*notes, *missing], pictures=drawn)


def scene_notes(recorded: RecordedScene) -> list[str]:
    """What the arrows of a scene mean, and what of the robot could not be drawn."""
    long = f"would be {recorded.arrow_length:.2g} m long"
    drawn = (group for group in recorded.arrows if group.largest > 0.0)
    arrows = [f"{group.title}: {group.largest:.3g} {group.unit} {long}" for group in drawn]
    meaning = "Arrows are forces that the model found, torques along the axes of joints; pale ends are 95 % intervals"
    return ([f"{meaning}. {'; '.join(arrows)}."] if arrows else []) + recorded.doubts


def scores_sentence(scores: Scores, model: str | None = None) -> str:
    """What was found of one model, in one sentence."""
    error, known, held = (scores.value(x, model=model) or 0.0 for x in ("mae", "known_physics_mae", "coverage_95"))
    better = f", a factor {known / error:.3g} less than known physics alone" if known > error > 0.0 else ""
    seen = f"the mean absolute error of the acceleration is {error:.3g} {unit_of(scores, 'a')}{better}"
    return f"On unseen rows, {seen}; 95 % intervals contain {100.0 * held:.0f} %."


def scores_table(scores: Scores, names: Mapping[str, str] | None = None) -> Table:
    """Models side by side, by these names if given."""
    header, rows = overall(scores)
    shown = [[(names or {}).get(name, name), *(cell.partition(" (")[0] for cell in cells)] for name, *cells in rows]
    return "Models on time that none of them has seen", header, shown
