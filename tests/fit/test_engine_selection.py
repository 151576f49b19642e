"""Engines behind `fit`: choice, hyper-parameters from some of the rows, the posterior from all."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.posterior.arm import arm_data

from forcegp import JointForces, JointFriction, load_posterior, save_posterior
from forcegp import fit as fit_model
from forcegp.errors import DataWarning, FileFormatError, InvalidInput, NotEnoughMemory, NumericalWarning
from forcegp.inference import Exact, Inducing, OptimizerOptions
from forcegp.inference import memory as memory_module
from forcegp.posterior.rollout import accelerations

QUICK = OptimizerOptions(iterations=5)


@pytest.fixture(scope="module")
def data():
    return arm_data(60, seed=1)


@pytest.fixture(scope="module")
def states():
    test = arm_data(8, seed=2)
    return test.q, test.v, test.u


def fit(data, engine="auto", prior=None, **how):
    model = data.model.with_forces(JointForces() if prior is None else prior)
    return fit_model(model, data, engine=engine, restarts=1, **{"options": QUICK, **how})


def test_enough_inducing_points_predict_what_the_exact_engine_does(data, states):
    engine = Inducing(points=60, tolerance=0.0)
    expected, given = fit(data, "exact").predict(*states), fit(data, engine).predict(*states)
    torch.testing.assert_close(given.mean, expected.mean, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(given.covariance, expected.covariance, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(given.unknown_force.mean, expected.unknown_force.mean, rtol=1e-6, atol=1e-6)


def test_parameters_come_from_some_rows_and_the_posterior_from_all(data, states):
    some, first = fit(data, learning_points=30, points=60), fit(data, points=30)
    for name, value in first.hyperparameters.items():
        torch.testing.assert_close(some.hyperparameters[name], value)
    assert (len(some.training.q), len(some.training.reference.q)) == (60, 30)
    assert some.settings["points"] == 60
    assert some.settings["learning_points"] == 30
    by_hand = first.update(data.rows([i for i in range(60) if i not in rows_of(first, data)]))
    torch.testing.assert_close(some.predict(*states).mean, by_hand.predict(*states).mean, rtol=1e-7, atol=1e-8)


def rows_of(posterior, data) -> set[int]:
    q = posterior.training.q.numpy()
    return {int(np.flatnonzero((data.q == row).all(1))[0]) for row in q}


def test_the_engine_is_chosen_and_said(data):
    assert fit(data).settings["engine_reason"].startswith("exact: 60 rows need")
    assert fit(data, "inducing").settings["engine_reason"] == "inducing: as asked for"


def test_few_features_take_inducing_points(data, monkeypatch):
    monkeypatch.setattr("forcegp.inference.engines.MOST_EXACT_ROWS", 50)
    posterior = fit(data, prior=JointFriction(), learning_points=60)
    assert posterior.engine == Inducing()
    assert posterior.latent.left_out <= 0.02
    there = {"start": posterior.hyperparameters, "options": OptimizerOptions(iterations=0)}
    exact, test = fit(data, "exact", prior=JointFriction(), **there), arm_data(8, seed=2)
    expected, given = (p.predict(test.q, test.v, test.u).mean for p in (exact, posterior))
    torch.testing.assert_close(given, expected, rtol=0.0, atol=2e-2)
    with pytest.raises(InvalidInput, match="the likelihood of all rows needs the factorised covariance"):
        _ = posterior.negative_log_likelihood


def test_stored_and_loaded_it_predicts_the_same(data, states, tmp_path):
    engine = Inducing(points=60)
    posterior = fit(data, engine, learning_points=30)
    save_posterior(posterior, tmp_path / "model")
    loaded = load_posterior(tmp_path / "model")
    assert loaded.engine == engine
    torch.testing.assert_close(loaded.predict(*states).mean, posterior.predict(*states).mean, rtol=1e-6, atol=1e-6)


def test_too_little_memory_is_said_before_anything_is_allocated(data, monkeypatch):
    # 460,800 bytes are needed, and nine tenths usable
    monkeypatch.setattr(memory_module, "free_memory", lambda device: 511_000)
    with pytest.raises(NotEnoughMemory, match=r"N=60 rows.* 0 MiB .*learning_points"):
        fit(data)


def test_an_engine_that_does_not_fit_names_the_others(data, monkeypatch):
    posterior = fit(data, points=30)
    monkeypatch.setattr(memory_module, "free_memory", lambda device: 10_000)
    with pytest.raises(NotEnoughMemory, match="use engine='inducing'"):
        Exact().condition(posterior.kernels, posterior.likelihood.terms(posterior.hyperparameters))


@pytest.mark.parametrize("given", ["fast", "Exact"])
def test_unknown_engines(data, given):
    with pytest.raises(InvalidInput, match=f"no engine '{given}'"):
        fit(data, given)


def test_learning_points_are_checked(data):
    with pytest.raises(InvalidInput, match="learning_points is 1"):
        fit(data, learning_points=1)


def test_functions_are_drawn_and_curves_read_from_inducing_points(data, states):
    q, v, u = (torch.tensor(x) for x in states)
    posterior = fit(data, Inducing(), prior=JointFriction())
    sampled = accelerations(posterior, posterior.model, 3)(*(x.repeat(3, 1) for x in (q, v, u)))
    assert sampled.shape == (24, 3)
    assert bool(torch.isfinite(sampled).all())
    assert bool((posterior.curve(posterior.latent_names[0], points=5).std > 0).all())


@pytest.mark.parametrize("engine", ["auto", "exact", "inducing"])
def test_without_unknown_forces_every_engine_is_the_exact_one(data, states, engine, monkeypatch):
    monkeypatch.setattr("forcegp.inference.engines.MOST_EXACT_ROWS", 10)
    posterior = fit(data, engine, prior=())
    assert posterior.engine == Exact()
    assert posterior.settings["engine_reason"] == "exact: there is no unknown force to learn"
    torch.testing.assert_close(posterior.predict(*states).mean, fit(data, prior=()).predict(*states).mean)


def test_too_few_inducing_points_are_said(data):
    with pytest.warns(NumericalWarning, match=r"15 inducing points leave out \S+"):
        posterior = fit(data, Inducing(points=5))
    assert posterior.latent.left_out > 0.02


def test_far_rows_beyond_the_learning_rows_are_said(data):
    lifted = replace(data, q=np.where(np.arange(60)[:, None] < 50, data.q + 0.3, data.q))
    near = lifted.rows(np.arange(59, -1, -1))  # the ten near ones first
    with pytest.warns(DataWarning, match="half of the training points lie more than"):
        fit(near, "exact", learning_points=30)


@pytest.mark.parametrize("stored", [["inducing"], "inducing", {"name": "inducing", "points": "5"}, {"name": "gone"}])
def test_a_damaged_engine_is_refused(data, stored, tmp_path):
    save_posterior(fit(data), tmp_path / "model")
    file = tmp_path / "model" / "model.json"
    document = json.loads(file.read_text())
    document["engine"] = stored
    file.write_text(json.dumps(document))
    with pytest.raises(FileFormatError):
        load_posterior(tmp_path / "model")
