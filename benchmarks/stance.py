"""Flags of feet that `estimate_stance` finds on the simulated quadruped, against the true ones, with noise of v.

Prints the share of the flags it sets that are right, and of the rows that it leaves open, least and largest over seeds.
"""

import argparse
from dataclasses import replace

import numpy as np

from forcegp.data import estimate_stance
from forcegp.simulation import QuadrupedConfig, simulate_quadruped

NOISES = (0.0, 0.02, 0.05, 0.1)  # rad/s and m/s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=12.0)
    options = parser.parse_args()
    scores: dict[float, list[tuple[float, float]]] = {noise: [] for noise in NOISES}
    for seed in range(1, options.seeds + 1):
        log = simulate_quadruped(QuadrupedConfig(seconds=options.seconds, seed=seed))
        for noise in NOISES:
            draws = noise * np.random.default_rng(seed).standard_normal(log.v.shape)
            found = estimate_stance(replace(log, v=log.v + draws, truth={}))
            true, decided = log.u[:, -len(found.names) :], np.isfinite(found.flags)
            right = float((found.flags[decided] == true[decided]).mean())
            scores[noise].append((right, float((~decided).any(axis=1).mean())))
    for noise, pairs in scores.items():
        right, open_rows = np.array(pairs).T
        print(f"noise {noise:g}: flags right {right.min():.4%} or more, rows open {open_rows.min():.1%} to", end=" ")
        print(f"{open_rows.max():.1%}", flush=True)


if __name__ == "__main__":
    main()
