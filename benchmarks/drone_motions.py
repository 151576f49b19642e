"""Calibrated intervals of a drone's motions on flights that it has not seen, and what refinement on motions changes.

It trains on 20 s in wind of 4 m/s, and predicts 60 motions of 1 s in each other flight, with wind that is observed.
`--refine` also refines on windows of 1 s, which takes many CPU minutes.
"""

import argparse
import warnings
from dataclasses import replace

import numpy as np
import torch

from forcegp import AerodynamicForce, Dataset, fit
from forcegp.data import Lag, recorded_motions
from forcegp.posterior import Posterior, observing
from forcegp.simulation import QuadrotorConfig, simulate_quadrotor

HORIZONS = (0.1, 0.25, 0.5, 1.0)


def flight(seed: int, wind: float) -> Dataset:
    """With the rotor speeds that act, from .3 s on."""
    dataset = simulate_quadrotor(QuadrotorConfig(seconds=20.0, seed=seed, wind=wind))
    late = Lag(0.06)(dataset.u, dataset.time)
    return replace(dataset, u=late).rows(np.arange(72, len(dataset)))


def report(posterior: Posterior, dataset: Dataset, samples: int) -> None:
    seeing, seen = observing(posterior, dataset)
    motions = recorded_motions(seen, 60, HORIZONS[-1])
    begin = motions.q[:, 0], motions.v[:, 0], motions.u, motions.dt
    rollout = seeing.rollout(*begin, integrator="rk4", samples=samples)
    off = rollout.space.difference(rollout.q, torch.tensor(motions.q))
    for horizon in HORIZONS:
        row = round(horizon / motions.dt)
        line = f"  {horizon:4g} s: "
        for name, part in (("m", off[:, row, :3]), ("rad", off[:, row, 3:])):
            line += f"rms {float(part.square().sum(-1).mean().sqrt()):.5f} {name}, "
        if rollout.intervals is not None:
            low, high = (end[:, row] for end in rollout.interval())
            line += f"inside {float(((low <= off[:, row]) & (off[:, row] <= high)).double().mean()):.1%}"
        print(line, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=150)
    parser.add_argument("--refine", action="store_true")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    train = flight(1, 4.0)
    fitted = fit(train.model.with_forces(AerodynamicForce()), train, points=options.points, restarts=1)
    models = {"calibrated": fitted.calibrated_on_motions(train)}
    if options.refine:
        models["refined"] = fitted.refined_on_motions(train, 1.0)
    for name, posterior in models.items():
        for seed, wind in ((2, 4.0), (3, 4.0), (2, 0.0)):
            for samples in (0, 16) if name == "calibrated" else (0,):
                print(f"{name}, seed {seed}, wind {wind:g} m/s, {samples} samples", flush=True)
                report(posterior, flight(seed, wind), samples)


if __name__ == "__main__":
    main()
