"""Plot: short motions predicted one after the other along a recording, as errors within their 95 % intervals."""

import numpy as np
import torch
from matplotlib.figure import Figure

from forcegp.data import Dataset, recorded_motions
from forcegp.posterior.posterior import Posterior
from forcegp.scores.figures import style
from forcegp.scores.motions import apart_from, interval_about

LARGEST_GRID = 12
SAMPLES = 24
"""Functions drawn for an interval where the model has no calibrated ones."""


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
