"""Computed torque with what was learned of friction, against PD, the URDF, least squares and the true model.

KUKA iiwa without a tool load, Stribeck friction in every joint (`kuka-surface`'s), controlled at 240 Hz, simulated in
steps of 1/960 s. All controllers have the same gains, omega = 10: stiffness 100 / s^2, critically damped. The reference
moves all joints by sines for 10 s; the error is the root mean square over joints and time after the first second.

Rows: 100 of 20 s of another motion of sines that a PD controller follows *in the simulation*, the farthest in (q, v,
u); the acceleration is the difference of velocities over one period plus noise of 0.1 rad/s^2, the state that in its
middle. "task": 100 rows of the reference itself under PD. "payload": all inertias of the URDF are 10 % too large and
0.5 kg at the tool are missing; parameters and friction are identified from all rows of one log of 30 s, what is left
is learned from 200 of them. Five seeds (both motions and the noise), medians.

    python -m benchmarks tracking
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from forcegp import ComputedTorque, Coulomb, Dataset, JointFriction, KukaSurfaceConfig, Model, Robot, Viscous, fit
from forcegp.control.tracking import TrackingController
from forcegp.data import farthest_rows
from forcegp.evidence import Accelerations
from forcegp.forces import GearFriction, Offset, RigidBodies, Rotor
from forcegp.posterior import Posterior
from forcegp.simulation.kuka_surface import joint_friction_of, kuka_robot

SEEDS = (1, 2, 3, 4, 5)
RATE, FINE, NOISE, ROWS = 240, 4, 0.1, 100
CONFIG = KukaSurfaceConfig(joint_friction="stribeck")
GAINS = {"stiffness": 100.0}
MIDDLE = np.array([0.0, 0.5, 0.0, -1.3, 0.0, 0.9, 0.0])


class PDGravity(TrackingController):
    """u = M(q) (Kd (v_d - v) + Kp (q_d - q)) + g(q): masses alone."""

    def __init__(self, robot: Robot, **settings: Any) -> None:
        self._dynamics = robot.compile()
        super().__init__(robot, **settings)

    @override
    def _torques(self, q: Tensor, v: Tensor, v_d: Tensor, a_d: Tensor, e: Tensor, e_v: Tensor) -> Tensor:
        return self._dynamics.mass_matrix(q) @ self.feedback(e, e_v) + self._dynamics.gravity_forces(q)


def robot_of(payload: float = 0.0, inertia: float = 1.0) -> Robot:
    """The arm; `inertia` scales all masses and inertias, `payload` kg are added to the last link."""
    robot = kuka_robot(replace(CONFIG, tool_mass=CONFIG.tool_mass + payload))
    if inertia == 1.0:
        return robot
    import re

    scaled = re.sub(
        r'(mass value|i[xyz]{2})="([^"]+)"',
        lambda found: f'{found[1]}="{inertia * float(found[2])!r}"',
        robot.urdf_text,
    )
    return Robot.from_urdf_text(scaled, gravity=(0.0, 0.0, -CONFIG.gravity))


@dataclass
class Reference:
    """q_d(t) of sines, two per joint, from rest at MIDDLE."""

    size: np.ndarray
    rate: np.ndarray

    @classmethod
    def random(cls, seed: int, size: float, fastest: float) -> Reference:
        rng = np.random.default_rng(seed)
        return cls(size * rng.uniform(0.6, 1.0, (2, 7)), rng.uniform(0.8, fastest, (2, 7)))

    def __call__(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        s, w = self.size, self.rate
        ramp = 1.0 - np.exp(-(t**2))  # from rest
        slope, bend = 2 * t * np.exp(-(t**2)), (2 - 4 * t**2) * np.exp(-(t**2))
        x, dx, ddx = (s * np.sin(w * t)).sum(0), (s * w * np.cos(w * t)).sum(0), -(s * w**2 * np.sin(w * t)).sum(0)
        return MIDDLE + ramp * x, slope * x + ramp * dx, bend * x + 2 * slope * dx + ramp * ddx


def followed(
    robot: Robot, reference: Reference, control: Callable[..., torch.Tensor], seconds: float
) -> dict[str, np.ndarray]:
    """q, v, u at the beginning of every period of the controller, and the error there."""
    plant, law = robot.compile(), joint_friction_of(CONFIG, robot)
    (q, v, _), rows = reference(0.0), []
    for k in range(round(seconds * RATE)):
        q_d, v_d, a_d = reference(k / RATE)
        u = control(q, v, q_d, v_d, a_d).numpy()
        rows.append((q, v, u, q_d - q))
        for _ in range(FINE):
            at = [torch.from_numpy(x) for x in (q, v, u + law(v))]
            v = v + plant.forward_dynamics(*at).numpy() / (RATE * FINE)
            q = q + v / (RATE * FINE)
    return {name: np.array(x) for name, x in zip(("q", "v", "u", "e"), zip(*rows, strict=True), strict=True)}


def rows_of(motion: dict[str, np.ndarray], model: Model, seed: int, count: int = ROWS) -> Dataset:
    """What a user has of that motion: noisy accelerations, and rows far apart."""
    q, v, u = (motion[name] for name in "qvu")
    a = np.diff(v, axis=0) * RATE + NOISE * np.random.default_rng([seed, 9]).standard_normal((len(v) - 1, 7))
    middle = [0.5 * (x[1:] + x[:-1]) for x in (q, v)]
    data = Dataset(
        q=middle[0], v=middle[1], u=u[:-1], a=a, time=np.arange(len(a)) / RATE, model=model,
        noise_std=np.full(7, NOISE),
    )  # fmt: skip
    return farthest_rows(data, count)


def fits(data: Dataset, given: Model, seed: int) -> dict[str, Posterior]:
    """Name -> model; all but the first learn from the same rows."""
    laws = replace(given, forces=(*given.forces, Viscous(), Coulomb(None, CONFIG.joint_smoothing)))
    return {
        "URDF": fit(given, data, restarts=1, seed=seed),
        "Coulomb's and viscous friction": fit(laws, data, Accelerations(), seed=seed),
        "learned": fit(given.with_forces(JointFriction()), data, restarts=1, seed=seed),
    }


def controllers(data: Dataset, given: Model, true: Robot, seed: int) -> dict[str, Callable]:
    """Name -> controller."""
    made = {
        name: ComputedTorque(fit.predictor(covariance="none"), **GAINS) for name, fit in fits(data, given, seed).items()
    }
    return {"PD + gravity": PDGravity(given.robot, **GAINS), **made, "true model": TrueModel(true)}


class TrueModel(ComputedTorque):
    """Computed torque by the masses and the friction of the simulation."""

    def __init__(self, robot: Robot) -> None:
        super().__init__(Model(robot), **GAINS)
        self.plant, self.law = robot.compile(), joint_friction_of(CONFIG, robot)

    def _torques(self, q, v, v_d, a_d, e, e_v):
        return self.plant.inverse_dynamics(q, v_d, a_d + self.feedback(e, e_v)) + torch.from_numpy(
            -self.law(v_d.numpy())
        )


def error(motion: dict[str, np.ndarray]) -> float:
    """Root mean square in mrad after the first second."""
    return 1e3 * float(np.sqrt(np.mean(motion["e"][RATE:] ** 2)))


def task_of(seed: int) -> Reference:
    return Reference.random(seed, 0.3, 3.0)


def excitation(seed: int) -> Reference:
    """Another motion, fast enough to visit the velocities of the task although the PD controller lags behind."""
    return Reference.random(seed + 100, 0.45, 4.0)


def by_rows(seed: int) -> dict[str, dict[str, float]]:
    """Rows of another motion and of the task itself -> controller -> error."""
    robot, task = robot_of(), task_of(seed)
    given, found = Model(robot), {}
    for name, reference in {"excitation": excitation(seed), "task": task}.items():
        motion = followed(robot, reference, PDGravity(robot, **GAINS), 20.0)
        rivals = controllers(rows_of(motion, given, seed), given, robot, seed)
        found[name] = {rival: error(followed(robot, task, control, 10.0)) for rival, control in rivals.items()}
    return found


def with_payload(seed: int) -> dict[str, dict[str, float]]:
    """All inertias of the URDF 10 % too large, 0.5 kg at the tool that it lacks, 30 s under PD of the URDF."""
    true, given, task = robot_of(payload=0.5), Model(robot_of(inertia=1.1)), task_of(seed)
    motion = followed(true, excitation(seed), PDGravity(given.robot, **GAINS), 30.0)
    rows = rows_of(motion, given, seed, len(motion["q"]) - 1)
    bodies = given.with_forces(RigidBodies("all"), Viscous(), GearFriction(), Offset(), Rotor())
    identified = fit(bodies, rows, Accelerations()).model
    learned = fit(identified.with_forces(JointFriction()), rows, points=200, restarts=1, seed=seed)
    rivals = {
        "URDF": ComputedTorque(given, **GAINS),
        "identified": ComputedTorque(identified, **GAINS),
        "identified and learned": ComputedTorque(learned.predictor(covariance="none"), **GAINS),
        "true model": TrueModel(true),
    }
    return {"payload": {name: error(followed(true, task, control, 10.0)) for name, control in rivals.items()}}


LEARNED = ("learned", "identified and learned")


def run() -> dict[str, float]:
    found: dict[str, dict[str, list[float]]] = {}
    for seed in SEEDS:
        for name, errors in (by_rows(seed) | with_payload(seed)).items():
            for rival, value in errors.items():
                found.setdefault(name, {}).setdefault(rival, []).append(value)
                print(f"seed {seed}, {name:10s} {rival:31s} {value:7.2f} mrad", flush=True)
    results = {}
    for name, errors in found.items():
        for rival, values in errors.items():
            print(f"{name:10s} {rival:31s} {statistics.median(values):7.2f} ({min(values):.2f} to {max(values):.2f})")
        learned = next(errors[rival] for rival in LEARNED if rival in errors)
        for rival, key in (("URDF", "urdf"), ("Coulomb's and viscous friction", "laws"), ("identified", "identified")):
            if rival in errors:
                ratios = [x / y for x, y in zip(learned, errors[rival], strict=True)]
                results[f"tracking_{name}_over_{key}"] = statistics.median(ratios)
    return results
