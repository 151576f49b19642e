"""What air does: sought where u has the model's columns, observed where rows have a past, and learned in new wind."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.data.test_wind import flight

from forcegp import AerodynamicForce, fit
from forcegp.data import lagged
from forcegp.errors import InvalidInput
from forcegp.posterior import export_c, load_posterior, observing, save_posterior
from forcegp.posterior.observed_wrench import TRIED, _observed, _with_past, in_air
from forcegp.simulation import QuadrotorConfig, simulate_quadrotor


def test_wind_is_sought_where_inputs_are_those_of_the_model():
    rows = flight([(3.0, -2.0, 0.0)])
    model = rows.model.with_forces(AerodynamicForce())
    settings, seen = in_air(model, rows)
    np.testing.assert_allclose(settings["air"]["wind"], (3.0, -2.0, 0.0), atol=1e-5)
    assert len(seen.model.inputs) == len(model.inputs) + 3


def test_rows_without_a_past_are_left_out_and_refused_where_all_are():
    rows = flight([(0.0, 0.0, 0.0)] * 2, episodes=2, rows=30)
    assert _with_past(rows, 0.105).tolist() == [*range(11, 30), *range(41, 60)]
    with pytest.raises(InvalidInput, match=r"less than 1 s of flight.*give longer pieces"):
        _with_past(rows, 1.0)


def test_each_component_takes_the_time_that_missed_least():
    """Against sums written out: of .02 to 1 s that with the least mean square over the second before."""
    rows, times = flight([(0.0, 0.0, 0.0)] * 2, episodes=2, rows=120), (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
    rng, taken = np.random.default_rng(0), set()
    wrench = rng.standard_normal((240, 6)) + rng.standard_normal((240, 6)).cumsum(0) * [0.0, 0.05, 0.1, 0.3, 0.6, 3.0]
    for start in (0, 120):
        time, own = rows.time[start : start + 120], wrench[start : start + 120]

        def before(values, seconds, time=time):
            weights = [np.exp((time[:k] - time[k]) / seconds) for k in range(1, 120)]
            means = [np.average(values[:k], axis=0, weights=weights[k - 1]) for k in range(1, 120)]
            return np.stack([np.zeros(6), *means])

        means = np.stack([before(own, seconds) for seconds in times])
        best = np.stack([before((own - mean) ** 2, 1.0) for mean in means]).argmin(0)
        taken |= set(best[20:].ravel().tolist())
        expected = np.take_along_axis(means, best[None], axis=0)[0]
        np.testing.assert_allclose(_observed(wrench, rows, TRIED)[start : start + 120], expected, atol=1e-9)
    assert taken == set(range(6))


@pytest.fixture(scope="module")
def posterior():
    train = simulate_quadrotor(QuadrotorConfig(seconds=8.0, seed=1))
    with warnings.catch_warnings(action="ignore"):
        return fit(train.model.with_forces(AerodynamicForce()), acting(train), points=50, restarts=1)


@pytest.fixture(scope="module")
def test():
    return simulate_quadrotor(QuadrotorConfig(seconds=4.5, seed=2, wind=8.0))


def acting(dataset, lag=0.06):
    """With the rotor speeds that act, from half a second on."""
    return replace(dataset, u=lagged(dataset.u, dataset.time, lag)).rows(np.arange(120, len(dataset)))


def test_new_wind_is_observed_from_the_past(posterior, test):
    rows = acting(test)
    seeing, seen = observing(posterior, rows, seconds=0.05)
    assert seen.time[0] - rows.time[0] == pytest.approx(0.05, abs=1 / 240)
    a = np.interp(seen.time, test.time, np.arange(len(test))).round().astype(int)
    a = test.truth["a"][a]
    blind = a - posterior.predict(seen.q, seen.v, seen.u[:, :4], covariance=False).mean.numpy()
    left = a - seeing.predict(seen.q, seen.v, seen.u, covariance=False).mean.numpy()
    assert np.all(np.square(left).mean(0) < 0.05 * np.square(blind).mean(0))
    assert seen.model.held_inputs == tuple(range(4, 13))  # wind, then a wrench
    assert "Q_U" not in seen.truth


def test_an_observer_sees_the_past_only(posterior, test):
    rows = acting(test)
    _, seen = observing(posterior, rows)
    other = rows.a.copy()
    other[200:] += 5.0
    _, changed = observing(posterior, replace(rows, a=other))
    here = 200 - (len(rows) - len(seen))
    np.testing.assert_array_equal(changed.u[: here + 1], seen.u[: here + 1])
    assert np.abs(changed.u[here + 1] - seen.u[here + 1]).max() > 0.0


def test_predicted_motions_keep_the_wind_of_their_start(posterior, test):
    seeing, seen = observing(posterior, acting(test))
    u = seen.u[300:330]
    other = u.copy()
    other[1:, 4:] += 3.0
    first, second = (seeing.rollout(seen.q[300], seen.v[300], given, 1 / 240) for given in (u, other))
    torch.testing.assert_close(first.q, second.q, rtol=0.0, atol=0.0)
    after = np.linalg.norm(first.q[-1, :3].numpy() - seen.q[300 + len(first.q) - 1, :3])
    blind = posterior.rollout(seen.q[300], seen.v[300], u[:, :4], 1 / 240)
    assert after < 0.3 * np.linalg.norm(blind.q[-1, :3].numpy() - seen.q[300 + len(first.q) - 1, :3])


def test_what_cannot_be_observed_is_refused(posterior, test):
    with pytest.raises(InvalidInput, match="looks back"):
        observing(posterior, acting(test), seconds=-1.0)
    calm = test.model.with_forces(AerodynamicForce(observe=0.0))
    with warnings.catch_warnings(action="ignore"):
        fitted = fit(calm, acting(test), points=30, restarts=1)
    assert observing(fitted, test) == (fitted, test)


def test_a_model_with_wind_learns_rows_of_another_flight(posterior, test, tmp_path):
    """Exactly as a posterior that was stored; rows that show no wind are refused."""
    rows = acting(test)
    save_posterior(posterior, tmp_path / "drone")
    more = [each.update(rows.rows(np.arange(300))) for each in (posterior, load_posterior(tmp_path / "drone"))]
    assert more[0].model.inputs == posterior.model.inputs
    assert len(more[0].training) == len(posterior.training) + 275  # those with .1 s before them
    means = [each.predict(rows.q[:5], rows.v[:5], rows.u[:5], covariance=False).mean for each in more]
    torch.testing.assert_close(*means, rtol=1e-9, atol=1e-9)
    with pytest.raises(InvalidInput, match="longer pieces"):
        posterior.update(rows.rows(np.arange(10)))
    with pytest.raises(InvalidInput, match="longer pieces"):
        observing(posterior, rows.rows(np.arange(10)))


def test_a_predictor_takes_what_observers_report(posterior, test, tmp_path):
    """Wind and wrench as inputs, at the rate of a controller; the program of it in C as well."""
    seeing, seen = observing(posterior, acting(test))
    predictor = seeing.predictor(compile=False)
    for k in (0, 500):
        q, v, u = seen.q[k], seen.v[k], seen.u[k]
        expected = seeing.predict(q, v, u, covariance=False).mean
        np.testing.assert_allclose(predictor.mean(q, v, u), expected, rtol=1e-9, atol=1e-9)
    assert export_c(seeing, tmp_path / "c").differences
