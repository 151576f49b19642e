import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.inference.problems import SHAPES, Problem, condition, normal, problem

from forcegp.errors import NumericalError, NumericalWarning
from forcegp.inference import ExactPosterior, likelihood
from forcegp.inference.likelihood import factorize
from forcegp.inference.posterior import appended, with_rows


@pytest.fixture(params=["LAPACK", "torch"])
def route(request, monkeypatch):
    """The way of the CPU, and the way of all other devices."""
    if request.param == "torch":
        monkeypatch.setattr(likelihood, "_is_for_lapack", lambda matrix: False)


def positive_definite(size: int, seed: int = 0) -> torch.Tensor:
    factor = normal(size, size, seed=seed)
    return factor @ factor.mT + 0.1 * torch.eye(size, dtype=torch.float64)


@pytest.mark.usefixtures("route")
@pytest.mark.parametrize("size", [0, 1, 2, 7, 150])
def test_everything_a_factor_does_with_the_lower_triangle(size):
    matrix, right = positive_definite(size), normal(size, 3, seed=1)
    kept = right.clone()
    factor = factorize(lambda: matrix.masked_fill(torch.ones(size, size).triu(1).bool(), math.nan))
    assert factor.jitter == 0.0
    torch.testing.assert_close(factor.lower.tril(), torch.linalg.cholesky(matrix))
    torch.testing.assert_close(factor.log_determinant(), torch.logdet(matrix) if size else torch.tensor(0.0).double())
    torch.testing.assert_close(factor.solve(right), torch.linalg.solve(matrix, right))
    torch.testing.assert_close(factor.solve_lower(right), torch.linalg.solve(torch.linalg.cholesky(matrix), right))
    assert torch.equal(right, kept)
    inverse = torch.linalg.inv(torch.linalg.cholesky(matrix))
    torch.testing.assert_close(factor.into_inverse_factor().tril(), inverse, rtol=1e-9, atol=1e-9)


def test_factor_and_inverse_live_in_the_memory_of_the_matrix():
    """Two copies of 288 MB less at 6000 x 6000."""
    matrix = positive_definite(20)
    address, factor = matrix.data_ptr(), factorize(lambda: matrix)
    assert (factor.lower.data_ptr(), factor.into_inverse_factor().data_ptr()) == (address, address)


@pytest.mark.usefixtures("route")
@pytest.mark.parametrize("relative", [1e-12, 1e-10, 1e-8])
def test_the_smallest_sufficient_jitter_is_added_and_reported(relative):
    """A matrix whose smallest eigenvalue is -relative / 3 of its mean diagonal."""
    basis = torch.linalg.qr(normal(5, 5)).Q
    matrix = (basis * torch.tensor([1.0, 1.0, 1.0, 2.0, -relative / 3.0], dtype=torch.float64)) @ basis.mT
    matrix = 0.5 * (matrix + matrix.mT)
    with pytest.warns(NumericalWarning, match=r"5 x 5 covariance positive definite; larger noise"):
        factor = factorize(matrix.clone)
    assert factor.jitter == pytest.approx(relative * float(matrix.diagonal().mean()))
    shifted, lower = matrix + factor.jitter * torch.eye(5, dtype=torch.float64), factor.lower.tril()
    torch.testing.assert_close(lower @ lower.mT, shifted, rtol=0.0, atol=1e-14)


@pytest.mark.usefixtures("route")
@pytest.mark.parametrize("smallest", [-1.0, -1e-6])
def test_an_indefinite_matrix_is_refused(smallest):
    matrix = torch.diag(torch.tensor([1.0, smallest, 1.0], dtype=torch.float64))
    with pytest.raises(NumericalError, match=r"not positive definite .*noise"):
        factorize(matrix.clone)


@pytest.mark.usefixtures("route")
@pytest.mark.parametrize(("where", "value"), [((0, 0), math.nan), ((2, 1), math.inf)], ids=str)
def test_a_matrix_that_is_not_finite_is_refused(where, value):
    matrix = positive_definite(4)
    matrix[where] = value
    with pytest.raises(NumericalError, match="covariance matrix"):
        factorize(matrix.clone)


def rows_of(given_problem: Problem, index) -> Problem:
    tensors = (tensor[index] for tensor in given_problem.data)
    return Problem(*tensors, [z[index] for z in given_problem.features], given_problem.kernels)


def add(latent: ExactPosterior, more: Problem) -> ExactPosterior:
    return with_rows(latent, more.terms)


