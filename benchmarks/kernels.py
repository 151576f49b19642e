"""What the kernels of `forcegp.forces.KERNELS` are worth on functions that are smooth and on those that jump.

python -m benchmarks.kernels                                     four seeds, squared exponential, Matern 3/2 and deep
python -m benchmarks.kernels 2 squared-exponential deep          two seeds, these kernels

One Gaussian process on standardised points, noise of a tenth of the function's spread, three starts of the search; the
best by posterior density is tested on 400 new points. For every function, the mean over the seeds of the negative log
predictive density of noisy values in nats (lower is better), the root mean square error over the spread, and CPU s.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from forcegp.fit.search import perturbed
from forcegp.forces.kernels import kernel_of
from forcegp.inference import ExactPosterior, LatentKernels, Terms, minimize_objective, negative_log_likelihood

NOISE = 0.1
STARTS = 3
TEST_POINTS = 400

Function = Callable[[np.ndarray], np.ndarray]


def smooth(dimension: int, lengthscale: float, rng: np.random.Generator) -> Function:
    """A draw of a squared exponential, by 300 random cosines."""
    omega = rng.standard_normal((300, dimension)) / lengthscale
    phase, weight = rng.uniform(0.0, 2.0 * np.pi, 300), rng.standard_normal(300) * math.sqrt(2.0 / 300)
    return lambda x: np.cos(x @ omega.T + phase) @ weight


def linear(dimension: int, rng: np.random.Generator) -> Function:
    weight = rng.standard_normal(dimension)
    return lambda x: x @ weight


def step(dimension: int, lengthscale: float, size: float, rng: np.random.Generator) -> Function:
    background = smooth(dimension, lengthscale, rng)
    return lambda x: size * background(x) + 1.5 * (x[:, 0] > 0.2 * (dimension == 1))


def patch(rng: np.random.Generator) -> Function:
    """A coefficient of friction that is three times as large beyond x = 0, times a load."""
    background = smooth(2, 2.0, rng)
    return lambda x: 0.3 * background(x) + (0.5 + (x[:, 0] > 0.0)) * (1.0 + 0.3 * x[:, 1])


def disc(rng: np.random.Generator) -> Function:
    background = smooth(2, 2.0, rng)
    return lambda x: 0.3 * background(x) + 1.5 * ((x**2).sum(1) < 1.0)


FUNCTIONS: dict[str, tuple[int, int, Callable[[np.random.Generator], Function]]] = {
    "smooth, 1 feature": (1, 40, lambda rng: smooth(1, 0.6, rng)),
    "smooth, 2 features": (2, 60, lambda rng: smooth(2, 1.0, rng)),
    "smooth, 4 features": (4, 100, lambda rng: smooth(4, 2.0, rng)),
    "smooth, 8 features": (8, 100, lambda rng: smooth(8, 3.0, rng)),
    "linear, 4 features": (4, 60, lambda rng: linear(4, rng)),
    "step, 1 feature": (1, 40, lambda rng: step(1, 1.0, 0.5, rng)),
    "patch, 2 features": (2, 100, patch),
    "disc, 2 features": (2, 150, disc),
    "step, 4 features": (4, 150, lambda rng: step(4, 3.0, 0.3, rng)),
}


def scores(kernel: str, function: str, seed: int) -> tuple[float, float]:
    """Negative log predictive density and root mean square error."""
    dimension, count, make = FUNCTIONS[function]
    rng = np.random.default_rng((seed, 7))
    truth = make(rng)
    shape = [(count, dimension), (TEST_POINTS, dimension)]
    points = [rng.uniform(-2.0, 2.0, s) if dimension == 1 else rng.standard_normal(s) for s in shape]
    values = [truth(x) for x in points]
    mean, spread = values[0].mean(), values[0].std()
    noisy = [(y - mean) / spread + NOISE * rng.standard_normal(len(y)) for y in values]
    z, new = (torch.as_tensor(x) for x in points)
    y, target = (torch.as_tensor(x) for x in noisy)
    W, noise = torch.ones(count, 1, 1, dtype=torch.float64), torch.full((1, 1), NOISE**2, dtype=torch.float64)
    latent = LatentKernels([kernel_of(kernel, dimension, 1.0)])

    def objective(parameters):
        nll = negative_log_likelihood(W, y[:, None], noise, latent.matrices(parameters, [z]))
        return nll - latent.log_prior(parameters)

    moments = latent.initial_parameters()
    starts = [moments, *(perturbed(moments, seed, index) for index in range(1, STARTS))]
    best = min((minimize_objective(objective, start) for start in starts), key=lambda result: result.value)
    posterior = ExactPosterior.condition(latent.at(best.parameters), Terms([z], W, y[:, None], noise))
    error = target - posterior.mean([new])[:, 0]
    variance = posterior.covariance([new])[:, 0, 0].clamp_min(0.0) + NOISE**2
    density = 0.5 * (error.square() / variance + (2.0 * math.pi * variance).log()).mean()
    return float(density), float(error.square().mean().sqrt())


def main(seeds: int, kernels: list[str]) -> None:
    print(f"{'function':20s}" + "".join(f"{kernel:>30s}" for kernel in kernels))
    for function in FUNCTIONS:
        cells = []
        for kernel in kernels:
            start = time.process_time()
            density, error = np.mean([scores(kernel, function, seed) for seed in range(seeds)], axis=0)
            cells.append(f"{density:10.2f} {error:7.3f} {time.process_time() - start:8.1f} s")
        print(f"{function:20s}" + "".join(f"{cell:>30s}" for cell in cells), flush=True)


if __name__ == "__main__":
    with threadpool_limits(1):
        torch.set_num_threads(1)
        main(int(sys.argv[1]) if sys.argv[1:] else 4, sys.argv[2:] or ["squared-exponential", "matern-3/2", "deep"])
