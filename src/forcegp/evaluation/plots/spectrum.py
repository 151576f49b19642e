"""Plot: power spectra of acceleration and torque before and after a filter, its cut-off and the noise floor."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forcegp.data import (
    Dataset,
    MotionSpectrum,
    Preparation,
    episodes_in_order,
    low_pass_gain,
    motion_spectrum,
    power_density,
)
from forcegp.evaluation.plots import style

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
    for joint in range(dataset.nv):
        panel = axes[joint, 0]
        draw_acceleration_spectrum(panel, spectrum, joint, preparation)
        style.quiet(panel, y=f"{names[joint]}\n({units['a'][joint]})² / Hz")
        panel = axes[joint, 1]
        _draw(panel, frequency, torque[:, joint], style.MEASUREMENT, "as logged")
        if preparation.cutoff is not None:
            gain = low_pass_gain(frequency, 1.0 / step, float(preparation.cutoff), preparation.order)
            _draw(panel, frequency, torque[:, joint] * gain**2, style.PREDICTION, "after the filter")
            draw_cutoff(panel, float(preparation.cutoff))
        _limits(panel, torque[:, joint])
        style.quiet(panel, y=f"({units['u'][joint]})² / Hz")
    for column, title in enumerate(("Acceleration (positions differentiated)", "Torque")):
        axes[0, column].set_title(title, fontsize=style.NORMAL, loc="left")
        axes[-1, column].set_xlabel("frequency in Hz", fontsize=style.NORMAL)
    figure.align_ylabels(axes[:, 0])
    title = "Power spectra"
    if preparation.cutoff is not None:
        title += f" and the filter at {float(preparation.cutoff):.3g} Hz"
    style.legend_above(figure, title, axes[0, 0])
    return figure


def draw_acceleration_spectrum(axes: Axes, spectrum: MotionSpectrum, joint: int, preparation: Preparation) -> None:
    """The acceleration of one joint, its noise floor, and what the filter leaves."""
    power = spectrum.acceleration_density[:, joint]
    _draw(axes, spectrum.frequency, power, style.MEASUREMENT, "as logged")
    if np.isfinite(spectrum.floor[joint]):
        order = 4 if spectrum.source == "q" else 2
        floor = spectrum.floor[joint] * (2.0 * np.pi * spectrum.frequency) ** order
        axes.plot(
            spectrum.frequency, floor, color=style.KNOWN_PHYSICS, linewidth=1.0, linestyle=":", label="noise floor"
        )
    if preparation.cutoff is not None:
        gain = low_pass_gain(spectrum.frequency, 1.0 / spectrum.step, float(preparation.cutoff), preparation.order)
        _draw(axes, spectrum.frequency, power * gain**2, style.PREDICTION, "after the filter")
        draw_cutoff(axes, float(preparation.cutoff))
    _limits(axes, power)


def draw_cutoff(axes: Axes, cutoff: float, color: str = style.PREDICTION) -> None:
    """A vertical line at the cut-off [Hz]."""
    axes.axvline(cutoff, color=color, linewidth=1.0, linestyle=style.DASHED, label="cut-off")


def _draw(axes: Axes, frequency: np.ndarray, power: np.ndarray, color: str, label: str) -> None:
    axes.loglog(frequency, np.maximum(power, 1e-300), color=color, linewidth=1.0, label=label)
    axes.set_xlim(frequency[0], frequency[-1])


def _limits(axes: Axes, power: np.ndarray) -> None:
    """From the least to the largest of what was logged: a filter leaves next to nothing beyond, which need not show."""
    shown = power[power > 0.0]
    if len(shown):
        top = 5.0 * float(shown.max())
        axes.set_ylim(max(0.1 * float(shown.min()), top * 10.0**-DECADES), top)


def draw_time_steps(axes: Axes, dataset: Dataset) -> None:
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
    label = f"median {median:.4g} ms"
    axes.axhline(median, color=style.PREDICTION, linewidth=1.0, linestyle=style.DASHED, label=label)
    axes.set_ylim(0.0, 1.15 * max(steps))
    axes.margins(x=0)
    axes.legend(fontsize=style.SMALL, frameon=False, loc="upper right")
