"""A motion chosen for what it teaches, against random motions within the same limits.

KUKA iiwa with Stribeck friction in every joint, as in `tracking`. The robot has made one slow motion (velocities up to
0.3 rad/s), from 50 rows of which `joint-friction` was fitted. Then it makes one more of 10 s, within 1 rad from the
start, 1.5 rad/s and 6 rad/s^2, followed as a robot's own position controller does (computed torque on that model, 900 /
s^2; with the gains of `tracking` it lags by 0.15 rad, and what was planned is not what is visited); 100 rows of it, the
farthest apart, join those before, and the model is fitted again. The error is that of the acceleration (root mean
square over joints) at the states of the task of `tracking`, of which `excitation` got a log.

Rivals: 9 random Fourier series of five harmonics, faded in and out over a second and scaled until the first limit is
reached, and 5 random splines of the family that is searched, each joint scaled to its own limits. Five seeds (all
motions and the noise), medians. Seeds from 11 on were used to choose criterion and rows.

    python -m benchmarks excitation
"""

from __future__ import annotations

import statistics
import time
import warnings
from dataclasses import replace

import numpy as np
import torch
from scipy.stats import spearmanr

from benchmarks.tracking import (
    CONFIG,
    GAINS,
    MIDDLE,
    NOISE,
    RATE,
    SEEDS,
    PDGravity,
    Reference,
    followed,
    robot_of,
    rows_of,
    task_of,
)
from forcegp import ComputedTorque, Dataset, JointFriction, Model, excitation, fit
from forcegp.control.informative_motions import Excitation, LearnedForces, Motion
from forcegp.errors import ContactWarning
from forcegp.simulation.kuka_surface import joint_friction_of

SECONDS, SERIES, SPLINES = 10.0, 9, 5
LIMITS = {"position": 1.0, "velocity": 1.5, "acceleration": 6.0}
FEW, MORE, STIFF = 50, 100, 900.0


def joined(*parts: Dataset) -> Dataset:
    """The rows of several Datasets of one robot."""
    q, v, u, a = (np.vstack([getattr(part, name) for part in parts]) for name in "qvua")
    count = np.arange(len(q)) / RATE
    return Dataset(q=q, v=v, u=u, a=a, time=count, model=parts[0].model, noise_std=np.full(7, NOISE))


def fitted(rows: Dataset):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactWarning)  # of a motion so small that the tool seems to stay on a sphere
        return fit(rows.model.with_forces(JointFriction()), rows, restarts=1, seed=0)


