"""Plots: predicted accelerations and normal forces against the truth, and the course of the search."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forcegp.data import Dataset
from forcegp.errors import InvalidInput
from forcegp.evaluation.plots import style
from forcegp.evaluation.plots.style import QUANTILE
from forcegp.evaluation.predicted_rows import PredictedRows, predict_rows
from forcegp.mechanics import Contact, Held, LoopClosure
from forcegp.posterior.posterior import Posterior


def prediction_figure(posterior: Posterior, dataset: Dataset, *, start: float = 0.0, seconds: float = 4.0) -> Figure:
    """One row per joint: acceleration on the left, errors on the right, over `seconds` of the first episode.

    The dark band is 2 sigma of the acceleration, the light one adds the measurement noise.
    """
    rows = style.window(dataset, start, seconds)
    predicted = predict_rows(posterior, rows)
    figure = style.new_figure(11.0, 1.0 + 1.35 * rows.nv)
    axes = figure.subplots(rows.nv, 2, sharex=True, squeeze=False, width_ratios=(1.25, 1.0))
    names, units = style.short_joint_names(rows.joint_names), style.joint_units(rows, "a")
    for joint in range(rows.nv):
        draw_acceleration(axes[joint, 0], rows, predicted, joint)
        draw_error(axes[joint, 1], rows, predicted, joint)
        style.quiet(axes[joint, 0], y=f"{names[joint]}\n{units[joint]}")
        style.quiet(axes[joint, 1], y=units[joint])
    for column, title in enumerate(("Acceleration", "Error: prediction minus measurement (dots) or truth (line)")):
        axes[0, column].set_title(title, fontsize=style.NORMAL, loc="left")
        axes[-1, column].set_xlabel("time [s]", fontsize=style.NORMAL)
    figure.align_ylabels(axes[:, 0])
    figure.align_ylabels(axes[:, 1])
    title = f"Prediction after {len(posterior.training)} training points"
    style.legend_above(figure, title, axes[0, 0], axes[0, 1], markerscale=4)
    return figure


def draw_acceleration(axes: Axes, rows: Dataset, predicted: PredictedRows, joint: int) -> None:
    """Measurement, band, truth and mean of one joint over time."""
    time, mean, spread = rows.time, predicted.mean[:, joint], 2.0 * predicted.std[:, joint]
    axes.plot(time, rows.a[:, joint], ".", color=style.MEASUREMENT, markersize=1.8, alpha=0.7, label="measured")
    style.draw_band(axes, time, mean, spread, alpha=0.35, label="2σ")
    if "a" in rows.truth:
        axes.plot(time, rows.truth["a"][:, joint], color=style.TRUTH, linewidth=1.0, label="true")
    axes.plot(time, mean, color=style.PREDICTION, linewidth=1.3, linestyle=style.DASHED, label="predicted")
    axes.margins(x=0)


def draw_error(axes: Axes, rows: Dataset, predicted: PredictedRows, joint: int) -> None:
    """Errors of one joint over time, about the bands of 2 sigma without and with measurement noise."""
    time, mean = rows.time, predicted.mean[:, joint]
    inner, outer = 2.0 * predicted.std[:, joint], 2.0 * predicted.measurement_std[:, joint]
    style.draw_band(axes, time, np.zeros_like(mean), outer, alpha=0.13, label="2σ of a measurement")
    style.draw_band(axes, time, np.zeros_like(mean), inner, alpha=0.35)
    axes.plot(time, mean - rows.a[:, joint], ".", color=style.MEASUREMENT, markersize=1.8, alpha=0.7)
    if "a" in rows.truth:
        axes.plot(time, mean - rows.truth["a"][:, joint], color=style.TRUTH, linewidth=1.0)
    axes.axhline(0.0, color=style.PREDICTION, linewidth=0.8, linestyle=style.DASHED)
    axes.margins(x=0)
    limit, largest = 2.0 * float(np.median(outer)), float(np.abs(mean - rows.a[:, joint]).max())
    if largest < 1.5 * limit:  # equal scales where the model is right
        axes.set_ylim(-max(limit, 1.05 * largest), max(limit, 1.05 * largest))


LARGEST_ERROR = 5.0
"""Standard deviations at which the histogram of errors ends; what lies beyond is counted at the ends."""
ERROR_ROWS = 2000


def normal_force_figure(posterior: Posterior, dataset: Dataset, *, start: float = 0.0, seconds: float = 4.0) -> Figure:
    """One row per contact: force over `seconds` of the first episode; errors in standard deviations beside it.

    The force is |s_p| lambda in N, positive where the surface pushes along its gradient; where a point is held, the
    part along each axis of the world. Where the Dataset holds
    "lambda", it is drawn, with a histogram of (prediction - truth) / standard deviation over up to ERROR_ROWS rows of
    the whole Dataset beside the standard normal distribution, which it follows if the intervals are right.
    Raises InvalidInput without contacts, and for models without forces.
    """
    if not posterior.model.contacts:
        raise InvalidInput(
            f"a model of {posterior.description} has no normal force to show; give one with contacts that predicts "
            "forces."
        )
    rows = style.window(dataset, start, seconds)
    contacts = len(posterior.model.contacts)
    known = "lambda" in dataset.truth and dataset.truth["lambda"].shape[1] == contacts
    figure = style.new_figure(11.0 if known else 8.0, 1.2 + 2.4 * contacts)
    grid = figure.subplots(contacts, 2 if known else 1, squeeze=False, width_ratios=(2.4, 1.0) if known else None)
    forces = _normal_forces(posterior, rows)
    every = None
    if known:
        spread = np.unique(np.linspace(0, len(dataset) - 1, ERROR_ROWS).astype(int))
        every = _normal_forces(posterior, dataset.rows(spread))
    for index, contact in enumerate(posterior.model.contacts):
        name, label = _contact_labels(contact)
        title = f"Contact {index}: {name}" if contacts > 1 else name[0].upper() + name[1:]
        _draw_force(grid[index, 0], rows, forces, index, known)
        style.quiet(grid[index, 0], title=title, x="time [s]", y=label)
        if every is not None:
            title = _draw_errors(grid[index, 1], every, index, label.split()[-1].strip("[]"))
            style.quiet(grid[index, 1], title=title, x="error / standard deviation", y="density")
    style.legend_below(figure, *grid.ravel(), size=style.NORMAL)
    held = any(isinstance(contact.surface, Held) for contact in posterior.model.contacts)
    style.heading(figure, f"{'Contact' if held else 'Normal'} force after {len(posterior.training)} training points")
    return figure


def _contact_labels(contact: Contact) -> tuple[str, str]:
    """What a contact is, and what its multiplier is."""
    if not isinstance(contact.surface, Held):
        return f"{type(contact.surface).__name__.lower()} at {contact.frame}", "normal force [N]"
    n = contact.surface.normal
    axis = "xyz"[n.index(1.0)] if sorted(n) == [0.0, 0.0, 1.0] else "({:.2g}, {:.2g}, {:.2g})".format(*n)
    if isinstance(contact, LoopClosure):
        where = f"{contact.frame} with {contact.second_frame}"
        return (f"{where} about {axis}", "torque [Nm]") if contact.turning else (f"{where} along {axis}", "force [N]")
    return f"{contact.frame} along {axis}", "force [N]"


@dataclass(frozen=True, eq=False)
class _Forces:
    """Normal forces (rows, m) in N: prediction, its standard deviation, the known forces alone, and the truth."""

    mean: Float[np.ndarray, "rows m"]
    std: Float[np.ndarray, "rows m"]
    nominal: Float[np.ndarray, "rows m"]
    truth: Float[np.ndarray, "rows m"] | None


def _normal_forces(posterior: Posterior, rows: Dataset) -> _Forces:
    q, v, u = (torch.tensor(values) for values in (rows.q, rows.v, rows.u))
    with torch.no_grad():
        multiplier = posterior.predict(q, v, u).multiplier
        assert multiplier is not None, "models with forces predict lambda"
        dynamics = posterior.dynamics(q, v, u)
        size = torch.linalg.vector_norm(dynamics.normals, dim=-1)
        own = size if rows.model is None else torch.linalg.vector_norm(rows.model.dynamics(q, v, u).normals, dim=-1)
        truth = rows.truth.get("lambda")
        if truth is not None:
            truth = own.numpy() * truth if truth.shape == own.shape == size.shape else None
        parts = (size * multiplier.mean, size * multiplier.std, size * dynamics.multiplier_map().offset)
    mean, std, nominal = (part.cpu().numpy() for part in parts)
    return _Forces(mean, std, nominal, truth)


def _draw_force(axes: Axes, rows: Dataset, forces: _Forces, index: int, known: bool) -> None:
    time, mean, spread = rows.time, forces.mean[:, index], QUANTILE * forces.std[:, index]
    axes.plot(time, forces.nominal[:, index], color=style.KNOWN_PHYSICS, linewidth=1.1, label="known physics alone")
    if known and forces.truth is not None:
        axes.plot(time, forces.truth[:, index], color=style.TRUTH, linewidth=3.5, alpha=0.3, label="true")
    style.draw_band(axes, time, mean, spread, alpha=0.3, label="95 % band")
    axes.plot(time, mean, color=style.PREDICTION, linewidth=1.3, label="predicted")
    axes.margins(x=0)


def _draw_errors(axes: Axes, forces: _Forces, index: int, unit: str) -> str:
    """The histogram of errors; returns what their root mean square is, for its title."""
    assert forces.truth is not None, "errors are drawn where the truth is known"
    std = forces.std[:, index]
    acts = std >= 1e-9 * std.max()  # a foot that is lifted has no force, and no error but rounding
    errors = (forces.mean - forces.truth)[acts, index] / np.maximum(std[acts], np.finfo(float).tiny)
    bins = np.linspace(-LARGEST_ERROR, LARGEST_ERROR, 41)
    # half a bin inside of the ends, so that the errors beyond them are seen
    kept = np.clip(errors, 0.5 * (bins[0] + bins[1]), 0.5 * (bins[-2] + bins[-1]))
    axes.hist(kept, bins=list(bins), density=True, color=style.PREDICTION, alpha=0.45, linewidth=0)
    at = np.linspace(-LARGEST_ERROR, LARGEST_ERROR, 201)
    style.draw_line(axes, at, np.exp(-0.5 * at**2) / np.sqrt(2.0 * np.pi), style.TRUTH, 1.0, "standard normal")
    axes.set_xlim(-LARGEST_ERROR, LARGEST_ERROR)
    text = f"{100.0 * float((np.abs(errors) <= QUANTILE).mean()):.0f} % inside\nthe 95 % band"
    corner: dict[str, Any] = {"xycoords": "axes fraction", "ha": "right", "va": "top"}
    axes.annotate(text, (0.98, 0.95), fontsize=style.SMALL, color=style.TRUTH, **corner)
    truth = forces.truth[:, index]
    error, size = (float(np.sqrt(np.square(x).mean())) for x in (forces.mean[:, index] - truth, truth))
    relative = f" ({100.0 * error / size:.2g} %)" if size else ""
    return f"Errors: root mean square {error:.2g} {unit}{relative}"
