"""A tool pressed onto a plane without a force sensor: `HybridForce` on the URDF, on laws and on learned friction.

`kuka-surface` with Stribeck friction at the tool, in proportion to the load (240 Hz, ideal contact). The
tool follows the motion of another recording of the scenario for 8 s and presses with 15 N; gains omega = 10. Errors
after the first second: root mean square of the normal force, and of the tool's distance to its path. The model learns
from 100 rows of 40 s of the scenario's own motion (`load-friction`, analytical mean); of the same rows least squares
finds a law with two numbers, mu = c + d s of the speed s. "noise": the controller reads positions with noise of 0.1
mrad and velocities with 2 mrad/s. Five seeds, medians.

    python -m benchmarks normal_force
"""

from __future__ import annotations

import statistics
from collections.abc import Callable

import numpy as np
import torch
from scipy.optimize import least_squares

from forcegp import Dataset, HybridForce, KukaSurfaceConfig, fit, simulate_kuka_surface
from forcegp.data import farthest_rows
from forcegp.forces import parse_forces
from forcegp.posterior.predictor import Predictor
from forcegp.simulation.kuka_surface import IdealContact, tool_friction_of
from forcegp.simulation.trajectory import ArmState, compiled_plant, table_of

SEEDS = (1, 2, 3, 4, 5)
ROWS, SECONDS, WANTED = 100, 8.0, 15.0
CONFIG = KukaSurfaceConfig(friction="stribeck")


def recorded(seed: int, seconds: float) -> Dataset:
    return simulate_kuka_surface(KukaSurfaceConfig(friction="stribeck", seconds=seconds, seed=seed))


Law = Callable[[np.ndarray], np.ndarray]
NOISE_Q, NOISE_V = 1e-4, 2e-3


def per_newton(dataset: Dataset, law: Law, q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Joint torques (..., nv) of friction at the tool per newton of normal force."""
    contact = dataset.model.contacts[0]
    kinematics = dataset.model.robot.kinematics(q, v)
    J = kinematics.frame_jacobian(contact.frame, contact.point)[..., :3, :]
    velocity = (J @ v[..., None])[..., 0]
    normal = contact.surface.gradient(contact.position(kinematics))
    velocity = velocity - (velocity * normal).sum(-1, keepdim=True) * normal
    speed = torch.linalg.vector_norm(velocity, dim=-1, keepdim=True)
    mu = torch.from_numpy(np.asarray(law(speed.numpy())))
    return -(J.mT @ (mu * velocity / speed.clamp_min(1e-12))[..., None])[..., 0]


class ByLaw(HybridForce):
    """The same controller, with friction by a law."""

    def __init__(self, data: Dataset, predictor: Predictor, law: Law) -> None:
        self.data, self.law = data, law
        super().__init__(predictor, stiffness=100.0)

    def _torques(self, q, v, v_d, a_d, e, e_v):
        return super()._torques(q, v, v_d, a_d, e, e_v) - per_newton(self.data, self.law, q, v_d) * self.wanted


def fitted_law(data: Dataset) -> Law:
    """mu = c + d s, by least squares on the accelerations of the rows."""
    q, v, u = (torch.tensor(x) for x in (data.q, data.v, data.u))
    at = data.model.dynamics(q, v, u)
    free, towards = (torch.linalg.solve(at.M, x) for x in (at.Q_K[..., None], at.A.mT))

    def residual(x: np.ndarray) -> np.ndarray:
        load = torch.linalg.solve(at.M, per_newton(data, lambda s: x[0] + x[1] * s, q, v)[..., None]) + towards
        push = (at.b[..., None] - at.A @ free) / (at.A @ load)
        return ((free + load @ push)[..., 0].numpy() - data.a).ravel()

    c, d = least_squares(residual, [0.1, 0.0]).x
    return lambda s: c + d * s


def played(control: HybridForce, task: Dataset, seed: int = 0, noise: float = 0.0) -> tuple[float, float]:
    """Error of the normal force [N] and of the tool's place [mm], root mean squares after the first second."""
    rng = np.random.default_rng(seed)
    forces, places = [], []
    contact = task.model.contacts[0]
    plant = compiled_plant(task.model.robot)
    surface = IdealContact(
        table_of(CONFIG), tool_friction_of(CONFIG), CONFIG.baumgarte_omega, CONFIG.baumgarte_zeta, touched=True
    )
    low, high = ([getattr(joint, end) for joint in task.model.robot.joints] for end in ("lower", "upper"))
    reference = np.clip(task.q, low, high)  # the scenario begins on the limit of a joint
    q, v = task.q[0], task.v[0]
    for q_d, v_d, a_d in zip(reference, task.v, task.truth["a"], strict=True):
        state = ArmState.of(plant, contact.frame, CONFIG.tool_point, q, v)
        read = (x + noise * std * rng.standard_normal(7) for x, std in ((q, NOISE_Q), (v, NOISE_V)))
        u = control(*read, q_d, v_d, a_d, WANTED).numpy()
        found = surface.forces(state, u)
        v = v + CONFIG.time_step * np.linalg.solve(state.mass, u + found.push - state.bias)
        q = q + CONFIG.time_step * v
        forces.append(found.multiplier - WANTED)
        places.append(state.position)
    wanted = contact.position(task.model.robot.kinematics(torch.tensor(task.q))).numpy()
    off = np.linalg.norm(np.array(places) - wanted, axis=1)
    first = round(1.0 / CONFIG.time_step)
    force, place = (float(np.sqrt(np.mean(np.square(x[first:])))) for x in (np.array(forces), 1e3 * off))
    return force, place


def controllers(data: Dataset, seed: int) -> dict[str, HybridForce]:
    """Name -> controller; the second and the third learn from the same rows."""
    plain = fit(data.model, data, restarts=1, seed=seed).predictor(covariance="none")
    learned = fit(data.model.with_forces(parse_forces("gp:load-friction")), data, restarts=1, seed=seed)
    return {
        "URDF": HybridForce(plain, stiffness=100.0),
        "two numbers": ByLaw(data, plain, fitted_law(data)),
        "learned": HybridForce(learned.predictor(covariance="none"), stiffness=100.0),
        "true friction": ByLaw(data, plain, tool_friction_of(CONFIG).coefficient),
    }


def run() -> dict[str, float]:
    found: dict[str, list[tuple[float, float]]] = {}
    for seed in SEEDS:
        data, task = farthest_rows(recorded(seed, 40.0), ROWS), recorded(seed + 100, SECONDS)
        for name, control in controllers(data, seed).items():
            for condition, noise in (("", 0.0), (", noise", 1.0)):
                control.restart()
                force, path = played(control, task, seed, noise)
                found.setdefault(name + condition, []).append((force, path))
                print(f"seed {seed}, {name + condition:20s} force {force:7.4f} N, path {path:7.4f} mm", flush=True)
    results = {}
    for name, errors in found.items():
        for key, values, unit in zip(("force", "path"), zip(*errors, strict=True), ("N", "mm"), strict=True):
            label = name.lower().replace(", ", "_").replace(" ", "_")
            results[f"normal_force_{key}_{label}"] = statistics.median(values)
            print(f"{name:20s} {key}: {statistics.median(values):.4f} {unit} ({min(values):.4f} to {max(values):.4f})")
    return results
