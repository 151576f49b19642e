"""`posterior.update`: against conditioning on all rows at once, with the standardization of the fit."""

import dataclasses

import numpy as np
import pytest
import torch
from tests.posterior.arm import arm_data

from forcegp.errors import ContactError, InvalidInput, NotEnoughMemory
from forcegp.fit import fit
from forcegp.forces import ContactFriction, JointForces, JointFriction
from forcegp.inference import OptimizerOptions, likelihood
from forcegp.inference import memory as memory_module
from forcegp.noise import Noise
from forcegp.posterior import load_posterior, save_posterior

QUICK = OptimizerOptions(iterations=8)


def learned(data, first=12, model=None, **how):
    model = model or data.model.with_forces(JointForces())
    return fit(model, data.rows(slice(0, first)), restarts=1, options=QUICK, **how)


def at_once(posterior, data):
    """The posterior of all rows of `data` at the parameters of `posterior`, which was fitted to the first of them."""
    first = posterior.training
    whole = type(first).of(data, torch.device("cpu"))
    whole = dataclasses.replace(whole, reference=first)
    kept = {"hidden_force", "correlated_rows"} & {*posterior.settings}
    settings = {"widening": posterior.widening} | {name: posterior.settings[name] for name in kept}
    return posterior.conditioned(posterior.trained, whole, posterior.hyperparameters, posterior.result, settings)


def test_rows_that_count_as_one_do_so_after_an_update(tmp_path):
    data = arm_data(20, 5)
    few = learned(data)
    settings = {**few.settings, "correlated_rows": 4.0}
    alike = few.conditioned(few.trained, few.training, few.hyperparameters, few.result, settings)
    updated = alike.update(data.rows(slice(12, 20)))
    assert_same(updated, at_once(alike, data), data)
    save_posterior(updated, tmp_path / "run")
    assert_same(load_posterior(tmp_path / "run"), updated, data)


def assert_same(one, other, data, tolerance=1e-8):
    states = data.q, data.v, data.u
    mine, theirs = one.predict(*states), other.predict(*states)
    for name in ("multiplier", "contact_force", "unknown_force", "measurement"):
        for part in ("mean", "covariance"):
            ours, expected = (getattr(getattr(p, name), part) for p in (mine, theirs))
            size = 1.0 + expected.abs().max() if expected.numel() else 1.0
            torch.testing.assert_close(ours, expected, rtol=0.0, atol=float(tolerance * size), msg=f"{name} {part}")


MODELS = {
    "joint forces": lambda model: model.with_forces(JointForces()),
    "no analytical mean, noise of the forces": lambda model: model.with_forces(
        JointForces(), noise=Noise(0.05, 0.02, learn=True)
    ).without_mean(),
    "friction under load and in the joints": lambda model: model.with_forces(
        ContactFriction(load=True), JointFriction()
    ),
    "no unknown force": lambda model: model,
}


@pytest.mark.filterwarnings("ignore::forcegp.errors.NumericalWarning", "ignore::forcegp.errors.DataWarning")
@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS)
def test_updates_are_conditioning_on_all_rows(make):
    data, test = arm_data(20, seed=1), arm_data(5, seed=2)
    posterior = learned(data, model=make(data.model))
    grown, expected = posterior.update(data.rows([12])).update(data.rows(slice(13, 20))), at_once(posterior, data)
    assert_same(grown, expected, test)
    assert grown.negative_log_likelihood == pytest.approx(expected.negative_log_likelihood, rel=1e-9)
    shifts = (each.likelihood.standardization.shift for each in (grown, posterior))
    for mine, theirs in zip(*shifts, strict=True):
        assert torch.equal(mine, theirs)
    assert grown.settings["points"] == len(grown.training.q) == 20
    assert grown.settings["rows_added"] == 8


