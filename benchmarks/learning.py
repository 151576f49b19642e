"""How well does the structured model learn from 100 points, and is it calibrated?

For each seed: a train and a test trajectory of `kuka-surface` with different way-points, 100 training points by
farthest-point sampling, noise 0.1 rad/s^2; every 12th row of the test trajectory is scored.

    python -m benchmarks learning
"""

from __future__ import annotations

import statistics
import time

from benchmarks.scores import scores_of
from forcegp.fit import fit
from forcegp.forces import JointForces
from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface

SEEDS = (11, 12, 13, 14, 15)
SECONDS = 100.0
POINTS = 100


def run() -> dict[str, float]:
    """Measure and print; returns the keys of results.json that this question answers."""
    scores: dict[str, list] = {"analytical": [], "zero": []}
    print("seed       mean     MAE noise-free    NLPD coverage |A a - b|  CPU s")
    for seed in SEEDS:
        train = simulate_kuka_surface(KukaSurfaceConfig(seconds=SECONDS, seed=seed))
        test = simulate_kuka_surface(KukaSurfaceConfig(seconds=SECONDS, seed=1000 + seed)).rows(slice(0, None, 12))
        for mean, collected in scores.items():
            start, model = time.process_time(), train.model.with_forces(JointForces())
            posterior = fit(model if mean == "analytical" else model.without_mean(), train, points=POINTS, seed=seed)
            seconds = time.process_time() - start
            score = scores_of(posterior, test)
            collected.append(score)
            print(
                f"{seed:4d} {mean:>10} {score['mae']:7.4f} {score['mae_noise_free']:10.4f} {score['nlpd']:7.3f} "
                f"{score['coverage_95']:8.3f} {score['constraint_error']:9.1e} {seconds:6.1f}",
                flush=True,
            )
    everything = [score for collected in scores.values() for score in collected]
    results = {
        "constraint_error_n100": max(score["constraint_error"] for score in everything),
        "coverage_95_lowest_n100": min(score["coverage_95"] for score in everything),
        "coverage_95_highest_n100": max(score["coverage_95"] for score in everything),
    }
    for mean, collected in scores.items():
        results[f"mae_{mean}_n100"] = statistics.median(score["mae"] for score in collected)
        results[f"mae_noise_free_{mean}_n100"] = statistics.median(score["mae_noise_free"] for score in collected)
    return results
