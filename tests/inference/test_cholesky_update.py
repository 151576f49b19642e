"""Rows appended and left out: against conditioning on all rows at once."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.inference.problems import Problem, normal, problem

from forcegp.errors import NumericalError
from forcegp.inference import ExactPosterior, likelihood
from forcegp.inference.cholesky import factorize
from forcegp.inference.posterior import appended, with_only, with_rows


def rows_of(given_problem: Problem, index) -> Problem:
    tensors = (tensor[index] for tensor in given_problem.data)
    return Problem(*tensors, [z[index] for z in given_problem.features], given_problem.kernels)


def condition(given_problem: Problem) -> ExactPosterior:
    return ExactPosterior.condition(given_problem.kernels, given_problem.terms)


def add(latent: ExactPosterior, more: Problem) -> ExactPosterior:
    return with_rows(latent, more.terms)


def assert_same(first: ExactPosterior, second: ExactPosterior) -> None:
    points = [normal(5, z.shape[1], seed=90 + c) for c, z in enumerate(first.features)]
    with torch.no_grad():
        torch.testing.assert_close(first.mean(points), second.mean(points), rtol=1e-9, atol=1e-10)
        torch.testing.assert_close(first.covariance(points), second.covariance(points), rtol=1e-9, atol=1e-10)
    ours, theirs = (latent.system.factor.log_determinant() for latent in (first, second))
    torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)


SHAPES = {
    "no constraint": {"constraints": 0},
    "three constraints": {"constraints": 3},
    "fewer latents than outputs": {"latents": 2},
    "more latents than outputs": {"latents": 6, "outputs": 3},
    "no latent": {"latents": 0},
}


@pytest.mark.parametrize("panel_bytes", [4 * 2**20, 1], ids=["one panel", "one row per panel"])
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
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
    assert_same(with_only(grown, torch.tensor([0, 2, 6])), condition(rows_of(joined, [0, 2, 6])))


def test_noise_covariances_and_an_empty_beginning():
    whole = problem(constraints=1)
    whole.noise = torch.diag_embed(whole.noise) + 0.02 * whole.W @ whole.W.mT
    assert_same(add(condition(rows_of(whole, slice(0, 0))), whole), condition(whole))


def test_the_old_posterior_stays_as_it_was():
    whole = problem()
    old = condition(rows_of(whole, slice(0, 9)))
    kept = [x.clone() for x in (old.system.factor.lower.tril(), old.system.alpha, old.system.beta, *old.features)]
    add(old, rows_of(whole, slice(9, 12)))
    with_only(old, torch.arange(4))
    for before, now in zip(
        kept, (old.system.factor.lower.tril(), old.system.alpha, old.system.beta, *old.features), strict=True
    ):
        assert torch.equal(before, now)


def test_repeated_rows_without_noise_need_jitter_and_say_so():
    T = torch.ones(3, 3, dtype=torch.float64)
    factor = factorize(lambda: torch.ones(1, 1, dtype=torch.float64))
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