def test_what_is_kept_of_the_fit_are_its_numbers_by_the_parameters_own_meaning():
    """Against the likelihood itself: W, residual and noise of all rows, features by hand from the first ones."""
    data = arm_data(18, seed=3)
    posterior = learned(data)
    grown = posterior.update(data.rows(slice(12, 18)))
    features, W, residual, noise = grown.likelihood.terms(posterior.hyperparameters)
    raw = np.hstack([data.q, data.v, data.u])
    shift, scale = posterior.likelihood.standardization.shift[0], posterior.likelihood.standardization.scale[0]
    torch.testing.assert_close(features[0], (torch.tensor(raw) - shift) / scale)
    torch.testing.assert_close(noise, posterior.hyperparameters["noise.log_acceleration"].exp().square()[None])
    torch.testing.assert_close(W, data.model.dynamics(*map(torch.tensor, (data.q, data.v, data.u))).H)
    matrices = posterior.kernels.matrices(posterior.hyperparameters, features)
    with torch.no_grad():
        expected = float(likelihood.negative_log_likelihood(W, residual, noise, matrices))
    assert grown.negative_log_likelihood == pytest.approx(expected, rel=1e-9)


def test_everything_else_works_after_an_update(tmp_path):
    data = arm_data(20, seed=13)
    posterior = learned(data, model=data.model.with_forces(JointFriction()))
    grown = posterior.update(data.rows(slice(12, 20)))
    moved, expected = grown.with_contacts([]), at_once(posterior, data)
    assert_same(moved, expected.with_contacts([]), data)
    curves = [each.curve(grown.latent_names[0], [0.1, 0.2]).mean for each in (grown, expected)]
    torch.testing.assert_close(*curves)
    assert bool(torch.isfinite(grown.rollout(data.q[0], data.v[0], np.zeros((3, 3)), 0.001, samples=2).q).all())


# ---------------------------------------------------------------- on disk


@pytest.mark.filterwarnings("ignore::forcegp.errors.NumericalWarning", "ignore::forcegp.errors.DataWarning")
@pytest.mark.parametrize("prior", [JointForces(), ContactFriction(load=True)], ids=["joint forces", "load friction"])
def test_what_comes_back_from_disk_predicts_the_same(tmp_path, prior):
    data = arm_data(20, seed=14)
    grown = learned(data, model=data.model.with_forces(prior)).update(data.rows(slice(12, 20)))
    save_posterior(grown, tmp_path / "run")
    loaded = load_posterior(tmp_path / "run")
    assert_same(loaded, grown, data)
    assert loaded.update(data.rows([11])).settings["rows_added"] == 9
    assert_same(loaded.update(data.rows([11])), grown.update(data.rows([11])), data)
    save_posterior(grown.with_contacts([]), tmp_path / "free")
    assert_same(load_posterior(tmp_path / "free"), grown.with_contacts([]), data)


@pytest.fixture(scope="module")
def posterior():
    return learned(arm_data(12, seed=16))


def test_rows_away_from_the_surface_are_refused(posterior):
    rows = arm_data(3, seed=17)
    away = dataclasses.replace(rows, q=rows.q - [0.0, 0.5, 0.0], truth={})
    with pytest.raises(ContactError, match="no training point touches"):
        posterior.update(away)


def test_more_rows_than_memory_holds_are_refused_before_anything_is_computed(posterior, monkeypatch):
    few = arm_data(60, seed=17)
    again = {name: np.tile(getattr(few, name), (1000, 1)) for name in ("q", "v", "u", "a")}
    many = dataclasses.replace(few, **again, time=0.01 * np.arange(60_000), episode=np.zeros(60_000, int), truth={})
    monkeypatch.setattr(memory_module, "free_memory", lambda device: 2**30)
    with pytest.raises(NotEnoughMemory, match=r"12 \+ 60000 rows .*1\.0 GiB .*fewer rows"):
        posterior.update(many)


def test_a_posterior_that_was_carried_elsewhere_is_updated_before(posterior):
    with pytest.raises(InvalidInput, match="before it is carried there"):
        posterior.with_contacts([]).update(arm_data(3, seed=17))


def test_posteriors_that_are_not_exact_say_what_to_do():
    data = arm_data(20, seed=20)
    posterior = fit(data.model.with_forces(JointForces()), data, restarts=1, options=QUICK, engine="inducing")
    with pytest.raises(InvalidInput, match="engine='exact'"):
        posterior.update(data)


def test_single_updates_do_not_drift():
    data = arm_data(60, seed=1)
    posterior = grown = learned(data)
    for row in range(12, 60):
        grown = grown.update(data.rows([row]))
    assert_same(grown, at_once(posterior, data), arm_data(5, seed=2))
    assert grown.settings["rows_added"] == 48
