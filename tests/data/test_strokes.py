"""What friction with memory needs of the past: strokes, encoders, noise, filters and delays."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from tests.forces.test_presliding import DT, JOINTS, SIGMA, dahl, log_of, lugre_log, motion  # noqa: F401  # a fixture
from tests.posterior.arm import arm_model

from forcegp import Torques, fit
from forcegp.data import Preparation, estimate_delay, with_memory, with_strokes
from forcegp.data.spectrum import held_out_cutoff
from forcegp.data.strokes import encoder_step, strokes, turning_points, white_noise
from forcegp.data.views import FORGOTTEN, past_known
from forcegp.errors import InvalidInput
from forcegp.fit.doubts import doubts_of_past
from forcegp.forces import Coulomb
from forcegp.forces.presliding import after_strokes


def test_a_thinned_log_has_the_same_past():
    time, q, v, a = motion(3000, 4)
    log = log_of(q, v, a, a, time)
    model = log.model.with_forces(Coulomb(1.0, sigma=SIGMA.tolist(), memory=True))
    whole, some = with_memory(log, model), np.sort(np.random.default_rng(0).choice(3000, 300, replace=False))
    np.testing.assert_array_equal(with_memory(whole.rows(some), model).u, whole.rows(some).u)
    shuffled = whole.rows(np.random.default_rng(1).permutation(some))
    np.testing.assert_array_equal(with_memory(shuffled, model).u, shuffled.u)
    gaps = with_memory(log.rows(some), model).u[:, 3:]  # steps of 20 ms: only the rows about reversals differ
    assert np.median(abs(gaps - whole.u[some, 3:])) < 1e-6
    with pytest.raises(InvalidInput, match="remembers, and the rows are not in order of time"):
        with_memory(log.rows(some[::-1]), model)


def test_motors_that_turn_with_two_joints_have_strokes_of_their_own():
    time, q, v, a = motion(1500, 3)
    law = Coulomb(1.0, sigma=SIGMA.tolist(), memory=True, transmission="bend+lift/pan-0.5*bend")
    T = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, 0.0], [0.0, 1.0, 1.0]])
    np.testing.assert_array_equal(law.bound_to(arm_model(0).robot).transmission, T)
    log, model = log_of(q, v, a, a, time), arm_model(0).with_forces(law)
    whole = with_memory(log, model)
    expected = np.stack([dahl(time, q @ T[j], v @ T[j], float(SIGMA[j])) for j in range(3)], axis=1)
    np.testing.assert_allclose(whole.u[:, 3:], expected, atol=0.01)
    force = whole.model.laws[-1].force(whole.model.state(*(torch.tensor(x) for x in (whole.q, whole.v, whole.u))))
    np.testing.assert_allclose(force, -whole.u[:, 3:] @ T, atol=1e-12)
    some = whole.rows(np.random.default_rng(1).permutation(1500)[:300])
    np.testing.assert_array_equal(with_memory(some, model).u, some.u)
    with pytest.raises(InvalidInput, match="not in order of time"):
        with_memory(with_strokes(log).rows(slice(None, None, -1)), model)
    step = 1e-3
    coarse = log_of(np.round(q / step) * step, v, a, a, time)
    z = after_strokes(torch.tensor(strokes(coarse, transmission=T)), torch.tensor(0.1 / step))
    smooth = after_strokes(torch.tensor(strokes(log, transmission=T)), torch.tensor(0.1 / step))
    assert float((z - smooth).abs().mean()) < 0.05


def test_steps_of_an_encoder_are_no_reversals():
    time, q, v, a = motion(3000, 5, slow=0.3)
    step = 2e-4
    noise = 0.25 * step * np.random.default_rng(0).standard_normal(q.shape)
    coarse = log_of(np.round((q + noise) / step) * step, v, a, a, time)
    assert encoder_step(coarse, coarse.q[:, 0]) == pytest.approx(step)
    assert encoder_step(log_of(q, v, a, a, time), q[:, 0]) == 0.0
    smooth, sigma = strokes(log_of(q, v, a, a, time)), torch.tensor(0.1 / step)
    apart = after_strokes(torch.tensor(strokes(coarse)), sigma) - after_strokes(torch.tensor(smooth), sigma)
    assert float(apart.abs().mean()) < 0.05
    jitter = np.array([0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 2.0, 3.0, 2.0, 3.0, 9.0, 2.0])
    assert turning_points(jitter, 2.0).tolist() == [0, 10]
    assert turning_points(jitter, 0.5).tolist() == [0, 1, 2, 3, 4, 7, 8, 10]


@pytest.mark.parametrize("delay", [0.0, 0.012])
def test_hysteresis_is_no_delay(delay, lugre_log):  # noqa: F811  # the fixture
    """With friction of velocity alone the same logs show 20 ms more."""
    few = lugre_log.rows(slice(0, 6000, 2))
    late = replace(few, u=CubicSpline(few.time, few.u)(few.time - delay))
    assert abs(estimate_delay(late).significant - delay) < 0.004
    alone = estimate_delay(replace(late, time_ordered=True, strokes=np.zeros((len(late), 3, 1))))  # nothing remembered
    assert alone.significant > delay + 0.01


def test_friction_behind_the_filter_of_the_log_is_not_early(lugre_log):  # noqa: F811  # the fixture
    """A filter rounds the turn of friction from before the reversal on, which reads as torque that is early."""
    filtered = Preparation(cutoff=6.0).rows(lugre_log.rows(slice(0, 6000, 2)))
    sharp, alike = (estimate_delay(filtered, cutoff).common for cutoff in (None, 6.0))
    assert abs(alike) < 0.001
    assert sharp < -0.01


def test_a_cutoff_is_judged_beside_friction_that_remembers(lugre_log):  # noqa: F811  # the fixture
    """Without memory friction leaves 3 % of the torque behind every cut-off, beside which noise is nothing."""
    few = lugre_log.rows(slice(0, 6000, 2))
    noisy = replace(few, q=few.q + 1e-4 * np.random.default_rng(0).standard_normal(few.q.shape))
    best, shares = held_out_cutoff(noisy, 20.0)
    assert best == 14.0
    assert shares[best] < 5e-4 < shares[40.0]


def test_noise_of_positions_is_no_reversal():
    """Its size is found at any rate, and motion is not taken for it."""
    time, rng = DT * np.arange(8000), np.random.default_rng(0)
    q = np.stack([0.4 * np.sin((1.0 + 0.3 * j) * time) for j in range(3)], 1)
    v, a = np.gradient(q, time, axis=0), np.zeros_like(q)
    smooth, noisy = log_of(q, v, a, a, time), log_of(q + 1e-4 * rng.standard_normal(q.shape), v, a, a, time)
    assert [white_noise(noisy, each) for each in noisy.q.T] == pytest.approx(3 * [1e-4], rel=0.1)
    assert [white_noise(each, each.q[:, 0]) for each in (smooth, smooth.rows(slice(None, None, 200)))] == [0.0, 0.0]
    reversals = [(np.diff(np.sign(strokes(log)[:, :, 0]), axis=0) != 0).sum() for log in (smooth, noisy)]
    assert abs(reversals[1] - reversals[0]) <= 3  # of three joints, at the first rows
    fast = replace(smooth, q=0.1 * np.sin(2.0 * np.pi * 0.195 * np.arange(8000))[:, None] * np.ones(3))
    assert white_noise(fast, fast.q[:, 0]) == 0.0  # a fifth of the rate: orders differ by a factor of 1.7
    way = np.interp(time, [0.0, 4.0, 5.0, 16.0], [0.0, 0.2, 0.1995, 0.5])[:, None] + np.zeros(3)
    back = log_of(way + 1e-4 * rng.standard_normal(q.shape), a, a, a, time)
    assert (strokes(back)[:, :, 1] != 0.0)[-1].all()  # five deviations back, and as many of noise, are a reversal
    still = log_of(1e-4 * rng.standard_normal(q.shape), a, a, a, time)
    assert np.abs(strokes(still)[:, :, 1]).max() < 1e-3  # at rest there is no past, but for rare peaks


def test_a_filter_does_not_round_the_reversals_that_friction_remembers():
    """Of a log of postures, strokes are those before the filter."""
    time = DT * np.arange(6000)
    steps = np.cumsum(np.where(np.arange(6000) % 1500 < 300, 2e-3, 0.0) * np.sign(np.sin(0.001 * np.arange(6000))))
    q = np.stack([steps, 0.5 * steps, -0.3 * steps], 1)
    v = np.gradient(q, time, axis=0)
    raw = log_of(q, v, np.gradient(v, time, axis=0), v, time)
    filtered = Preparation(cutoff=2.0, every=3).apply(raw)
    assert np.array_equal(np.asarray(filtered.strokes), strokes(raw)[::3])
    assert not np.allclose(filtered.strokes, strokes(replace(filtered, strokes=None)), atol=1e-4)
    moving = replace(raw, q=q + 0.5 * np.sin(time)[:, None])
    assert Preparation(cutoff=2.0).apply(moving).strokes is None, "without rests, positions fit the filtered torques"
    for share, rests in ((0.012, False), (0.03, True)):  # of one joint, while others move
        phase = DT * np.cumsum(np.arange(6000) % 3000 >= 0.3 / DT + 3000 * share)
        raw = replace(raw, q=np.stack([np.sin(phase), np.sin(1.1 * time), np.cos(time)], 1))
        filtered = Preparation(cutoff=2.0).apply(raw)
        assert (filtered.strokes is not None) is rests
    here = np.where(np.arange(3)[:, None] == 0, strokes(raw), strokes(replace(filtered, strokes=None)))
    np.testing.assert_array_equal(filtered.strokes, here)


def test_rows_before_a_joint_has_moved_are_left_out():
    _, q, v, a = motion(6000, 2)
    rest = 1e-9 * np.random.default_rng(0).standard_normal((15, 3))
    q, v, a = np.vstack([q[0] + rest, q]), np.vstack([rest, v]), np.vstack([rest, a])
    log = with_strokes(log_of(q, v, a, a, DT * np.arange(len(q))))
    model = arm_model(0).with_forces(Coulomb(sigma=500.0, memory=("lift",)))
    known = past_known(log, model)
    first = int(np.argmax(known))
    assert known[first:].all()
    assert first >= 15
    for share, said in ((0.09, False), (0.11, True)):
        assert bool(list(doubts_of_past(model, log, np.arange(1000) >= 1000 * share))) is said
    for rows, left_out in ((60 * first, True), (30 * first, False)):
        assert ("rows_before_a_past" in fit(model, log.rows(slice(0, rows)), Torques(), rows=500).settings) is left_out
    assert FORGOTTEN / 500.0 - 0.005 < np.abs(np.diff(q[: first + 1, 1])).sum() < FORGOTTEN / 500.0 + 0.005
    longer = [np.r_[x, 0.0 * x[:300] + x[-1]] for x in (q, v, a, a)]
    longer[0][len(q) :, 1] += 1e-4 * np.sin(np.arange(300.0))  # it trembles at rest
    longer = log_of(*longer, DT * np.arange(len(q) + 300))
    np.testing.assert_array_equal(past_known(with_strokes(longer), model)[first:], True)
    q[:, 1] = q[0, 1]  # a joint that never moves keeps its rows
    assert past_known(with_strokes(log_of(q, v, a, a, log.time)), model).all()
    assert past_known(log, arm_model(0)).all()
