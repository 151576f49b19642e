"""Recordings with known true forces, and what models of them predict (pictures of docs/how-to/forces.md)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import torch

from forcegp import ContactFriction, Dataset, KukaSurfaceConfig, Model, Robot, fit, simulate_kuka_surface
from forcegp.forces import Unknown
from forcegp.mechanics import surface_axes
from forcegp.robots.inertia import physical_of_pseudo_inertia, pseudo_inertia

NOISE = 0.1
"""rad/s^2"""
TOOL = "lbr_iiwa_link_7"
F64 = torch.float64

Law = Callable[[torch.Tensor], torch.Tensor]


@cache
def recording(seed: int, **options: Any) -> Dataset:
    return simulate_kuka_surface(KukaSurfaceConfig(seconds=40.0, seed=seed, **options))


def with_force(data: Dataset, prior: Unknown, *laws: Law, seed: int = 5) -> Dataset:
    """The states and torques of `data` with the acceleration under another unknown force, one law per latent."""
    assert data.model is not None
    q, v, u = (torch.tensor(x) for x in (data.q, data.v, data.u))
    dynamics = data.model.dynamics(q, v, u)
    latents = [law(z[:, 0]) for law, z in zip(laws, prior.features(dynamics), strict=True)]
    a = dynamics.acceleration((prior.direction(dynamics) @ torch.stack(latents, -1)[..., None])[..., 0]).numpy()
    return replace(data, a=a + NOISE * np.random.default_rng(seed).standard_normal(a.shape), truth={"a": a})


def fitted(
    data: Dataset, prior: Unknown | tuple[Unknown, ...], points: int, mean: str = "analytical", **options: Any
) -> Any:
    assert data.model is not None
    model = data.model.with_forces(*(prior if isinstance(prior, tuple) else (prior,)))
    return fit(model if mean == "analytical" else model.without_mean(), data, points=points, restarts=1, **options)  # type: ignore[arg-type]  # one of the names in Mean


def turntable(torque: Law) -> Dataset:
    """25 postures at rest of a joint about the vertical, on which nothing but `torque` acts; none near half a turn."""
    robot = Robot.from_urdf_text(TURNTABLE)
    rng = np.random.default_rng(0)
    q = torch.tensor(rng.uniform(-math.pi + 0.8, math.pi - 0.8, (25, 1)))
    a = robot.forward_dynamics(q, 0.0 * q, torque(q)).numpy()
    return _dataset(Model(robot), q.numpy(), 0.0 * a, 0.0 * a, a, rng)


def slow_motions(mass: float, place: torch.Tensor) -> Dataset:
    """300 states of the KUKA in free motion with a point mass at `place` in link 7, of which its system knows nothing.

    Accelerations of some 0.1 rad/s^2: what shows is the weight, but the mass has its inertia, too.
    """
    known = recording(1).model
    assert known is not None
    carrying = _with_body(known.robot, mass, place)
    rng = np.random.default_rng(3)
    q = np.deg2rad((85, 50, -10, -100, -170, -25, -100)) + rng.uniform(-0.8, 0.8, (300, 7))
    v, a = 0.1 * rng.standard_normal((2, 300, 7))
    u = carrying.inverse_dynamics(torch.tensor(q), torch.tensor(v), torch.tensor(a)).numpy()
    return _dataset(Model(known.robot), q, v, u, a, rng)


def across_the_strip() -> tuple[torch.Tensor, torch.Tensor]:
    """Places x (201, 1) across the strip, and the points (201, 3) on the plane at y = 0.5 m."""
    x = torch.linspace(-0.5, 0.5, 201, dtype=F64)
    return x[:, None], torch.stack([x, torch.full_like(x, 0.5), torch.full_like(x, 0.055)], -1)


def roughness(x: torch.Tensor) -> torch.Tensor:
    """Viscous coefficient in N/(m/s), four times as much on a strip."""
    return 1.0 + 3.0 * ((x > 0.0) & (x < 0.25))


def on_a_rough_strip() -> Dataset:
    return with_force(recording(1), ContactFriction(viscous=True, inputs=("position",)), roughness)


def plane_of(posterior: Any) -> tuple[torch.Tensor, np.ndarray]:
    """The two tangents (3, 2) of the plane, of which the first is x, and where the tool was in x."""
    dynamics = posterior.likelihood.dynamics
    tool = dynamics.state.kinematics.frame_pose(TOOL)
    points = tool[:, :3, 3] + 0.1 * tool[:, :3, 2]
    return surface_axes(dynamics.normals[:1, 0, :])[0, :, :2], points[:, 0].numpy()


def visited(posterior: Any, latent: int, feature: int = 0) -> np.ndarray:
    features = posterior.model.unknown.features(posterior.likelihood.dynamics)
    return features[latent][:, feature].numpy()


def mass_and_place(posterior: Any) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of m and c = (m c) / m, the latter to first order."""
    rows = posterior.training
    latents = posterior.components(rows.q[:1], rows.v[:1], rows.u[:1])["payload"].latents
    mean, covariance = latents.mean[0], latents.covariance[0]
    center = mean[1:] / mean[0]
    derivative = torch.cat([-center[:, None], torch.eye(3, dtype=F64)], -1) / mean[0]
    derivative = torch.cat([torch.eye(1, 4, dtype=F64), derivative])
    spread = (derivative @ covariance @ derivative.mT).diagonal().sqrt()
    return torch.cat([mean[:1], center]).numpy(), spread.numpy()


def _dataset(
    model: Model, q: np.ndarray, v: np.ndarray, u: np.ndarray, a: np.ndarray, rng: np.random.Generator
) -> Dataset:
    """With noise on the acceleration."""
    return Dataset(
        q=q,
        v=v,
        u=u,
        a=a + NOISE * rng.standard_normal(a.shape),
        time=0.01 * np.arange(len(q)),
        joint_names=model.robot.joint_names,
        noise_std=np.full(q.shape[1], NOISE),
        model=model,
    )


def _with_body(robot: Robot, mass: float, place: torch.Tensor) -> Robot:
    """The robot with a point mass fixed to link 7."""
    link = robot.link(TOOL)
    together = pseudo_inertia(link.mass, np.array(link.center_of_mass), np.array(link.inertia))
    together = together + pseudo_inertia(mass, place.numpy(), np.zeros((3, 3)))
    return robot.with_link(TOOL, *physical_of_pseudo_inertia(together))


TURNTABLE = """<robot name="turntable"><link name="base"/><joint name="turn" type="continuous"><parent link="base"/>
<child link="table"/><axis xyz="0 0 1"/></joint><link name="table"><inertial><mass value="2"/>
<inertia ixx="0.3" iyy="0.3" izz="0.5" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
