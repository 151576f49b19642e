"""Models fitted once, with stretches of time left out in closed form."""

import dataclasses

import numpy as np
import pytest
from tests.posterior.arm import arm_data

from forcegp import score
from forcegp.data import time_blocks
from forcegp.errors import InvalidInput
from forcegp.forces import JointForces, JointFriction

QUICK = {"split": "leave-out", "points": 40, "restarts": 1, "iterations": 20}


@pytest.fixture(scope="module")
def train():
    return arm_data(80, seed=0)


def models(log):
    each = {"anything": JointForces(), "friction": JointFriction(), "nothing": ()}
    return {name: log.model.with_forces(*(own if isinstance(own, tuple) else (own,))) for name, own in each.items()}


@pytest.fixture(scope="module")
def scores(train):
    return score(models(train), train, **QUICK)


def test_the_force_that_the_data_were_made_with_is_the_best(scores):
    nats = {name: scores.value("nlpd", "all joints", name) for name in scores.models}
    assert min(nats, key=nats.__getitem__) == "friction"
    assert scores.difference("density", "friction", "nothing").outcome == "better"
    assert scores.winners["density"]["model"] == scores.recommended == "friction"


def test_every_number_is_that_of_the_fitted_model(scores, train):
    for name, posterior in scores.posteriors.items():
        rows = [int(np.flatnonzero((train.q == q).all(1))[0]) for q in posterior.training.q.numpy()]
        blocks = time_blocks(train.time[rows], train.episode[rows], scores.about["stretch"])
        found = posterior.leave_out(blocks)
        assert scores.value("nlpd", "all joints", name) == pytest.approx(-found.total / 40)
        own = np.array(scores.runs[name][0]["stretches"]["density"])
        np.testing.assert_allclose(own * 40 / len(blocks), -found.log_density.numpy())


def test_names_of_forces_will_do(train):
    given = train.model.with_forces()
    found = score({"a": "gp:joint-friction", "b": "none"}, train, model=given, **QUICK)
    assert found.recommended == "a"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda log: (["one"], log), "there is nothing to compare"),
        (lambda log: ({"one": log.model}, log), "there is nothing to compare"),
        (lambda log: (models(log), dataclasses.replace(log, model=None)), "does not carry its robot"),
        (lambda log: (models(log), dataclasses.replace(log, episode=np.arange(80))), "no stretches of time"),
        (lambda log: ({"a": "gp:joint", "b": "gp:nothing"}, log), "forces 'b': .*no force"),
    ],
)
def test_what_makes_no_sense_is_refused(train, change, message):
    given, log = change(train)
    with pytest.raises(InvalidInput, match=message):
        score(given, log, **QUICK)
