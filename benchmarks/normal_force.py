"""A tool pressed onto a plane without a force sensor: `HybridForce` on the URDF and on what was learned of friction.

`kuka-surface` with Stribeck friction at the tool, in proportion to the load (PyBullet at 240 Hz, ideal contact). The
tool follows the motion of another recording of the scenario for 8 s and presses with 15 N; gains omega = 10. Errors
after the first second: root mean square of the normal force, and of the tool's distance to its path. The model learns
from 100 rows of 40 s of the scenario's own motion (`load-friction`, analytical mean). Five seeds, medians.

    python -m benchmarks normal_force
"""

from __future__ import annotations

import statistics

import numpy as np
import torch

from forcegp import Dataset, HybridForce, KukaSurfaceConfig, NoForces, StructuredGP, simulate_kuka_surface
from forcegp.data import farthest_rows
from forcegp.models import StructuredPosterior
from forcegp.priors import named_prior
from forcegp.simulation.bullet import ArmState, BulletArm
from forcegp.simulation.contact_forces import IdealContact
from forcegp.simulation.kuka_motion import kuka_urdf, tool_friction_of
from forcegp.simulation.trajectory import table_of

SEEDS = (1, 2, 3, 4, 5)
ROWS, SECONDS, WANTED = 100, 8.0, 15.0
CONFIG = KukaSurfaceConfig(friction="stribeck")


def recorded(seed: int, seconds: float) -> Dataset:
    return simulate_kuka_surface(KukaSurfaceConfig(friction="stribeck", seconds=seconds, seed=seed))


def played(posterior: StructuredPosterior, task: Dataset) -> tuple[float, float]:
    """Error of the normal force [N] and of the tool's place [mm], root mean squares after the first second."""
    control = HybridForce(posterior.predictor(covariance="none"), stiffness=100.0)
    forces, places = [], []
    contact = task.system.contacts[0]
    with BulletArm(
        kuka_urdf(CONFIG), gravity=CONFIG.gravity, time_step=CONFIG.time_step, tool_point=CONFIG.tool_point
    ) as arm:
        arm.reset(task.q[0], task.v[0])
        surface = IdealContact(
            table_of(CONFIG), tool_friction_of(CONFIG), CONFIG.baumgarte_omega, CONFIG.baumgarte_zeta, touched=True
        )
        low, high = ([getattr(joint, end) for joint in task.system.robot.joints] for end in ("lower", "upper"))
        reference = np.clip(task.q, low, high)  # the scenario begins on the limit of a joint
        for q_d, v_d, a_d in zip(reference, task.v, task.truth["a"], strict=True):
            state = ArmState.of(arm)
            u = control(state.q, state.v, q_d, v_d, a_d, WANTED).numpy()
            forces.append(surface.step(arm, state, u).normal_force - WANTED)
            places.append(state.position)
    wanted = contact.position(task.system.robot.kinematics(torch.tensor(task.q))).numpy()
    off = np.linalg.norm(np.array(places) - wanted, axis=1)
    first = round(1.0 / CONFIG.time_step)
    return tuple(float(np.sqrt(np.mean(np.square(x[first:])))) for x in (np.array(forces), 1e3 * off))


def run() -> dict[str, float]:
    found: dict[str, list[tuple[float, float]]] = {}
    for seed in SEEDS:
        data, task = farthest_rows(recorded(seed, 40.0), ROWS), recorded(seed + 100, SECONDS)
        models = {
            "URDF": StructuredGP(data.system, NoForces()),
            "learned": StructuredGP(data.system, named_prior("load-friction", data.system)),
        }
        for name, model in models.items():
            force, path = played(model.fit(data, restarts=1, seed=seed), task)
            found.setdefault(name, []).append((force, path))
            print(f"seed {seed}, {name:8s} force {force:6.3f} N, path {path:6.3f} mm", flush=True)
    results = {}
    for name, errors in found.items():
        for key, values, unit in zip(("force", "path"), zip(*errors, strict=True), ("N", "mm"), strict=True):
            results[f"normal_force_{key}_{name.lower()}"] = statistics.median(values)
            print(f"{name:8s} {key}: {statistics.median(values):.3f} {unit} ({min(values):.3f} to {max(values):.3f})")
    return results
