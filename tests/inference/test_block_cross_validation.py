"""Rows that are left out, against conditioning without them: dense Gaussian algebra, and the posterior itself."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal
from tests.inference.dense import dense_covariance
from tests.inference.problems import Problem, problem

from forcegp.errors import InvalidInput
from forcegp.inference import ExactPosterior, LeaveOut, Terms, leave_blocks_out, negative_log_likelihood

BLOCKS = ((3, 1, 7), (0,), (11, 2), (10, 4, 5, 6))  # row 8 and 9 are never left out


def with_force_noise() -> Problem:
    made = problem(constraints=1)
    made.noise = torch.diag_embed(made.noise) + 0.02 * made.W @ made.W.mT
    return made


def with_differing_ranks() -> Problem:
    made = problem(outputs=4, constraints=0)
    made.W[1] = problem(outputs=4, constraints=3).W[0]
    made.W[4] = 0.0
    return made


def without_latents() -> Problem:
    made = problem()
    made.W, made.features = made.W[..., :0], []
    made.kernels = type(made.kernels)([])
    return made


def that_say_nothing() -> Problem:
    made = problem()
    made.W = torch.zeros_like(made.W)
    return made


PROBLEMS = {
    "no constraint": lambda: problem(constraints=0),
    "three constraints": lambda: problem(constraints=3),
    "fewer latents than outputs": lambda: problem(latents=2),
    "more latents than outputs": lambda: problem(latents=6, outputs=3),
    "force noise": with_force_noise,
    "differing ranks": with_differing_ranks,
    "no latents": without_latents,
    "W = 0": that_say_nothing,
}


def condition(given_problem: Problem, rows: list[int] | None = None) -> ExactPosterior:
    rows = list(range(len(given_problem.W))) if rows is None else rows
    noise = given_problem.noise if len(given_problem.noise) == 1 else given_problem.noise[rows]
    features = [z[rows] for z in given_problem.features]
    terms = Terms(features, given_problem.W[rows], given_problem.residual[rows], noise)
    return ExactPosterior.condition(given_problem.kernels, terms)


def left_out(given_problem: Problem, blocks=None) -> LeaveOut:
    return leave_blocks_out(condition(given_problem).system, given_problem.noise, blocks)


def others(given_problem: Problem, block) -> list[int]:
    return [row for row in range(len(given_problem.W)) if row not in block]


def noise_of(given_problem: Problem, row: int) -> torch.Tensor:
    noise = given_problem.noise[0 if len(given_problem.noise) == 1 else row]
    return torch.diag(noise) if noise.dim() == 1 else noise


def dense_log_density(given_problem: Problem, block) -> float:
    """Of the whole block, from the Schur complement of the full covariance."""
    count, outputs, _ = given_problem.W.shape
    with torch.no_grad():
        matrices = given_problem.kernels(given_problem.features)
        S = dense_covariance(given_problem.W, given_problem.noise, matrices).reshape(count, outputs, count, outputs)
    rest = others(given_problem, block)

    def part(one, other):
        return S[one][:, :, other].reshape(len(one) * outputs, len(other) * outputs)

    block = list(block)
    gain = torch.linalg.solve(part(rest, rest), part(rest, block)).mT if rest else torch.zeros(len(block) * outputs, 0)
    mean = gain.double() @ given_problem.residual[rest].reshape(-1)
    covariance = part(block, block) - gain.double() @ part(rest, block)
    density = multivariate_normal(mean.numpy(), (0.5 * (covariance + covariance.mT)).numpy())
    return float(density.logpdf(given_problem.residual[block].reshape(-1).numpy()))


@pytest.mark.parametrize("make", PROBLEMS.values(), ids=PROBLEMS)
@pytest.mark.parametrize("blocks", [None, BLOCKS], ids=["rows", "blocks"])
def test_densities_are_those_of_conditioning_without_the_block(make, blocks):
    given_problem = make()
    found = left_out(given_problem, blocks)
    for block, density in zip(found.blocks, found.log_density, strict=True):
        assert float(density) == pytest.approx(dense_log_density(given_problem, block), rel=1e-7, abs=1e-6)
    assert found.total == pytest.approx(float(found.log_density.sum()))


@pytest.mark.parametrize("make", PROBLEMS.values(), ids=PROBLEMS)
@pytest.mark.parametrize("blocks", [None, BLOCKS], ids=["rows", "blocks"])
def test_rows_are_predicted_as_by_a_posterior_without_their_block(make, blocks):
    given_problem = make()
    found = left_out(given_problem, blocks)
    assert found.rows.tolist() == sorted(row for block in found.blocks for row in block)
    for block in found.blocks:
        rest = condition(given_problem, others(given_problem, block))
        features = [z[list(block)] for z in given_problem.features]
        W = given_problem.W[list(block)]
        with torch.no_grad():
            mean = (W @ rest.mean(features)[..., None])[..., 0] if features else torch.zeros(len(block), 5).double()
            covariance = W @ rest.covariance(features) @ W.mT if features else torch.zeros(len(block), 5, 5).double()
        for i, row in enumerate(block):
            place = found.rows.tolist().index(row)
            residual = given_problem.residual[row] - mean[i]
            of_measurement = covariance[i] + noise_of(given_problem, row)
            scale = float(given_problem.residual.abs().max())
            torch.testing.assert_close(found.residual[place], residual, rtol=1e-6, atol=1e-7 * scale)
            torch.testing.assert_close(found.covariance[place], of_measurement, rtol=1e-6, atol=1e-7 * scale)
            density = multivariate_normal(cov=of_measurement.numpy()).logpdf(residual.numpy())
            assert float(found.per_row[place]) == pytest.approx(density, rel=1e-6, abs=1e-5)


def test_single_rows_have_one_density():
    found = left_out(problem())
    torch.testing.assert_close(found.per_row, found.log_density, rtol=1e-10, atol=1e-10)


def test_noise_that_is_shared_by_all_rows():
    given_problem = problem(count=6, outputs=3)
    given_problem.noise = torch.full((1, 3), 0.04, dtype=torch.float64)
    for block, density in zip(((1, 2), (5,)), left_out(given_problem, ((1, 2), (5,))).log_density, strict=True):
        assert float(density) == pytest.approx(dense_log_density(given_problem, block), rel=1e-8)


@settings(max_examples=15)
@given(st.integers(2, 7), st.integers(1, 4), st.integers(1, 4), st.integers(0, 10_000))
def test_leaving_everything_out_is_the_marginal_likelihood_and_the_chain_rule_holds(count, outputs, latents, seed):
    given_problem = problem(count, outputs, 0, latents, seed=seed)
    W, residual, noise = given_problem.data

    def log_likelihood(rows):
        with torch.no_grad():
            matrices = given_problem.kernels([z[rows] for z in given_problem.features])
            return -float(negative_log_likelihood(W[rows], residual[rows], noise[rows], matrices))

    whole = log_likelihood(list(range(count)))
    assert left_out(given_problem, [list(range(count))]).total == pytest.approx(whole, rel=1e-7, abs=1e-7)
    block = list(range(0, count, 2))
    given_rest = left_out(given_problem, [block]).total
    assert given_rest + log_likelihood(others(given_problem, block)) == pytest.approx(whole, rel=1e-7, abs=1e-6)


def test_what_was_conditioned_on_can_be_used_again():
    given_problem = problem()
    conditioned = condition(given_problem)
    before = conditioned.system.factor.lower.clone()
    one, two = (leave_blocks_out(conditioned.system, given_problem.noise).log_density for _ in range(2))
    assert torch.equal(one, two)
    assert torch.equal(conditioned.system.factor.lower, before)


def test_the_order_of_rows_in_a_block_means_nothing():
    one, two = left_out(problem(), [[3, 7, 1]]), left_out(problem(), [[1, 3, 7]])
    torch.testing.assert_close(one.log_density, two.log_density)
    for name in ("rows", "per_row", "residual", "covariance"):
        torch.testing.assert_close(getattr(one, name), getattr(two, name))


@pytest.mark.parametrize(
    ("blocks", "message"),
    [
        ([], "no block"),
        ([[0], []], "without rows"),
        ([[0, 12]], "row 12 does not exist; there are 12 training rows"),
        ([[-1]], "row -1 does not exist"),
        ([[0, 1], [1]], "row 1 is in the blocks more than once"),
    ],
)
def test_blocks_that_make_no_sense_are_refused(blocks, message):
    with pytest.raises(InvalidInput, match=message):
        left_out(problem(), blocks)
