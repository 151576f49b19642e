"""How small a push does a monitor see, without a false alarm? On the URDF, on least squares, on learned friction.

The arm of `tracking` (KUKA iiwa, Stribeck friction in every joint, 240 Hz, simulated in steps of 1/960 s) follows sines
under PD and gravity. Every model is that of 100 rows of one motion (20 s); every monitor is calibrated on another
motion of 3 min, to one false alarm in 10 hours. A third motion of 10 min is free: its alarms are false. In a fourth one
forces act at the elbow for 0.5 s every 2 s, 100 each of 5 N and 3 N, in random directions across the upper arm.
Velocities have noise of 0.002 rad/s, torques 0.05 Nm. Found: an alarm within the 0.5 s. Five seeds, medians.
The same monitor in C (gcc -O2, through ctypes) sees 5,000 rows with pushes; a place follows every step.

    python -m benchmarks contact_monitor
"""

from __future__ import annotations

import ctypes
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from benchmarks.tracking import (
    CONFIG,
    FINE,
    GAINS,
    RATE,
    PDGravity,
    Reference,
    excitation,
    fits,
    followed,
    robot_of,
    rows_of,
)
from forcegp import ContactMonitor, Model, Robot, Viscous, export_c
from forcegp.control.monitor import ContactState
from forcegp.forces import Stribeck
from forcegp.posterior import Predictor
from forcegp.simulation.kuka_surface import joint_friction_of

SEEDS = (1, 2, 3, 4, 5)
ELBOW, PUSHES, EVERY, LASTING = "lbr_iiwa_link_4", 100, 2.0, 0.5
NOISE_V, NOISE_U = 0.002, 0.05


def moved(robot: Robot, seed: int, seconds: float, newton: float = 0.0) -> dict[str, np.ndarray]:
    """q, v, u (T, 7) as measured, and the joint torques of the pushes."""
    plant, law, reference = robot.compile(), joint_friction_of(CONFIG, robot), Reference.random(seed, 0.4, 3.5)
    control, rng, force = PDGravity(robot, **GAINS), np.random.default_rng(seed), np.zeros(3)
    (q, v, _), rows, push = reference(0.0), [], np.zeros(7)
    for k in range(round(seconds * RATE)):
        since = (k / RATE) % EVERY
        if newton and since < LASTING:
            if since < 0.5 / RATE:
                along = robot.frame_pose(torch.from_numpy(q), ELBOW)[:3, 3].numpy()
                along = along / np.linalg.norm(along)
                direction = rng.standard_normal(3)
                direction -= along * (along @ direction)
                force = newton * direction / np.linalg.norm(direction)
            push = force @ robot.frame_jacobian(torch.from_numpy(q), ELBOW)[:3].numpy()
        else:
            push = np.zeros(7)
        u = control(q, v, *reference(k / RATE)).numpy()
        rows.append((q, v, u, push))
        for _ in range(FINE):
            at = [torch.from_numpy(x) for x in (q, v, u + push + law(v))]
            v = v + plant.forward_dynamics(*at).numpy() / (RATE * FINE)
            q = q + v / (RATE * FINE)
    found = {name: np.array(x) for name, x in zip(("q", "v", "u", "push"), zip(*rows, strict=True), strict=True)}
    found["v"] = found["v"] + NOISE_V * rng.standard_normal(found["v"].shape)
    found["u"] = found["u"] + NOISE_U * rng.standard_normal(found["u"].shape)
    return found


