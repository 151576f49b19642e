"""Candidates on the same rows: scores, standard errors and the sentence about them."""

import dataclasses
import re

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tests.models.arm import arm_data

from forcegp.data import time_blocks
from forcegp.errors import InvalidInput, NotEnoughMemory
from forcegp.evaluation import PriorComparison, PriorScore, compare_priors, evaluate
from forcegp.evaluation.prior_comparison import paired_difference
from forcegp.inference import OptimizerOptions
from forcegp.inference import memory as memory_module
from forcegp.models import Noise, StructuredGP
from forcegp.priors import JointForces, JointFriction, NoForces

QUICK = {"restarts": 1, "options": OptimizerOptions(iterations=20)}
PRIORS = {"anything": JointForces(), "friction": JointFriction(), "nothing": NoForces()}


@pytest.fixture(scope="module")
def train():
    return arm_data(80, seed=0)


@pytest.fixture(scope="module")
def comparison(train):
    return compare_priors(train, PRIORS, points=40, test=arm_data(60, seed=1), **QUICK)


def test_the_prior_that_the_data_were_made_with_is_supported(comparison):
    assert comparison.preferred.name == "friction"
    assert "nothing" not in [score.name for score in comparison.supported]
    assert "friction" in comparison.verdict
    assert [score.name for score in comparison.scores] == list(PRIORS)
    assert [score.latents for score in comparison.scores] == [3, 3, 0]
    assert comparison.scores[0].mae > comparison.scores[1].mae
    assert comparison.scores[2].mae > comparison.scores[0].mae


def test_every_number_is_that_of_the_fitted_model(comparison, train):
    test = arm_data(60, seed=1)
    densities = {}
    for score in comparison.scores:
        posterior = comparison.posteriors[score.name]
        rows = [int(np.flatnonzero((train.q == q).all(1))[0]) for q in posterior.training.q.numpy()]
        first = rows if not densities else first
        assert rows == first
        blocks = time_blocks(train.time[rows], train.episode[rows], comparison.block_seconds)
        assert len(blocks) == comparison.blocks
        found = posterior.leave_out(blocks)
        densities[score.name] = found.log_density.numpy()
        assert score.leave_block_out == pytest.approx(found.total / 40)
        assert score.leave_one_out == pytest.approx(posterior.leave_out().total / 40)
        assert score.nll == pytest.approx(posterior.negative_log_likelihood)
        free = sum(value.numel() for name, value in posterior.parameters.items() if not name.startswith("noise."))
        assert score.parameters == free  # the noise is as the data state
        evaluation = evaluate(posterior, test)
        assert (score.mae, score.nlpd) == pytest.approx((evaluation.mae, evaluation.nlpd))
    sizes = np.array([len(block) for block in blocks], dtype=float)
    for score in comparison.scores:
        wanted = paired_difference(densities[score.name], densities[comparison.best.name], sizes)
        assert (score.difference, score.standard_error) == pytest.approx(wanted)
    assert comparison.best.difference == comparison.best.standard_error == 0.0


def test_the_same_arguments_give_the_same(comparison, train):
    again = compare_priors(train, PRIORS, points=40, test=arm_data(60, seed=1), **QUICK)
    assert again.scores == comparison.scores


