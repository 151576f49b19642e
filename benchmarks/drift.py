"""Friction that drifts while the robot works: learned on, with forgetting, against what else could be done.

KUKA iiwa of `benchmarks.tracking`, Stribeck friction in every joint, of which 30 % are lost evenly within ten minutes.
Before, 20 s of another motion under PD give the first model: hyper-parameters from 100 rows, all 4799 rows taken in by
60 inducing points per joint. Then `ComputedTorque` follows a reference of sines for ten minutes at 240 Hz; every second
the 240 rows of it (noise of 0.1 rad/s^2) go to `posterior.update(rows, horizon=HORIZON)`, and the controller gets
`predictor.refreshed(posterior)`. In this comparison the simulation waits for both.

All rivals see the same rows of the same motion: "never updated"; "refit": from scratch at every full minute, to all
rows of the last minute (hyper-parameters from 100 of them, as many inducing points); "no forgetting": the same updates
with an infinite horizon. Error: root mean square over all joints of the predicted torque and
acceleration, against the noise-free ones of the simulation, on every fifth second from the second minute on, before its
rows are learned. CPU: process time of update and refresh over the number of rows. Coverage: of the noise-free
acceleration by 95 % intervals. Five seeds, medians.

    python -m benchmarks drift
"""

from __future__ import annotations

import math
import statistics
import time

import numpy as np
import torch

from benchmarks.plants import JointFrictionLaw
from benchmarks.tracking import (
    CONFIG,
    FINE,
    GAINS,
    NOISE,
    RATE,
    SEEDS,
    Reference,
    excitation,
    followed,
    robot_of,
    task_of,
)
from forcegp import ComputedTorque, Dataset, JointFriction, Model, fit
from forcegp.control import PDGravity
from forcegp.inference import Inducing
from forcegp.posterior import Posterior

SECONDS, LOST = 600, 0.3
HORIZON = 2.0 * SECONDS / LOST**2
"""Under which a force changes by 30 % of its prior standard deviation within ten minutes."""
ENGINE = Inducing(points=60)
EVALUATED = 5


class Plant:
    """The arm with friction at a share of what it was at first."""

    def __init__(self) -> None:
        self.robot = robot_of()
        self.arm, self.law, self.model = self.robot.compile(), JointFrictionLaw(CONFIG, self.robot), Model(self.robot)

    @staticmethod
    def share(t: float) -> float:
        return 1.0 - LOST * t / SECONDS

    def acceleration(self, q: np.ndarray, v: np.ndarray, u: np.ndarray, t: float) -> np.ndarray:
        moving = u - self.share(t) * self.law.curve(v)
        return self.arm.forward_dynamics(*(torch.as_tensor(x) for x in (q, v, moving))).numpy()

    def second(
        self, control: ComputedTorque, reference: Reference, q: np.ndarray, v: np.ndarray, begin: float
    ) -> tuple[np.ndarray, ...]:
        """States and torques of one second at every period: q, v (RATE + 1, 7) and u (RATE, 7)."""
        Q, V, U = [q], [v], []
        for k in range(RATE):
            t = begin + k / RATE
            U.append(control(q, v, *reference(t)).numpy())
            for _ in range(FINE):
                v = v + self.acceleration(q, v, U[-1], t) / (RATE * FINE)
                q = q + v / (RATE * FINE)
            Q.append(q)
            V.append(v)
        return tuple(np.array(x) for x in (Q, V, U))

    def rows(self, q: np.ndarray, v: np.ndarray, u: np.ndarray, begin: float, seed: int) -> Dataset:
        """What a robot has of it: differences of velocities with noise, states in the middle of every period."""
        generator = np.random.default_rng([seed, int(begin < 0.0), abs(round(begin))])
        a = np.diff(v, axis=0) * RATE + NOISE * generator.standard_normal(u.shape)
        middle = [0.5 * (x[1:] + x[:-1]) for x in (q, v)]
        return Dataset(
            q=middle[0], v=middle[1], u=u, a=a, time=begin + np.arange(len(u)) / RATE, model=self.model,
            noise_std=np.full(7, NOISE),
        )  # fmt: skip

    def errors(self, posterior: Posterior, rows: Dataset) -> tuple[float, float, float]:
        """Mean squares of torque and acceleration against the simulation's, and the coverage by 95 % intervals."""
        t = float(rows.time.mean())
        true = np.array([self.acceleration(q, v, u, t) for q, v, u in zip(rows.q, rows.v, rows.u, strict=True)])
        predicted = posterior.predict(rows.q, rows.v, rows.u).acceleration
        away = predicted.mean - torch.as_tensor(true)
        torque = (self.robot.mass_matrix(torch.as_tensor(rows.q)) @ away[..., None])[..., 0]
        within = away.abs() <= 1.96 * predicted.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        return float(torque.square().mean()), float(away.square().mean()), float(within.double().mean())


