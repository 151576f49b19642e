"""What do the likelihood and all its gradients cost, against the dense formulation of the paper?

The dense side forms the DN x DN covariance and lets autograd differentiate `torch.linalg.solve` and `torch.logdet` (two
LU factorisations), as the paper's formulation does. Both sides get the same kernels, mixing vectors and residuals and
return the same 154 + 7 gradients (7 x (21 length scales + 1 output scale) + 7 noise levels). With the prior
"tool-friction" (two latents on the two velocities of the tool along its surface, kernels linear + squared exponential)
the dense side stays DN x DN, the deflated one has 2 N. One process, one thread, CPU seconds, medians; each side's peak
memory is measured in a child process of its own, above the memory that process had before the first evaluation.

Autograd through two LU factorisations is a weak peer. The strong one, "cholesky", is what shows the worth of deflation
itself: the same DN x DN covariance, one Cholesky factor (LAPACK's dpotrf), its inverse, and gradients by hand, with the
kernels, panels and products that the deflated side has.

    python -m benchmarks.likelihood
"""

from __future__ import annotations

import json
import math
import statistics
import subprocess
import sys
import time
from pathlib import Path

import torch
from gpytorch.kernels import Kernel, ScaleKernel
from threadpoolctl import threadpool_limits

from forcegp.forces import ToolForces
from forcegp.forces.kernels import kernel_of, squared_exponential
from forcegp.inference.dense_kernels import taken_apart
from forcegp.inference.likelihood import INNER, deflated_covariance, factorize, negative_log_likelihood

JOINTS, INPUTS, TANGENTS = 7, 21, 2


class Problem:
    """A random well-posed problem with the shapes of the iiwa: 7 joints, 21 inputs, m constraints."""

    def __init__(self, count: int, constraints: int, prior: str = "joint") -> None:
        generator = torch.Generator().manual_seed(0)

        def normal(*shape: int) -> torch.Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        factor = normal(count, JOINTS, JOINTS) / math.sqrt(JOINTS)
        M = factor @ factor.mT + 0.1 * torch.eye(JOINTS, dtype=torch.float64)
        M_inv = torch.linalg.inv(M)
        A = normal(count, constraints, JOINTS)
        self.H = M_inv - M_inv @ A.mT @ torch.linalg.solve(A @ M_inv @ A.mT, A @ M_inv)
        self.inputs = normal(count, INPUTS)
        self.residual = normal(count, JOINTS)
        if prior == "tool-friction":
            self.W, self.features = self.H @ normal(count, JOINTS, TANGENTS), self.inputs[:, :TANGENTS]
            self.kernels = [kernel_of(ToolForces().kernel, TANGENTS, 1.0 + axis) for axis in range(TANGENTS)]
        else:
            self.W, self.features = self.H, self.inputs
            self.kernels = [squared_exponential(INPUTS, 1.0 + joint) for joint in range(JOINTS)]
        self.log_noise = torch.full((JOINTS,), math.log(0.1), dtype=torch.float64, requires_grad=True)
        self.parameters = [parameter for kernel in self.kernels for parameter in kernel.parameters()] + [self.log_noise]

    def deflated(self) -> tuple[torch.Tensor, ...]:
        matrices = [taken_apart(kernel).cross(self.features, self.features) for kernel in self.kernels]
        value = negative_log_likelihood(self.W, self.residual, (2.0 * self.log_noise).exp()[None], matrices)
        return (value.detach(), *torch.autograd.grad(value, self.parameters))

    def dense(self) -> tuple[torch.Tensor, ...]:
        count = self.inputs.shape[0]
        matrices = [self._dense_kernel(kernel) for kernel in self.kernels]
        weighted = torch.stack(matrices, dim=1)[..., None] * self.W.permute(2, 0, 1)  # (i, c, j, e)
        S = torch.bmm(self.W, weighted.reshape(count, len(matrices), count * JOINTS))
        S = S.reshape(count * JOINTS, count * JOINTS)
        S = S + torch.diag_embed((2.0 * self.log_noise).exp().repeat(count))
        y = self.residual.reshape(-1)
        value = 0.5 * (y @ torch.linalg.solve(S, y) + torch.logdet(S) + y.numel() * math.log(2.0 * math.pi))
        return (value.detach(), *torch.autograd.grad(value, self.parameters))

    def cholesky(self) -> tuple[torch.Tensor, ...]:
        matrices = [taken_apart(kernel).cross(self.features, self.features) for kernel in self.kernels]
        with torch.no_grad():
            value, K_gradients, noise_gradient = self._by_hand([K.detach() for K in matrices])
        kernels = torch.autograd.grad(matrices, self.parameters[:-1], K_gradients)
        return (value, *kernels, noise_gradient)

    def _by_hand(self, matrices: list[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor], torch.Tensor]:
        count, latents, noise = len(self.residual), len(matrices), (2.0 * self.log_noise).exp()

        def covariance() -> torch.Tensor:
            S = deflated_covariance(self.W, matrices)  # plus the identity
            S.diagonal().add_(noise.repeat(count) - 1.0)
            return S

        factor = factorize(covariance)
        alpha = factor.solve(self.residual.reshape(-1, 1)).reshape(count, JOINTS)
        value = (self.residual * alpha).sum() + factor.log_determinant() + alpha.numel() * math.log(2.0 * math.pi)
        beta, inverse = torch.einsum("idc,id->ic", self.W, alpha), factor.into_inverse_factor()
        gradients = [torch.outer(beta[:, c], -0.5 * beta[:, c]) for c in range(latents)]
        squares, height = torch.zeros(count * JOINTS, dtype=torch.float64), INNER // JOINTS
        for start in range(0, count, height):
            stop = min(count, start + height)
            rows = inverse[start * JOINTS : stop * JOINTS, : stop * JOINTS]
            rows[:, start * JOINTS :].tril_()
            squares[: stop * JOINTS] += rows.square().sum(0)  # the diagonal of S^-1
            V = torch.bmm(self.W[:stop].mT, rows.view(-1, stop, JOINTS).permute(1, 2, 0))
            for c, gradient in enumerate(gradients):
                gradient[:stop, :stop].addmm_(V[:, c], V[:, c].mT, alpha=0.5)
        return 0.5 * value, gradients, noise * (squares.view(count, JOINTS) - alpha.square()).sum(0)

    def _dense_kernel(self, kernel: Kernel) -> torch.Tensor:
        """Plain operations on the whole matrix, which autograd differentiates."""
        if not isinstance(kernel, ScaleKernel):
            return kernel(self.features, self.features).to_dense()
        scaled = self.features / kernel.base_kernel.lengthscale
        squared = scaled.square().sum(-1)
        distance = squared[:, None] + squared[None, :] - 2.0 * scaled @ scaled.mT
        return kernel.outputscale * torch.exp(-0.5 * distance)


