"""Stances and masses that are found of robots whose base moves, in simulation; for docs/how-to/moving-bases.md.

stance: flags of `estimate_stance` on the quadruped against the true ones, with white noise of v, and with white noise
    of q behind a filter: the share that is right, and rows that are left open, least and largest over seeds.
masses: of the quadruped by regression, where its poses have 1 mm and 1 mrad of white noise and joints a fifth of it:
    the mass of all bodies (19.2 kg, 17.2 kg in the URDF) with its standard error, and errors of accelerations on
    another motion over those of the URDF, least and largest over seeds.
load: of the quadruped, with friction in its joints; 200 rows of 30 s for each seed, 10 s of another motion. `laws`
    learns mass and centre of the trunk with viscous and Coulomb friction by maximum likelihood, `force prior` friction
    as functions. Errors of accelerations are parts of those of the URDF.

    python -m benchmarks.moving_bases {stance,masses,load} [--runs N]
"""

import argparse
import time
import warnings
from dataclasses import replace

import numpy as np
import torch

from forcegp import Coulomb, Dataset, JointFriction, Viscous
from forcegp.data import Preparation, estimate_stance
from forcegp.evidence import Torques
from forcegp.fit import fit
from forcegp.forces import Body, RigidBodies
from forcegp.posterior import Posterior
from forcegp.simulation import QuadrupedConfig, simulate_quadruped


def with_noise_of_poses(log: Dataset, noise: float, seed: int) -> Dataset:
    """Of that size in m and rad, of joints a fifth."""
    assert log.model is not None
    steps = noise * np.random.default_rng(seed).standard_normal(log.v.shape)
    steps[:, 6:] *= 0.2
    q = log.model.robot.integrate(torch.tensor(log.q), torch.tensor(steps)).numpy()
    return replace(log, q=q, truth={}, noise_std=None)


def stance(seeds: int = 10) -> None:
    cases = [("noise", x) for x in (0.0, 0.02, 0.05, 0.1)]  # rad/s and m/s
    cases += [("of poses behind 10 Hz, noise", x) for x in (2e-4, 5e-4, 1e-3)]
    scores: dict[tuple[str, float], list[tuple[float, float]]] = {case: [] for case in cases}
    for seed in range(1, seeds + 1):
        log = simulate_quadruped(QuadrupedConfig(seconds=12.0, seed=seed))
        for kind, noise in cases:
            draws = noise * np.random.default_rng(seed).standard_normal(log.v.shape)
            noisy = replace(log, v=log.v + draws, truth={})
            if kind != "noise":
                noisy = Preparation(cutoff=10.0).apply(with_noise_of_poses(log, noise, seed))
            found = estimate_stance(noisy)
            true, decided = log.u[:, -len(found.names) :], np.isfinite(found.flags)
            right = float((found.flags[decided] == true[decided]).mean())
            scores[kind, noise].append((right, float((~decided).any(axis=1).mean())))
    for (kind, noise), pairs in scores.items():
        right, rows = np.array(pairs).T
        told = f"flags right {right.min():.4%} or more, rows open {rows.min():.1%} to {rows.max():.1%}"
        print(f"{kind} {noise:g}: {told}", flush=True)


def masses(seeds: int = 3) -> None:
    test = simulate_quadruped(QuadrupedConfig(seconds=10.0, seed=77))
    at = tuple(torch.tensor(x) for x in (test.q, test.v, test.u))

    def errors(model) -> np.ndarray:
        wrong = (model.dynamics(*at).acceleration_map().offset.numpy() - test.truth["a"]) ** 2
        return np.sqrt([wrong[:, :6].mean(), wrong[:, 6:].mean()])

    given = errors(test.model)
    logs = [simulate_quadruped(QuadrupedConfig(seconds=20.0, seed=seed)) for seed in range(1, seeds + 1)]
    for cutoff in (4.0, 10.0, 20.0):  # Hz
        for name, evidence in (("torque", Torques()), ("both", Torques("both"))):
            found, begun = [], time.process_time()
            for seed, log in enumerate(logs, start=1):
                filtered = Preparation(cutoff=cutoff, stance="auto", trim=0.3)
                rows = filtered.apply(with_noise_of_poses(log, 1e-3, seed))
                model = rows.model.with_forces(RigidBodies("all"), Viscous(), Coulomb())
                result = fit(model, rows, evidence, rows=1000)
                found.append((*result.parameters.total_mass, *(errors(result.model) / given)))
            mass, deviation, base, joints = np.array(found).T
            each = ", ".join(f"{m:.2f} ± {d:.2f}" for m, d in zip(mass, deviation, strict=True))
            over = f"base {base.min():.3f}-{base.max():.3f}, joints {joints.min():.3f}-{joints.max():.3f}"
            seconds = (time.process_time() - begun) / seeds
            print(f"{cutoff:4g} Hz  {name:7}  mass {each} kg; {over}; {seconds:.0f} CPU s", flush=True)


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


QUESTIONS = {"stance": stance, "masses": masses, "load": load}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("question", choices=QUESTIONS)
    parser.add_argument("--runs", type=int, help="flights or seeds")
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    QUESTIONS[asked.question](*([] if asked.runs is None else [asked.runs]))