def qvu(motion: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return motion["q"], motion["v"], motion["u"]


def true_system(robot: Robot) -> Model:
    """With the friction of the simulation."""
    more = tuple(np.subtract(CONFIG.joint_static, CONFIG.joint_coulomb))
    dry = (CONFIG.joint_coulomb, more, CONFIG.joint_breakaway_velocity, CONFIG.joint_smoothing)
    plain = Model(robot)
    known = (*plain.forces, Viscous(CONFIG.joint_viscous), Stribeck(*dry))
    return Model(robot, forces=known)


def scores(state: ContactState, motion: dict[str, np.ndarray]) -> tuple[float, float]:
    """Share of pushes found, and the median delay [ms] of those."""
    period, window = round(EVERY * RATE), round(LASTING * RATE)
    pushes = state.alarm.numpy()[: len(motion["q"]) // period * period].reshape(-1, period)[:, : window + 1]
    found = pushes.any(axis=1)
    return float(found.mean()), float(np.median(pushes[found].argmax(axis=1)) * 1e3 / RATE) if found.any() else np.nan


def recordings(seed: int) -> dict[str, dict[str, np.ndarray]]:
    """Free motion for the threshold and for false alarms, and pushes."""
    robot = robot_of()
    return {
        "calibration": moved(robot, seed + 200, 180.0),
        "free": moved(robot, seed + 300, 600.0),
        "5 N": moved(robot, seed + 400, PUSHES * EVERY, 5.0),
        "3 N": moved(robot, seed + 400, PUSHES * EVERY, 3.0),
    }


def monitors(seed: int, calibration: dict[str, np.ndarray]) -> dict[str, ContactMonitor]:
    """Name -> monitor, calibrated."""
    robot = robot_of()
    given = Model(robot)
    motion = followed(robot, excitation(seed), PDGravity(robot, **GAINS), 20.0)
    models = {name: fit.predictor() for name, fit in fits(rows_of(motion, given, seed), given, seed).items()}
    made = {**models, "true model": true_system(robot)}
    made["learned, noise alone"] = models["learned"].posterior.predictor(covariance="none")
    found = {name: ContactMonitor(model, dt=1 / RATE, bandwidth=5.0) for name, model in made.items()}
    return {name: each.calibrate([qvu(calibration)], false_alarms_per_hour=0.1) for name, each in found.items()}


def seconds_per_call(monitor: ContactMonitor, motion: dict[str, np.ndarray]) -> float:
    samples = [tuple(torch.from_numpy(x[k]) for x in qvu(motion)) for k in range(3000)]
    begun = time.process_time()
    for sample in samples:
        monitor(*sample)
    return (time.process_time() - begun) / len(samples)


def in_c(monitor: ContactMonitor, motion: dict[str, np.ndarray]) -> dict[str, float]:
    """Times of a step and of a place, and the largest difference from Python relative to the largest value."""
    assert isinstance(monitor.model, Predictor), "of what was learned"
    links, samples = [*monitor.ends], list(zip(*(np.ascontiguousarray(x[:5000]) for x in qvu(motion)), strict=True))
    made = [np.zeros((len(samples), size)) for size in (7, 1, 10 + len(links))]
    state, alarm, times = np.zeros(100), np.zeros(1, np.int32), []
    with tempfile.TemporaryDirectory() as folder:
        export_c(monitor.model.posterior, Path(folder) / "c", covariance=monitor.open, monitor=monitor, name="arm")
        build = ["gcc", "-std=c99", "-O2", "-fPIC", "-shared", "arm.c", "-o", "arm.so", "-lm"]
        subprocess.run(build, cwd=Path(folder) / "c", check=True)
        library = ctypes.CDLL(str(Path(folder) / "c" / "arm.so"))
        for sample, *results in zip(samples, *made, strict=True):
            q, v, u, torque, distance, place, *own = (
                ctypes.c_void_p(x.ctypes.data) for x in (*sample, *results, state, alarm)
            )
            begun = time.perf_counter()
            library.arm_monitor_step(own[0], q, v, u, torque, distance, own[1])
            between = time.perf_counter()
            library.arm_monitor_place(q, torque, place)
            times.append((between - begun, time.perf_counter() - between))
    monitor.restart()
    wanted = []
    for q, v, u in samples:
        seen = monitor(q, v, u)
        at = monitor.place(q, seen.torque)
        also = [links.index(at.link), *(name in at.also for name in links)]
        wanted.append((seen.torque.numpy(), seen.distance[None].numpy(), at.point, at.force, at.force_std, also))
    numbers, which = made[2][:, :9].reshape(-1, 3, 3), made[2][:, 9:].copy().view(np.int32)[:, : 1 + len(links)]
    pairs = zip((*made[:2], *numbers.swapaxes(0, 1), which), map(np.array, zip(*wanted, strict=True)), strict=True)
    apart = max(float(np.abs(x - y).max() / np.abs(y).max()) for x, y in pairs)
    step, placed = 1e6 * np.median(times, axis=0)
    return {"step_us": float(step), "place_us": float(placed), "apart": apart}


def run() -> dict[str, float]:
    found: dict[str, dict[str, list[float]]] = {}
    calls: list[float] = []
    programs: dict[str, dict[str, float]] = {}
    for seed in SEEDS:
        motions = recordings(seed)
        made = monitors(seed, motions["calibration"])
        for name, monitor in made.items():
            alarms = monitor.run(*qvu(motions["free"])).alarm.numpy()
            each = {"false alarms": float((np.diff(alarms.astype(int)) > 0).sum())}
            for pushed in ("5 N", "3 N"):
                share, delay = scores(monitor.run(*qvu(motions[pushed])), motions[pushed])
                each |= {pushed: share, f"{pushed} delay": delay}
            for score, value in each.items():
                found.setdefault(name, {}).setdefault(score, []).append(value)
            print(f"seed {seed}, {name:32s}", ", ".join(f"{k} {v:.3g}" for k, v in each.items()), flush=True)
        calls.append(1e3 * seconds_per_call(made["learned"], motions["free"]))
        if not programs:
            for name in ("learned, noise alone", "learned"):
                programs[name] = in_c(made[name], motions["5 N"])
                print(name, "in C:", programs[name])
    for name, each in found.items():
        middle = {score: f"{statistics.median(v):.3g} ({min(v):.3g} to {max(v):.3g})" for score, v in each.items()}
        print(f"{name:32s}", middle)
    learned = {score: statistics.median(values) for score, values in found["learned"].items()}
    return {
        "monitor_5n": learned["5 N"],
        "monitor_3n": learned["3 N"],
        "monitor_5n_delay_ms": learned["5 N delay"],
        "monitor_false_alarms": max(found["learned"]["false alarms"]),
        "monitor_3n_laws": statistics.median(found["Coulomb's and viscous friction"]["3 N"]),
        "monitor_3n_urdf": statistics.median(found["URDF"]["3 N"]),
        "monitor_call_ms": statistics.median(calls),
        "monitor_c_step_mean_us": programs["learned, noise alone"]["step_us"],
        "monitor_c_step_us": programs["learned"]["step_us"],
        "monitor_c_place_us": max(each["place_us"] for each in programs.values()),
        "monitor_c_apart": max(each["apart"] for each in programs.values()),
    }
