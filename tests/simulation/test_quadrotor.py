"""`quadrotor`: rows obey Newton and Euler, and its air forces are learned in wind that is new."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from forcegp import AerodynamicForce, fit
from forcegp.data import lagged
from forcegp.errors import InvalidInput
from forcegp.posterior import export_c, load_posterior, observing, save_posterior
from forcegp.simulation import QuadrotorConfig, moving_bases, simulate_quadrotor


@pytest.fixture(scope="module")
def train():
    return simulate_quadrotor(QuadrotorConfig(seconds=12.0, seed=1))


@pytest.fixture(scope="module")
def test():
    return simulate_quadrotor(QuadrotorConfig(seconds=6.0, seed=2, wind=8.0))


def acting(dataset, lag=0.06):
    """With the rotor speeds that act, from half a second on."""
    late = lagged(dataset.u, dataset.time, lag)
    return replace(dataset, u=late).rows(np.arange(120, len(dataset)))


@pytest.fixture(scope="module")
def posterior(train):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return fit(train.model.with_forces(AerodynamicForce()), acting(train), points=50, restarts=1)


PLACES = np.array([(0.13, -0.13, 0.02), (-0.13, 0.13, 0.02), (0.13, 0.13, 0.02), (-0.13, -0.13, 0.02)])


def pushed(robot, height, R, V, speeds, air):
    """Accelerations in the axes of the body: Mahony, Kumar & Corke 2012; drag of rotors, thrust near the ground."""
    link, flow, w = robot.link("body"), V[:3] - R.T @ air, speeds.mean()
    lost = 1.0 - 0.9 * flow[2] / (0.127 * w) + 2.0 * (flow[0] ** 2 + flow[1] ** 2) / (0.127 * w) ** 2
    thrust = 1.1e-5 * speeds**2 * lost / (1.0 - 1.5 * (0.127 / (4.0 * max(height, 0.1905))) ** 2)
    drag = -np.array([0.022, 0.034, 0.06]) * np.linalg.norm(flow) * flow
    force = drag - np.array([9e-5, 11e-5, 4e-5]) * speeds.sum() * flow + [0.0, 0.0, thrust.sum()]
    moment = np.cross([0.01, -0.006, 0.02], drag) + 0.006 * np.array([-flow[1], flow[0], 0.0])
    for place, each, spin in zip(PLACES, thrust, (0.016, 0.016, -0.016, -0.016), strict=True):
        moment = moment + np.cross(place, [0.0, 0.0, each]) + [0.0, 0.0, spin * each]
    turned = np.linalg.solve(link.inertia, moment - np.cross(V[3:], link.inertia @ V[3:]))
    return np.concatenate([force / link.mass - 9.81 * R[2] - np.cross(V[3:], V[:3]), turned])


@pytest.mark.parametrize("wind", [0.0, 7.0])
def test_it_flies_by_newton_euler_and_the_published_air(wind, monkeypatch):
    """In steady wind, behind rotors of first order; from row to row by small steps."""
    monkeypatch.setattr(moving_bases, "GUST", 0.0)
    lag, dt = 0.05, 1.0 / 240.0
    data = simulate_quadrotor(QuadrotorConfig(seconds=2.0, seed=3, wind=wind, noise=0.0, lag=lag, episodes=1))
    air, robot, speeds = np.array(data.metadata["wind"][0]), data.model.robot, np.array(data.u[0])
    assert np.linalg.norm(air) == pytest.approx(wind)
    for k in range(len(data) - 1):
        x, V, R = data.q[k, :3], data.v[k], Rotation.from_quat(data.q[k, 3:]).as_matrix()
        if k > 300:  # the rotors at the first row are not known
            np.testing.assert_allclose(data.truth["a"][k], pushed(robot, x[2], R, V, speeds, air), rtol=0, atol=1e-6)
        for part in np.full(40, dt / 40) if k in (301, 400) else ():
            now = data.u[k] + (speeds - data.u[k]) * np.exp(-0.5 * part / lag)
            half = V + 0.5 * part * pushed(robot, x[2], R, V, now, air)
            middle = R @ Rotation.from_rotvec(0.5 * part * V[3:]).as_matrix()
            x, V = x + part * middle @ half[:3], V + part * pushed(robot, x[2], middle, half, now, air)
            R = R @ Rotation.from_rotvec(part * half[3:]).as_matrix()
            speeds = data.u[k] + (speeds - data.u[k]) * np.exp(-part / lag)
        if k in (301, 400):
            np.testing.assert_allclose(np.r_[x, V], np.r_[data.q[k + 1, :3], data.v[k + 1]], rtol=0, atol=2e-5)
            np.testing.assert_allclose(R, Rotation.from_quat(data.q[k + 1, 3:]).as_matrix(), rtol=0, atol=1e-5)
        else:
            speeds = data.u[k] + (speeds - data.u[k]) * np.exp(-dt / lag)


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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fitted = fit(calm, acting(test), points=30, restarts=1)
    assert observing(fitted, test) == (fitted, test)


def test_a_model_with_wind_learns_rows_of_another_flight(posterior, test, tmp_path):
    """Exactly as a posterior that was stored; rows that show no wind are refused."""
    rows = acting(test)
    save_posterior(posterior, tmp_path / "drone")
    loaded = load_posterior(tmp_path / "drone")
    more = [each.update(rows.rows(np.arange(300))) for each in (posterior, loaded)]
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
