"""Path integral control of an arm with dry friction: the URDF, least squares, what was learned, and the true model.

An arm of two links with Stribeck friction in both joints hangs down and has motors too weak to lift it straight up
(8 and 4 Nm, 9.8 Nm were needed). `MPPI` gets 4 s at 50 Hz to swing it up; the cost is that of the motion of the
simulated arm (steps of 1 ms). Rows: 100 of 20 s under sinusoidal torques, accelerations with noise of 0.1 rad/s^2.
Five seeds (torques of the recording, noise, and the controller's random numbers), medians.

    python -m benchmarks swing_up
"""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import replace

import numpy as np
import torch

from forcegp import MPPI, Coulomb, Dataset, JointFriction, Model, Noise, Robot, Stribeck, Viscous, fit
from forcegp.evidence import Accelerations
from forcegp.posterior import Posterior

SEEDS = (1, 2, 3, 4, 5)
DT, STEPS, FINE = 0.02, 200, 20  # s, of the controller, and steps of the simulation in each
LIMITS = (8.0, 4.0)
LINK = """<link name="{0}"><inertial><origin xyz="0 0 0.25"/><mass value="1"/>
<inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{0}" type="continuous"><parent link="{1}"/><child link="{2}"/><origin xyz="0 0 {3}"/>
<axis xyz="0 1 0"/></joint>"""
URDF = "".join(
    (
        '<robot name="two-links"><link name="base"/>',
        LINK.format("upper"),
        LINK.format("fore"),
        JOINT.format("shoulder", "base", "upper", 0.0),
        JOINT.format("elbow", "upper", "fore", 0.5),
        "</robot>",
    )
)
STRIBECK = Stribeck([0.6, 0.4], [1.0, 0.7], [0.3, 0.3], [0.05, 0.05])
VISCOUS = Viscous([0.1, 0.05])


def model_of(*friction: object) -> Model:
    model = Model(Robot.from_urdf_text(URDF))
    return replace(model, forces=(*model.forces, *friction))


class Arm:
    """The simulated arm: symplectic Euler steps of 1 ms."""

    def __init__(self) -> None:
        self.robot = Robot.from_urdf_text(URDF).compile()
        c, s, speed, width = (torch.tensor(x) for x in ([0.6, 0.4], [1.0, 0.7], [0.3, 0.3], [0.05, 0.05]))
        viscous = torch.tensor([0.1, 0.05])
        self.friction = lambda v: -(c + (s - c) * torch.exp(-((v / speed) ** 2))) * torch.tanh(v / width) - viscous * v
        self.q, self.v = torch.tensor([math.pi, 0.0]), torch.zeros(2)

    def acceleration(self, u: torch.Tensor) -> torch.Tensor:
        return self.robot.forward_dynamics(self.q, self.v, u + self.friction(self.v))

    def step(self, u: torch.Tensor) -> None:
        for _ in range(FINE):
            self.v = self.v + DT / FINE * self.acceleration(u)
            self.q = self.q + DT / FINE * self.v


def recorded(seed: int) -> Dataset:
    """100 rows of 20 s under sinusoidal torques of at most the limits."""
    rng, arm, rows = np.random.default_rng(seed), Arm(), []
    rates, phases = rng.uniform(0.5, 8.0, (5, 2)), rng.uniform(0.0, 2.0 * math.pi, (5, 2))
    for k in range(round(20.0 / DT)):
        u = torch.tensor(np.array(LIMITS) / 3.0 * np.sin(rates * k * DT + phases).sum(0))
        u = torch.minimum(torch.maximum(u, -torch.tensor(LIMITS)), torch.tensor(LIMITS))
        if k % 10 == 9:
            noisy = arm.acceleration(u) + torch.tensor(rng.normal(0.0, 0.1, 2))
            rows.append([arm.q, arm.v, u, noisy])
        arm.step(u)
    q, v, u, a = (torch.stack(x).numpy() for x in zip(*rows, strict=True))
    return Dataset(q=q, v=v, u=u, a=a, time=0.2 * np.arange(len(q)), model=model_of())


def running(q: torch.Tensor, v: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    """Per second: both links away from upright, speed, torque."""
    away = 2.0 - torch.cos(q[..., 0]) - torch.cos(q.sum(-1))
    return away + 0.01 * v.square().sum(-1) + 0.001 * u.square().sum(-1)


def cost(q: torch.Tensor, v: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    end = 2.0 - torch.cos(q[..., -1, 0]) - torch.cos(q[..., -1, :].sum(-1)) + 0.01 * v[..., -1, :].square().sum(-1)
    return DT * running(q[..., :-1, :], v[..., :-1, :], u).sum(-1) + 5.0 * end


def swung_up(predictor: object, seed: int) -> tuple[float, float]:
    """Cost of the motion, and CPU milliseconds a step."""
    arm, total, seconds = Arm(), 0.0, 0.0
    control = MPPI(predictor, cost, dt=DT, steps=50, torque_limits=LIMITS, seed=seed)
    for _ in range(STEPS):
        start = time.process_time()
        u = control(arm.q, arm.v)
        seconds += time.process_time() - start
        total += DT * float(running(arm.q, arm.v, u))
        arm.step(u)
    return total, 1e3 * seconds / STEPS


def models(data: Dataset, seed: int) -> dict[str, Posterior]:
    """Name -> posterior, all of the same rows."""
    how = {"restarts": 1, "seed": seed}
    laws = model_of(Viscous(), Coulomb(None, 0.05))
    noise = Noise(0.1, learn=False)
    return {
        "URDF": fit(model_of().with_forces(noise=noise), data, **how),
        "Coulomb's and viscous friction": fit(laws, data, Accelerations(), seed=seed),
        "learned": fit(model_of().with_forces(JointFriction(), noise=noise), data, **how),
        "true": fit(model_of(STRIBECK, VISCOUS).with_forces(noise=noise), data, **how),
    }


def run() -> dict[str, float]:
    torch.set_default_dtype(torch.float64)
    costs: dict[str, list[float]] = {}
    cpu: dict[str, list[float]] = {}
    for seed in SEEDS:
        for name, posterior in models(recorded(seed), seed).items():
            found, milliseconds = swung_up(posterior.predictor(covariance="none"), seed)
            costs.setdefault(name, []).append(found)
            cpu.setdefault(name, []).append(milliseconds)
            print(f"seed {seed}, {name:31s} cost {found:6.2f}, {milliseconds:.1f} ms of CPU a step", flush=True)
    of_true = {
        name: statistics.median(x / y for x, y in zip(found, costs["true"], strict=True))
        for name, found in costs.items()
    }
    for name, found in costs.items():
        spread = f"{min(found):.2f} to {max(found):.2f}"
        print(f"{name:31s} {statistics.median(found):6.2f} ({spread}), {of_true[name]:.3f} of the true model's")
    torch.set_default_dtype(torch.float32)
    return {
        "swing_up_learned_over_true": of_true["learned"],
        "swing_up_laws_over_true": of_true["Coulomb's and viscous friction"],
        "swing_up_urdf_over_true": of_true["URDF"],
        "swing_up_step_ms": statistics.median(cpu["learned"]),
    }
