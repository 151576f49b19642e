"""Plots of one model on a recording: accelerations, normal forces and short motions, and which of them there are."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forcegp.data import Dataset, recorded_motions
from forcegp.errors import ForceGPError, InvalidInput
from forcegp.mechanics import Contact, Held, LoopClosure
from forcegp.posterior.posterior import Posterior
from forcegp.scores.figures import style
from forcegp.scores.figures.friction_curves import curve_panels, friction_curves_figure
from forcegp.scores.motions import apart_from, interval_about
from forcegp.scores.predicted_rows import PredictedRows, predict_rows

LARGEST_GRID = 12
SAMPLES = 24
"""Functions drawn for an interval where the model has no calibrated ones."""


def model_pictures(
    posterior: Posterior, dataset: Dataset, progress: Callable[[int, int, str], None] | None = None
) -> tuple[list[style.Picture], list[str]]:
    """Every plot that the model and the recording allow, and why others are missing (uneven time steps, say)."""
    wanted: list[tuple[str, str, Callable[[Posterior, Dataset], Figure]]] = [
        (
            "motions_ahead",
            "Every half second a prediction begins at the recorded state and follows the recorded u. The line is its "
            "error, the band its 95 % interval.",
            motion_bands_figure,
        ),
        ("prediction", "Accelerations over time, and their errors on the right.", prediction_figure),
    ]
    if curve_panels(posterior):
        caption = (
            "Forces over velocity, with 95 % bands: the friction laws of the model and what was learned beside them. "
            "Ticks are the velocities of the training data."
        )
        wanted.insert(0, ("forces", caption, friction_curves_figure))
    if posterior.model.contacts:
        wanted.insert(-1, ("normal_force", "The forces of contacts, which no sensor measured.", normal_force_figure))
    pictures, missing = [], []
    for done, (name, caption, draw) in enumerate(wanted):
        if progress is not None:
            progress(done, len(wanted), name)
        try:
            pictures.append(style.Picture(name, caption, draw(posterior, dataset)))
        except ForceGPError as error:
            missing.append(f"{name.replace('_', ' ')}: not drawn, because {error}")
    return pictures, missing


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


def normal_force_figure(posterior: Posterior, dataset: Dataset, *, start: float = 0.0, seconds: float = 4.0) -> Figure:
    """One row per contact: force over `seconds` of the first episode, with the truth where the Dataset holds "lambda".

    The force is |s_p| lambda in N, positive where the surface pushes along its gradient; where a point is held, the
    part along each axis of the world. Raises InvalidInput without contacts, and for models without forces.
    """
    if not posterior.model.contacts:
        raise InvalidInput(
            f"a model of {posterior.description} has no normal force to show; give one with contacts that predicts "
            "forces."
        )
    rows, contacts = style.window(dataset, start, seconds), posterior.model.contacts
    figure = style.new_figure(8.0, 1.2 + 2.4 * len(contacts))
    grid: Any = figure.subplots(len(contacts), 1, squeeze=False)[:, 0]
    q, v, u = (torch.tensor(values) for values in (rows.q, rows.v, rows.u))
    with torch.no_grad():
        multiplier, dynamics = posterior.predict(q, v, u).multiplier, posterior.dynamics(q, v, u)
        assert multiplier is not None, "models with forces predict lambda"
        own = dynamics if rows.model is None else rows.model.dynamics(q, v, u)
        size, other = (torch.linalg.vector_norm(each.normals, dim=-1).numpy() for each in (dynamics, own))
        mean, spread = size * multiplier.mean.numpy(), style.QUANTILE * size * multiplier.std.numpy()
        nominal, truth = size * dynamics.multiplier_map().offset.numpy(), rows.truth.get("lambda")
    for index, (axes, contact) in enumerate(zip(grid, contacts, strict=True)):
        style.draw_line(axes, rows.time, nominal[:, index], style.KNOWN_PHYSICS, 1.1, "known physics alone")
        if truth is not None and truth.shape == other.shape == size.shape:
            style.draw_line(axes, rows.time, (other * truth)[:, index], style.TRUTH, 3.5, "true", alpha=0.3)
        style.draw_band(axes, rows.time, mean[:, index], spread[:, index], alpha=0.3, label="95 % band")
        style.draw_line(axes, rows.time, mean[:, index], style.PREDICTION, 1.3, "predicted")
        axes.margins(x=0)
        name, label = _contact_labels(contact)
        title = f"Contact {index}: {name}" if len(contacts) > 1 else name[0].upper() + name[1:]
        style.quiet(axes, title=title, x="time [s]", y=label)
    style.legend_below(figure, *grid, size=style.NORMAL)
    held = any(isinstance(contact.surface, Held) for contact in contacts)
    style.heading(figure, f"{'Contact' if held else 'Normal'} force after {len(posterior.training)} training points")
    return figure


def _contact_labels(contact: Contact) -> tuple[str, str]:
    """What a contact is, and what its multiplier is."""
    if not isinstance(contact.surface, Held):
        return f"{type(contact.surface).__name__.lower()} at {contact.frame}", "normal force [N]"
    axis = " ".join(f"{x:.2g}" for x in contact.surface.normal)
    axis = {"1 0 0": "x", "0 1 0": "y", "0 0 1": "z"}.get(axis, f"({axis})")
    if isinstance(contact, LoopClosure) and contact.turning:
        return f"{contact.frame} about {axis}", "torque [Nm]"
    return f"{contact.frame} along {axis}", "force [N]"


def motion_bands_figure(
    posterior: Posterior, dataset: Dataset, *, start: float = 0.0, seconds: float = 6.0, horizon: float = 0.5
) -> Figure:
    """Errors of q over time: every `horizon` s a prediction begins at the recorded state and follows the recorded u.

    Bands are 95 % intervals: calibrated ones of the model, else those of functions drawn from it; a model without
    either has none. Positions would coincide at this scale, so their errors are drawn. At most 12 joints.

    Raises InvalidInput for a recording whose rows are not evenly spaced, or shorter than `horizon`.
    """
    rows = style.window(dataset, start, seconds)
    elapsed = rows.time - rows.time[0]
    starts = np.searchsorted(elapsed, np.arange(0.0, elapsed[-1] - horizon, horizon) - 1e-9)
    recorded = recorded_motions(rows, [int(row) for row in starts] or 1, horizon)
    q0, v0, u = (torch.tensor(x) for x in (recorded.q[:, 0], recorded.v[:, 0], recorded.u))
    calibrated = posterior.motion_intervals is not None
    drawn = len(posterior.latent_names) > 0
    samples = SAMPLES if drawn and not calibrated else 0
    rollout = posterior.rollout(q0, v0, u, recorded.dt, integrator="rk4", samples=samples)
    half_widths = None
    if calibrated or samples:
        low, high = interval_about(rollout, rollout.q)
        half_widths = 0.5 * (high - low).cpu().numpy()
    joints = min(rows.nv, LARGEST_GRID)
    columns = 1 if joints < 3 else 2 if joints < 9 else 3
    figure = style.new_figure(11.0, 1.0 + 1.55 * -(-joints // columns))
    names, units = style.short_joint_names(rows.joint_names), style.joint_units(rows, "q")
    panels = style.joint_panels(figure, joints, columns)
    there = torch.as_tensor(recorded.q.copy(), device=rollout.q.device)
    signed = apart_from(there, rollout.q, rollout.space).cpu().numpy()
    for joint, (axes, lowest) in enumerate(panels):
        axes.axhline(0.0, color="#B8BCC2", linewidth=0.8)
        for motion, row in enumerate(recorded.rows):
            time = elapsed[row] + recorded.time
            first = motion == 0
            if half_widths is not None:
                half = half_widths[motion, :, joint]
                band = {"alpha": 0.28, "label": "95 % interval" if first else None}
                style.draw_band(axes, time, np.zeros_like(half), half, **band)
            label = "predicted − recorded" if first else None
            style.draw_line(axes, time, signed[motion, :, joint], style.TRUTH, 1.1, label)
        axes.margins(x=0)
        style.quiet(axes, title=names[joint], y=units[joint], x="time [s]" if lowest else "")
    shown = f" ({joints} of {rows.nv} joints)" if joints < rows.nv else ""
    style.legend_above(figure, f"Errors of positions predicted {horizon:g} s ahead{shown}", panels[0][0])
    return figure
