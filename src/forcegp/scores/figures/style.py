"""What all figures share: colours that everyone can distinguish, quiet axes, names, units, and whole PNG files."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, FigureBase
from matplotlib.text import Text

from forcegp.atomic_files import atomic_file
from forcegp.data import Dataset
from forcegp.errors import InvalidInput

# Okabe & Ito (2008): distinguishable with every kind of colour vision.
PREDICTION = "#0072B2"
KNOWN_PHYSICS = "#D55E00"
IDENTIFIED = "#009E73"
BLACK_BOX = "#CC79A7"
TRUTH = "#111111"
MEASUREMENT = "#9A9A9A"
QUIET = "#5F6670"
SERIES = (PREDICTION, KNOWN_PHYSICS, IDENTIFIED, BLACK_BOX, "#E69F00", "#56B4E9", TRUTH)

DASHED = (0, (4, 1.5))
SMALL, NORMAL, LARGE = 8.0, 9.0, 11.0
RESOLUTION = 150  # dots per inch
QUANTILE = 1.959963984540054  # of the standard normal distribution at 97.5 %


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of that size in inches on its own Agg canvas; touches no global state of pyplot."""
    figure = Figure(figsize=(width, height), dpi=RESOLUTION, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def quiet(axes: Axes, *, title: str = "", x: str = "", y: str = "") -> None:
    """Titles and labels in place, and nothing that draws the eye away from the data."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#B8BCC2")
    axes.grid(True, color="#ECEEF0", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=SMALL, color="#B8BCC2", labelcolor=QUIET, length=3)
    if title:
        axes.set_title(title, fontsize=NORMAL, loc="left", color=TRUTH)
    axes.set_xlabel(x, fontsize=SMALL, color=QUIET)
    axes.set_ylabel(y, fontsize=SMALL, color=QUIET)


def draw_band(
    axes: Axes, x: np.ndarray, mean: np.ndarray, half: np.ndarray, *, color: str = PREDICTION, alpha: float, **more: Any
) -> None:
    """The band from `mean - half` to `mean + half`, without a line around it."""
    axes.fill_between(x, mean - half, mean + half, color=color, alpha=alpha, linewidth=0, **more)


def draw_line(axes: Axes, x: Any, y: Any, color: str, width: float, label: str | None = None, **more: Any) -> None:
    """A line of that colour and width."""
    axes.plot(x, y, color=color, linewidth=width, label=label, **more)


def heading(figure: FigureBase, text: str, *, size: float = LARGE) -> None:
    """A bold title above all panels, at the left."""
    figure.suptitle(text, fontsize=size, fontweight="bold", x=0.01, ha="left")


def legend_below(figure: FigureBase, *axes: Axes, columns: int | None = None, size: float = SMALL, **more: Any) -> None:
    """What these axes show, each label once, below all panels, by default in one row."""
    entries: dict[str, Artist] = {}
    for source in axes:
        for handle, label in zip(*source.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    more |= {"handles": [*entries.values()], "ncols": columns or max(1, len(entries))}
    figure.legend(loc="outside lower center", fontsize=size, frameon=False, **more)


@dataclass(frozen=True, eq=False)
class Picture:
    """A figure under the name of its file without ending, with a caption that says what is to be seen."""

    name: str
    caption: str
    figure: Figure

    @cached_property
    def png(self) -> bytes:
        """The figure as a file."""
        stream = io.BytesIO()
        for text in self.figure.findobj(Text):
            text.set_parse_math(False)  # type: ignore[attr-defined]  # a Text; "$" in the name of a joint is no formula
        with rc_context({"text.parse_math": False}):  # of ticks that are made now
            self.figure.savefig(stream, format="png")
        return stream.getvalue()

    def save(self, folder: Path) -> None:
        """Write NAME.png. Raises InvalidInput if the folder does not exist."""
        with atomic_file(folder / f"{self.name}.png") as temporary:
            temporary.write_bytes(self.png)


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a PNG. Raises InvalidInput if the folder does not exist."""
    Picture(Path(path).stem, "", figure).save(Path(path).parent)


def window(dataset: Dataset, start: float, seconds: float) -> Dataset:
    """Rows of the first episode from `start` s on for `seconds`, in order of time. Raises InvalidInput."""
    rows = np.flatnonzero(dataset.episode == dataset.episodes[0])
    rows = rows[np.argsort(dataset.time[rows], kind="stable")]
    elapsed = dataset.time[rows] - dataset.time[rows[0]]
    chosen = rows[(elapsed >= start) & (elapsed <= start + seconds)]
    if not chosen.size:
        raise InvalidInput(
            f"no rows from {start} s on for {seconds} s: episode {dataset.episodes[0]} lasts {elapsed[-1]:.3g} s."
        )
    return dataset.rows(chosen)


def short_joint_names(names: Sequence[str]) -> list[str]:
    """`lbr_iiwa_joint_1`, `lbr_iiwa_joint_2` -> `joint 1`, `joint 2`: the common beginning of all names is left out."""
    columns = list(zip(*names, strict=False)) if len(names) > 1 else []
    different = next((place for place, letters in enumerate(columns) if len(set(letters)) > 1), len(columns))
    shared = names[0][:different]
    shared = shared[: max(shared.rfind(mark) for mark in "_-/. ") + 1]
    return [f"joint {end}" if end.isdigit() else end for end in [name[len(shared) :] for name in names]]