def assert_same(first: ExactPosterior, second: ExactPosterior) -> None:
    points = [normal(5, z.shape[1], seed=90 + c) for c, z in enumerate(first.features)]
    with torch.no_grad():
        torch.testing.assert_close(first.mean(points), second.mean(points), rtol=1e-9, atol=1e-10)
        torch.testing.assert_close(first.covariance(points), second.covariance(points), rtol=1e-9, atol=1e-10)
    ours, theirs = (latent.system.factor.log_determinant() for latent in (first, second))
    torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("panel_bytes", [4 * 2**20, 1], ids=["one panel", "one row per panel"])
@pytest.mark.parametrize("shape", [*SHAPES.values(), {"latents": 0}], ids=[*SHAPES, "no latent"])
def test_appending_is_conditioning_on_all_rows(shape, panel_bytes, monkeypatch):
    monkeypatch.setattr(likelihood, "PANEL_BYTES", panel_bytes)
    whole = problem(**shape)
    grown = condition(rows_of(whole, slice(0, 7)))
    for part in (slice(7, 8), slice(8, 12)):
        grown = add(grown, rows_of(whole, part))
    if shape.get("latents") == 0:
        expected = condition(whole).system.deflation.remainder  # of all rows at once, so rounded otherwise
        torch.testing.assert_close(grown.system.deflation.remainder, expected, rtol=1e-13, atol=1e-13)
    else:
        assert_same(grown, condition(whole))


@pytest.mark.parametrize("order", [[0, 1], [1, 0]], ids=["rank grows", "rank falls"])
def test_old_and_new_rows_of_differing_rank(order):
    parts = [problem(count=4, constraints=3, seed=1), problem(count=5, constraints=0, seed=2)]
    first, second = (parts[k] for k in order)
    second.kernels = first.kernels
    joined = Problem(
        *(torch.cat(pair) for pair in zip(first.data, second.data, strict=True)),
        [torch.cat(pair) for pair in zip(first.features, second.features, strict=True)],
        first.kernels,
    )
    grown = add(condition(first), second)
    assert grown.system.deflation.rank == 5
    assert_same(grown, condition(joined))


def test_noise_covariances_and_an_empty_beginning():
    whole = problem(constraints=1)
    whole.noise = torch.diag_embed(whole.noise) + 0.02 * whole.W @ whole.W.mT
    assert_same(add(condition(rows_of(whole, slice(0, 0))), whole), condition(whole))


def test_the_old_posterior_stays_as_it_was():
    whole = problem()
    old = condition(rows_of(whole, slice(0, 9)))
    kept = [x.clone() for x in (old.system.factor.lower.tril(), old.system.alpha, old.system.beta, *old.features)]
    add(old, rows_of(whole, slice(9, 12)))
    for before, now in zip(
        kept, (old.system.factor.lower.tril(), old.system.alpha, old.system.beta, *old.features), strict=True
    ):
        assert torch.equal(before, now)


def test_repeated_rows_without_noise_need_jitter_and_say_so():
    T, factor = torch.ones(3, 3, dtype=torch.float64), factorize(lambda: torch.ones(1, 1, dtype=torch.float64))
    with pytest.raises(NumericalError, match="not positive definite"):
        appended(factor, T[1:, :1], T[1:, 1:] - 0.5)


def test_new_rows_that_are_not_finite_are_refused():
    whole = problem(count=4)
    more = rows_of(whole, slice(2, 4))
    more.residual[1, 0] = torch.nan
    with pytest.raises(NumericalError, match="row 1"):
        add(condition(rows_of(whole, slice(0, 2))), more)


# ---------------------------------------------------------------- properties


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), cut=st.integers(1, 7), log_noise=st.floats(-6.0, 1.0), outputs=st.integers(1, 4))
def test_more_rows_never_widen_and_their_order_does_not_matter(seed, cut, log_noise, outputs):
    whole = problem(count=8, outputs=outputs, constraints=0, seed=seed)
    whole.noise = torch.full((8, outputs), 10.0**log_noise, dtype=torch.float64)
    halves = [rows_of(whole, slice(0, cut)), rows_of(whole, slice(cut, 8))]
    points = [normal(4, 3, seed=seed + c) for c in range(outputs)]
    forth, back = add(condition(halves[0]), halves[1]), add(condition(halves[1]), halves[0])
    with torch.no_grad():
        torch.testing.assert_close(forth.mean(points), back.mean(points), rtol=1e-6, atol=1e-7)
        torch.testing.assert_close(forth.covariance(points), back.covariance(points), rtol=1e-6, atol=1e-7)
        narrower = condition(halves[0]).covariance(points) - forth.covariance(points)
    assert torch.linalg.eigvalsh(narrower).min() > -1e-8