def test_many_rows_are_conditioned_on_exactly_with_parameters_from_some(train, monkeypatch):
    for module in ("inference.engines", "models.structured.refinement"):
        monkeypatch.setattr(f"forcegp.{module}.MOST_EXACT_ROWS", 20)
    monkeypatch.setattr("forcegp.models.structured.refinement.LEARNING_ROWS", 15)
    assert StructuredGP(train.system, JointFriction()).fit(train, points=30, **QUICK).engine.name == "inducing"
    found = compare_priors(train, PRIORS, points=30, **QUICK)
    for posterior in found.posteriors.values():
        assert posterior.engine.name == "exact"
        assert (posterior.settings["points"], posterior.settings["learning_points"]) == (30, 15)
    assert found.points == 30
    posterior = found.posteriors["friction"]
    features, W, residual, noise = posterior.likelihood.terms(posterior.parameters)
    with torch.no_grad():  # log p(row | others) = log p(all) - log p(others), with dense covariances
        kernels = torch.stack(list(posterior.kernels.matrices(posterior.parameters, features)))
        covariance = torch.einsum("iac,jbc,cij->iajb", W, W, kernels).reshape(90, 90)
        covariance += torch.diag(noise.expand(30, 3).reshape(-1))
    density = 0.0
    for row in range(30):
        others = [k for k in range(90) if k // 3 != row]
        density += log_density(residual.reshape(-1), covariance)
        density -= log_density(residual.reshape(-1)[others], covariance[others][:, others])
    assert found.scores[1].leave_one_out == pytest.approx(density / 30)


def test_more_rows_than_memory_holds_are_refused_before_the_first_fit(train, monkeypatch):
    monkeypatch.setattr(memory_module, "free_memory", lambda device: 10_000)
    with pytest.raises(NotEnoughMemory, match=r"N=40 rows .*fewer `points`"):
        compare_priors(train, PRIORS, points=40, **QUICK)


def log_density(y, covariance):
    return float(torch.distributions.MultivariateNormal(torch.zeros_like(y), covariance).log_prob(y))


def test_noise_mean_and_stretches_are_as_given(train):
    noise = Noise(0.2, 0.05, learn=True)
    found = compare_priors(train, PRIORS, points=20, noise=noise, mean="zero", block_seconds=0.1, **QUICK)
    assert found.block_seconds == 0.1
    for posterior in found.posteriors.values():
        assert posterior.model.mean == "zero"
        assert "noise.log_force" in posterior.result.parameters
    assert all(score.mae is None for score in found.scores)
    assert found.scores[2].parameters == 6  # nothing but the noise


# ---------------------------------------------------------------- standard errors


@given(st.integers(2, 30), st.integers(0, 1000))
def test_with_stretches_of_one_size_it_is_the_standard_error_of_a_mean(count, seed):
    generator = np.random.default_rng(seed)
    one, other = generator.normal(size=(2, count))
    difference, error = paired_difference(one, other, np.full(count, 4.0))
    assert difference == pytest.approx((one - other).mean() / 4.0)
    assert error == pytest.approx((one - other).std(ddof=1) / np.sqrt(count) / 4.0)


@given(st.integers(0, 1000), st.floats(-5.0, 5.0))
def test_an_advantage_that_every_row_has_is_certain(seed, advantage):
    generator = np.random.default_rng(seed)
    sizes = generator.integers(1, 9, 12).astype(float)
    one, other = generator.normal(size=(2, 12))
    difference, error = paired_difference(one, other, sizes)
    more, same = paired_difference(one + advantage * sizes, other, sizes)
    assert more == pytest.approx(difference + advantage)
    assert same == pytest.approx(error)


def test_the_standard_error_is_the_scatter_of_repetitions():
    generator = np.random.default_rng(0)
    found = []
    for _ in range(2000):
        sizes = generator.integers(1, 9, 20).astype(float)
        gain = 0.3 * sizes + generator.normal(size=20) * np.sqrt(sizes)
        found.append(paired_difference(gain, np.zeros(20), sizes))
    differences, errors = np.array(found).T
    assert differences.mean() == pytest.approx(0.3, abs=0.01)
    assert errors.mean() == pytest.approx(differences.std(), rel=0.08)
    assert (np.abs(differences - 0.3) < 2.0 * errors).mean() == pytest.approx(0.94, abs=0.02)


# ---------------------------------------------------------------- the sentence


def score(name, leave_block_out, best, standard_error, latents=2, parameters=10):
    return PriorScore(
        name=name,
        latents=latents,
        parameters=parameters,
        nll=0.0,
        leave_one_out=0.0,
        leave_block_out=leave_block_out,
        difference=leave_block_out - best,
        standard_error=standard_error,
        converged=True,
    )


def told(*scores):
    return PriorComparison(scores=scores, points=40, blocks=10, block_seconds=2.5)


def test_one_that_is_clearly_best():
    found = told(score("a", 1.0, 3.0, 0.5), score("b", 3.0, 3.0, 0.0, latents=7), score("c", 1.5, 3.0, 0.7))
    assert found.verdict == (
        "The data support b: it predicts left-out stretches of 2.5 s better than c does, by 1.5 nats per row "
        "(standard error 0.7)."
    )
    assert found.preferred is found.best is found.scores[1]


def test_of_equals_the_simplest_is_preferred():
    found = told(score("a", 3.0, 3.0, 0.0, latents=9), score("b", 2.1, 3.0, 0.5), score("c", 1.0, 3.0, 0.5, latents=1))
    assert found.verdict == (
        "a and b cannot be distinguished in left-out stretches of 2.5 s; b is the simplest, with 2 latent functions."
    )
    assert (found.best.name, found.preferred.name) == ("a", "b")
    assert [s.name for s in found.supported] == ["a", "b"]


def test_of_equally_many_functions_that_with_the_fewest_parameters():
    found = told(score("a", 3.0, 3.0, 0.0, parameters=12), score("b", 2.9, 3.0, 0.5), score("c", 2.8, 3.0, 0.5))
    assert "a, b and c cannot be distinguished" in found.verdict
    assert found.verdict.endswith("equally many latent functions; b has the fewest parameters.")
    alike = told(score("a", 2.9, 3.0, 0.5), score("b", 3.0, 3.0, 0.0))
    assert alike.preferred.name == "b"
    assert alike.verdict.endswith("equally many parameters; b did best by a little.")


# ---------------------------------------------------------------- what makes no sense


WRONG = [
    ({"priors": {"friction": JointFriction()}}, "nothing to compare friction; give two priors or more"),
    ({"points": 81}, "points=81` must be an integer from 2 to 80, the rows"),
    ({"block_seconds": 100.0}, "fall into 1 stretches of 100 s, too few"),
    ({"block_seconds": 0.0}, "must be positive and finite"),
    ({"noise": Noise((0.1, 0.2))}, "prior 'anything': Noise has 2 values for 3 joints"),
]


@pytest.mark.parametrize(("changes", "message"), WRONG, ids=[message for _, message in WRONG])
def test_what_makes_no_sense_is_refused(train, changes, message):
    with pytest.raises(InvalidInput, match=re.escape(message)):
        compare_priors(train, **{"priors": PRIORS, **QUICK, **changes})


def test_data_that_do_not_fit_are_refused_before_anything_is_fitted(train):
    def never(*_):
        raise AssertionError("a fit was begun")

    how = {"progress": never, **QUICK}
    with pytest.raises(InvalidInput, match="does not carry its robot"):
        compare_priors(dataclasses.replace(train, system=None), PRIORS, **how)
    other = dataclasses.replace(train, system=None, joint_names=("a", "b", "c"))
    with pytest.raises(InvalidInput, match="the joints of test are a, b, c"):
        compare_priors(train, PRIORS, test=other, **how)
    still = dataclasses.replace(train, v=np.zeros_like(train.v), truth={})
    with pytest.raises(InvalidInput, match="prior 'friction': latent"):
        compare_priors(still, PRIORS, **how)
    apart = dataclasses.replace(train, episode=np.arange(80))
    with pytest.raises(InvalidInput, match="no stretches of time"):
        compare_priors(apart, PRIORS, **how)


def test_progress_names_the_candidate(train):
    seen = []
    compare_priors(train, PRIORS, points=12, progress=lambda *what: seen.append(what), **QUICK)
    assert list(dict.fromkeys(name for name, *_ in seen)) == ["anything", "friction"]  # nothing has nothing to search
    assert all(np.isfinite(value) for *_, value in seen)
    assert torch.is_grad_enabled()
