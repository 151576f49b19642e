"""The weighted search against scipy's, its weights against the definition, and correlation times against theory."""

import numpy as np
import pytest
from scipy.optimize import least_squares, lsq_linear

from forcegp.evidence.least_squares import Chained, Regressor, correlation_time, step_within, weighted_least_squares

TRUTH = np.array([1.0, -0.5, 0.3])


def problem(rows=200, seed=0):
    """Two columns of different noise: y = [exp(x0 t) + x1, x2 t + x1 t^2]."""
    generator = np.random.default_rng(seed)
    t = generator.uniform(0.0, 1.0, rows)

    def model(x):
        return np.stack([np.exp(x[0] * t) + x[1], x[2] * t + x[1] * t**2], axis=1)

    y = model(TRUTH) + generator.normal(size=(rows, 2)) * [0.01, 0.5]

    def residual(x):
        zero = np.zeros_like(t)
        return y - model(x), -np.array([[t * np.exp(x[0] * t), zero + 1.0, zero], [zero, t**2, t]]).transpose(2, 0, 1)

    return residual


def no_prior(x):
    return np.zeros(0), np.zeros((0, len(x)))


FREE = (np.full(3, -np.inf), np.full(3, np.inf))


@pytest.mark.parametrize("bounds", [FREE, (np.array([-9.0, -0.49, 0.0]), np.array([9.0, 9.0, 9.0]))])
def test_the_minimum_is_that_of_scipy_at_the_same_weights(bounds):
    residual = problem()
    fit = weighted_least_squares(residual, no_prior, np.ones(3), bounds)
    assert fit.settled
    theirs = least_squares(
        lambda x: (residual(x)[0] / fit.noise).ravel(), np.clip(TRUTH, *bounds) + 1e-3, bounds=bounds, xtol=1e-12
    )
    np.testing.assert_allclose((fit.x - theirs.x) / np.sqrt(np.diag(np.linalg.inv(fit.information))), 0.0, atol=0.05)
    np.testing.assert_allclose(fit.noise, np.sqrt((fit.residual**2).mean(0)), rtol=0.05)


@pytest.mark.parametrize("seed", range(6))
def test_steps_within_bounds_are_nearly_those_of_lsq_linear(seed):
    """Inside the bounds the slope is zero, and a search of linear residuals by these steps ends at its minimum."""
    generator, noise = np.random.default_rng(seed), np.array([1e-3, 4e-3])
    A, y, low = generator.normal(size=(20, 2, 5)), generator.normal(size=(20, 2)), -generator.uniform(0.0, 0.2, 5)
    bounds = low * [1.0, 1.0, 0.0, 1.0, 1.0], low + 0.2
    J, target = (A / noise[:, None]).reshape(-1, 5), (y / noise).ravel()
    best, step = lsq_linear(J, target, bounds, tol=1e-12), step_within(-J.T @ target, J.T @ J, *bounds)
    slope, inside = J.T @ (J @ step - target), (step > bounds[0]) & (step < bounds[1])
    np.testing.assert_allclose(slope[inside], 0.0, atol=1e-9 * abs(J.T @ target).max())
    assert ((bounds[0] <= step) & (step <= bounds[1])).all()
    lowered = 0.5 * (np.square(target).sum() - np.square(J @ step - target).sum())
    assert lowered > 0.9 * (0.5 * np.square(target).sum() - best.cost)
    fit = weighted_least_squares(lambda x: (A @ x - y, A), no_prior, np.zeros(5), bounds, known=noise)
    np.testing.assert_allclose(fit.x, best.x, atol=1e-6)
    assert (fit.settled, fit.evaluations) == (True, pytest.approx(3, abs=1))
    assert fit.expected == pytest.approx(lowered, rel=1e-3)


def test_the_noise_of_every_column_is_found_and_decides_the_weights():
    fit = weighted_least_squares(problem(2000), no_prior, np.zeros(3), FREE)
    np.testing.assert_allclose(fit.noise, [0.01, 0.5], rtol=0.1)
    assert (abs(fit.x - TRUTH) < 4.0 * np.sqrt(np.diag(np.linalg.inv(fit.information)))).all()


@pytest.mark.parametrize("bodies", [0, 2])
def test_normal_equations_in_parts_are_those_of_the_whole_jacobian(bodies):
    generator, noise = np.random.default_rng(1), np.array([0.1, 2.0, 5.0])
    inner, others = generator.normal(size=(10 * bodies, 7 * bodies)), generator.normal(size=(50, 3, 4))
    others[:, 0, 1:] = 0.0  # numbers of one joint do not act on others
    jacobian = Chained(Regressor(generator.normal(size=(50, 3, 10 * bodies))), inner, others)
    white = generator.normal(size=(50, 3))
    gradient, curvature = jacobian.normal_equations(white, noise)
    whole = (np.asarray(jacobian) / noise[:, None]).reshape(150, -1)
    np.testing.assert_allclose(gradient, whole.T @ white.ravel(), rtol=1e-10)
    np.testing.assert_allclose(curvature, whole.T @ whole, rtol=1e-10, atol=1e-10)


def test_the_prior_decides_what_the_data_do_not():
    def blind(x):
        r, jacobian = problem()(np.append(x[:2], TRUTH[2]))
        return r, np.concatenate([jacobian[..., :2], np.zeros((*r.shape, 1))], axis=-1)

    def prior(x):
        return np.array([0.1 * (x[2] - 7.0)]), np.array([[0.0, 0.0, 0.1]])

    assert weighted_least_squares(blind, prior, np.zeros(3), FREE).x[2] == pytest.approx(7.0, abs=1e-6)


def test_correlation_time_of_an_autoregressive_process():
    """(1 + rho) / (1 - rho) for r_n = rho r_(n-1) + e; 1 for independent residuals, episodes kept apart."""
    series = np.random.default_rng(1).normal(size=(20_000, 2))
    for row in range(1, len(series)):
        series[row, 0] += 0.8 * series[row - 1, 0]
    np.testing.assert_allclose(correlation_time(series, np.zeros(len(series), dtype=int)), [9.0, 1.0], rtol=0.2)
    np.testing.assert_allclose(correlation_time(series, np.arange(len(series))), 1.0)


def test_levels_of_few_rows_are_drawn_towards_the_one_that_joints_share():
    """Two rows' worth of a common share of the sizes: of a joint that is fitted exactly, too."""
    r, sizes = np.array([[3.0, 0.0], [-3.0, 0.0], [3.0, 0.0]]), np.array([10.0, 1.0])

    def prior(x):
        return x, np.eye(1)

    bounds = np.full(1, -1.0), np.ones(1)
    fit = weighted_least_squares(lambda x: (r, np.zeros((3, 2, 1))), prior, np.zeros(1), bounds, sizes=sizes)
    share = 0.5 * 0.3**2
    np.testing.assert_allclose(fit.noise**2, [(3 * 9.0 + 2 * share * 100.0) / 5, (2 * share) / 5], rtol=1e-3)
