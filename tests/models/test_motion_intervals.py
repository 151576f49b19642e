"""Intervals of motions: against what is drawn, against fresh recordings, between horizons, stored and refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.models.test_motion_fit import QUIET, bump, line, recording, slide

from forcegp import JointFriction, NeuralNetwork, NoForces, StructuredGP, load_posterior, save_posterior
from forcegp.data.motion_records import recorded_motions
from forcegp.errors import InvalidInput
from forcegp.models.motion_intervals import DEVIATIONS, MotionIntervals

HORIZONS = (0.1, 0.25, 0.5)


@pytest.fixture(scope="module")
def log():
    return recording(bump, 1)


@pytest.fixture(scope="module", params=["analytical", "refined", "friction"])
def calibrated(request, log):
    """A model that cannot have the bump, the same refined on motions, and one that learns it from a few rows."""
    system = slide(3.0, 4.0)
    prior = JointFriction() if request.param == "friction" else NoForces()
    fitted = StructuredGP(system, prior, noise=QUIET).fit(log, points=40, restarts=1)
    if request.param == "refined":
        fitted = fitted.refined_on_motions(log, 0.5)
    return fitted.calibrated_on_motions(log, HORIZONS)


@pytest.mark.parametrize("samples", [0, 12])
def test_they_hold_in_another_recording(calibrated, samples):
    fresh = recorded_motions(recording(bump, 2), 40, 0.5)
    found = calibrated.rollout(fresh.q[:, 0], fresh.v[:, 0], fresh.u, fresh.dt, integrator="rk4", samples=samples)
    for name in ("q", "v"):
        low, high = (end.numpy() for end in found.interval(name))
        inside = (low <= getattr(fresh, name)) & (getattr(fresh, name) <= high)
        for horizon in HORIZONS:
            assert 0.8 <= inside[:, round(horizon / fresh.dt)].mean() <= 1.0
    half = found.interval("q")[1] - found.q
    error = np.abs(found.q.numpy() - fresh.q)
    assert float(half[:, -1].mean()) < 4.0 * np.sqrt(np.square(error[:, -1]).mean()), "and are no wider than they need"


def test_widths_between_horizons_are_linear_and_grow_beyond_the_last():
    rms, factors = np.zeros((2, 2, 1)), np.ones((2, 2, 2, 1))
    rms[:, 0, 0], factors[0, :, 0, 0] = (0.1, 0.3), (0.5, 1.5)
    found = MotionIntervals(np.array([1.0, 2.0]), rms, factors)
    time = torch.tensor([0.0, 0.5, 1.0, 1.5, 2.0, 4.0], dtype=torch.float64)
    alone = found.half_width("q", time, None)[:, 0] / DEVIATIONS
    torch.testing.assert_close(alone, torch.tensor([0.0, 0.05, 0.1, 0.2, 0.3, 0.6], dtype=torch.float64))
    spread = torch.full((3, 6, 1), 0.4, dtype=torch.float64)
    both = found.half_width("q", time, spread)[0, :, 0] / DEVIATIONS
    expected = np.array([0.5, 0.5, 0.5, 1.0, 1.5, 1.5]) * np.hypot(0.4, [0.0, 0.05, 0.1, 0.2, 0.3, 0.6])
    np.testing.assert_allclose(both.numpy(), expected)


def test_they_are_stored_and_go_with_the_system(calibrated, tmp_path):
    save_posterior(calibrated, tmp_path / "run")
    for again in (load_posterior(tmp_path / "run"), calibrated.to("cpu")):
        for name in ("horizons", "rms", "factors"):
            expected = getattr(calibrated.motion_intervals, name)
            np.testing.assert_array_equal(getattr(again.motion_intervals, name), expected)
    other = calibrated.with_system(slide(1.0, 1.0))
    assert other.motion_intervals is None, "widths of another robot"


def test_without_calibration_the_samples_decide(log):
    plain = StructuredGP(slide(3.0, 4.0), JointFriction(), noise=QUIET).fit(log, points=20, restarts=1)
    q, v, u = log.q[:1, :], log.v[:1, :], log.u[None, :20]
    sampled = plain.rollout(q, v, u, 0.01, samples=8)
    low, high = sampled.interval()
    torch.testing.assert_close(torch.stack([low, high]), sampled.quantiles((0.025, 0.975)))
    with pytest.raises(InvalidInput, match="0 samples"):
        plain.rollout(q, v, u, 0.01).interval()


def test_recordings_that_cannot_teach_it_are_refused(log):
    plain = StructuredGP(slide(3.0, 4.0), NoForces(), noise=QUIET).fit(log, points=20, restarts=1)
    with pytest.raises(InvalidInput, match="two stretches of 9 s"):
        plain.calibrated_on_motions(log, (9.0,))
    with pytest.raises(InvalidInput, match="horizons are"):
        plain.calibrated_on_motions(log, (0.0,))
    network = NeuralNetwork(slide(3.0, 4.0), steps=2).fit(recording(line, 3, 1.0))
    with pytest.raises(InvalidInput, match="take a StructuredGP or an analytical model"):
        network.calibrated_on_motions(log)
    swapped = replace(log.rows(np.arange(len(log))[::-1]), system=log.system)
    with pytest.raises(InvalidInput, match="not in the order of time"):
        plain.calibrated_on_motions(swapped, HORIZONS)
