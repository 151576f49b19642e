"""Plot: the friction curves of a model, laws and learned part together, over velocity, and the truth where known."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from forcegp.data import Dataset
from forcegp.errors import InvalidInput, require_known
from forcegp.forces import (
    Actuation,
    ContactFriction,
    CoupledRotors,
    JointFriction,
    LoadFriction,
    Offset,
    RigidBodies,
    Rotor,
    ToolForces,
    Unknown,
    UnknownForces,
)
from forcegp.mechanics import ConstrainedDynamics
from forcegp.model import Model
from forcegp.posterior.components import Curve
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
"""What the panels of a model without processes are called."""
TRUE_POINTS = 200
TRUE_DOTS = "#A8A8A8"
ALONG = 0.15
"""Largest |velocity along other axes| relative to that along its own of rows whose true force belongs on a slice."""


@dataclass(frozen=True, eq=False)
class CurvePanel:
    """One process over one velocity: which one, its own number in its term, and which feature runs along the axis.

    `joint` is the joint whose friction it is, by number: the laws of the system are added to it. The `component` of a
    joint with laws alone is LAWS.
    """

    latent: str
    component: str
    term: Unknown
    index: int
    feature: int
    resisting: float
    """-1 where the process is a force along its axis instead of the force that resists the motion, else 1."""
    joint: int | None = None


def curve_panels(posterior: Posterior) -> list[CurvePanel]:
    """All processes of a model that are curves: those of one feature, and tool forces along their own velocity.

    Where there are none, the friction laws of the joints.
    """
    robot = posterior.model.robot
    names = posterior.latent_names
    widths = [z.shape[-1] for z in posterior.likelihood.standardization.shift]
    panels = []
    for component, term, which in posterior.trained.unknown.named(robot):
        for index, latent in enumerate(term.latent_names(robot)):
            place = which.start + index
            along = _velocity_along(term, latent, index) if widths[place] > 1 else None
            if widths[place] == 1:
                joint = robot.joint_names.index(latent) if isinstance(term, JointFriction) else None
                panels.append(CurvePanel(names[place], component, term, index, 0, 1.0, joint))
            elif along is not None:
                panels.append(CurvePanel(names[place], component, term, index, along, -1.0))
    if panels:
        return panels
    with_law = [joint for joint in range(robot.nv) if law_forces(posterior.model, joint, np.ones(1)).any()]
    return [CurvePanel(robot.joint_names[joint], LAWS, UnknownForces(), joint, 0, 1.0, joint) for joint in with_law]


def law_forces(model: Model, joint: int, velocities: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """What the friction laws of the system resist with, in Nm or N, where this joint moves alone; 0 without laws."""
    robot = model.robot
    v = torch.zeros(len(velocities), robot.nv, dtype=torch.float64, device=robot.device)
    v[:, joint] = torch.tensor(velocities, dtype=v.dtype, device=v.device)
    u = v.new_zeros(len(v), len(model.inputs))
    state = model.state(robot.neutral().expand(len(v), -1), v, u)
    laws = [law for law in model.laws if not isinstance(law, NOT_OF_VELOCITY)]
    return -sum((law.force(state).expand_as(v) for law in laws), torch.zeros_like(v))[:, joint].detach().cpu().numpy()


def friction_curves_figure(
    posterior: Posterior, dataset: Dataset | None = None, *, latents: Sequence[str] | None = None
) -> Figure:
    """Every curve with its 95 % band over the velocities that were visited in training, and a little beyond.

    Shown are processes of one feature, and of tool forces the force along each axis over the velocity along it, at
    rest along the others, as the force that resists. To the friction of a joint, the friction laws of the system are
    added, so that the whole friction is seen; a line shows them alone. Where `dataset` holds the true parts of the
    unknown force, dots show them at its rows (of tool forces: at rows that move nearly along that axis). `latents`
    chooses among the names of `posterior.latent_names`, and of joints that have laws alone; None takes the first
    LARGEST_GRID. Raises InvalidInput if there is no curve.
    """
    panels = curve_panels(posterior)
    if not panels:
        raise InvalidInput(
            f"a model of {posterior.description} has no process that is a curve; fit one with friction priors, for "
            "example JointFriction() or ContactFriction()."
        )
    by_name = {panel.latent: panel for panel in panels}
    for name in latents or ():
        require_known("curve", name, "this model", by_name)
    chosen = panels[:LARGEST_GRID] if latents is None else [by_name[name] for name in latents]
    columns = min(4 if len(chosen) > 6 else 3, len(chosen))
    rows = math.ceil(len(chosen) / columns)
    figure = style.new_figure(max(3.1 * columns, 5.2), 1.1 + 2.3 * rows)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    titles = _titles(chosen, posterior)
    truth = {} if dataset is None else _truth(posterior, dataset, chosen)
    for number, (axes, panel) in enumerate(zip(grid, chosen, strict=False)):
        feature, unit = _draw_curve(axes, posterior, panel, truth.get(panel.latent))
        what = {"Nm": "torque [Nm]", "": "force / normal force"}.get(unit, f"force [{unit}]")
        what = f"resisting {what}" if panel.resisting < 0 else what
        label, _, own = feature.partition(" [")  # `velocity of lbr_iiwa_joint_1 [rad/s]`: the title names the joint
        label = " [".join(filter(None, (label.split(" of ")[0], own)))
        style.quiet(axes, title=titles[number], x=label, y=what)
    for axes in grid[len(chosen) :]:
        axes.set_visible(False)
    below = {"columns": 5 if columns > 2 else 3, "size": style.NORMAL, "markerscale": 2}
    style.legend_below(figure, *grid[: len(chosen)], **below)
    what = "Friction" if all("friction" in panel.component for panel in chosen) else "Forces"
    how = "learned" if any(panel.component != LAWS for panel in chosen) else "by the laws of a model"
    shown = f" ({len(chosen)} of {len(panels)} curves)" if len(chosen) < len(panels) else ""
    style.heading(figure, f"{what} {how} from {len(posterior.training)} points{shown}")
    return figure


def _velocity_along(term: Unknown, name: str, index: int) -> int | None:
    """The feature that is the velocity along a tool force's own axis; None for other processes."""
    of_velocity = isinstance(term, ToolForces) and term.inputs in (("velocity",), ("velocity", "angular-velocity"))
    return index if of_velocity and name.startswith("force") else None


