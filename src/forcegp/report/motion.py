"""A recorded motion of a robot, with the forces that a model learned as arrows, in the scene of viser."""

import io
import socket
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from forcegp.data import Dataset, with_memory
from forcegp.errors import required_extra
from forcegp.forces import Actuation, AerodynamicForce, ObservedWrench, RigidBodies, Rotor, Thrusters, Unknown
from forcegp.mechanics import ConstrainedDynamics
from forcegp.mechanics.gauss_principle import placed
from forcegp.posterior.posterior import Posterior
from forcegp.posterior.prediction import Gaussian, joint_forces_given
from forcegp.report.shapes import LinkShape, link_shapes, poses_of_links, reach
from forcegp.robots import Robot
from forcegp.scores.figures import style

FRAMES_PER_SECOND = 30.0
MOST_FRAMES = 450
LONGEST_ARROW = 0.4  # of the reach of the robot, for a force that is large in its group
LARGE = 98.0  # percentile of the largest force of each row: peaks do not make all other arrows short
NOT_SHOWN = (Actuation, Thrusters, ObservedWrench, RigidBodies, Rotor)
"""Known forces that are no finding at a joint: what motors do, wind on a base, and inertia."""


@dataclass(frozen=True, eq=False)
class Arrows:
    """Forces over time as arrows: `start` (rows, k, 3) in m and unit vectors `direction` (rows, k, 3), world axes.

    `mean` and `half` (rows, k) are the force along the direction and half its 95 % interval, in `unit`; `names` has k
    entries. A torque of a joint is drawn along its axis.
    """

    title: str
    unit: str
    names: tuple[str, ...]
    start: Float[np.ndarray, "rows k 3"]
    direction: Float[np.ndarray, "rows k 3"]
    mean: Float[np.ndarray, "rows k"]
    half: Float[np.ndarray, "rows k"]

    @property
    def largest(self) -> float:
        """A large force of the group in `unit`, for the scale: what the largest of a row stays below nearly always."""
        return float(np.percentile(np.abs(self.mean).max(axis=1), LARGE)) if self.mean.size else 0.0

    def tips(self, row: int, length: float) -> tuple[np.ndarray, np.ndarray]:
        """Arrows (k, 2, 3) of the mean, and to the end of the interval; a large force is `length` m long."""
        scale = length / max(self.largest, np.finfo(float).tiny)
        mean, away = self.mean[row][:, None], np.where(self.mean[row] < 0.0, -1.0, 1.0)[:, None]
        start, direction = self.start[row], self.direction[row]
        tip = start + scale * mean * direction
        end = tip + scale * away * self.half[row][:, None] * direction
        return np.stack([start, tip], axis=1), np.stack([start, end], axis=1)


@dataclass(frozen=True, eq=False)
class RecordedScene:
    """Rows of a recording, ready to be drawn.

    `time` (rows,) in s from the first; `q` (rows, nq); `poses` (rows, links, 4, 4) of `shapes` in the world; `arrows`;
    `size` the reach of the robot in m; `doubts` what could not be drawn.
    """

    robot: Robot
    time: Float[np.ndarray, " rows"]
    q: Float[np.ndarray, "rows nq"]
    shapes: list[LinkShape]
    poses: Float[np.ndarray, "rows links 4 4"]
    arrows: list[Arrows]
    size: float
    doubts: list[str] = field(default_factory=list)

    @property
    def arrow_length(self) -> float:
        """Length of the longest arrow in m."""
        return LONGEST_ARROW * self.size


