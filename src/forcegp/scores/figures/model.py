"""Plots of one model on a recording: curves, and forces of contacts."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forcegp.data import Dataset, evenly
from forcegp.errors import ForceGPError, InvalidInput
from forcegp.evidence.recorded_rows import sensed_of
from forcegp.forces import Actuation, JointFriction, Offset, RigidBodies, Rotor, Unknown
from forcegp.mechanics import Held
from forcegp.model import Model
from forcegp.posterior.posterior import Posterior
from forcegp.progress import part
from forcegp.scores.figures import style

LARGEST_GRID = 12
BEYOND = 0.18  # part of the visited range that is drawn on either side of it
POINTS = 241
NOT_OF_VELOCITY = (Actuation, RigidBodies, Rotor, Offset)
"""Known forces that are no curve over the velocity of one joint."""
FAR = 1e9  # rad or m, after which no friction remembers what was before
LAWS = "friction laws"  # the component of a joint that has laws alone
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
    """What the friction laws of the system resist with, in Nm or N, where this joint moves alone; 0 without laws.

    No load is on it, and friction that remembers has slid on.
    """
    robot = model.robot
    v = torch.zeros(len(velocities), robot.nv, dtype=torch.float64, device=robot.device)
    v[:, joint] = torch.tensor(velocities, dtype=v.dtype, device=v.device)
    u, first = v.new_zeros(len(v), len(model.inputs)), model.memory_column
    if count := len(model.memory.names):
        u[:, first : first + count] = model.memory.past_of(FAR * v.sign()[..., None])
    state = model.state(robot.neutral().expand(len(v), -1), v, u)
    laws = [law for law in model.laws if not isinstance(law, NOT_OF_VELOCITY)]
    return -sum((law.force(state).expand_as(v) for law in laws), torch.zeros_like(v))[:, joint].detach().cpu().numpy()


def friction_curves_figure(posterior: Posterior, dataset: Dataset | None = None) -> Figure:
    """The first `LARGEST_GRID` curves with their 95 % bands over what was visited in training, and a little beyond.

    Of joints with the laws of the system, which a line shows alone. Where `dataset` holds the true friction of joints,
    dots show it. Raises InvalidInput if there is no curve.
    """
    panels = curve_panels(posterior)
    if not panels:
        seen = f"a model of {posterior.description} has no process that is a curve"
        raise InvalidInput(f"{seen}; fit one with friction priors, for example JointFriction() or ContactFriction().")
    chosen = panels[:LARGEST_GRID]
    columns = min(4 if len(chosen) > 6 else 3, len(chosen))
    rows = math.ceil(len(chosen) / columns)
    figure = style.new_figure(max(3.1 * columns, 5.2), 1.1 + 2.3 * rows)
    grid, robot = figure.subplots(rows, columns, squeeze=False).ravel(), posterior.model.robot
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
    """Mean and band, solid where the training data were; training velocities as ticks; the truth as dots."""
    with torch.no_grad():
        v = posterior.training.v[:, panel.index, None]
        visited = v if panel.term is None else panel.term.features(posterior.likelihood.dynamics)[panel.index]
    visited = visited[:, 0].cpu().numpy()
    low, high = float(visited.min()), float(visited.max())
    margin = BEYOND * (high - low)
    start = max(0.0, low - margin) if low >= 0.0 else low - margin  # a speed is never negative
    at = np.linspace(start, high + margin, POINTS)
    inside = (at >= low) & (at <= high)
    laws = np.zeros(POINTS) if panel.joint is None else law_forces(posterior.model, panel.joint, at)
    slides = panel.joint is not None and posterior.model.robot.joints[panel.joint].type == "prismatic"
    mean, spread, label, unit = laws, np.zeros(POINTS), "laws", "N" if slides else "Nm"
    feature = "velocity [m/s]" if slides else "velocity [rad/s]"
    if panel.term is not None:
        curve = posterior.curve(panel.latent, at[:, None])
        mean, spread = laws + curve.mean.cpu().numpy(), style.QUANTILE * curve.std.cpu().numpy()
        label, unit = "laws and learned part" if laws.any() else "learned", curve.unit
        feature = re.sub(" of [^[]*(?= \\[)", "", curve.feature_names[0])  # the title names the joint
        style.draw_band(axes, at, mean, spread, alpha=0.28, where=inside.tolist(), label="95 % band")
        style.draw_band(axes, at, mean, spread, alpha=0.12)
        if laws.any():
            style.draw_line(axes, at, laws, style.KNOWN_PHYSICS, 1.0, "laws alone", linestyle=style.DASHED)
    axes.axhline(0.0, color="#B8BCC2", linewidth=0.8, zorder=1)
    style.draw_line(axes, at[inside], mean[inside], style.PREDICTION, 1.5, label)
    style.draw_line(
        axes, at, mean, style.PREDICTION, 1.2, "beyond the training data", linestyle=(0, (3, 2)), zorder=1.9
    )
    ticks = {"markersize": 5, "color": style.TRUTH, "alpha": 0.5, "transform": axes.get_xaxis_transform()}
    axes.plot(visited, np.full(len(visited), 0.025), "|", label="training velocities", **ticks)
    levels, key = [(mean - spread)[inside], (mean + spread)[inside]], f"Q_U.{panel.component}"
    if dataset is not None and panel.joint is not None and key in dataset.truth and not posterior.carries_known_forces:
        rows = dataset.rows(evenly(dataset, TRUE_POINTS))
        true_at = rows.v[:, panel.joint]
        truth = true_at, law_forces(dataset.model, panel.joint, true_at) - rows.truth[key][:, panel.joint]
        true_at, force = (values[(true_at >= at[0]) & (true_at <= at[-1])] for values in truth)
        axes.plot(true_at, force, "o", label="true", color="#A8A8A8", markersize=4.0, markeredgewidth=0, zorder=1.8)
        levels.append(force)
    values = np.concatenate(levels)
    room = 0.12 * max(float(np.ptp(values)), 1e-12)
    axes.set_ylim(float(values.min()) - 1.6 * room, float(values.max()) + room)
    axes.set_xlim(at[0], at[-1])
    axes.locator_params(axis="x", nbins=6)
    return feature, unit


def model_pictures(posterior: Posterior, dataset: Dataset) -> tuple[list[style.Picture], list[str]]:
    """Every plot that the model and the recording allow, and why others are missing."""
    there = {"forces": curve_panels(posterior), "normal_force": posterior.model.contacts}
    wanted, pictures, missing = [name for name in PICTURES if there.get(name, True)], [], []
    for done, name in enumerate(wanted):
        draw, caption = PICTURES[name]
        try:
            with part(done, len(wanted), name):
                pictures.append(style.Picture(name, caption, draw(posterior, dataset)))
        except ForceGPError as error:
            missing.append(f"{name.replace('_', ' ')}: not drawn, because {error}")
    return pictures, missing


def normal_force_figure(posterior: Posterior, dataset: Dataset, *, start: float = 0.0, seconds: float = 4.0) -> Figure:
    """Forces of contacts in N over `seconds` of the first episode, and the truth where the Dataset holds "lambda".

    Positive where the surface pushes; of a held point along each axis. Raises InvalidInput where there are none.
    """
    if not posterior.model.contacts:
        raise InvalidInput(
            f"a model of {posterior.description} has no normal force to show; give one whose contacts predict forces."
        )
    rows, contacts = style.window(dataset, start, seconds), posterior.model.contacts
    figure = style.new_figure(8.0, 1.2 + 2.4 * len(contacts))
    grid: Any = figure.subplots(len(contacts), 1, squeeze=False)[:, 0]
    q, v, u = (torch.tensor(values) for values in (rows.q, rows.v, rows.u))
    with torch.no_grad():
        sensed = {name: x for name, x in sensed_of(rows).items() if any(name == each.frame for each in contacts)}
        given = torch.tensor(rows.a) if sensed else None  # as an estimator beside a sensor has it
        multiplier, dynamics = posterior.predict(q, v, u, a=given).multiplier, posterior.dynamics(q, v, u)
        assert multiplier is not None, "models with forces predict lambda"
        own = rows.model.dynamics(q, v, u)
        size, other = (torch.linalg.vector_norm(each.normals, dim=-1).numpy() for each in (dynamics, own))
        mean, spread = size * multiplier.mean.numpy(), style.QUANTILE * size * multiplier.std.numpy()
        nominal, truth = size * dynamics.multiplier_map().offset.numpy(), rows.truth.get("lambda")
    for index, (axes, contact) in enumerate(zip(grid, contacts, strict=True)):
        style.draw_line(axes, rows.time, nominal[:, index], style.KNOWN_PHYSICS, 1.1, "known physics alone")
        if truth is not None and truth.shape == other.shape == size.shape:
            style.draw_line(axes, rows.time, (other * truth)[:, index], style.TRUTH, 3.5, "true", alpha=0.3)
        if contact.frame in sensed:
            there = ((dynamics.normals[:, index].numpy() / size[:, [index]]) * sensed[contact.frame]).sum(1)
            style.draw_line(axes, rows.time, there, style.TRUTH, 3.5, "measured", alpha=0.3)
        style.draw_band(axes, rows.time, mean[:, index], spread[:, index], alpha=0.3, label="95 % band")
        style.draw_line(axes, rows.time, mean[:, index], style.PREDICTION, 1.3, "predicted")
        axes.margins(x=0)
        name, label = f"{type(contact.surface).__name__.lower()} at {contact.frame}", "normal force [N]"
        if isinstance(contact.surface, Held):
            axis = " ".join(f"{x:.2g}" for x in contact.surface.normal)
            axis = {"1 0 0": "x", "0 1 0": "y", "0 0 1": "z"}.get(axis, f"({axis})")
            name, label = f"{contact.frame} along {axis}", "force [N]"
        title = f"Contact {index}: {name}" if len(contacts) > 1 else name[0].upper() + name[1:]
        style.quiet(axes, title=title, x="time [s]", y=label)
    style.legend_below(figure, *grid, size=style.NORMAL)
    held = any(isinstance(contact.surface, Held) for contact in contacts)
    style.heading(figure, f"{'Contact' if held else 'Normal'} force after {len(posterior.training)} training points")
    return figure


PICTURES: dict[str, tuple[Callable[[Posterior, Dataset], Figure], str]] = {
    "forces": (
        friction_curves_figure,
        "Forces over velocity, with 95 % bands: the friction laws of the model, without load and far from reversals, "
        "and what was learned beside them. Ticks are the velocities of the training data.",
    ),
    "normal_force": (normal_force_figure, "The forces of contacts, and what sensors measured of them."),
}
"""By name, how each is drawn, and what is to be seen."""
