"""Plots of a log: what a check found, and the spectra before and after preparation."""

from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forcegp.checks import CheckReport
from forcegp.checks.torques import inverse_dynamics
from forcegp.data import Dataset, Preparation, episodes_in_order, low_pass_gain, motion_spectrum, power_density
from forcegp.data.configurations import as_vectors, space_of
from forcegp.scores.figures import style

DECADES = 12.0
"""Most that an axis of powers shows below its top."""


def preparation_figure(dataset: Dataset, preparation: Preparation) -> Figure:
    """One row per joint: acceleration on the left, torque on the right, of a raw log and after the filter.

    `preparation` holds numbers, not "auto" (`Prepared.preparation`). Raises DatasetError as `motion_spectrum`.
    """
    spectrum = motion_spectrum(dataset, preparation.differentiate)
    frequency, torque, _, step = power_density(dataset, dataset.u)
    figure = style.new_figure(9.0, 1.3 + 1.6 * dataset.nv)
    axes: Any = figure.subplots(dataset.nv, 2, sharex=True, squeeze=False)
    names = style.short_joint_names(dataset.joint_names)
    units = {name: style.joint_units(dataset, name) for name in ("a", "u")}
    inputs = dataset.joint_names if dataset.model is None else dataset.model.inputs
    for joint in range(dataset.nv):
        panel = axes[joint, 0]
        _draw_filtered(panel, spectrum.frequency, spectrum.acceleration_density[:, joint], spectrum.step, preparation)
        if np.isfinite(spectrum.floor[joint]):
            order = 4 if spectrum.source == "q" else 2
            floor = spectrum.floor[joint] * (2.0 * np.pi * spectrum.frequency) ** order
            below = {"label": "noise floor", "linestyle": ":"}
            style.draw_line(panel, spectrum.frequency, floor, style.KNOWN_PHYSICS, 1.0, **below)
        style.quiet(panel, y=f"{names[joint]}\n({units['a'][joint]})² / Hz")
        panel = axes[joint, 1]
        if dataset.joint_names[joint] in inputs:  # a base has no torque
            own = torque[:, inputs.index(dataset.joint_names[joint])]
            _draw_filtered(panel, frequency, own, step, preparation)
        style.quiet(panel, y=f"({units['u'][joint]})² / Hz")
    for column, title in enumerate(("Acceleration (positions differentiated)", "Torque")):
        axes[0, column].set_title(title, fontsize=style.NORMAL, loc="left")
        axes[-1, column].set_xlabel("frequency [Hz]", fontsize=style.NORMAL)
    figure.align_ylabels(axes[:, 0])
    title = "Power spectra"
    if preparation.cutoff is not None:
        title += f" and the filter at {float(preparation.cutoff):.3g} Hz"
    style.legend_above(figure, title, axes[0, 0])
    return figure


def _draw_filtered(axes: Axes, frequency: np.ndarray, power: np.ndarray, step: float, preparation: Preparation) -> None:
    """A spectrum as logged and what the filter leaves of it."""
    _draw(axes, frequency, power, "as logged", color=style.MEASUREMENT)
    if preparation.cutoff is not None:
        gain = low_pass_gain(frequency, 1.0 / step, float(preparation.cutoff), preparation.order)
        _draw(axes, frequency, power * gain**2, "after the filter", color=style.PREDICTION)
        axes.axvline(float(preparation.cutoff), color=style.PREDICTION, linestyle="--", linewidth=1.0, label="cut-off")
    _limits(axes, frequency, power)


def _draw(axes: Axes, frequency: np.ndarray, power: np.ndarray, label: str, **look: Any) -> None:
    axes.loglog(frequency, np.maximum(power, 1e-300), linewidth=1.0, label=label, **look)


def _limits(axes: Axes, frequency: np.ndarray, power: np.ndarray) -> None:
    """From the least to the largest of what was logged: a filter leaves next to nothing beyond, which need not show."""
    axes.set_xlim(frequency[0], frequency[-1])
    shown = power[power > 0.0]
    if len(shown):
        top = 5.0 * float(shown.max())
        axes.set_ylim(max(0.1 * float(shown.min()), top * 10.0**-DECADES), top)


def _draw_time_steps(axes: Axes, dataset: Dataset) -> None:
    """Every time step of a log against time, episodes one after the other."""
    elapsed = 0.0
    steps: list[float] = []
    for _, rows, _ in episodes_in_order(dataset):
        time = rows.time - rows.time[0]
        own = 1e3 * np.diff(time)
        axes.plot(elapsed + time[1:], own, ".", color=style.MEASUREMENT, markersize=1.5, rasterized=True)
        elapsed += float(time[-1])
        steps += own.tolist()
    if not steps:
        return
    median = float(np.median(steps))
    axes.axhline(median, color=style.PREDICTION, linewidth=1.0, linestyle=style.DASHED, label=f"median {median:.4g} ms")
    axes.set_ylim(0.0, 1.15 * max(steps))
    axes.margins(x=0)
    axes.legend(fontsize=style.SMALL, frameon=False, loc="upper right")


COLUMNS, ENTRIES = 3, 6  # panels and names of a legend beside each other
SECONDS = 5.0
MOST_ROWS = 1000


