"""Mini-batches against the collapsed bound, which has the optimal inducing values in closed form."""

import pytest
import torch
from tests.inference.problems import problem

from forcegp.errors import NumericalError
from forcegp.inference.inducing import InducingPosterior, collapsed_bound
from forcegp.inference.likelihood import Terms
from forcegp.inference.stochastic import _AllLatents, _batch, stochastic_search


@pytest.fixture
def given():
    return problem(count=30, outputs=3, constraints=1, dimension=2)


def inducing(given, points=8) -> InducingPosterior:
    return InducingPosterior.condition(given.kernels, terms_of(given), points=points, tolerance=0.0)


def terms_of(given) -> Terms:
    return Terms(given.features, *given.data)


def test_at_the_optimum_all_rows_give_the_collapsed_bound(given):
    begin = inducing(given)
    parameters = given.kernels.initial_parameters()
    model = _AllLatents(given.kernels, begin)
    W, y, log_noise, features = _batch(terms_of(given), torch.arange(30))
    with torch.no_grad():
        bound = model.divergence() - model.expected(parameters, W, y, features) + log_noise
        collapsed = collapsed_bound(*given.data, given.kernels, parameters, given.features, begin.features)
    assert float(bound) == pytest.approx(float(collapsed), rel=1e-5)


def test_the_search_lowers_the_collapsed_bound(given):
    begin = inducing(given)
    start = given.kernels.initial_parameters()
    found = stochastic_search(
        given.kernels, begin, lambda p: terms_of(given), start, lambda p: torch.zeros(()), steps=60, batch=15, rate=0.05
    )

    def bound(parameters) -> float:
        with torch.no_grad():
            return float(collapsed_bound(*given.data, given.kernels, parameters, given.features, begin.features))

    assert bound(found.parameters) < bound(start) - 1.0
    again = stochastic_search(
        given.kernels, begin, lambda p: terms_of(given), start, lambda p: torch.zeros(()), steps=60, batch=15, rate=0.05
    )
    for name, value in found.parameters.items():
        torch.testing.assert_close(again.parameters[name], value, rtol=0.0, atol=0.0)


def test_a_search_that_runs_away_is_an_error(given):
    broken = Terms(given.features, given.W, given.residual * float("inf"), given.noise)
    with pytest.raises(NumericalError, match="not finite after 0 steps"):
        stochastic_search(
            given.kernels,
            inducing(given),
            lambda p: broken,
            given.kernels.initial_parameters(),
            lambda p: torch.zeros(()),
            steps=2,
            batch=5,
            rate=0.1,
        )
