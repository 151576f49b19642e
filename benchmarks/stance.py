"""Flags of feet that `estimate_stance` finds on the simulated quadruped, against the true ones.

With white noise of v, and with white noise of q behind a filter from which v and a follow. Prints the share of the
flags it sets that are right, and of the rows that it leaves open, least and largest over seeds.
"""

import argparse
from dataclasses import replace

import numpy as np
import torch

from forcegp import Dataset
from forcegp.data import Preparation, estimate_stance
from forcegp.simulation import QuadrupedConfig, simulate_quadruped

NOISES = (0.0, 0.02, 0.05, 0.1)  # rad/s and m/s
POSES, CUTOFF = (2e-4, 5e-4, 1e-3), 10.0  # m and rad of the base, a fifth of it at the joints; Hz


def with_noise_of_poses(log: Dataset, noise: float, seed: int) -> Dataset:
    """The log as a filter leaves it."""
    assert log.model is not None
    steps = noise * np.random.default_rng(seed).standard_normal(log.v.shape)
    steps[:, 6:] *= 0.2
    q = log.model.robot.integrate(torch.tensor(log.q), torch.tensor(steps)).numpy()
    return Preparation(cutoff=CUTOFF).apply(replace(log, q=q, truth={}, noise_std=None))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=12.0)
    options = parser.parse_args()
    behind = f"of poses behind {CUTOFF:g} Hz, noise"
    cases = [*(("noise", noise) for noise in NOISES), *((behind, noise) for noise in POSES)]
    scores: dict[tuple[str, float], list[tuple[float, float]]] = {case: [] for case in cases}
    for seed in range(1, options.seeds + 1):
        log = simulate_quadruped(QuadrupedConfig(seconds=options.seconds, seed=seed))
        for kind, noise in cases:
            draws = noise * np.random.default_rng(seed).standard_normal(log.v.shape)
            noisy = (
                replace(log, v=log.v + draws, truth={}) if kind == "noise" else with_noise_of_poses(log, noise, seed)
            )
            found = estimate_stance(noisy)
            true, decided = log.u[:, -len(found.names) :], np.isfinite(found.flags)
            right = float((found.flags[decided] == true[decided]).mean())
            scores[kind, noise].append((right, float((~decided).any(axis=1).mean())))
    for (kind, noise), pairs in scores.items():
        right, open_rows = np.array(pairs).T
        print(f"{kind} {noise:g}: flags right {right.min():.4%} or more, rows open {open_rows.min():.1%} to", end=" ")
        print(f"{open_rows.max():.1%}", flush=True)


if __name__ == "__main__":
    main()
