"""Gradients of the likelihood from a few linear solves instead of a factorisation: cost and error.

Lin, Padhy, Mlodozeniec, Antoran & Hernandez-Lobato (2024), "Improving linear system solvers for hyperparameter
optimisation in iterative Gaussian processes": with S probes x_s = T^-1 z_s, z_s ~ N(0, T) drawn from the prior, which
has covariance T^-1,

    dNLL = 1/2 mean_s x_s^T dT x_s - 1/2 alpha^T dT alpha + alpha^T dt,

all S + 1 systems in one search of conjugate gradients with the library's preconditioner. Exact draws from the prior,
by Cholesky factors of the kernel matrices. Part of `benchmarks.solvers`.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from benchmarks.solver_problem import Task
from forcegp.inference import LatentKernels
from forcegp.inference.iterative import LowRankPlusDiagonal, conjugate_gradients
from forcegp.inference.likelihood import deflate, whiten
from forcegp.models.structured.marginal_likelihood import MarginalLikelihood

ROWS, PROBES, SEEDS, TOLERANCE = 1000, (8, 32), (0, 1, 2), 1e-2
JITTER = 1e-10
"""Of the mean diagonal of a kernel matrix, so that it can be factorised to draw from the prior."""

Gradient = list[Tensor]


def exact_gradient(
    likelihood: MarginalLikelihood, kernels: LatentKernels, parameters: Mapping[str, Tensor]
) -> Gradient:
    """From the factorised covariance, of all parameters."""
    leaves = _leaves(parameters)
    return list(torch.autograd.grad(likelihood(kernels, leaves), list(leaves.values())))


def estimated_gradient(
    likelihood: MarginalLikelihood,
    kernels: LatentKernels,
    parameters: Mapping[str, Tensor],
    *,
    probes: int,
    points: int,
    seed: int,
    tolerance: float = TOLERANCE,
) -> Gradient:
    """From `probes` draws, of all parameters."""
    leaves = _leaves(parameters)
    features, W, residual, noise = likelihood.terms(leaves)
    W_white, y_white, log_noise = whiten(W, residual, noise)
    matrices = kernels.matrices(leaves, features)
    with torch.no_grad():
        deflation = deflate(W_white, y_white)
        right = torch.cat([deflation.t[..., None], _prior_draws(deflation.C, matrices, probes, seed)], dim=-1)
        solved = _solve(kernels.at(parameters), features, deflation.C, deflation.t, matrices, right, points, tolerance)
        first = (deflation.U @ solved[..., :1])[..., 0] + deflation.remainder  # S~^-1 y~
        rest = deflation.U @ solved[..., 1:]
    # a function whose gradient at these parameters is the estimate: its vectors are constants
    fixed = torch.cat([first[..., None], rest], dim=-1)
    forces = torch.einsum("idc,ids->csi", W_white, fixed)
    quadratic = sum(((b @ K) * b).sum(-1) for b, K in zip(forces, matrices, strict=True))
    assert isinstance(quadratic, Tensor)
    value = (first * y_white).sum() - 0.5 * quadratic[0] + 0.5 * quadratic[1:].mean() + log_noise
    return list(torch.autograd.grad(value, list(leaves.values())))


def _leaves(parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().clone().requires_grad_() for name, value in parameters.items()}


def _prior_draws(C: Tensor, matrices: list[Tensor], count: int, seed: int) -> Tensor:
    """z ~ N(0, T) (N, r, count)."""
    generator = torch.Generator().manual_seed(seed)
    rows, rank, _ = C.shape
    draws = torch.randn(rows, rank, count, generator=generator, dtype=C.dtype)
    for c, K in enumerate(matrices):
        lower = torch.linalg.cholesky(K + JITTER * K.diagonal().mean() * torch.eye(rows, dtype=C.dtype))
        f = lower @ torch.randn(rows, count, generator=generator, dtype=C.dtype)
        draws += C[:, :, c, None] * f[:, None, :]
    return draws


def _solve(
    kernels: LatentKernels,
    features: list[Tensor],
    C: Tensor,
    t: Tensor,
    matrices: list[Tensor],
    right: Tensor,
    points: int,
    tolerance: float,
) -> Tensor:
    count, rank, _ = C.shape
    preconditioner = LowRankPlusDiagonal.of(kernels, features, C, t, points)

    def apply(x: Tensor) -> Tensor:
        given = x.reshape(count, rank, -1)
        mixed = (C.mT @ given).movedim(1, 0)
        latent = torch.stack([K @ y for K, y in zip(matrices, mixed, strict=True)], dim=1)
        return (C @ latent + given).reshape(x.shape)

    flat = right.reshape(count * rank, -1)
    found = conjugate_gradients(apply, preconditioner.solve, flat, tolerance=tolerance, iterations=2000)
    return found.solution.reshape(right.shape)


def run(task: Task) -> dict[str, float]:
    """Measure and print; returns keys of results.json."""
    results: dict[str, float] = {}
    likelihood = task.likelihood(task.rows.rows(slice(ROWS)))
    fitted = dict(task.fitted.parameters)
    places = {"start": fitted | likelihood.kernels().initial_parameters(), "fitted to 250": fitted}
    print(f"\ngradients at N = {ROWS}, tolerance {TOLERANCE:.0e}; errors of the whole gradient, mean of {len(SEEDS)}")
    print("parameters      method                       CPU s  relative error  cosine")
    kernels = task.fitted.kernels
    for place, parameters in places.items():
        exact, seconds = _timed(lambda p=parameters: exact_gradient(likelihood, kernels, p))
        print(f"{place:15} {'factorised covariance':27} {seconds:7.2f} {'':>15}", flush=True)
        results.setdefault("gradient_exact_cpu_s_n1000", seconds)
        for probes in PROBES:
            found = [
                _timed(
                    lambda p=parameters, n=probes, s=seed: estimated_gradient(
                        likelihood, kernels, p, probes=n, points=ROWS // 5, seed=s
                    )
                )
                for seed in SEEDS
            ]
            error = statistics.mean(float((g - exact).norm() / exact.norm()) for g, _ in found)
            cosine = statistics.mean(float(g @ exact / (g.norm() * exact.norm())) for g, _ in found)
            cost = statistics.median(spent for _, spent in found)
            print(f"{place:15} {f'{probes} probes':27} {cost:7.2f} {error:15.3f} {cosine:7.3f}", flush=True)
            if place != "start":
                results[f"gradient_{probes}_probes_cpu_s_n1000"] = cost
                results[f"gradient_{probes}_probes_error_n1000"] = error
    return results


def _timed(call: Callable[[], Gradient]) -> tuple[Tensor, float]:
    start = time.process_time()
    gradient = call()
    return torch.cat([part.reshape(-1) for part in gradient]), time.process_time() - start
