"""Intervals of motions: against what is drawn, against fresh recordings, between horizons, stored and refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.fit.test_motion_fit import QUIET, bump, recording, refined, slide
from tests.posterior import floating_arm
from torch.testing import assert_close

from forcegp import JointFriction, fit, load_posterior, save_posterior
from forcegp.data.views import recorded_motions
from forcegp.errors import InvalidInput
from forcegp.fit import calibrated as with_intervals
from forcegp.posterior.fitted import DEVIATIONS, MotionIntervals

HORIZONS = (0.1, 0.25, 0.5)


@pytest.fixture(scope="module")
def log():
    return recording(bump, 1)


OTHERS = "refined", "friction"


@pytest.fixture(scope="module", params=["analytical", *(pytest.param(k, marks=pytest.mark.nightly) for k in OTHERS)])
def calibrated(request, log):
    """A model that cannot have the bump, the same refined on motions, and one that learns it from a few rows."""
    model = slide(3.0, 4.0)
    prior = JointFriction() if request.param == "friction" else ()
    fitted = fit(model.with_forces(prior, noise=QUIET), log, points=40, restarts=1)
    if request.param == "refined":
        fitted = refined(fitted, log, 0.5)
    return with_intervals(fitted, log, HORIZONS)


@pytest.mark.parametrize("samples", [0, 12])
def test_they_hold_in_another_recording(calibrated, samples):
    fresh = recorded_motions(recording(bump, 2), 40, 0.5)
    found = calibrated.rollout(fresh.q[:, 0], fresh.v[:, 0], fresh.u, fresh.dt, integrator="rk4", samples=samples)
    for name in ("q", "v"):
        low, high = (end.numpy() for end in found.interval(name))
        inside = (low <= getattr(fresh, name)) & (getattr(fresh, name) <= high)
        for horizon in HORIZONS:
            assert 0.8 <= inside[:, round(horizon / fresh.dt)].mean() <= 1.0
    half, error = found.interval("q")[1] - found.q, np.abs(found.q.numpy() - fresh.q)
    assert float(half[:, -1].mean()) < 4.0 * np.sqrt(np.square(error[:, -1]).mean()), "and are no wider than they need"


def test_widths_between_horizons_are_linear_and_grow_beyond_the_last():
    rms, factors = np.zeros((2, 2, 1)), np.ones((2, 2, 2, 1))
    rms[:, 0, 0], factors[0, :, 0, 0] = (0.1, 0.3), (0.5, 1.5)
    found = MotionIntervals(np.array([1.0, 2.0]), rms, factors)
    time = torch.tensor([0.0, 0.5, 1.0, 1.5, 2.0, 4.0], dtype=torch.float64)
    alone = found.half_width("q", time, None)[:, 0] / DEVIATIONS
    assert_close(alone, torch.tensor([0.0, 0.05, 0.1, 0.2, 0.3, 0.6], dtype=torch.float64))
    both = found.half_width("q", time, torch.full((3, 6, 1), 0.4, dtype=torch.float64))[0, :, 0] / DEVIATIONS
    expected = np.array([0.5, 0.5, 0.5, 1.0, 1.5, 1.5]) * np.hypot(0.4, [0.0, 0.05, 0.1, 0.2, 0.3, 0.6])
    np.testing.assert_allclose(both.numpy(), expected)


@pytest.mark.parametrize("calibrated", ["analytical"], indirect=True)
def test_they_are_stored_and_go_with_the_system(calibrated, tmp_path):
    save_posterior(calibrated, tmp_path / "run")
    for again in (load_posterior(tmp_path / "run"), calibrated.to("cpu")):
        for name in ("horizons", "rms", "factors"):
            expected = getattr(calibrated.motion_intervals, name)
            np.testing.assert_array_equal(getattr(again.motion_intervals, name), expected)
    assert calibrated.with_model(slide(1.0, 1.0)).motion_intervals is None, "widths of another robot"


def test_without_calibration_the_samples_decide(log):
    plain = fit(slide(3.0, 4.0).with_forces(JointFriction(), noise=QUIET), log, points=20, restarts=1)
    q, v, u = log.q[:1, :], log.v[:1, :], log.u[None, :20]
    sampled = plain.rollout(q, v, u, 0.01, samples=8)
    low, high = sampled.interval()
    assert_close(torch.stack([low, high]), sampled.samples.q.quantile(torch.tensor([0.025, 0.975]).double(), dim=0))
    with pytest.raises(InvalidInput, match="0 samples"):
        plain.rollout(q, v, u, 0.01).interval()


def test_recordings_that_cannot_teach_it_are_refused(log):
    plain = fit(slide(3.0, 4.0).with_forces(noise=QUIET), log, points=20, restarts=1)
    with pytest.raises(InvalidInput, match="two stretches of 9 s"):
        with_intervals(plain, log, (9.0,))
    with pytest.raises(InvalidInput, match="horizons are"):
        with_intervals(plain, log, (0.0,))
    swapped = replace(log.rows(np.arange(len(log))[::-1]), model=log.model)
    with pytest.raises(InvalidInput, match="not in the order of time"):
        with_intervals(plain, swapped, HORIZONS)


@pytest.fixture(scope="module")
def floating():
    """A model of a satellite whose arm has friction that no law describes, and a recording."""
    log = floating_arm.recording(1, 3.0, floating_arm.satellite())
    return fit(log.model, log, points=20, restarts=1), log


@pytest.mark.nightly
def test_where_the_base_moves_they_hold_as_steps(floating):
    fitted, log = floating
    calibrated = with_intervals(fitted, log, HORIZONS)
    fresh = recorded_motions(floating_arm.recording(2, 6.0, log.model), 30, 0.5)
    robot, recorded = log.model.robot, torch.tensor(fresh.q)
    found = calibrated.rollout(fresh.q[:, 0], fresh.v[:, 0], fresh.u, fresh.dt, integrator="rk4")
    low, high = found.interval()
    assert low.shape == found.v.shape
    off = robot.difference(found.q, recorded)
    for horizon in HORIZONS:
        assert 0.8 <= float(((low <= off) & (off <= high))[:, round(horizon / fresh.dt)].double().mean()) <= 1.0
    assert float(high[:, -1].square().mean().sqrt()) < 6.0 * float(off[:, -1].square().mean().sqrt())
    np.testing.assert_array_equal(found.contains(recorded)[:, 1:], ((low <= off) & (off <= high)).numpy()[:, 1:])


@pytest.mark.nightly
def test_where_the_base_moves_samples_spread_as_steps(floating):
    fitted, log = floating
    robot, widths = log.model.robot, MotionIntervals(np.ones(1), np.zeros((1, 2, 7)), np.ones((2, 1, 2, 7)))
    plain = fitted.rollout(log.q[:3], log.v[:3], log.u[None, :20], 0.01)
    steps = 0.1 * torch.randn(6, *plain.v.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    others = ("v", "a", "diverged_at")
    same = {name: getattr(plain, name).expand(6, *getattr(plain, name).shape) for name in others}
    drawn = replace(plain, samples=replace(plain, q=robot.integrate(plain.q, steps), **same))
    assert_close(drawn.std(), steps.std(0))
    assert_close(torch.stack(drawn.interval()), steps.quantile(torch.tensor([0.025, 0.975]).double(), dim=0))
    low, high = replace(drawn, intervals=widths).interval()
    assert_close(high, DEVIATIONS * steps.std(0))
    assert_close(low, -high)
