"""Masses of the simulated quadruped by regression, where its poses are noisy, for each likelihood and filter.

Poses have 1 mm and 1 mrad of white noise, joints a fifth of it. Prints the mass of all bodies (19.2 kg, 17.2 kg in the
URDF), its standard error, and errors of accelerations on another motion over those of the URDF, least and largest over
the seeds.
"""

import argparse
import time
import warnings

import numpy as np
import torch

from forcegp.data import Preparation
from forcegp.evidence import Accelerations, Torques
from forcegp.fit import fit
from forcegp.forces import Coulomb, RigidBodies, Viscous
from forcegp.simulation import QuadrupedConfig, simulate_quadruped

NOISE = 1e-3
FILTERS = (4.0, 10.0, 20.0)  # Hz
LIKELIHOODS = "torque,both"  # acceleration takes minutes
ROWS = 1000
EVIDENCE = {"torque": Torques(), "acceleration": Accelerations(), "both": Torques("both")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--likelihoods", default=LIKELIHOODS, help="out of torque, acceleration and both")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    test = simulate_quadruped(QuadrupedConfig(seconds=10.0, seed=77))
    at = tuple(torch.tensor(x) for x in (test.q, test.v, test.u))

    def errors(model) -> np.ndarray:
        wrong = (model.dynamics(*at).acceleration_map().offset.numpy() - test.truth["a"]) ** 2
        return np.sqrt([wrong[:, :6].mean(), wrong[:, 6:].mean()])

    given = errors(test.model)
    logs = [simulate_quadruped(QuadrupedConfig(seconds=20.0, seed=seed)) for seed in range(1, options.seeds + 1)]
    for cutoff in FILTERS:
        for likelihood in options.likelihoods.split(","):
            found, begun = [], time.process_time()
            for seed, log in enumerate(logs, start=1):
                steps = NOISE * np.random.default_rng(seed).standard_normal(log.v.shape)
                steps[:, 6:] *= 0.2
                q = log.model.robot.integrate(torch.tensor(log.q), torch.tensor(steps)).numpy()
                noisy = log.__class__(q=q, v=log.v, u=log.u, a=log.a, time=log.time, model=log.model)
                prepared = Preparation(cutoff=cutoff, stance="auto", trim=0.3).apply(noisy)
                model = prepared.model.with_forces(RigidBodies("all"), Viscous(), Coulomb())
                result = fit(model, prepared, EVIDENCE[likelihood], rows=ROWS)
                found.append((*result.parameters.total_mass, *(errors(result.model) / given)))
            mass, deviation, base, joints = np.array(found).T
            seconds = (time.process_time() - begun) / options.seeds
            masses = ", ".join(f"{m:.2f} ± {d:.2f}" for m, d in zip(mass, deviation, strict=True))
            over = f"base {base.min():.3f}-{base.max():.3f}, joints {joints.min():.3f}-{joints.max():.3f}"
            print(f"{cutoff:4g} Hz  {likelihood:12}  mass {masses} kg; {over}; {seconds:.0f} CPU s", flush=True)


if __name__ == "__main__":
    main()
