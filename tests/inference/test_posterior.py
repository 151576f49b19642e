"""The posterior of the latents against dense Gaussian conditioning."""

import math
from dataclasses import replace

import pytest
import torch
from gpytorch.kernels import LinearKernel, MaternKernel, RBFKernel, ScaleKernel
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.inference.dense import dense_posterior
from tests.inference.problems import SHAPES, Problem, condition, normal, problem

from forcegp.errors import InvalidInput, NotEnoughMemory
from forcegp.inference import LatentKernels, engines, memory, posterior
from forcegp.inference.engines import Exact, Inducing, ProblemSize, choose_engine, engine_from_dict


def new_features(given_problem: Problem, points: int = 6) -> list[torch.Tensor]:
    return [normal(points, z.shape[1], seed=100 + c) for c, z in enumerate(given_problem.features)]


def dense(given_problem: Problem, features: list[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
    kernels = given_problem.kernels.kernels
    with torch.no_grad():
        matrices = [k(z, z).to_dense() for k, z in zip(kernels, given_problem.features, strict=True)]
        pairs = zip(kernels, features, given_problem.features, strict=True)
        cross = torch.stack([k(new, old).to_dense() for k, new, old in pairs])
        prior = torch.stack([k(new, diag=True) for k, new in zip(kernels, features, strict=True)], dim=-1)
        return dense_posterior(*given_problem.data, matrices, cross, prior)


def assert_equals_dense(given_problem: Problem, features: list[torch.Tensor] | None = None) -> None:
    features = new_features(given_problem) if features is None else features
    conditioned = condition(given_problem)
    mean, covariance = dense(given_problem, features)
    with torch.no_grad():
        torch.testing.assert_close(conditioned.mean(features), mean, rtol=1e-8, atol=1e-9)
        torch.testing.assert_close(conditioned.covariance(features), covariance, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("block_bytes", [64 * 2**20, 2000, 1], ids=["one block", "some blocks", "one point per block"])
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_mean_and_covariance(shape, block_bytes, monkeypatch):
    monkeypatch.setattr(posterior, "BLOCK_BYTES", block_bytes)
    assert_equals_dense(problem(**shape))


def test_noise_covariances_and_force_level_noise():
    given_problem = problem(constraints=1)
    given_problem.noise = torch.diag_embed(given_problem.noise) + 0.02 * given_problem.W @ given_problem.W.mT
    assert_equals_dense(given_problem)


def test_points_of_differing_rank():
    given_problem = problem(count=6, outputs=4, constraints=0)
    given_problem.W[1] = problem(outputs=4, constraints=3).W[0]
    given_problem.W[4] = 0.0
    assert_equals_dense(given_problem)


def test_other_kernels_and_features_of_several_dimensions():
    given_problem = problem(count=8, outputs=3, constraints=1)
    given_problem.features = [normal(8, d, seed=d) for d in (1, 2, 3)]
    given_problem.kernels = LatentKernels(
        [ScaleKernel(RBFKernel()).double(), MaternKernel(2.5, ard_num_dims=2).double(), LinearKernel().double()]
    )
    assert_equals_dense(given_problem)


def test_no_data_leaves_the_prior():
    given_problem = problem(count=0)
    features = new_features(given_problem)
    with torch.no_grad():
        mean, covariance = condition(given_problem).mean(features), condition(given_problem).covariance(features)
        variances = torch.stack([kernel.outputscale for kernel in given_problem.kernels.kernels])
    assert not mean.any()
    torch.testing.assert_close(covariance, torch.diag(variances).expand_as(covariance))


def test_data_without_noise_are_reproduced():
    given_problem = problem(constraints=0)
    given_problem.noise = torch.full((1, 5), 1e-10, dtype=torch.float64)
    with torch.no_grad():
        mean = condition(given_problem).mean(given_problem.features)
    residual = (given_problem.W @ mean[..., None])[..., 0]
    torch.testing.assert_close(residual, given_problem.residual, rtol=0.0, atol=1e-5)


def test_mean_is_differentiable_in_the_features():
    given_problem = problem(count=5, outputs=2, constraints=0)
    conditioned = condition(given_problem)
    features = [z.requires_grad_() for z in new_features(given_problem, points=2)]
    assert torch.autograd.gradcheck(lambda *z: conditioned.mean(z), features)
    assert torch.autograd.gradcheck(lambda *z: conditioned.covariance(z), features)


# ---------------------------------------------------------------- properties


@settings(max_examples=30)
@given(
    count=st.integers(1, 8), outputs=st.integers(1, 4), latents=st.integers(1, 5), seed=st.integers(0, 10_000),
    log_noise=st.floats(-12.0, 2.0),
)  # fmt: skip
def test_covariance_is_positive_semi_definite_and_below_the_prior(count, outputs, latents, seed, log_noise):
    given_problem = problem(count=count, outputs=outputs, constraints=0, latents=latents, seed=seed)
    given_problem.noise = torch.full((1, outputs), 10.0**log_noise, dtype=torch.float64)
    features = [torch.cat([z, normal(3, 3, seed=seed + c)]) for c, z in enumerate(given_problem.features)]
    with torch.no_grad():
        covariance = condition(given_problem).covariance(features)
        prior = torch.diag(torch.stack([kernel.outputscale for kernel in given_problem.kernels.kernels]))
    torch.testing.assert_close(covariance, covariance.mT)
    scale = float(prior.max())
    assert torch.linalg.eigvalsh(covariance).min() > -1e-8 * scale
    assert torch.linalg.eigvalsh(prior - covariance).min() > -1e-8 * scale


CPU = torch.device("cpu")
SIZE, GIB = ProblemSize(rows=1000, outputs=2, rank=2, latents=3, features=9), 2**30


@pytest.fixture
def free(monkeypatch):
    """A function that sets how many bytes are free."""

    def to(size):
        for module in (engines, memory):
            monkeypatch.setattr(module, "free_memory", lambda device: size)

    to(1000 * GIB)
    return to


@pytest.mark.parametrize(
    ("engine", "matrices"),
    [
        (Exact(), [(2000, 2000), (3000, 1000)]),
        (Inducing(100), [*[(300, 300)] * 3, (20_000, 100), (12 * 1000, 3 * 2)]),
        # its batch: ten matrices of the points and the rows of all latents
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_memory_is_that_of_the_matrices(engine, matrices):
    assert engine.required_bytes(SIZE) == sum(8 * rows * columns for rows, columns in matrices)


def test_the_engine_follows_rows_features_and_memory(free):
    assert choose_engine(replace(SIZE, rows=1500), CPU).engine == Exact()
    assert choose_engine(replace(SIZE, rows=8000), CPU).engine == Exact()  # rN = 16,000
    assert choose_engine(replace(SIZE, rows=8001), CPU).engine == Inducing(points=1000)
    chosen = choose_engine(replace(SIZE, rows=60_000), CPU)
    assert chosen.engine == Inducing(points=1000)
    assert chosen.reason.startswith("inducing: the exact covariance of 60000 rows needs")
    assert choose_engine(replace(SIZE, rows=1501, features=3), CPU).engine == Inducing()
    assert choose_engine(replace(SIZE, rows=1501, features=4), CPU).engine == Exact()
    assert choose_engine(replace(SIZE, rows=1501, features=3), CPU, inducing=False).engine == Exact()
    assert choose_engine(replace(SIZE, rows=10**6, latents=0), CPU).engine == Exact()
    few = replace(SIZE, features=2)
    free(Exact().required_bytes(few))  # 90 % of it may be planned with
    assert choose_engine(few, CPU).engine == Inducing()
    free(math.ceil(Exact().required_bytes(SIZE) / 0.9))
    assert choose_engine(SIZE, CPU).engine == Exact()
    free(1000)
    with pytest.raises(NotEnoughMemory, match="N=1000 rows"):
        choose_engine(SIZE, CPU)


@pytest.mark.parametrize(("name", "fine", "wrong"), [("points", 1, 0), ("tolerance", 0.0, -1e-9)])
def test_settings_up_to_their_bounds(name, fine, wrong):
    engine = Inducing(**{name: fine})
    assert engine_from_dict(engine.to_dict()) == engine
    with pytest.raises(InvalidInput, match=f"{name} is {wrong!r}"):
        Inducing(**{name: wrong})


@pytest.mark.parametrize("stored", [None, ["exact"], {"name": "gone"}, {"name": "exact", "points": 3}, {"points": 3}])
def test_what_is_no_stored_engine_is_refused(stored):
    with pytest.raises(InvalidInput, match="exact, inducing"):
        engine_from_dict(stored)
