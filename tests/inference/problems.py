"""Small random problems with the structure of constrained rigid bodies: W = H B with H A^T = 0."""

from dataclasses import dataclass
from pathlib import Path

import torch
from gpytorch.kernels import RBFKernel, ScaleKernel

from forcegp.codegen.c_writer import Program, head, write_entry, write_function
from forcegp.codegen.graph import Graph, jacobian
from forcegp.codegen.library import RowFunction, aligned, compile_library
from forcegp.inference import ExactPosterior, LatentKernels, Terms
from forcegp.inference.prepared_kernels import KernelSum

SHAPES = {
    "no constraint": {"constraints": 0}, "one constraint": {"constraints": 1},
    "three constraints": {"constraints": 3}, "fewer latents than outputs": {"latents": 2, "constraints": 0},
    "fewer latents than the rank of H": {"latents": 2, "constraints": 1},
    "more latents than outputs": {"latents": 6, "outputs": 3, "constraints": 1}, "one latent": {"latents": 1},
    "one output": {"outputs": 1, "constraints": 0}, "one point": {"count": 1}, "two points": {"count": 2},
}  # fmt: skip


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def constrained_inverse_mass(count: int, outputs: int, constraints: int, seed: int = 0) -> torch.Tensor:
    """H (count, outputs, outputs) of rank outputs - constraints, entries from 0.1 to several tens."""
    factor = normal(count, outputs, outputs, seed=seed)
    M_inv = torch.linalg.inv(factor @ factor.mT / outputs + 0.02 * torch.eye(outputs, dtype=torch.float64))
    A = normal(count, constraints, outputs, seed=seed + 1)
    return M_inv - M_inv @ A.mT @ torch.linalg.solve(A @ M_inv @ A.mT, A @ M_inv)


def squared_exponential_kernels(latents: int, dimension: int, seed: int = 0) -> LatentKernels:
    kernels = []
    for c in range(latents):
        kernel = ScaleKernel(RBFKernel(ard_num_dims=dimension)).double()
        kernel.base_kernel.lengthscale = 0.7 + 0.5 * normal(1, dimension, seed=seed + 10 * c).abs()
        kernel.outputscale = 0.5 + 0.3 * c
        kernels.append(kernel)
    return LatentKernels(kernels)


@dataclass
class Problem:
    W: torch.Tensor
    residual: torch.Tensor
    noise: torch.Tensor
    features: list[torch.Tensor]
    kernels: LatentKernels

    @property
    def data(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        return self.W, self.residual, self.noise

    @property
    def terms(self) -> Terms:
        return Terms(self.features, *self.data)


def problem(
    count: int = 12,
    outputs: int = 5,
    constraints: int = 1,
    latents: int | None = None,
    dimension: int = 3,
    seed: int = 0,
) -> Problem:
    """W = H, or H B where the number of latents is given; noise variances, one per point and output."""
    W = constrained_inverse_mass(count, outputs, constraints, seed)
    if latents is not None:
        W = W @ normal(count, outputs, latents, seed=seed + 2)
    return Problem(
        W=W, residual=3.0 * normal(count, outputs, seed=seed + 3),
        noise=(0.3 * normal(count, outputs, seed=seed + 4)).exp() * 0.05,
        features=[normal(count, dimension, seed=seed + 5 + c) for c in range(W.shape[-1])],
        kernels=squared_exponential_kernels(W.shape[-1], dimension, seed),
    )  # fmt: skip


def condition(given_problem: Problem) -> ExactPosterior:
    return ExactPosterior.condition(given_problem.kernels, given_problem.terms)


def rows_of_call(part: KernelSum, lanes: int, folder: Path) -> RowFunction:
    """A latent as a compiled program from features to values, slopes and prior variances."""
    graph = Graph(part.centers.shape[-1])
    values = part.call(graph, graph.inputs, True)
    slopes = [node for row in jacobian(graph, values, graph.inputs) for node in row]
    outputs = {"f": values, "J": slopes, "k": part.variance(graph, graph.inputs)}
    program = Program(graph, {"z": len(graph.inputs)}, outputs)
    function = write_function("program", graph, program.nodes, lanes, [f"{part.name}_slopes"])
    source = "\n".join([head(lanes), part.c_source(lanes, True), function, write_entry(program, "program")])
    options = ("-std=gnu11", "-O1", "-fno-math-errno", "-fPIC", "-shared")
    library = compile_library(source, options, folder / f"{part.name}-{lanes}.so", "evaluate")
    return RowFunction(library, 1, [len(x) for x in outputs.values()], [aligned(part.table())])
