"""Plot: the friction curves of a model, laws and learned part together, over velocity, and the truth where known."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forcegp.data import Dataset, evenly
from forcegp.errors import InvalidInput
from forcegp.forces import (
    Actuation,
    ContactFriction,
    CoupledRotors,
    JointFriction,
    LoadFriction,
    Offset,
    RigidBodies,
    Rotor,
    Unknown,
)
from forcegp.model import Model
from forcegp.posterior.posterior import Posterior
from forcegp.scores.accuracy import true_names
from forcegp.scores.figures import style

LARGEST_GRID = 12
BEYOND = 0.18
"""Part of the visited range that is drawn on either side of it."""
POINTS = 241
NOT_OF_VELOCITY = (Actuation, RigidBodies, Rotor, CoupledRotors, Offset, LoadFriction)
"""Known forces that are no curve over the velocity of one joint."""
LAWS = "friction laws"
"""The component of a joint that has laws alone."""
TRUE_POINTS = 200


@dataclass(frozen=True, eq=False)
class CurvePanel:
    """One process of one feature: its name, and its number in its term; None for the laws of a joint alone.

    `joint` is the joint whose friction it is, by number: the laws of the system are added to it.
    """

    latent: str
    component: str
    term: Unknown | None
    index: int
    joint: int | None


def curve_panels(posterior: Posterior) -> list[CurvePanel]:
    """All processes of one feature; where there are none, the friction laws of the joints."""
    robot, panels = posterior.model.robot, []
    for component, term, which in posterior.trained.unknown.named(robot):
        for index, own in enumerate(term.latent_names(robot)):
            place = which.start + index
            if posterior.likelihood.standardization.shift[place].shape[-1] == 1:
                joint = robot.joint_names.index(own) if isinstance(term, JointFriction) else None
                panels.append(CurvePanel(posterior.latent_names[place], component, term, index, joint))
    with_law = [j for j in range(robot.nv) if not panels and law_forces(posterior.model, j, np.ones(1)).any()]
    return panels + [CurvePanel(robot.joint_names[joint], LAWS, None, joint, joint) for joint in with_law]


def law_forces(model: Model, joint: int, velocities: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """What the friction laws of the system resist with, in Nm or N, where this joint moves alone; 0 without laws."""
    robot = model.robot
    v = torch.zeros(len(velocities), robot.nv, dtype=torch.float64, device=robot.device)
    v[:, joint] = torch.tensor(velocities, dtype=v.dtype, device=v.device)
    u = v.new_zeros(len(v), len(model.inputs))
    state = model.state(robot.neutral().expand(len(v), -1), v, u)
    laws = [law for law in model.laws if not isinstance(law, NOT_OF_VELOCITY)]
    return -sum((law.force(state).expand_as(v) for law in laws), torch.zeros_like(v))[:, joint].detach().cpu().numpy()


def friction_curves_figure(posterior: Posterior, dataset: Dataset | None = None) -> Figure:
    """The first `LARGEST_GRID` curves with their 95 % bands over what was visited in training, and a little beyond.

    To the friction of a joint, the friction laws of the system are added, so that the whole friction is seen; a line
    shows them alone. Where `dataset` holds the true parts of the unknown force, dots show them at its rows. Raises
    InvalidInput if there is no curve.
    """
    panels = curve_panels(posterior)
    if not panels:
        raise InvalidInput(
            f"a model of {posterior.description} has no process that is a curve; fit one with friction priors, for "
            "example JointFriction() or ContactFriction()."
        )
    chosen = panels[:LARGEST_GRID]
    columns = min(4 if len(chosen) > 6 else 3, len(chosen))
    rows = math.ceil(len(chosen) / columns)
    figure = style.new_figure(max(3.1 * columns, 5.2), 1.1 + 2.3 * rows)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    robot = posterior.model.robot
    short = dict(zip(robot.joint_names, style.short_joint_names(robot.joint_names), strict=True))
    several = len({panel.component for panel in chosen}) > 1
    for number, axes in enumerate(grid):
        axes.set_visible(number < len(chosen))
    for axes, panel in zip(grid, chosen, strict=False):
        feature, unit = _draw_curve(axes, posterior, panel, dataset)
        own = panel.latent if panel.term is None else panel.term.latent_names(robot)[panel.index]
        title = f"{panel.component}: {short.get(own, own)}" if several else short.get(own, own)
        what = {"Nm": "torque [Nm]", "": "force / normal force"}.get(unit, f"force [{unit}]")
        style.quiet(axes, title=title, x=feature, y=what)
    below = {"columns": 5 if columns > 2 else 3, "size": style.NORMAL, "markerscale": 2}
    style.legend_below(figure, *grid[: len(chosen)], **below)
    what = "Friction" if all("friction" in panel.component for panel in chosen) else "Forces"
    how = "by the laws of a model" if chosen[0].term is None else "learned"
    shown = f" ({len(chosen)} of {len(panels)} curves)" if len(chosen) < len(panels) else ""
    style.heading(figure, f"{what} {how} from {len(posterior.training)} points{shown}")
    return figure


def _draw_curve(axes: Axes, posterior: Posterior, panel: CurvePanel, dataset: Dataset | None) -> tuple[str, str]:
    """Mean and band, solid where the training data were; training velocities as ticks; the truth as dots.

    Returns the feature along the axis and the unit of the force.
    """
    with torch.no_grad():
        v = posterior.training.v[:, panel.index, None]
        visited = v if panel.term is None else panel.term.features(posterior.likelihood.dynamics)[panel.index]
    visited = visited[:, 0].cpu().numpy()
    low, high = float(visited.min()), float(visited.max())
    margin = BEYOND * (high - low)
    start = max(0.0, low - margin) if low >= 0.0 else low - margin  # a speed is never negative
    at = np.linspace(start, high + margin, POINTS)
    laws = np.zeros(POINTS) if panel.joint is None else law_forces(posterior.model, panel.joint, at)
    mean, spread, label = laws, np.zeros(POINTS), "laws"
    slides = panel.joint is not None and posterior.model.robot.joints[panel.joint].type == "prismatic"
    feature, unit = ("velocity [m/s]", "N") if slides else ("velocity [rad/s]", "Nm")
    inside = (at >= low) & (at <= high)
    if panel.term is not None:
        curve = posterior.curve(panel.latent, at[:, None])
        mean, spread = laws + curve.mean.cpu().numpy(), style.QUANTILE * curve.std.cpu().numpy()
        label, unit = "laws and learned part" if laws.any() else "learned", curve.unit
        name, _, of = curve.feature_names[0].partition(" [")  # `velocity of joint_1 [rad/s]`: the title names the joint
        feature = " [".join(filter(None, (name.split(" of ")[0], of)))
        style.draw_band(axes, at, mean, spread, alpha=0.28, where=inside.tolist(), label="95 % band")
        style.draw_band(axes, at, mean, spread, alpha=0.12)
        if laws.any():
            style.draw_line(axes, at, laws, style.KNOWN_PHYSICS, 1.0, "laws alone", linestyle=style.DASHED)
    axes.axhline(0.0, color="#B8BCC2", linewidth=0.8, zorder=1)
    style.draw_line(axes, at[inside], mean[inside], style.PREDICTION, 1.5, label)
    dashes = {"label": "beyond the training data", "linestyle": (0, (3, 2)), "zorder": 1.9}
    style.draw_line(axes, at, mean, style.PREDICTION, 1.2, **dashes)
    ticks = {"markersize": 5, "markeredgewidth": 0.6, "transform": axes.get_xaxis_transform()}
    ticks |= {"label": "training velocities", "color": style.TRUTH, "alpha": 0.5, "zorder": 4}
    axes.plot(visited, np.full(len(visited), 0.025), "|", **ticks)
    levels = [(mean - spread)[inside], (mean + spread)[inside]]
    truth = None if dataset is None else _truth(posterior, dataset, panel)
    if truth is not None:
        true_at, force = (values[(truth[0] >= at[0]) & (truth[0] <= at[-1])] for values in truth)
        dots = {"label": "true", "color": "#A8A8A8", "markersize": 4.0, "markeredgewidth": 0, "zorder": 1.8}
        axes.plot(true_at, force, "o", **dots)
        if force.size:
            levels.append(np.percentile(force, (1.0, 99.0)))  # a load near 0 makes any coefficient
    values = np.concatenate(levels)
    room = 0.12 * max(float(np.ptp(values)), 1e-12)
    axes.set_ylim(float(values.min()) - 1.6 * room, float(values.max()) + room)
    axes.set_xlim(at[0], at[-1])
    axes.locator_params(axis="x", nbins=6)
    return feature, unit


def _truth(posterior: Posterior, dataset: Dataset, panel: CurvePanel) -> tuple[np.ndarray, np.ndarray] | None:
    """Feature and true value of a process at rows of the Dataset, in the least-squares sense; None where unknown."""
    components = [name for name, *_ in posterior.trained.unknown.named(posterior.model.robot)]
    key = f"Q_U.{true_names(components, dataset).get(panel.component)}"
    if posterior.carries_known_forces or panel.term is None or key not in dataset.truth:
        return None
    rows = dataset.rows(evenly(dataset, TRUE_POINTS))
    model, term = posterior.model if dataset.model is None else dataset.model, panel.term
    with torch.no_grad():
        dynamics = model.dynamics(*(torch.tensor(values) for values in (rows.q, rows.v, rows.u)))
        force = (torch.linalg.pinv(term.direction(dynamics)) @ torch.tensor(rows.truth[key])[..., None])[:, panel.index]
        feature, force = term.features(dynamics)[panel.index][:, 0].numpy(), force[:, 0].numpy()
        if isinstance(term, ContactFriction) and term.load:
            size = torch.linalg.vector_norm(dynamics.normals, dim=-1).numpy()
            multiplier, known = rows.truth.get("lambda"), term.point_force(dynamics)
            if multiplier is None or multiplier.shape != size.shape or known is None:
                return None
            # the model's own load is that of the known forces alone; a coefficient is meant for the load that was there
            load = (size * np.abs(multiplier))[:, term.contact]
            force = force * torch.linalg.vector_norm(known[..., 0], dim=-1).numpy() / load
    if panel.joint is not None:  # the truth is what the system of the dataset lacks
        force = force + law_forces(model, panel.joint, rows.v[:, panel.joint])
    kept = np.isfinite(force)
    return feature[kept], force[kept]
