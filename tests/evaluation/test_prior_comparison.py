"""Candidates on the same rows: scores, standard errors and the sentence about them."""

import dataclasses
import re
import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.posterior.arm import arm_data

from forcegp.data import time_blocks
from forcegp.errors import InvalidInput
from forcegp.evaluation import PriorComparison, PriorScore, compare_priors
from forcegp.evaluation.prior_comparison import paired_difference
from forcegp.forces import JointForces, JointFriction
from forcegp.inference import OptimizerOptions
from forcegp.noise import Noise

QUICK = {"restarts": 1, "options": OptimizerOptions(iterations=20)}
PRIORS = {"anything": JointForces(), "friction": JointFriction(), "nothing": ()}


@pytest.fixture(scope="module")
def train():
    return arm_data(80, seed=0)


@pytest.fixture(scope="module")
def comparison(train):
    return compare_priors(train, PRIORS, points=40, **QUICK)


def test_the_force_that_the_data_were_made_with_is_supported(comparison):
    assert comparison.preferred == "friction"
    assert "nothing" not in comparison.supported
    assert "friction" in comparison.verdict
    assert "friction" in str(comparison)
    assert {name: score.latents for name, score in comparison.scores.items()} == dict(
        zip(PRIORS, (3, 3, 0), strict=True)
    )


def test_every_number_is_that_of_the_fitted_model(comparison, train):
    densities = {}
    for name, score in comparison.scores.items():
        posterior = comparison.posteriors[name]
        rows = [int(np.flatnonzero((train.q == q).all(1))[0]) for q in posterior.training.q.numpy()]
        blocks = time_blocks(train.time[rows], train.episode[rows], comparison.block_seconds)
        assert len(blocks) == comparison.blocks
        found = posterior.leave_out(blocks)
        densities[name] = found.log_density.numpy()
        assert score.density == pytest.approx(found.total / 40)
        free = sum(value.numel() for key, value in posterior.hyperparameters.items() if not key.startswith("noise."))
        assert score.parameters == free  # the noise is as the data state
    sizes = np.array([len(block) for block in blocks], dtype=float)
    best = max(densities, key=lambda name: densities[name].sum())
    for name, score in comparison.scores.items():
        wanted = paired_difference(densities[name], densities[best], sizes)
        assert (score.difference, score.standard_error) == pytest.approx(wanted)


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


def score(density, best, standard_error, latents=2, parameters=10):
    sizes = {"latents": latents, "parameters": parameters, "converged": True}
    return PriorScore(density=density, difference=density - best, standard_error=standard_error, **sizes)


def told(**scores):
    return PriorComparison(scores=scores, points=40, blocks=10, block_seconds=2.5)


def test_one_that_is_clearly_best():
    found = told(a=score(1.0, 3.0, 0.5), b=score(3.0, 3.0, 0.0, latents=7), c=score(1.5, 3.0, 0.7))
    assert found.verdict == (
        "The data support b: it predicts left-out stretches of 2.5 s better than c does, by 1.5 nats per row "
        "(standard error 0.7)."
    )
    assert found.preferred == "b"


def test_of_equals_the_simplest_is_preferred():
    found = told(a=score(3.0, 3.0, 0.0, latents=9), b=score(2.1, 3.0, 0.5), c=score(1.0, 3.0, 0.5, latents=1))
    assert found.verdict == "a and b cannot be distinguished in left-out stretches of 2.5 s; b is the simplest."
    assert (found.supported, found.preferred) == (("a", "b"), "b")
    fewest = told(a=score(3.0, 3.0, 0.0, parameters=12), b=score(2.9, 3.0, 0.5), c=score(2.8, 3.0, 0.5))
    assert fewest.preferred == "b"


# ---------------------------------------------------------------- what makes no sense


WRONG = [
    ({"candidates": {"friction": JointFriction()}}, "nothing to compare friction; give two forces or more"),
    ({"points": 81}, "points=81` must be an integer from 2 to 80, the rows"),
    ({"block_seconds": 100.0}, "fall into 1 stretches of 100 s, too few"),
    ({"block_seconds": 0.0}, "must be positive and finite"),
]


@pytest.mark.parametrize(("changes", "message"), WRONG, ids=[message for _, message in WRONG])
def test_what_makes_no_sense_is_refused(train, changes, message):
    with pytest.raises(InvalidInput, match=re.escape(message)):
        compare_priors(train, **{"candidates": PRIORS, **QUICK, **changes})


def test_data_that_do_not_fit_are_refused(train):
    with pytest.raises(InvalidInput, match="does not carry its robot"):
        compare_priors(dataclasses.replace(train, model=None), PRIORS, **QUICK)
    still = dataclasses.replace(train, v=np.zeros_like(train.v), truth={})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the candidate before it
        with pytest.raises(InvalidInput, match="forces 'friction': latent"):
            compare_priors(still, PRIORS, points=12, **QUICK)
    apart = dataclasses.replace(train, episode=np.arange(80))
    with pytest.raises(InvalidInput, match="no stretches of time"):
        compare_priors(apart, PRIORS, **QUICK)
    wrong = train.model.with_forces(noise=Noise((0.1, 0.2)))
    with pytest.raises(InvalidInput, match="forces 'anything': Noise has 2 values for 3 joints"):
        compare_priors(train, PRIORS, model=wrong, points=12, **QUICK)