class Sampled:
    """States of a motion at the controller's times, as `followed` asks for them."""

    def __init__(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> None:
        self.states = q, v, a

    def __call__(self, t: float) -> tuple[np.ndarray, ...]:
        return tuple(x[round(t * RATE)] for x in self.states)


TIMES = np.arange(round(SECONDS * RATE) + 1) / RATE


def random_series(rng: np.random.Generator, ends: np.ndarray) -> Sampled:
    """Five harmonics per joint, as large as the first limit lets them be."""
    t, rate = TIMES, 2.0 * np.pi / SECONDS * rng.uniform(0.5, 2.0) * np.arange(1, 6)
    sines, cosines = rng.standard_normal((2, 5, 7))
    q = (np.sin(rate * t[:, None])) @ sines + np.cos(rate * t[:, None]) @ cosines
    q = ((1.0 - np.exp(-(t**2))) * (1.0 - np.exp(-((SECONDS - t) ** 2))))[:, None] * q
    v = np.gradient(q, t, axis=0)
    a = np.gradient(v, t, axis=0)
    fastest = max(np.abs(v).max() / LIMITS["velocity"], np.abs(a).max() / LIMITS["acceleration"])
    size = max((q / ends[0]).max(), (q / ends[1]).max(), fastest)
    return Sampled(MIDDLE + q / size, v / size, a / size)


class Learner:
    """The robot after its slow motion, and what it learns from another."""

    def __init__(self, seed: int) -> None:
        self.seed, self.robot = seed, robot_of()
        self.given, self.law = Model(self.robot), joint_friction_of(CONFIG, self.robot)
        pd = PDGravity(self.robot, **GAINS)
        slow = followed(self.robot, Reference.random(seed + 300, 0.1, 1.5), pd, SECONDS)
        self.rows = rows_of(slow, self.given, seed, FEW)
        self.before = fitted(self.rows)
        self.control = ComputedTorque(self.before.predictor(covariance="none"), stiffness=STIFF)
        self.task = rows_of(followed(self.robot, task_of(seed), pd, SECONDS), self.given, seed, 200)
        self.states = [torch.tensor(np.array(x)) for x in zip(*map(task_of(seed), TIMES[::12]), strict=True)]

    def error(self, posterior) -> float:
        """Root mean square error of the acceleration in rad/s^2 along the task."""
        q, v, a = self.states
        u = self.robot.inverse_dynamics(q, v, a) - torch.from_numpy(self.law(v.numpy()))
        return float((posterior.predict(q, v, u).mean - a).square().mean().sqrt())

    def after(self, motion, number: int = 0) -> float:
        """The error of a model of old and new rows."""
        made = followed(self.robot, motion, self.control, SECONDS)
        new = rows_of(made, self.given, self.seed + 1000 + number, MORE)
        return self.error(fitted(joined(self.rows, new)))


def used(chosen: Excitation) -> float:
    """The largest position, velocity, acceleration and torque of 10,001 samples over its limit."""
    limits, states = chosen.limits, chosen.trajectory(np.linspace(0.0, SECONDS, 10_001))
    offset = states[0] - MIDDLE
    ratios = [offset / end for end in limits["position"]]
    values = dict(zip(("velocity", "acceleration", "torque"), (*states[1:], chosen.torques(*states)), strict=True))
    return max(float(x.max()) for x in [*ratios, *(np.abs(x) / limits[name][1] for name, x in values.items())])


def one(seed: int) -> dict[str, float]:
    """Errors, spreads and CPU seconds of one seed."""
    learner, rng, found = Learner(seed), np.random.default_rng([seed, 4]), {}
    found["before"] = learner.error(learner.before)
    how = {"limits": LIMITS, "start": MIDDLE, "seconds": SECONDS, "seed": seed}
    begun = time.process_time()
    chosen = excitation(learner.before, **how, task=learner.task)
    found["chosen_cpu"], found["chosen_used"] = time.process_time() - begun, used(chosen)
    found["chosen"] = learner.after(Sampled(*chosen.trajectory(TIMES)))
    teaches, rank = LearnedForces(learner.before, MORE), ([], [])
    teaches.judged_at = learner.task.q, learner.task.v, learner.task.u
    groups = {"series": [random_series(rng, chosen.limits["position"]) for _ in range(SERIES)]}
    splines = [chosen.kept(chosen.random(rng)).points for _ in range(SPLINES)]
    groups["splines"] = [Sampled(*replace(chosen, motion=Motion(x, x, x, x, x)).trajectory(TIMES)) for x in splines]
    for name, group in groups.items():
        for motion in group:
            q, v, a = (x[::5] for x in motion.states)
            rank[0].append(teaches.score(Motion(q, q, v, a, teaches.torques(q, v, a))))
            rank[1].append(learner.after(motion, len(rank[0])))
        errors = rank[1][-len(group) :]
        found[name], found[f"{name}_best"] = statistics.median(errors), min(errors)
    found["rank_correlation"] = float(spearmanr(*rank).statistic)
    return found


def run() -> dict[str, float]:
    found: dict[str, list[float]] = {}
    for seed in SEEDS:
        for name, value in one(seed).items():
            found.setdefault(name, []).append(value)
            print(f"seed {seed}, {name:24s} {value:8.3g}", flush=True)
    for name, values in found.items():
        print(f"{name:24s} {statistics.median(values):8.3g} ({min(values):.3g} to {max(values):.3g})")

    def over(one: str, other: str) -> float:
        return statistics.median(x / y for x, y in zip(found[one], found[other], strict=True))

    return {
        "excitation_over_random_series": over("chosen", "series"),
        "excitation_over_random_splines": over("chosen", "splines"),
        "excitation_rank_correlation": statistics.median(found["rank_correlation"]),
        "excitation_limits_used": max(found["chosen_used"]),
        "excitation_cpu_seconds": max(found["chosen_cpu"]),
    }
