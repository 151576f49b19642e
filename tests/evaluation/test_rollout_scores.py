"""Errors and pictures of motions of a base that moves, on the manifold of its positions."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from forcegp import JointFriction, fit
from forcegp.data import recorded_motions
from forcegp.errors import InvalidInput
from forcegp.evaluation import rollout_errors, rollout_figure
from forcegp.simulation import QuadrupedConfig, simulate_quadruped


@pytest.fixture(scope="module")
def log():
    return simulate_quadruped(QuadrupedConfig(seconds=2.0, seed=4))


@pytest.fixture(scope="module")
def posterior(log):
    return fit(log.model.with_forces(JointFriction()), log, points=20, restarts=1)


def rolled(posterior, log, **how):
    recorded = recorded_motions(log, [10, 200], 0.1)
    return posterior.rollout(recorded.q[:, 0], recorded.v[:, 0], recorded.u, recorded.dt, **how), recorded


def test_errors_are_ways_on_the_manifold(posterior, log):
    rollout, recorded = rolled(posterior, log)
    robot = log.model.robot
    step = 0.05 * torch.randn(*recorded.v.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    moved = robot.integrate(torch.tensor(recorded.q), step)
    turned = moved.clone()
    turned[..., 3:7] *= -1.0  # the same orientation
    for q in (moved, turned):
        errors = rollout_errors(replace(rollout, q=q), recorded, log.model)
        np.testing.assert_allclose(errors.joint, step.abs(), atol=1e-12)
    lost = moved.clone()
    lost[1, 5:] = torch.nan
    errors = rollout_errors(replace(rollout, q=lost), recorded, log.model)
    assert np.isnan(errors.joint[1, 5:]).all()
    assert np.isfinite(errors.joint[1, :5]).all()
    assert errors.tool is not None
    assert errors.constraint is None  # feet have no surface to be away from


@pytest.mark.nightly
def test_samples_give_intervals_about_the_mean(posterior, log):
    rollout, recorded = rolled(posterior, log, samples=8)
    errors = rollout_errors(rollout, recorded, log.model)
    assert errors.spread.shape == errors.inside.shape == recorded.v.shape
    ways = log.model.robot.difference(rollout.q.expand_as(rollout.samples.q), rollout.samples.q).numpy()
    low, high = np.quantile(ways, (0.025, 0.975), axis=0)
    np.testing.assert_allclose(errors.spread, 0.5 * (high - low), atol=1e-14)


def test_a_base_is_drawn_by_its_way_from_the_start(posterior, log):
    rollout, recorded = rolled(posterior, log, samples=8)
    errors = rollout_errors(rollout, recorded, log.model)
    figure = rollout_figure(rollout, recorded, errors, log, "title")
    panels = figure.subfigs[0].axes
    drawn = panels[0].lines[0].get_ydata()
    start = torch.tensor(recorded.q[0, :1])
    way = log.model.robot.difference(start.expand(len(drawn), -1), torch.tensor(recorded.q[0]))
    np.testing.assert_allclose(drawn, way[:, 0], atol=1e-12)


def test_a_diverged_motion_is_the_farthest_of_a_median(posterior, log):
    """A median over what is left would drop where the worst motion ends."""
    rollout, recorded = rolled(posterior, log)
    errors = rollout_errors(rollout, recorded, log.model)
    joint = np.ones((3, *errors.joint.shape[1:])) * np.array([1.0, 2.0, 4.0])[:, None, None]
    joint[2, 5:] = joint[1, 10:] = np.nan
    diverged = replace(errors, joint=joint, diverged_at=np.array([-1, 10, 5]))
    figure = rollout_figure(rollout, recorded, diverged, log, "title")
    (median,) = [line for line in figure.subfigs[1].axes[0].lines if line.get_label() == "median"]
    drawn = np.asarray(median.get_ydata())  # from row 1
    assert (drawn[:9] == 2.0).all()
    assert np.isnan(drawn[9:]).all()


def test_starts_that_are_counted_avoid_gaps(log):
    kept = np.setdiff1d(np.arange(len(log)), [*range(100, 110), *range(300, 330)])
    found = recorded_motions(log.rows(kept), 40, 0.2)
    steps = found.u.shape[1]
    for start in found.rows:
        at = kept[start : start + steps + 1]
        np.testing.assert_array_equal(at, at[0] + np.arange(steps + 1))
    with pytest.raises(InvalidInput, match="uneven"):
        recorded_motions(log.rows(kept), [int(np.searchsorted(kept, 100)) - 5], 0.2)
    with pytest.raises(InvalidInput, match="uneven"):
        recorded_motions(log.rows(kept), 5, 1.0)
