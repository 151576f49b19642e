"""Other ways to solve T alpha = t than the one that `forcegp` takes, for `benchmarks.solvers` only.

Every method is a generator: each step yields alpha and the residual t - T alpha that it carries along, None where it
carries none. All of them may keep the kernel matrices in memory and begin with nothing made, so that what they prepare
is part of their first step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

import torch
from torch import Tensor

from benchmarks.solver_problem import Problem
from forcegp.inference.cholesky import factorize
from forcegp.inference.iterative import KernelPanels, LowRankPlusDiagonal
from forcegp.inference.likelihood import deflated_covariance

Steps = Iterator[tuple[Tensor, Tensor | None]]
Preconditioner = Callable[[Problem], Callable[[Tensor], Tensor]]
"""Made from a problem: P^-1 as a function of residuals (N, r)."""

EVERYTHING = 2**40
"""Bytes of kernel matrices that may be kept."""


def cholesky(problem: Problem) -> Steps:
    """The factorised covariance, which the exact engine takes."""
    matrices = problem.new_matrices()
    factor = factorize(lambda: deflated_covariance(problem.C, list(matrices)))
    yield factor.solve(problem.t.reshape(-1, 1)).reshape(problem.t.shape), None


def conjugate_gradients(problem: Problem, preconditioner: Preconditioner) -> Steps:
    """Saad (2003), "Iterative methods for sparse linear systems", algorithm 9.1, with the products of the library."""
    panels = KernelPanels(problem.kernels, problem.features, EVERYTHING)
    precondition = preconditioner(problem)
    alpha, residual = torch.zeros_like(problem.t), problem.t.clone()
    z = precondition(residual)
    direction, rho = z, (residual * z).sum()
    while True:
        mixed = problem.beta(direction).mT.contiguous()[..., None]
        step = torch.einsum("irc,ci->ir", problem.C, panels(mixed)[..., 0]) + direction
        length = rho / (direction * step).sum()
        alpha = alpha + length * direction
        residual = residual - length * step
        yield alpha, residual
        z = precondition(residual)
        previous, rho = rho, (residual * z).sum()
        direction = z + (rho / previous) * direction


def unpreconditioned(problem: Problem) -> Callable[[Tensor], Tensor]:
    """P = I."""
    return lambda residual: residual


def point_blocks(problem: Problem) -> Callable[[Tensor], Tensor]:
    """P is the r x r block of T of every point (block Jacobi)."""
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(own_blocks(problem)))
    return lambda residual: (inverse @ residual[..., None])[..., 0]


def own_blocks(problem: Problem) -> Tensor:
    """T_ii = sum_c C_ic C_ic^T k_c(z_i, z_i) + I (N, r, r)."""
    pairs = zip(problem.kernels.dense, problem.features, strict=True)
    prior = torch.stack([kernel.diagonal(z) for kernel, z in pairs], dim=-1)
    return (problem.C * prior[:, None]) @ problem.C.mT + torch.eye(problem.C.shape[1], dtype=problem.C.dtype)


def pivoted_cholesky_of_covariance(rank: int, blocks: bool = False) -> Preconditioner:
    """P = L L^T + D with L from `rank` greedy pivots among the entries of T - I, and D = I.

    Gardner et al. (2018), "GPyTorch: blackbox matrix-matrix Gaussian process inference with GPU acceleration", sec. 4.
    `blocks`: D holds besides what L leaves out of the r x r block of every point, as our own preconditioner does.
    """

    def made(problem: Problem) -> Callable[[Tensor], Tensor]:
        C, (count, outputs) = problem.C, problem.t.shape
        left = own_blocks(problem).diagonal(dim1=1, dim2=2).reshape(-1) - 1.0
        rows = C.new_zeros(min(rank, count * outputs), count * outputs)
        for done in range(len(rows)):
            pivot = int(left.argmax())
            i, a = divmod(pivot, outputs)
            pairs = zip(problem.kernels.dense, problem.features, strict=True)
            cross = torch.stack([kernel.cross(z[i : i + 1], z)[0] for kernel, z in pairs], dim=-1)
            row = torch.einsum("jbc,jc,c->jb", C, cross, C[i, a]).reshape(-1) - rows[:done].mT @ rows[:done, pivot]
            rows[done] = row / row[pivot].clamp_min(1e-12).sqrt()
            left = (left - rows[done].square()).clamp_min_(0.0)
            left[pivot] = 0.0
        D = torch.eye(outputs, dtype=C.dtype).expand(count, -1, -1)
        if blocks:
            L = rows.mT.reshape(count, outputs, -1)
            D = own_blocks(problem) - L @ L.mT
        noise_precision = torch.cholesky_inverse(torch.linalg.cholesky(D))

        def whiten(x: Tensor) -> Tensor:  # D^-1 x for x (n, S)
            return (noise_precision @ x.reshape(count, outputs, -1)).reshape(x.shape) if blocks else x

        inner = torch.linalg.cholesky(torch.eye(len(rows), dtype=C.dtype) + rows @ whiten(rows.mT))

        def solve(residual: Tensor) -> Tensor:
            y = whiten(residual.reshape(-1, 1))
            return (y - whiten(rows.mT @ torch.cholesky_solve(rows @ y, inner))).reshape(residual.shape)

        return solve

    return made


def low_rank_plus_diagonal(points: int) -> Preconditioner:
    """The library's own, in force space, with so many points of each latent."""

    def made(problem: Problem) -> Callable[[Tensor], Tensor]:
        found = LowRankPlusDiagonal.of(problem.kernels, problem.features, problem.C, problem.t, points)
        return lambda residual: found.solve(residual.reshape(-1, 1)).reshape(residual.shape)

    return made


