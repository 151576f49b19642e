"""Masses and friction that are found of robots whose base moves, in simulation; for docs/how-to/moving-bases.md.

load: of the quadruped, with friction in its joints; 200 rows of 30 s for each seed, 10 s of another motion. `laws`
    learns mass and centre of the trunk with viscous and Coulomb friction by maximum likelihood, `force prior` friction
    as functions. Errors of accelerations are parts of those of the URDF.

    python -m benchmarks.moving_bases load [--runs N]
"""

import argparse
import warnings

import numpy as np
import torch

from forcegp import Coulomb, Dataset, JointFriction, Viscous
from forcegp.fit import fit
from forcegp.forces import Body, RigidBodies
from forcegp.posterior import Posterior
from forcegp.simulation import QuadrupedConfig, simulate_quadruped


def fits(train: Dataset) -> dict[str, Posterior]:
    trunk = RigidBodies({"trunk": Body(0.01)})
    laws = train.model.with_forces(trunk, Viscous(), Coulomb())
    return {
        "laws": fit(laws, train, rows=200),
        "force prior": fit(train.model.with_forces(trunk, JointFriction()), train, points=200, restarts=1),
    }


def load(seeds: int = 5) -> None:
    print(f"{'seed':>4} {'model':12} {'base':>7} {'joints':>7} {'load [kg]':>10} {'foot forces':>12}")
    for seed in range(1, seeds + 1):
        train = simulate_quadruped(QuadrupedConfig(seconds=30.0, seed=seed))
        test = simulate_quadruped(QuadrupedConfig(seconds=10.0, seed=100 + seed))
        q, v, u = (torch.tensor(x) for x in (test.q, test.v, test.u))
        a, forces = test.truth["a"], test.truth["lambda"]
        plain = np.square(test.model.dynamics(q, v, u).acceleration_map().offset.numpy() - a)
        for name, posterior in fits(train).items():
            found = posterior.predict(q, v, u, covariance=False)
            error = np.square(found.mean.numpy() - a)
            parts = [float(np.sqrt(error[:, k].sum() / plain[:, k].sum())) for k in (slice(6), slice(6, None))]
            load = posterior.parameters["trunk.mass"].value - train.model.robot.link("trunk").mass
            feet = np.sqrt(np.square(found.multiplier.mean.numpy() - forces).sum() / np.square(forces).sum())
            print(f"{seed:>4} {name:12} {parts[0]:7.4f} {parts[1]:7.4f} {load:10.4f} {feet:12.4f}", flush=True)


QUESTIONS = {"load": load}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("question", choices=QUESTIONS)
    parser.add_argument("--runs", type=int, help="flights or seeds")
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    QUESTIONS[asked.question](*([] if asked.runs is None else [asked.runs]))