def recorded_scene(
    dataset: Dataset,
    posterior: Posterior | None = None,
    *,
    start: float = 0.0,
    seconds: float = 10.0,
    shapes: str | Path | None = None,
) -> RecordedScene:
    """The motion of the first episode from `start` s on for `seconds`, at no more than 30 frames per second.

    Forces are those of the posterior: each of its priors by itself, and the friction laws of its system. Without one,
    the recorded u. `shapes` is a URDF with visual elements (`link_shapes`).

    Raises InvalidInput for a Dataset without rows in that time, MissingExtra without trimesh.
    """
    model = dataset.model if posterior is None else posterior.model
    rows = with_memory(style.window(dataset, start, seconds), model)
    first, last = rows.time[[0, -1]]
    steps = int(np.clip((last - first) * FRAMES_PER_SECOND, 1, min(MOST_FRAMES, len(rows) - 1) or 1))
    grid = np.linspace(first, last, steps + 1)
    rows = rows.rows(np.unique(np.searchsorted(rows.time, grid - 1e-9).clip(0, len(rows) - 1)))
    q, v, u = (torch.tensor(values) for values in (rows.q, rows.v, rows.u))
    drawn, doubts = link_shapes(model.robot, shapes)
    with torch.no_grad():
        if isinstance(posterior, Posterior):
            dynamics = posterior.dynamics(q, v, u)
            arrows = learned_forces(posterior, dynamics)
        else:
            dynamics = model.dynamics(q, v, u)
            arrows = [_at_joints(dynamics, "recorded u", dynamics.state.delivered, None)]
    poses, time = poses_of_links(model.robot, q, [shape.link for shape in drawn]), rows.time - rows.time[0]
    alone = [2.0 * float(np.linalg.norm(shape.vertices, axis=1).max()) for shape in drawn if len(drawn) == 1]
    return RecordedScene(model.robot, time, rows.q, drawn, poses, arrows, max(reach(model.robot), *alone, 0.0), doubts)


def learned_forces(posterior: Posterior, dynamics: ConstrainedDynamics) -> list[Arrows]:
    """What the model found at these states: joint forces, with the laws of its system, point and contact forces."""
    prior, robot = posterior.trained.unknown, posterior.model.robot
    B, latents = prior.direction(dynamics), posterior.latents(dynamics, True)
    of_joints, groups = torch.zeros(B.shape[-1], dtype=torch.bool), []
    for name, term, which in prior.named(robot):
        if (point := term.point_force(dynamics)) is None:
            of_joints[which] = True
        else:
            groups.append(_at_point(name, _place(term, dynamics), latents.entries(which).through(point)))
    forces = [force for force in posterior.model.laws if not isinstance(force, NOT_SHOWN)]
    if bool(of_joints.any()) or forces:
        own = latents.through(B * of_joints)
        mean = own.mean + sum(force.force(dynamics.state).expand_as(own.mean) for force in forces)
        title = "learned joint forces" if posterior.carries_known_forces else "friction and other joint forces"
        groups.append(_at_joints(dynamics, title, mean, own.std))
    if dynamics.contacts:
        map_ = dynamics.contact_force_map()
        matrix, offset = map_.matrix.unflatten(-2, (-1, 3)), map_.offset.unflatten(-1, (-1, 3))
        points: dict[tuple[object, ...], list[int]] = {}
        for index, contact in enumerate(dynamics.contacts):
            if not getattr(contact, "turning", False):  # a torque
                points.setdefault((contact.frame, contact.point), []).append(index)
        whole, _ = joint_forces_given(latents, B, posterior.unlearned(dynamics), dynamics.acceleration_map(), None)
        for which in points.values():  # a foot that stands is three contacts, and one force
            contact = dynamics.contacts[which[0]]
            force = whole.through(matrix[..., which, :, :].sum(-3), offset[..., which, :].sum(-2))
            place = contact.position(dynamics.state.kinematics)
            groups.append(_at_point(f"contact force at {contact.frame}", place, force))
    return groups


def _place(term: Unknown, dynamics: ConstrainedDynamics) -> torch.Tensor:
    frame = term.link(dynamics.state.robot) if isinstance(term, AerodynamicForce) else getattr(term, "frame", None)
    if frame is None:
        return dynamics.contacts[getattr(term, "contact", 0)].position(dynamics.state.kinematics)
    return placed(dynamics.state.kinematics, frame, getattr(term, "point", (0.0, 0.0, 0.0)))[1]


def _at_joints(dynamics: ConstrainedDynamics, title: str, mean: torch.Tensor, std: torch.Tensor | None) -> Arrows:
    robot, starts, axes = dynamics.state.robot, [], []
    for joint in robot.joints:
        pose = dynamics.state.kinematics.frame_pose(joint.child)
        axis = torch.tensor(joint.axis, dtype=pose.dtype, device=pose.device)
        starts.append(pose[..., :3, 3].expand(len(mean), 3))
        axes.append((pose[..., :3, :3] @ axis).expand(len(mean), 3))
    spread = torch.zeros_like(mean) if std is None else style.QUANTILE * std
    kinds = {"N" if joint.type == "prismatic" else "Nm" for joint in robot.joints}
    numbers = (torch.stack(starts, 1), torch.stack(axes, 1), mean, spread)
    return Arrows(title, " or ".join(sorted(kinds)), robot.joint_names, *(x.cpu().numpy() for x in numbers))