def _titles(panels: Sequence[CurvePanel], posterior: Posterior) -> list[str]:
    """What every panel shows: the component where there are several, and the joint or axis."""
    robot = posterior.model.robot
    short = dict(zip(robot.joint_names, style.short_joint_names(robot.joint_names), strict=True))
    several = len({panel.component for panel in panels}) > 1
    titles = []
    for panel in panels:
        own = panel.latent if panel.component == LAWS else panel.term.latent_names(robot)[panel.index]
        own = short.get(own, own).replace("force-", "force along ")
        titles.append(f"{panel.component}: {own}" if several else own)
    return titles


def _draw_curve(
    axes: Axes, posterior: Posterior, panel: CurvePanel, truth: tuple[np.ndarray, np.ndarray] | None
) -> tuple[str, str]:
    """Mean and band, solid where the training data were; training velocities as ticks; the truth as dots.

    Returns the feature along the axis and the unit of the force.
    """
    visited = _visited(posterior, panel)
    low, high = float(visited.min()), float(visited.max())
    margin = BEYOND * (high - low)
    start = max(0.0, low - margin) if low >= 0.0 else low - margin  # a speed is never negative
    at = np.linspace(start, high + margin, POINTS)
    curve = None if panel.component == LAWS else _curve(posterior, panel, at)
    mean = np.zeros(POINTS) if curve is None else panel.resisting * curve.mean.cpu().numpy()
    spread = np.zeros(POINTS) if curve is None else style.QUANTILE * curve.std.cpu().numpy()
    laws = np.zeros(POINTS) if panel.joint is None else law_forces(posterior.model, panel.joint, at)
    mean = mean + laws
    inside = (at >= low) & (at <= high)
    axes.axhline(0.0, color="#B8BCC2", linewidth=0.8, zorder=1)
    if start < 0.0:
        axes.axvline(0.0, color="#B8BCC2", linewidth=0.8, zorder=1)
    both = "laws and learned part" if curve is not None and laws.any() else "learned" if curve is not None else "laws"
    style.draw_line(axes, at[inside], mean[inside], style.PREDICTION, 1.5, both)
    if curve is not None:
        style.draw_band(axes, at, mean, spread, alpha=0.28, where=inside.tolist(), label="95 % band")
        style.draw_band(axes, at, mean, spread, alpha=0.12)
        if laws.any():
            style.draw_line(axes, at, laws, style.KNOWN_PHYSICS, 1.0, "laws alone", linestyle=style.DASHED)
    dashes = {"label": "beyond the training data", "linestyle": (0, (3, 2)), "zorder": 1.9}
    style.draw_line(axes, at, mean, style.PREDICTION, 1.2, **dashes)
    ticks = {"markersize": 5, "markeredgewidth": 0.6, "transform": axes.get_xaxis_transform()}
    ticks |= {"label": "training velocities", "color": style.TRUTH, "alpha": 0.5, "zorder": 4}
    axes.plot(visited, np.full(len(visited), 0.025), "|", **ticks)
    levels = [(mean - spread)[inside], (mean + spread)[inside]]
    if truth is not None and len(truth[0]):
        shown = (truth[0] >= at[0]) & (truth[0] <= at[-1])
        dots = {"label": "true", "color": TRUE_DOTS, "markersize": 4.0, "markeredgewidth": 0, "zorder": 1.8}
        axes.plot(truth[0][shown], truth[1][shown], "o", **dots)
        if shown.any():
            levels.append(np.percentile(truth[1][shown], (1.0, 99.0)))  # a load near 0 makes any coefficient
    values = np.concatenate(levels)
    room = 0.12 * max(float(values.max() - values.min()), 1e-12)
    axes.set_ylim(float(values.min()) - 1.6 * room, float(values.max()) + room)
    axes.set_xlim(at[0], at[-1])
    axes.locator_params(axis="x", nbins=6)
    if curve is not None:
        return curve.feature_names[panel.feature], curve.unit
    slides = posterior.model.robot.joints[panel.index].type == "prismatic"
    return ("velocity [m/s]", "N") if slides else ("velocity [rad/s]", "Nm")