def check_figure(report: CheckReport) -> Figure:
    """Torques of every joint over up to 5 s, then the spectra of all accelerations, then all time steps.

    Where torques were not compared, positions are drawn instead.
    """
    inputs = report.inputs
    nv = inputs.log.nv
    columns = min(nv, COLUMNS if nv != 4 else 2)
    grid = -(-nv // columns)
    figure = style.new_figure(10.0, 1.75 * grid + 3.4 + 0.22 * -(-nv // ENTRIES))
    entries = 0.22 * -(-nv // ENTRIES)  # inches of the legend
    halves: Any = figure.subfigures(2, 1, height_ratios=(1.75 * grid + 0.7, 2.7 + entries))
    panels = style.joint_panels(halves[0], nv, columns)
    names = style.short_joint_names(inputs.names)
    shown = style.window(inputs.log if inputs.compared is None else inputs.compared, 0.0, SECONDS)
    shown = shown.rows(slice(None, None, max(1, len(shown) // MOST_ROWS)))
    for joint, (panel, lowest) in enumerate(panels):
        unit = _draw_joint(panel, report, shown, joint)
        style.quiet(panel, title=_title(names[joint], report, joint), y=unit, x="time [s]" if lowest else "")
    style.legend_above(halves[0], _heading(report), *(panel for panel, _ in panels), markerscale=4)
    left, right = halves[1].subplots(1, 2, squeeze=False)[0]
    _draw_spectra(left, report, names)
    style.legend_below(halves[1], left, columns=min(nv + 1, ENTRIES))
    _draw_time_steps(right, inputs.log)
    style.quiet(right, title="Time steps as logged", x="recorded time [s]", y="ms")
    return figure


def _draw_joint(axes: Axes, report: CheckReport, shown: Dataset, joint: int) -> str:
    """Torque, or position where torques were not compared, of one joint; returns the unit."""
    axes.margins(x=0)
    log = report.comparison
    if log is None:
        space, label = space_of(shown), "position"
        values = as_vectors(shown).copy()
        values[:, space.single_rows] = space.singles(torch.tensor(shown.q)).numpy()
        label = label if space.is_vector_space else "position; of a base its way from the first row"
        style.draw_line(axes, shown.time, values[:, joint], style.TRUTH, 1.0, label)
        return style.joint_units(shown, "q")[joint]
    rows = log.applied(shown)
    tau = inverse_dynamics(log.robot, rows)
    measured, fitted = rows.u[:, joint], log.fit.at(log.robot, tau, rows)[:, joint]
    mended = not np.array_equal(rows.u[:, joint], shown.u[:, joint])
    if mended:
        style.draw_line(axes, rows.time, shown.u[:, joint], style.KNOWN_PHYSICS, 0.9, "before the correction")
    style.draw_line(axes, rows.time, measured, style.MEASUREMENT, 2.2, "measured, filtered")
    style.draw_line(axes, rows.time, tau[:, joint], style.TRUTH, 0.8, "inverse dynamics", linestyle=":")
    dashed = {"label": "with factor, armature, friction", "linestyle": style.DASHED}
    style.draw_line(axes, rows.time, fitted, style.PREDICTION, 1.1, **dashed)
    drawn = [measured, fitted, *([shown.u[:, joint]] if mended else [])]
    low, high = min(values.min() for values in drawn), max(values.max() for values in drawn)
    space = 0.3 * max(float(high - low), 1e-9)
    axes.set_ylim(low - space, high + space)  # inverse dynamics alone may be far off: for example with a wrong unit
    return style.joint_units(shown, "u")[joint]


def _heading(report: CheckReport) -> str:
    counts = report.to_dict()["counts"]
    wrong = dict.fromkeys(finding.subject for finding in report.findings if finding.severity == "wrong")
    what = f" ({', '.join(wrong)})" if wrong else ""
    return f"Check: {counts['wrong']} wrong{what}, {counts['look']} to look at, {counts['ok']} ok"


def _title(name: str, report: CheckReport, joint: int) -> str:
    if report.comparison is None:
        return name
    left = report.comparison.fit.unexplained[joint]
    return f"{name}: {100.0 * left:.2g} % unexplained" if np.isfinite(left) else f"{name}: constant torque"


def _draw_spectra(axes: Axes, report: CheckReport, names: list[str]) -> None:
    """Power of the accelerations of all joints, by differences of the positions, and the cut-off."""
    inputs = report.inputs
    spectrum = motion_spectrum(inputs.even)
    for joint, name in enumerate(names):
        turn, color = divmod(joint, len(style.SERIES))
        look = {"color": style.SERIES[color], "linestyle": ("-", "--", ":")[turn % 3]}
        _draw(axes, spectrum.frequency, spectrum.acceleration_density[:, joint], name, **look)
    _limits(axes, spectrum.frequency, spectrum.acceleration_density)
    preparation = Preparation() if inputs.prepared is None else inputs.prepared.preparation
    title = "Acceleration as logged: no filter"
    if preparation.cutoff is not None:
        axes.axvline(float(preparation.cutoff), color=style.TRUTH, linestyle="--", linewidth=1.0, label="cut-off")
        title = f"Acceleration as logged, and the cut-off at {float(preparation.cutoff):.3g} Hz"
    style.quiet(axes, title=title, x="frequency [Hz]", y="(rad/s²)² / Hz" if inputs.rotates.all() else "power / Hz")