def first_model(plant: Plant, seed: int) -> Posterior:
    """Of all rows of a motion by inducing points."""
    motion = followed(plant.robot, excitation(seed), PDGravity(plant.arm, **GAINS), 20.0)
    log = plant.rows(motion["q"], motion["v"], motion["u"][:-1], -100.0, seed)
    return fitted(log, seed)


def fitted(log: Dataset, seed: int) -> Posterior:
    model = log.model.with_forces(JointFriction())
    return fit(model, log, points=len(log), learning_points=100, engine=ENGINE, restarts=1, seed=seed)


def merged(parts: list[Dataset]) -> Dataset:
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ("q", "v", "u", "a", "time")}
    return Dataset(**arrays, model=parts[0].model, noise_std=parts[0].noise_std)


def drifted(seed: int, seconds: int = SECONDS, horizons: tuple[float, ...] = ()) -> dict[str, tuple[float, ...]]:
    """Name -> error of torque and acceleration, coverage, and CPU ms per row (0 where nothing is learned)."""
    plant, reference = Plant(), task_of(seed)
    first = first_model(plant, seed)
    online = {"online": HORIZON, "no forgetting": math.inf} | {f"horizon {h:g}": h for h in horizons}
    models = dict.fromkeys(["never updated", "refit", *online], first)
    predictors = {name: first.predictor(covariance="none") for name in online}
    control = ComputedTorque(predictors["online"], **GAINS)
    sums, spent, count = {name: np.zeros(3) for name in models}, dict.fromkeys(models, 0.0), 0
    (q, v, _), minute = reference(0.0), []
    for second in range(seconds):
        Q, V, U = plant.second(control, reference, q, v, float(second))
        q, v, rows = Q[-1], V[-1], plant.rows(Q, V, U, float(second), seed)
        if second >= 60 and second % EVALUATED == 0:
            count += 1
            for name, posterior in models.items():
                sums[name] += plant.errors(posterior, rows)
        minute = [*minute[-59:], rows]
        for name, horizon in online.items():
            begin = time.process_time()
            models[name] = models[name].update(rows, horizon=horizon)
            predictors[name] = predictors[name].refreshed(models[name])
            spent[name] += 1e3 * (time.process_time() - begin)
        control.model = predictors["online"]
        if second % 60 == 59:
            begin = time.process_time()
            models["refit"] = fitted(merged(minute), seed)
            spent["refit"] += 1e3 * (time.process_time() - begin)
    found = {}
    for name, total in sums.items():
        torque, acceleration, coverage = total / count
        found[name] = math.sqrt(torque), math.sqrt(acceleration), coverage, spent[name] / (seconds * RATE)
    return found


def run() -> dict[str, float]:
    found: dict[str, list[tuple[float, ...]]] = {}
    for seed in SEEDS:
        for name, values in drifted(seed).items():
            found.setdefault(name, []).append(values)
            print(f"seed {seed} {name:15s} " + " ".join(f"{x:.4f}" for x in values), flush=True)
    ratios = {
        name: [
            tuple(a / b for a, b in zip(x[:2], y[:2], strict=True)) for x, y in zip(every, found["refit"], strict=True)
        ]
        for name, every in found.items()
    }
    for name, every in found.items():
        torque, acceleration, coverage, spent = (statistics.median(x) for x in zip(*every, strict=True))
        over = [statistics.median(x) for x in zip(*ratios[name], strict=True)]
        print(
            f"{name:15s} {1e3 * torque:8.2f} mNm {acceleration:7.4f} rad/s^2, over refit {over[0]:.2f} {over[1]:.2f}, "
            f"coverage {coverage:.3f}, {spent:.3f} ms CPU per row"
        )
    return {
        "drift_online_over_refit_torque": statistics.median(x[0] for x in ratios["online"]),
        "drift_online_over_refit_acceleration": statistics.median(x[1] for x in ratios["online"]),
        "drift_online_ms_per_row": statistics.median(x[3] for x in found["online"]),
    }
