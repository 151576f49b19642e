"""Sums of kernel functions as C against the posterior that they were made of."""

import pytest
import torch
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from tests.inference.problems import normal, problem

from forcegp.codegen.c_writer import Program, head, write_entry, write_function
from forcegp.codegen.graph import Graph, jacobian
from forcegp.codegen.library import RowFunction, aligned, compile_library
from forcegp.inference import ExactPosterior, LatentKernels, Terms
from forcegp.inference.prepared_kernels import kernel_groups, kernel_sums

SHARED = [1, 3, 4]
"""Latents with the same centres; one of them has one length scale for all features."""


@pytest.fixture(scope="module")
def latent() -> ExactPosterior:
    given = problem(count=9)
    kernels = list(given.kernels)
    kernels[2] = ScaleKernel(MaternKernel(nu=2.5, ard_num_dims=3)).double()
    kernels[4] = ScaleKernel(RBFKernel()).double()
    features = [given.features[1] + 5.0 if c in SHARED else z for c, z in enumerate(given.features)]
    built = LatentKernels(kernels)
    built.requires_grad_(False)
    return ExactPosterior.condition(built, Terms(features, *given.data))


def points(latent: ExactPosterior, count: int = 6) -> list[torch.Tensor]:
    one = 5.0 + normal(count, 3, seed=70)
    return [one if c in SHARED else normal(count, 3, seed=71 + c) for c in range(5)]


def close(actual: torch.Tensor, expected: torch.Tensor) -> None:
    torch.testing.assert_close(actual, expected, rtol=1e-10, atol=1e-10)


def test_latents_are_grouped_by_their_centers(latent):
    assert kernel_groups(latent) == ((2,), (0,), tuple(SHARED))


@pytest.mark.parametrize("lanes", [1, 8])
def test_the_sums_as_c_have_values_slopes_and_roots(latent, lanes, tmp_path):
    """Every group in a program of its own, whose inputs are the features."""
    for group, part in zip(kernel_groups(latent), kernel_sums(latent), strict=True):
        graph = Graph(part.features)
        values = part.call(graph, graph.inputs, True)
        slopes = [node for row in jacobian(graph, values, graph.inputs) for node in row]
        program = Program(
            graph, {"z": part.features}, {"f": values, "J": slopes, "k": part.variance(graph, graph.inputs)}
        )
        text = [
            head(lanes),
            part.c_source(lanes, True),
            write_function("program", graph, program.nodes, lanes, [f"{part.name}_slopes"]),
        ]
        options = ("-std=gnu11", "-O1", "-fno-math-errno", "-fPIC", "-shared")
        source = "\n".join([*text, write_entry(program, "program")])
        library = compile_library(source, options, tmp_path / f"{part.name}-{lanes}.so", "evaluate")
        sizes = [len(x) for x in program.outputs.values()]
        function = RowFunction(library, 1, sizes, [aligned(part.table())])
        z = points(latent, 11)
        given = z[group[0]]
        outputs = [torch.empty(11, size, dtype=torch.float64) for size in sizes]
        assert function.rows(11, [given], outputs) == 0
        leaf = [x.clone().requires_grad_() for x in z]
        expected = latent.mean(leaf)[:, list(group)]
        close(outputs[0], expected)
        close(function.single(given[3])[1][0], expected[3])
        for place in range(len(group)):
            theirs = torch.autograd.grad(expected[:, place].sum(), leaf, retain_graph=True, allow_unused=True)
            mine = theirs[group[place]]
            close(outputs[1].view(11, len(group), -1)[:, place], mine)
            close(function.single(given[3])[1][1].view(len(group), -1)[place], mine[3])
        close(outputs[2], torch.stack([latent.kernels.dense[c].diagonal(given) for c in group], -1))
