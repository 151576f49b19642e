"""How far do rollouts of one fitted model go astray, per integrator, and what do they cost?

Prints the table of docs/how-to/rollouts.md: a test trajectory under recorded torques, and one row of samples.

    python benchmarks/rollouts.py
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch

from forcegp import KukaSurfaceConfig, fit, simulate_kuka_surface
from forcegp.data import recorded_motions
from forcegp.forces import JointForces
from forcegp.mechanics import Baumgarte
from forcegp.scores.motions import apart_from, inside_interval

HELD = Baumgarte(10.0, 1.0)
RUNS = (("symplectic-euler", HELD, 0), ("symplectic-euler", None, 0), ("rk4", HELD, 0))
RUNS_WITH_SAMPLES = (("symplectic-euler", HELD, 20),)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--points", type=int, default=200)
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=21, help="trains on this trajectory, tests on the next")
    given = parser.parse_args()
    torch.set_num_threads(1)
    train, test = (simulate_kuka_surface(KukaSurfaceConfig(seconds=20, seed=given.seed + k)) for k in (0, 1))
    assert train.model is not None
    assert test.model is not None
    posterior = fit(train.model.with_forces(JointForces()), train, points=given.points, restarts=1)
    recorded = recorded_motions(test, given.starts, given.seconds)
    header = ("integrator", "Baumgarte", "largest \\|c\\| [mm]", "median \\|c\\| [mm]")
    print("|", " | ".join((*header, "joint error [rad]: median, largest", "CPU")), "|")
    print("|---|---|---:|---:|---:|---:|")
    for integrator, baumgarte, samples in (*RUNS, *RUNS_WITH_SAMPLES):
        begin = time.process_time()
        rollout = posterior.rollout(
            recorded.q[:, 0],
            recorded.v[:, 0],
            recorded.u,
            recorded.dt,
            integrator=integrator,
            baumgarte=baumgarte,
            samples=samples,
        )
        seconds = time.process_time() - begin
        there = torch.tensor(recorded.q)
        inside = inside_interval(rollout, there)
        if inside is not None:
            share = f"{float(inside[:, 1:].mean()):.1%} of the recorded positions"
            print(f"\n{samples} samples: 95 % intervals hold {share}; {seconds:.1f} s CPU")
            continue
        worst = apart_from(there, rollout.q, rollout.space)[:, -1].abs().amax(-1).numpy()
        off = rollout.constraint.abs().amax(-1).numpy()
        name = "none" if baumgarte is None else f"{baumgarte.omega:g}, {baumgarte.zeta:g}"
        sizes = f"{1e3 * off.max():.2g} | {1e3 * np.median(off):.2g}"
        print(
            f"| `{integrator}` | {name} | {sizes} | {np.median(worst):.3f}, {worst.max():.3f} | {seconds:.1f} s |",
            flush=True,
        )


if __name__ == "__main__":
    main()
