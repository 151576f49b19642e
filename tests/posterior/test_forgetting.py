"""`posterior.update` with a horizon, against dense algebra of kernels with a factor in time; predictors refreshed."""

import dataclasses
import math
import pickle

import numpy as np
import pytest
import torch
from tests.posterior.arm import Weight, arm_data, arm_model
from tests.posterior.test_update import assert_same, learned

from forcegp.codegen import library
from forcegp.data import Dataset
from forcegp.errors import InvalidInput
from forcegp.forces import JointForces, JointFriction
from forcegp.posterior import load_posterior, programs, save_posterior

FIRST, HORIZON = 14, 20.0


@pytest.fixture(scope="module")
def model():
    return arm_model(contacts=0, baumgarte=None)


@pytest.fixture(scope="module")
def data(model):
    """The rows of the fit, the same states again 5 s later, and others: episodes of rows that count as simultaneous."""
    data = arm_data(FIRST + 10, 1, model)
    again = np.r_[:FIRST, :6, FIRST : FIRST + 10]
    time = np.r_[np.linspace(-2.0, -1.0, FIRST), np.full(6, 5.0), np.full(10, 9.0)]
    names = ("q", "v", "u", "a")
    arrays = {name: getattr(data, name)[again] for name in names}
    episode = np.r_[np.zeros(FIRST, int), np.arange(1, 17)]  # within an episode no two rows are simultaneous
    rows = Dataset(**arrays, time=time, episode=episode, model=model, noise_std=data.noise_std)
    noise = 0.05 * np.random.default_rng(2).standard_normal(rows.a.shape)
    return dataclasses.replace(rows, a=rows.a + np.where(time[:, None] > 0.0, noise, 0.0))


@pytest.fixture(scope="module")
def posterior(data, model):
    return learned(data, FIRST, model.with_forces(JointFriction()))


def in_time(posterior, data, horizon, parts):
    """`posterior` after `parts` of the rows, one after the other."""
    for part in parts:
        posterior = posterior.update(data.rows(part), horizon=horizon)
    return posterior


def dense(posterior, points, data, horizon, test):
    """Mean and covariance (n, nv, nv) at the last time; what `points` leave out is noise of later rows.

    Rows of the fit count as measured with the first of the others.
    """
    kernels, noise = posterior.latent.kernels.dense, np.diag(posterior.noise_std.numpy() ** 2)
    t = np.maximum(data.time, 5.0)

    def terms(rows):
        dynamics = posterior.model.dynamics(*map(torch.tensor, (rows.q, rows.v, rows.u)))
        features = posterior.likelihood.standardization(posterior.model.unknown.features(dynamics))
        return (
            features,
            dynamics.H @ posterior.model.unknown.direction(dynamics),
            dynamics.acceleration_map().offset,
        )

    (z, W, offset), (at, W_test, mean) = terms(data), terms(test)
    n, nv = data.q.shape
    S = torch.block_diag(*[torch.tensor(noise)] * n).reshape(n, nv, n, nv)
    across = torch.zeros(n, nv, len(test), nv).double()
    prior = torch.zeros(len(test), nv, nv).double()
    for c, (kernel, p) in enumerate(zip(kernels, points, strict=True)):
        lower = torch.linalg.cholesky(kernel.cross(p, p))
        phi, phi_test = (torch.linalg.solve_triangular(lower, kernel.cross(p, x), upper=False) for x in (z[c], at[c]))
        factor = torch.tensor(np.exp(-np.abs(t[:, None] - t) / horizon))
        left = kernel.diagonal(z[c]) - phi.square().sum(0)
        together = phi.mT @ phi * factor + torch.diag(left * torch.tensor(data.time > 0.0))
        S += torch.einsum("ia,ij,jb->iajb", W[..., c], together, W[..., c])
        known = phi.mT @ phi_test * torch.tensor(np.exp(-(t[-1] - t) / horizon))[:, None]
        across += torch.einsum("ia,ij,jb->iajb", W[..., c], known, W_test[..., c])
        prior += torch.einsum("ia,i,ib->iab", W_test[..., c], kernel.diagonal(at[c]), W_test[..., c])
    S, across = S.reshape(n * nv, n * nv), across.reshape(n * nv, -1)
    solved = torch.linalg.solve(S, across)
    mean = mean + ((torch.tensor(data.a) - offset).reshape(-1) @ solved).reshape(-1, nv)
    explained = (across.mT @ solved).reshape(len(test), nv, len(test), nv).diagonal(dim1=0, dim2=2).permute(2, 0, 1)
    return mean, posterior.widening**2 * (prior - explained)


