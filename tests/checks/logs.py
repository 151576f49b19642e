"""Logs of small arms in free motion, clean, and with one defect planted."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from tests.posterior.arm import arm_model

from forcegp.data import Dataset
from forcegp.model import Model
from forcegp.robots import Robot

RATE = 200.0
PENDULUM = """<robot name="pendulum"><link name="base"/>
<link name="upper"><inertial><origin xyz="0 0 -0.2"/><mass value="1.5"/>
<inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="lower"><inertial><origin xyz="0 0 -0.15"/><mass value="0.7"/>
<inertia ixx="0.006" iyy="0.006" izz="0.0005" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/></joint>
<joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/><axis xyz="0 1 0"/>
<origin xyz="0 0 -0.4"/></joint></robot>"""


def arm() -> Model:
    """Three joints: the first vertical, the others horizontal and parallel."""
    return arm_model(contacts=0)


def pendulum() -> Model:
    """Two parallel horizontal joints without limits."""
    return Model(Robot.from_urdf_text(PENDULUM))


def clean(seed: int, model: Model | None = None, *, seconds: float = 7.0, noise: float = 1.0) -> Dataset:
    """Sums of sines; torques of inverse dynamics, viscous and dry friction; white noise on q, v and u."""
    model = model or arm()
    generator, nv = np.random.default_rng(seed), model.robot.nv
    time, omega = np.arange(round(seconds * RATE)) / RATE, 2 * np.pi * generator.uniform(0.1, 1.2, (6, 1, nv))
    size, phase = generator.uniform(0.05, 0.2, (6, 1, nv)), generator.uniform(0, 2 * np.pi, (6, 1, nv))
    angle = omega * time[:, None] + phase
    q, v = (size * np.sin(angle)).sum(0), (size * omega * np.cos(angle)).sum(0)
    a = (-size * omega**2 * np.sin(angle)).sum(0)
    u = model.robot.inverse_dynamics(*(torch.tensor(x) for x in (q, v, a))).numpy()
    u = u + 0.1 * v + 0.2 * np.tanh(v / 0.05)
    q, v, u = (x + noise * level * generator.normal(size=x.shape) for x, level in ((q, 2e-5), (v, 3e-4), (u, 0.03)))
    if noise:
        a = np.gradient(v, time, axis=0, edge_order=2)
    return Dataset(q=q, v=v, u=u, a=a, time=time, model=model)


def column(data: Dataset, name: str, joint: int, change: Callable[[np.ndarray], np.ndarray]) -> Dataset:
    values = getattr(data, name).copy()
    values[:, joint] = change(values[:, joint])
    return replace(data, **{name: values})


def exchanged(data: Dataset, names: str, order: list[int]) -> Dataset:
    return replace(data, **{name: getattr(data, name)[:, order] for name in names})


def late(data: Dataset, seconds: float, joints: slice = slice(None)) -> Dataset:
    """With torques logged late; the first row keeps what it has."""
    u = data.u.copy()
    for joint in range(data.nv)[joints]:
        u[:, joint] = np.interp(data.time - seconds, data.time, data.u[:, joint])
    return replace(data, u=u)
