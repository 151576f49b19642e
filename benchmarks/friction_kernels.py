"""How smooth should the level of dry friction be? Kernels for g in f(s) = tanh(s / w) g(s) + d s, on Stribeck friction.

Every kernel takes the place of the built-in one in the prior "load-friction"; 200 points of `kuka-surface --friction
stribeck`, analytical mean, scored on another trajectory against the noise-free acceleration; once with the scenario's
own law, and once with a sharper one, which bends within 2 cm/s instead of 5.

    python -m benchmarks.friction_kernels
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from itertools import product
from typing import Any

import torch
from gpytorch.kernels import AdditiveKernel, Kernel, ProductKernel
from threadpoolctl import threadpool_limits

from benchmarks.scores import scores_of
from forcegp.data import farthest_rows
from forcegp.errors import NumericalWarning
from forcegp.fit import fit
from forcegp.forces import KERNELS, ContactFriction, kernel_of
from forcegp.forces.basic_kernels import SmoothSignKernel, float64, linear
from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface

POINTS, SEEDS = 200, (401, 402)
LAWS: dict[str, dict[str, Any]] = {"scenario": {}, "sharp": {"friction_smoothing": 0.02, "breakaway_velocity": 0.1}}
LEVELS = {
    "squared exponential": "squared-exponential",
    "Matern 5/2": "matern-5/2",
    "Matern 3/2": "matern-3/2",
    "Matern 1/2": "matern-1/2",
}


def friction_with(level: str) -> Callable[[int, Any], Kernel]:
    """The friction kernel with another kernel, of the velocity itself, for what is not constant in g."""

    def make(dimension: int, variance: Any) -> Kernel:
        share = float64(variance) / 3.0
        inner = kernel_of(f"constant + {level}", dimension, 2.0 * share)
        return AdditiveKernel(ProductKernel(SmoothSignKernel(), inner), linear(dimension, share))

    return make


def run() -> dict[str, float]:
    """Measure and print; returns nothing for results.json."""
    names = {}
    for label, level in LEVELS.items():
        names[f"{label} of s"] = f"friction-{level}"
        KERNELS[f"friction-{level}"] = friction_with(level)
    names["Matern 1/2 of asinh(s / w), built in"] = "friction"
    print(f"{'law':9} {'kernel of the level':38} {'seed':>5} {'MAE noise-free':>15} {'NLPD':>7} {'in 95 % band':>13}")
    for law, seed in product(LAWS, SEEDS):
        config = {"friction": "stribeck", **LAWS[law]}
        train = farthest_rows(simulate_kuka_surface(KukaSurfaceConfig(seconds=60.0, seed=seed, **config)), POINTS)
        other = simulate_kuka_surface(KukaSurfaceConfig(seconds=20.0, seed=1000 + seed, **config))
        test = other.rows(slice(None, None, 4))
        for label, name in names.items():
            prior = ContactFriction(load=True, kernel=name)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NumericalWarning)  # of fits that the table shows to be worse
                scores = scores_of(fit(train.model.with_forces(prior), train), test)
            shown = f"{scores['mae_noise_free']:15.4f} {scores['nlpd']:7.2f} {scores['coverage_95']:13.3f}"
            print(f"{law:9} {label:38} {seed:5d} {shown}")
    return {}


if __name__ == "__main__":
    torch.set_num_threads(1)
    with threadpool_limits(1):
        run()