def alternating_projections(problem: Problem, size: int, clusters: bool) -> Steps:
    """Blocks of about `size` points, each solved exactly in turn, that with the largest residual first.

    Wu, Wenger, Jones, Pleiss & Gardner (2024), "Large-scale Gaussian processes via alternating projection", with the
    greedy (Gauss-Southwell) choice and cached Cholesky factors of all blocks. `clusters`: blocks of neighbours by
    bisection in the features; otherwise slices of the rows as they are.
    """
    count = len(problem.t)
    if clusters:
        blocks = _bisected(torch.cat(problem.features, dim=-1), torch.arange(count), size)
    else:
        blocks = list(torch.arange(count).tensor_split(-(-count // size)))
    order = torch.cat(blocks)
    kernels, features = problem.kernels, tuple(z[order] for z in problem.features)
    ordered = Problem(kernels, features, problem.C[order], problem.t[order])
    matrices, C = ordered.new_matrices(), ordered.C
    stops = torch.tensor([0, *map(len, blocks)]).cumsum(0).tolist()
    parts = [slice(start, stop) for start, stop in pairwise(stops)]
    factors = [factorize(lambda p=p: deflated_covariance(C[p], list(matrices[:, p, p]))) for p in parts]
    back = order.argsort()
    alpha, residual = torch.zeros_like(ordered.t), ordered.t.clone()
    while True:
        sizes = torch.stack([residual[part].square().sum() for part in parts])
        part, factor = parts[int(sizes.argmax())], factors[int(sizes.argmax())]
        change = factor.solve(residual[part].reshape(-1, 1)).reshape(residual[part].shape)
        alpha[part] += change
        mixed = torch.einsum("irc,ir->ci", C[part], change)
        latent = torch.stack([K[part].mT @ x for K, x in zip(matrices, mixed, strict=True)])
        residual -= torch.einsum("irc,ci->ir", C, latent)
        residual[part] -= change
        yield alpha[back], residual[back]


def _bisected(features: Tensor, rows: Tensor, size: int) -> list[Tensor]:
    """Rows cut at the median along their direction of largest spread until no part has more than `size`."""
    if len(rows) <= size:
        return [rows]
    centered = features[rows] - features[rows].mean(0)
    direction = torch.linalg.svd(centered, full_matrices=False).Vh[0]
    order = rows[(centered @ direction).argsort()]
    half = len(rows) // 2
    return [*_bisected(features, order[:half], size), *_bisected(features, order[half:], size)]


def stochastic_dual_descent(
    problem: Problem, step: float, batch: int, steps: int, whitened: bool, momentum: float = 0.9
) -> Steps:
    """Gradient steps on 1/2 alpha^T T alpha - alpha^T t, `batch` random points at a time.

    Lin, Padhy, Antoran, Tripp, Terenin, Szepesvari, Hernandez-Lobato & Janz (2024), "Stochastic gradient descent for
    Gaussian processes done right", algorithm 1: Nesterov's momentum and geometric averaging with weight 100 / steps.
    The step size is step / (largest eigenvalue), which 20 power iterations find. `whitened`: in coordinates in which
    every point's own block of T is I; the paper's own are those without.
    """
    matrices, count = problem.new_matrices(), len(problem.t)
    shape = torch.eye(problem.C.shape[1], dtype=problem.C.dtype).expand(count, -1, -1)
    if whitened:
        lower = torch.linalg.cholesky(own_blocks(problem))
        shape = torch.linalg.inv(lower)
    C, t, noise = shape @ problem.C, (shape @ problem.t[..., None])[..., 0], shape @ shape.mT

    def covariance_rows(chosen: Tensor | slice, x: Tensor) -> Tensor:
        mixed = torch.einsum("irc,ir->ci", C, x)
        latent = torch.stack([K[chosen] @ y for K, y in zip(matrices, mixed, strict=True)])
        return torch.einsum("irc,ci->ir", C[chosen], latent) + (noise[chosen] @ x[chosen][..., None])[..., 0]

    rate = step / _largest_eigenvalue(lambda x: covariance_rows(slice(None), x), t)
    generator = torch.Generator().manual_seed(0)
    average = min(1.0, 100.0 / steps)
    x, speed, mean = torch.zeros_like(t), torch.zeros_like(t), torch.zeros_like(t)
    while True:
        chosen = torch.randperm(count, generator=generator)[:batch]
        ahead = x + momentum * speed
        gradient = (count / len(chosen)) * (covariance_rows(chosen, ahead) - t[chosen])
        speed = momentum * speed
        speed[chosen] -= rate * gradient
        x = x + speed
        mean = average * x + (1.0 - average) * mean
        yield (shape.mT @ mean[..., None])[..., 0], None


def _largest_eigenvalue(apply: Callable[[Tensor], Tensor], start: Tensor) -> float:
    x = start / start.norm()
    size = 1.0
    for _ in range(20):
        y = apply(x)
        size = float(y.norm())
        x = y / size
    return size


def small_problem_solvers() -> dict[str, Callable[[Problem], Steps]]:
    """Every method with settings for a few dozen rows, for a check against dense linear algebra."""
    return {
        "cholesky": cholesky,
        "plain": lambda p: conjugate_gradients(p, unpreconditioned),
        "point blocks": lambda p: conjugate_gradients(p, point_blocks),
        "pivoted Cholesky of T": lambda p: conjugate_gradients(p, pivoted_cholesky_of_covariance(10)),
        "pivoted Cholesky of T and blocks": lambda p: conjugate_gradients(p, pivoted_cholesky_of_covariance(10, True)),
        "low rank plus diagonal": lambda p: conjugate_gradients(p, low_rank_plus_diagonal(5)),
        "alternating projections": lambda p: alternating_projections(p, 10, False),
        "alternating projections, clusters": lambda p: alternating_projections(p, 10, True),
        "stochastic dual descent": lambda p: stochastic_dual_descent(p, 0.3, 10, 200, False),
        "stochastic dual descent, whitened": lambda p: stochastic_dual_descent(p, 0.3, 10, 200, True),
    }