def _curve(posterior: Posterior, panel: CurvePanel, at: Float[np.ndarray, " n"]) -> Curve:
    """The process of a panel, at rest along its other features."""
    width = len(posterior.likelihood.standardization.shift[posterior.latent_names.index(panel.latent)])
    features = np.zeros((len(at), width))
    features[:, panel.feature] = at
    return posterior.curve(panel.latent, features)


def _visited(posterior: Posterior, panel: CurvePanel) -> Float[np.ndarray, " N"]:
    """The feature of a panel at the training points."""
    if panel.component == LAWS:
        return posterior.training.v[:, panel.index].cpu().numpy()
    with torch.no_grad():
        features = panel.term.features(posterior.likelihood.dynamics)
    return features[panel.index][:, panel.feature].cpu().numpy()


def _truth(
    posterior: Posterior, dataset: Dataset, panels: Sequence[CurvePanel]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Feature and true value of the processes at rows of the Dataset, as far as its truth holds them."""
    if posterior.carries_known_forces:
        return {}
    named = true_names(list(dict.fromkeys(panel.component for panel in panels)), dataset)
    rows = dataset.rows(np.unique(np.linspace(0, len(dataset) - 1, TRUE_POINTS).astype(int)))
    model = posterior.model if dataset.model is None else dataset.model
    q, v, u = (torch.tensor(values) for values in (rows.q, rows.v, rows.u))
    with torch.no_grad():
        dynamics = model.dynamics(q, v, u)
        found = {}
        for panel in panels:
            values = _true_latents(panel, named.get(panel.component), rows, dynamics)
            if values is None:
                continue
            features = panel.term.features(dynamics)[panel.index]
            own = features[:, panel.feature]
            others = torch.cat([features[:, : panel.feature], features[:, panel.feature + 1 :]], dim=-1)
            latent = panel.resisting * values[:, panel.index]
            if panel.joint is not None:  # the truth is what the system of the dataset lacks
                latent = latent + torch.tensor(law_forces(model, panel.joint, rows.v[:, panel.joint]))
            kept = (torch.linalg.vector_norm(others, dim=-1) <= ALONG * own.abs()) & torch.isfinite(latent)
            found[panel.latent] = (own[kept].numpy(), latent[kept].numpy())
    return found


def _true_latents(panel: CurvePanel, name: str | None, rows: Dataset, dynamics: ConstrainedDynamics) -> Tensor | None:
    """The values (rows, C) that the processes of a term must have for the true force, in the least-squares sense."""
    if name is None:
        return None
    directions = panel.term.point_force(dynamics)
    if directions is None:
        key, directions = f"Q_U.{name}", panel.term.direction(dynamics)
    else:
        key = f"force.{name}"
    if key not in rows.truth:
        return None
    if isinstance(panel.term, ContactFriction) and panel.term.load:
        contact = panel.term.contact
        if "lambda" not in rows.truth or rows.truth["lambda"].shape[1] <= contact:
            return None
        size = torch.linalg.vector_norm(dynamics.normals[..., contact, :], dim=-1)
        load = size * torch.tensor(rows.truth["lambda"][:, contact]).abs()
        # the model's own load is that of the known forces alone; a coefficient is meant for the load that was there
        unit = directions / torch.linalg.vector_norm(directions, dim=-2, keepdim=True)
        directions = load[:, None, None] * unit
    truth = torch.tensor(rows.truth[key])
    return (torch.linalg.pinv(directions) @ truth[..., None])[..., 0]
