"""Predictors that take over what `posterior.update` learned."""

import pickle

import numpy as np
import pytest
import torch
from tests.posterior.arm import arm_data, arm_model
from tests.posterior.test_update import learned

from forcegp.codegen import library
from forcegp.errors import InvalidInput
from forcegp.forces import JointForces, JointFriction
from forcegp.posterior import programs

FIRST = 14


@pytest.fixture(scope="module")
def model():
    return arm_model(contacts=0, baumgarte=None)


@pytest.fixture(scope="module")
def data(model):
    return arm_data(FIRST + 16, 1, model)


@pytest.fixture(scope="module")
def posterior(data, model):
    return learned(data, FIRST, model.with_forces(JointFriction()))


def forbidden(*given, **named):
    raise AssertionError("nothing is traced or compiled")


@pytest.mark.parametrize("compile", [True, False])
def test_a_refreshed_predictor_predicts_what_the_posterior_does(posterior, data, compile, monkeypatch):
    predictor = posterior.predictor(covariance="none", compile=compile)
    states = data.q, data.v, data.u
    roll = [data.q[:9], data.v[:9], np.repeat(data.u[:9, None], 4, axis=1), 0.01]
    before = [predictor.mean(*states), predictor.linearize(*states).da_dv, predictor.rollouts(*roll).v]
    predictor.refreshed(posterior)  # traces, if the programs were found on disk
    later = posterior.update(data.rows(slice(FIRST, None)))
    with monkeypatch.context() as patch:
        for name in ("trace", "load_library"):
            patch.setattr(programs, name, forbidden)
        patch.setattr(library, "load_library", forbidden)
        found = predictor.refreshed(later).refreshed(later)
        after = [found.mean(*states), found.linearize(*states).da_dv, found.rollouts(*roll).v]
    for one, other in zip(before, [predictor.mean(*states), predictor.linearize(*states).da_dv], strict=False):
        assert torch.equal(one, other)
    made = later.predictor(covariance="none", compile=compile)
    expected = [made.mean(*states), made.linearize(*states).da_dv, made.rollouts(*roll).v]
    for one, other, old in zip(after, expected, before, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)
        assert not torch.allclose(one, old)
    torch.testing.assert_close(after[0], later.predict(*states).mean, rtol=1e-8, atol=1e-8)
    assert torch.equal(pickle.loads(pickle.dumps(found)).mean(*states), after[0])
    drawn = [p.rollouts(*roll, functions=2).v for p in (found, made)]
    torch.testing.assert_close(*drawn, rtol=1e-9, atol=1e-9)


def test_predictors_that_cannot_be_refreshed_say_what_to_do(posterior, data, model):
    later = posterior.update(data.rows(slice(FIRST, None)))
    predictor = posterior.predictor(covariance="none")
    for other in (None, later.with_contacts([]), learned(data, FIRST, model.with_forces(JointFriction()))):
        with pytest.raises(InvalidInput, match=r"posterior.predictor\(\)"):
            predictor.refreshed(other)
    with pytest.raises(InvalidInput, match="covariance='none'"):
        posterior.predictor().refreshed(later)
    wide = learned(data, FIRST, model.with_forces(JointForces()))
    with pytest.raises(InvalidInput, match="programs hold numbers"):
        wide.predictor(covariance="none").refreshed(wide.update(data.rows(slice(FIRST, None))))