def median_cpu_seconds(problem: Problem, rounds: int) -> list[float]:
    """Median CPU seconds of one evaluation of each side, in turn: dense once, the others three times a round."""
    seconds: dict[str, list[float]] = {"dense": [], "cholesky": [], "deflated": []}
    for _ in range(rounds):
        for side in ("dense", *("cholesky", "deflated") * 3):
            start = time.process_time()
            getattr(problem, side)()
            seconds[side].append(time.process_time() - start)
    return [statistics.median(taken) for taken in seconds.values()]


def peak_mebibytes(side: str, count: int, constraints: int) -> float:
    """Peak resident memory of one evaluation above the start of it, in a fresh process."""
    command = [sys.executable, "-m", "benchmarks.likelihood", "--peak", side, str(count), str(constraints)]
    return float(json.loads(subprocess.run(command, capture_output=True, check=True, text=True).stdout))


def peak_of_this_process() -> float:
    """Peak resident memory in MiB (Linux; ru_maxrss would inherit the parent's peak through exec)."""
    status = Path("/proc/self/status").read_text()
    return next(float(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmHWM"))


def run() -> dict[str, float]:
    """Measure and print; returns the keys of results.json that this question answers."""
    results: dict[str, float] = {}
    print(
        f"{'N':>5} {'constraints':>11} {'prior':>13} {'dense [s]':>10} {'cholesky [s]':>13} {'deflated [s]':>13} "
        f"{'ratios':>12} {'value diff':>10} {'gradient diff':>13}"
    )
    for count, constraints, prior, rounds, key in (
        (400, 1, "joint", 5, "nll_speedup_n400"),
        (400, 3, "joint", 5, "nll_speedup_n400_three_constraints"),
        (1000, 1, "joint", 3, "nll_speedup_n1000"),
        (400, 1, "tool-friction", 5, "nll_speedup_n400_tool_friction"),
    ):
        problem = Problem(count, constraints, prior)
        expected, *others = problem.dense(), problem.cholesky(), problem.deflated()
        value_error = max(float((expected[0] - given[0]).abs()) for given in others)
        gradient_error = max(
            float((e - g).abs().max() / e.abs().max())
            for given in others
            for e, g in zip(expected[1:], given[1:], strict=True)
        )
        assert gradient_error < 1e-5, gradient_error
        dense, cholesky, deflated = median_cpu_seconds(problem, rounds)
        results[key] = dense / deflated
        if key in ("nll_speedup_n400", "nll_speedup_n1000"):
            results[key.replace("speedup", "vs_cholesky")] = cholesky / deflated
        print(
            f"{count:5d} {constraints:11d} {prior:>13} {dense:10.3f} {cholesky:13.3f} {deflated:13.3f} "
            f"{dense / deflated:6.2f}{cholesky / deflated:6.2f} {value_error:10.1e} {gradient_error:13.1e}"
        )
    dense_peak, deflated_peak = (peak_mebibytes(side, 1000, 1) for side in ("dense", "deflated"))
    results["nll_memory_ratio_n1000"] = deflated_peak / dense_peak
    print(
        f"peak memory at N=1000: dense {dense_peak:.0f} MiB, deflated {deflated_peak:.0f} MiB, ratio "
        f"{deflated_peak / dense_peak:.3f}"
    )
    return results


if __name__ == "__main__":
    torch.set_num_threads(1)
    with threadpool_limits(1):
        if len(sys.argv) == 5 and sys.argv[1] == "--peak":
            side, count, constraints = sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
            getattr(Problem(20, constraints), side)()  # libraries load their work buffers before the baseline is taken
            problem = Problem(count, constraints)
            before = peak_of_this_process()
            getattr(problem, side)()
            print(peak_of_this_process() - before)
        else:
            run()
