"""A small arm that moves through time: heavier than its URDF says, and with friction that nobody told the model.

`python -m tests.scores.moving_arm FOLDER` writes what docs/how-to/scoring.md shows: arm.urdf, and
20 s of an arm with Stribeck friction as log.h5.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from tests.posterior.arm import URDF

from forcegp.data import Dataset
from forcegp.forces import Actuation, Coulomb, RigidBodies, Stribeck, Viscous
from forcegp.integration import integrator_named
from forcegp.model import Model
from forcegp.robots import Robot

NOISE, STEP = 0.2, 0.01


def given_system() -> Model:
    """What the model is told: the URDF alone, without its friction."""
    return Model(Robot.from_urdf_text(URDF), (), (Actuation(), RigidBodies()))


def true_system(stribeck: bool = False) -> Model:
    """What really moves: other masses, viscous and dry friction; with `stribeck` more of it near rest."""
    heavier = URDF.replace('mass value="1.2"', 'mass value="1.5"').replace('mass value="0.6"', 'mass value="0.8"')
    dry = Coulomb((0.5, 0.5, 0.1), 0.1)
    if stribeck:
        dry = Stribeck((0.4, 0.4, 0.06), (1.0, 1.0, 0.15), 0.5, 0.1)
    return Model(Robot.from_urdf_text(heavier), (), (Actuation(), RigidBodies(), Viscous((0.3, 0.3, 0.05)), dry))


def moving_arm(seconds: float = 2.0, episodes: int = 2, seed: int = 0, stribeck: bool = False) -> Dataset:
    """Episodes of a controlled motion at 100 Hz; u[k] acts from row k to row k + 1, a has noise of known level."""
    model, generator = true_system(stribeck), np.random.default_rng(seed)
    rows = round(seconds / STEP)
    time = STEP * np.arange(rows)
    shape = (3, 1, episodes, 3)  # sines, times, episodes, joints
    rate, phase = generator.uniform(2.0, 6.0, shape), generator.uniform(0.0, 6.0, shape)
    size, angle = generator.uniform(0.1, 0.3, shape), rate * time[:, None, None] + phase
    wanted, speed = (size * np.sin(angle)).sum(0) + np.array([0.0, 0.7, 0.7]), (size * rate * np.cos(angle)).sum(0)
    q, v = torch.tensor(wanted[0]), torch.tensor(speed[0])
    integrator = integrator_named("rk4", model)
    found: dict[str, list[np.ndarray]] = {"q": [], "v": [], "u": [], "a": []}
    for k in range(rows):
        u = model.robot.bias_forces(q, v) + torch.tensor([20.0, 20.0, 3.0]) * (torch.tensor(wanted[k]) - q)
        u = u + torch.tensor([2.0, 2.0, 0.3]) * (torch.tensor(speed[k]) - v)

        def acceleration(q, v, u=u):
            return model.dynamics(q, v, u).acceleration_map().offset

        for name, values in (("q", q), ("v", v), ("u", u), ("a", acceleration(q, v))):
            found[name].append(values.numpy())
        step = integrator(acceleration, q, v, STEP)
        q, v = step.q, step.v
    arrays = {name: np.stack(values, axis=1).reshape(-1, 3) for name, values in found.items()}
    return Dataset(
        **{**arrays, "a": arrays["a"] + NOISE * generator.normal(size=arrays["a"].shape)}, time=np.tile(time, episodes),
        episode=np.repeat(np.arange(episodes), rows), model=given_system(), noise_std=np.full(3, NOISE),
    )  # fmt: skip


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.urdf").write_text(URDF, encoding="utf-8")
    moving_arm(5.0, 4, stribeck=True).save(folder / "log.h5")