@pytest.mark.parametrize("horizon", [HORIZON, 1e5, math.inf])
def test_it_is_the_posterior_of_kernels_with_a_factor_in_time(posterior, data, horizon):
    test = arm_data(5, 7, posterior.model)
    parts = [slice(FIRST, FIRST + 6), slice(FIRST + 6, FIRST + 12), slice(FIRST + 12, FIRST + 16)]
    found = in_time(posterior, data, horizon, parts)
    mean, covariance = dense(posterior, found.latent.features, data, horizon, test)
    predicted = found.predict(test.q, test.v, test.u)
    torch.testing.assert_close(predicted.mean, mean, rtol=0.0, atol=1e-8)
    torch.testing.assert_close(predicted.covariance, covariance, rtol=0.0, atol=1e-8)


def test_each_term_is_forgotten_within_its_own_time(model, data):
    posterior = learned(data, FIRST, model.with_forces(JointFriction(), Weight()))
    later = dataclasses.replace(data.rows([FIRST]), time=np.array([5.0]), noise_std=data.noise_std)
    start = posterior.update(later, horizon=math.inf)
    later = dataclasses.replace(later, time=np.array([50.0]))
    kept, lost = (start.update(later, horizon=how) for how in ({}, {"weight": 1e-3}))
    states = data.q[:3], data.v[:3], data.u[:3]
    prior = [kernel.diagonal(torch.zeros(1, 0).double()) for kernel in posterior.latent.kernels.dense[3:]]
    spread = [p.latent.covariance([z[:1] for z in p.latent.features])[0].diagonal() for p in (start, kept, lost)]
    assert bool((spread[2][3:] > 1.05 * spread[1][3:]).any())
    assert bool((spread[2][3:] <= torch.cat(prior) + 1e-12).all())
    assert bool((spread[1] <= spread[0] + 1e-12).all())
    assert bool(kept.predict(*states).mean.isfinite().all())


def test_what_comes_back_from_disk_forgets_on(posterior, data, tmp_path):
    parts = [slice(FIRST, FIRST + 6)]
    found = in_time(posterior, data, HORIZON, parts)
    assert found.settings["rows_added"] == 6
    save_posterior(found, tmp_path / "run")
    loaded, more = load_posterior(tmp_path / "run"), data.rows(slice(FIRST + 6, None))
    assert_same(loaded.update(more, horizon=HORIZON), found.update(more, horizon=HORIZON), data)


# ---------------------------------------------------------------- predictors


def forbidden(*given, **named):
    raise AssertionError("nothing is traced or compiled")


@pytest.mark.parametrize("compile", [True, False])
def test_a_refreshed_predictor_predicts_what_the_posterior_does(posterior, data, compile, monkeypatch):
    predictor = posterior.predictor(covariance="none", compile=compile)
    states = data.q, data.v, data.u
    roll = [data.q[:9], data.v[:9], np.repeat(data.u[:9, None], 4, axis=1), 0.01]
    before = [predictor.mean(*states), predictor.linearize(*states).da_dv, predictor.rollouts(*roll).v]
    predictor.refreshed(posterior)  # traces, if the programs were found on disk
    later = in_time(posterior, data, HORIZON, [slice(FIRST, None)])
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
    later = in_time(posterior, data, HORIZON, [slice(FIRST, None)])
    predictor = posterior.predictor(covariance="none")
    for other in (None, later.with_contacts([]), learned(data, FIRST, model.with_forces(JointFriction()))):
        with pytest.raises(InvalidInput, match=r"posterior.predictor\(\)"):
            predictor.refreshed(other)
    with pytest.raises(InvalidInput, match="covariance='none'"):
        posterior.predictor().refreshed(later)
    wide = learned(data, FIRST, model.with_forces(JointForces()))
    with pytest.raises(InvalidInput, match="programs hold numbers"):
        wide.predictor(covariance="none").refreshed(wide.update(data.rows(slice(FIRST, None))))


# ---------------------------------------------------------------- errors


@pytest.mark.parametrize("horizon", [0.0, -1.0, math.nan, "long", {"joint-friction": None}])
def test_horizons_that_mean_nothing_are_refused(posterior, data, horizon):
    with pytest.raises(InvalidInput, match=r"seconds above 0"):
        posterior.update(data.rows(slice(FIRST, None)), horizon=horizon)


def test_unknown_terms_and_time_that_goes_back_are_refused(posterior, data):
    rows = data.rows(slice(FIRST, None))
    with pytest.raises(InvalidInput, match="no term 'load' in this model"):
        posterior.update(rows, horizon={"load": 1.0})
    with pytest.raises(InvalidInput, match="order of time"):
        posterior.update(rows, horizon=1.0).update(data.rows(slice(0, FIRST)), horizon=1.0)
