"""Plot of a log: what a check found."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forcegp.checks import CheckReport
from forcegp.data import Dataset, motion_spectrum
from forcegp.data.configurations import as_vectors, space_of
from forcegp.scores.figures import style

DECADES = 12.0
"""Most that an axis of powers shows below its top."""


COLUMNS, ENTRIES = 3, 6  # panels and names of a legend beside each other
SECONDS = 5.0
MOST_ROWS = 1000


def check_figure(report: CheckReport) -> Figure:
    """Torques of every joint over up to 5 s, then the spectra of all accelerations.

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
        unit, title = _draw_joint(panel, report, shown, joint), names[joint]
        if report.comparison is not None:
            left = report.comparison.fit.unexplained[joint]
            title += f": {100.0 * left:.2g} % unexplained" if np.isfinite(left) else ": constant torque"
        style.quiet(panel, title=title, y=unit, x="time [s]" if lowest else "")
    counts = report.to_dict()["counts"]
    wrong = report.doubts.at("wrong").subjects
    told = f"{counts['wrong']} wrong{wrong and f' ({wrong})'}, {counts['look']} to look at, {counts['ok']} ok"
    style.legend_above(halves[0], f"Check: {told}", *(panel for panel, _ in panels), markerscale=4)
    spectra = halves[1].subplots()
    _draw_spectra(spectra, report, names)
    style.legend_below(halves[1], spectra, columns=min(nv + 1, ENTRIES))
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
    there, every = log.at(shown)
    rows, tau, fitted = there.rows, there.tau, every[:, joint]
    measured = rows.u[:, joint]
    if not np.array_equal(measured, shown.u[:, joint]):
        style.draw_line(axes, rows.time, shown.u[:, joint], style.KNOWN_PHYSICS, 0.9, "before the correction")
    style.draw_line(axes, rows.time, measured, style.MEASUREMENT, 2.2, "measured, filtered")
    style.draw_line(axes, rows.time, tau[:, joint], style.TRUTH, 0.8, "inverse dynamics", linestyle=":")
    dashed = {"label": "with factor, armature, friction", "linestyle": style.DASHED}
    style.draw_line(axes, rows.time, fitted, style.PREDICTION, 1.1, **dashed)
    drawn = measured, fitted, shown.u[:, joint]
    low, high = min(values.min() for values in drawn), max(values.max() for values in drawn)
    space = 0.3 * max(float(high - low), 1e-9)
    axes.set_ylim(low - space, high + space)  # inverse dynamics alone may be far off: for example with a wrong unit
    return style.joint_units(shown, "u")[joint]


def _draw_spectra(axes: Axes, report: CheckReport, names: list[str]) -> None:
    """Power of the accelerations of all joints, by differences of the positions, and the cut-off."""
    inputs = report.inputs
    spectrum = motion_spectrum(inputs.even)
    power = spectrum.acceleration_density
    for joint, name in enumerate(names):
        turn, color = divmod(joint, len(style.SERIES))
        look = {"color": style.SERIES[color], "linestyle": ("-", "--", ":")[turn % 3], "linewidth": 1.0, "label": name}
        axes.loglog(spectrum.frequency, np.maximum(power[:, joint], 1e-300), **look)
    axes.set_xlim(spectrum.frequency[0], spectrum.frequency[-1])
    shown = power[power > 0.0]
    if shown.size:
        top = 5.0 * float(shown.max())
        axes.set_ylim(max(0.1 * float(shown.min()), top * 10.0**-DECADES), top)
    cutoff = inputs.cutoff
    title = "Acceleration as logged: no filter"
    if cutoff is not None:
        axes.axvline(float(cutoff), color=style.TRUTH, linestyle="--", linewidth=1.0, label="cut-off")
        title = f"Acceleration as logged, and the cut-off at {float(cutoff):.3g} Hz"
    style.quiet(axes, title=title, x="frequency [Hz]", y="(rad/s²)² / Hz" if inputs.rotates.all() else "power / Hz")


def contacts_figure(
    time: Float[np.ndarray, " rows"],
    distance: Float[np.ndarray, " rows"],
    threshold: float,
    torque: Float[np.ndarray, "rows nv"],
    contacts: Sequence[tuple[float, float]],
    joints: Sequence[str],
    title: str,
) -> Figure:
    """Squared Mahalanobis distances with their threshold, and torques in Nm (N); `contacts` (start, end) in s."""
    figure = style.new_figure(9.0, 5.4)
    above, below = figure.subplots(2, 1, sharex=True)
    for axes in (above, below):
        axes.margins(x=0)
        for start, end in contacts:
            axes.axvspan(start, end, color=style.KNOWN_PHYSICS, alpha=0.18, linewidth=0, label="contact")
    style.draw_line(above, time, np.maximum(distance, 1e-3), style.PREDICTION, 0.8, "distance from free motion")
    style.draw_line(above, time, np.full_like(time, threshold), style.TRUTH, 1.0, "threshold", linestyle=style.DASHED)
    above.set_yscale("log")
    above.set_ylim(bottom=max(0.1, float(np.quantile(distance, 0.01))))
    style.quiet(above, y="squared distance [σ²]")
    names = style.short_joint_names(joints)
    for joint, name in enumerate(names):
        style.draw_line(below, time, torque[:, joint], style.SERIES[joint % len(style.SERIES)], 0.9, name)
    style.quiet(below, x="time [s]", y="unexplained torque [Nm (N)]")
    style.legend_above(figure, title, above)
    style.legend_below(figure, below)
    return figure