def _at_point(name: str, place: torch.Tensor, force: Gaussian) -> Arrows:
    """A force in space as one arrow along its mean, with the standard deviation in that direction."""
    mean = force.mean
    size = torch.linalg.vector_norm(mean, dim=-1, keepdim=True)
    direction = torch.where(size > 0.0, mean / size.clamp_min(torch.finfo(mean.dtype).tiny), torch.eye(3)[2].to(mean))
    half = style.QUANTILE * force.through(direction[..., None, :]).std
    numbers = (place[:, None], direction[:, None], size, half)
    return Arrows(name, "N", (name,), *(x.detach().cpu().numpy() for x in numbers))


LINK, DARK_LINK = (150, 157, 166), (118, 126, 136)
COLORS = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0))
"""Okabe and Ito (2008), as the figures, for groups of arrows."""
PALE = 0.55  # how far the colour of an interval goes towards white
OPACITY = 0.6  # of links: arrows along the axes of joints begin inside of them


def recording(recorded: RecordedScene) -> str:
    """The whole motion as one HTML page that needs no server: viser's recording. Raises MissingExtra without viser."""
    viser = required_extra("viser", "view", "drawing the robot")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    with redirect_stdout(io.StringIO()):  # where it prints its address, which results must not be mixed with
        server = viser.ViserServer(host="127.0.0.1", port=port)
    try:
        show, serializer = _drawn(server, recorded), server.get_scene_serializer()
        for row in range(len(recorded.time)):
            show(row)
            last = row + 1 == len(recorded.time)
            serializer.insert_sleep(0.0 if last else float(recorded.time[row + 1] - recorded.time[row]))
        return serializer.as_html()
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def _drawn(server: Any, recorded: RecordedScene) -> Callable[[int], None]:
    """The nodes of one recorded scene; what is returned moves them to a row."""
    scene, size, length = server.scene, recorded.size, recorded.arrow_length
    places = recorded.poses[..., :3, 3].reshape(-1, 3) if recorded.shapes else np.zeros((1, 3))
    center, far = (places.max(0) + places.min(0)) / 2.0, max(size, 1.4 * float(np.ptp(places, axis=0).max()))
    scene.set_up_direction("+z")
    scene.add_grid("/ground", width=2.0 * far, height=2.0 * far, cell_size=far / 5.0, section_size=far)
    server.initial_camera.position = tuple(center + far * np.array([0.6, -0.55, 0.28]))
    server.initial_camera.look_at = tuple(center)
    links, arrows = [], []
    for place, shape in enumerate(recorded.shapes):
        look = {"color": DARK_LINK if place % 2 else LINK, "opacity": OPACITY, "flat_shading": True}
        triangles = shape.vertices.astype(np.float32), shape.faces.astype(np.uint32)
        links.append(scene.add_mesh_simple(f"/robot/{place}", *triangles, **look))
    for place, group in enumerate(recorded.arrows):  # of the mean, and thinner pale ones to the end of the interval
        color = np.array(COLORS[place % len(COLORS)])
        looks = ("mean", color, 0.014), ("interval", color + PALE * (255 - color), 0.008)
        for points, (kind, shade, width) in zip(group.tips(0, length), looks, strict=True):
            radii = {"shaft_radius": width * size, "head_radius": 2.0 * width * size, "head_length": 2.5 * width * size}
            name = f"/forces/{place}/{kind}"
            arrows.append(scene.add_arrows(name, points.astype(np.float32), shade.astype(np.uint8), **radii))

    def show(row: int) -> None:
        for pose, node in zip(recorded.poses[row], links, strict=True):
            node.wxyz = np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)  # w first
            node.position = pose[:3, 3]
        tips = [points for group in recorded.arrows for points in group.tips(row, length)]
        for node, points in zip(arrows, tips, strict=True):
            node.points = points.astype(np.float32)

    show(0)
    return show
