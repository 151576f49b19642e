"""Doubts about single channels on either side of what decides, from one joint whose signals are known."""

from dataclasses import replace

import numpy as np
import pytest
from tests.checks.logs import PENDULUM

from forcegp.checks.check_input import CheckInput, _drop_outs, _even, _few_stretches, _smoothed
from forcegp.checks.signals import (
    _compared,
    _differences,
    sampling_doubts,
    signal_doubts,
    target_doubts,
    without_registers,
)
from forcegp.data import Dataset
from forcegp.doubts import Doubts
from forcegp.model import Model
from forcegp.robots import Robot

MODEL = Model(Robot.from_urdf_text(PENDULUM, locked={"elbow": 0.0}))


def swing(rate=100.0, rows=1000, **columns) -> Dataset:
    """q = sin 2t; the given columns instead."""
    time = np.arange(rows) / rate
    made = {
        "q": np.sin(2.0 * time),
        "v": 2.0 * np.cos(2.0 * time),
        "u": np.cos(3.0 * time + 1.0),
        "a": -4.0 * np.sin(2.0 * time),
    }
    return Dataset(**{name: x[:, None] for name, x in (made | columns).items()}, time=time, model=MODEL)


def said(log, about):
    return Doubts(signal_doubts(CheckInput.as_recorded(log, log.model))).of(about)


@pytest.mark.parametrize(
    ("name", "rows", "rate", "found"),
    [(name, rows, 100.0, rows > 10) for name in "qvu" for rows in (9, 11)]
    + [("q", 9, 20.0, False), ("q", 11, 20.0, True), ("u", 39, 400.0, False), ("u", 41, 400.0, True)],
)
def test_a_channel_is_frozen_for_a_tenth_of_a_second_and_ten_rows(name, rows, rate, found):
    log, start = swing(rate), round(1.0 * rate)
    x = getattr(log, name)[:, 0].copy()
    x[start : start + rows + 1] = x[start]
    doubts = said(replace(log, **{name: x[:, None]}), "frozen channel")
    assert len(doubts) == found
    if found:
        assert doubts[0].level == "wrong"
        assert doubts[0].numbers == {"quantity": name, "row": start, "seconds": pytest.approx(rows / rate)}
    if name == "q":  # a joint that sticks goes on from where it was; one whose torque stands still is at rest
        x[start + rows + 1 :] += x[start] - x[start + rows + 1]
        u = log.u.copy()
        u[start : start + rows + 1] = u[start]
        assert not said(replace(log, q=x[:, None]), "frozen channel")
        assert "q" not in [each.numbers["quantity"] for each in said(replace(log, q=x[:, None], u=u), "frozen channel")]


def test_a_torque_of_zero_may_be_one_that_was_switched_off_and_a_held_command_is_none():
    u = np.cos(3.0 * np.arange(1000) / 100.0)
    u[100:120] = 0.0
    assert said(swing(u=u), "frozen channel").level == "look"
    u[100:120] = u.max() + 0.1
    assert not said(swing(u=u), "frozen channel")
    assert not said(swing(u=u[np.arange(1000) // 20 * 20]), "frozen channel")


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("rows", "below", "near", "run", "found"),
    [
        (10, 1.9e-3, 1, 10, True),
        (9, 1.9e-3, 1, 9, False),
        (17, 1.9e-3, 2, 17, True),
        (16, 1.9e-3, 2, 16, False),
        (16, 2.1e-3, 2, 16, True),
        (12, 1.9e-3, 1, 2, False),
        (12, 1.9e-3, 1, 3, True),
    ],
)
def test_a_torque_is_clipped_where_far_more_rows_are_at_the_extreme_than_in_the_next_thousandth(
    sign, rows, below, near, run, found
):
    u = np.random.default_rng(0).permutation(np.linspace(-1.0, 0.99, 2000))
    at = 100 + np.arange(rows) // run * 50 + np.arange(rows) % run
    u[at], u[5 : 5 + near] = 1.0, 1.0 - below
    log = swing(rows=2000, u=sign * u, v=np.ones(2000))
    doubts = said(log, "saturation")
    assert [each.numbers for each in doubts] == found * [{"value": sign, "rows": rows, "row": 100}]
    assert (f"{'largest' if sign > 0.0 else 'smallest'} value" in doubts[0].what) if found else True
    rest = np.ones((2000, 1))
    rest[at] = 0.19
    assert not said(replace(log, v=rest), "saturation")


@pytest.mark.parametrize(("rows", "found"), [(19, False), (21, True)])
def test_rows_repeat_where_two_in_a_hundred_do_while_the_robot_moves(rows, found):
    log, at = swing(), 50 + 40 * np.arange(rows)
    q = log.q.copy()
    q[at] = q[at - 1]
    for v, more in (
        (np.full((1000, 1), 2.0), found),
        (np.where(np.isin(np.arange(1000), at), 0.1, 2.0)[:, None], False),
    ):
        repeated = replace(log, q=q, v=v)
        first, *others = sampling_doubts(CheckInput.as_recorded(repeated, MODEL))
        assert first.numbers == {
            "sample_rate": pytest.approx(100.0),
            "seconds": pytest.approx(9.99),
            "episodes": 1,
            "rows": 1000,
        }
        assert [each.numbers for each in others] == more * [{"share": pytest.approx(rows / 999), "row": 50}]


V, UNIT = "v looks like ", "unit"
DIFFERENT = [
    ("v", (1.04, np.nan, 0.0), None, "", {}),
    ("v", (1.06, np.nan, 0.0), "look", "1.06 times dq/dt.", {}),
    ("v", (1.19, np.nan, 0.0), "look", "1.19 times", {}),
    ("v", (1.21, np.nan, 0.0), "wrong", "1.21 times dq/dt.", {}),
    ("v", (58.0, np.nan, 0.0), "wrong", V + "deg/s where q is in rad", {UNIT: {"v": ("deg/s",)}}),
    ("v", (0.0174, np.nan, 0.0), "wrong", V + "rad/s where q is in degrees", {UNIT: {"q": ("deg",)}}),
    ("v", (9.5, np.nan, 0.0), "wrong", V + "rpm", {UNIT: {"v": ("rpm",)}}),
    ("v", (1e3, np.nan, 0.0), "wrong", V + "mrad/s", {UNIT: {"v": ("mrad/s",)}}),
    ("v", (1e-3, np.nan, 0.0), "wrong", V + "per millisecond", {}),
    ("v", (0.16, np.nan, 0.0), "wrong", V + "turns per second", {UNIT: {"v": ("rev/s",)}}),
    ("v", (-1.04, np.nan, 0.0), "wrong", "opposite sign", {"sign": {"v": (-1.0,)}}),
    ("v", (-1.06, np.nan, 0.0), "wrong", "(factor -1.06)", {}),
    ("v", (1.0, 0.0118, 0.0), None, "", {}),
    ("v", (1.0, 0.0122, 0.0), "look", "12.2 ms later than dq/dt: 1.2 time steps", {}),
    ("v", (1.0, -0.0122, 0.0), "look", "12.2 ms earlier", {}),
    ("v", (1.5, np.nan, 0.049), "wrong", "1.5 times", {}),
    ("v", (1.5, np.nan, 0.051), None, "", {}),
    ("v", (1.5, np.nan, 0.29), None, "", {}),
    ("v", (1.5, np.nan, 0.31), "wrong", "not dq/dt: 31 % of its power", {}),
    ("a", (1.5, np.nan, 0.31), "look", "not dv/dt: 31 %", {}),
    ("a", (58.0, np.nan, 0.0), "wrong", "58 times dv/dt.", {}),
]


@pytest.mark.parametrize(("name", "fit", "level", "words", "correction"), DIFFERENT)
def test_how_a_signal_differs_from_a_derivative_is_said_with_its_remedy(name, fit, level, words, correction):
    inputs = CheckInput.as_recorded(swing(), MODEL)
    found = list(_differences(inputs, name, {"v": "q", "a": "v"}[name], {0: fit}, [0]))
    assert [each.level for each in found] == ([] if level is None else [level])
    for each in found:
        assert words in each.what
        assert each.correction == correction
        delay = None if np.isnan(fit[1]) else fit[1]
        assert each.numbers == {"quantity": name, "factor": fit[0], "delay": delay, "unexplained": fit[2]}


@pytest.mark.parametrize("late", [-0.0123, 0.008])
def test_a_signal_is_compared_by_factor_delay_and_what_remains(late):
    time = np.arange(1000) / 100.0
    v = 1.3 * 2.0 * np.cos(2.0 * (time - late)) + 0.2 * np.sin(23.0 * time)
    pieces = [swing(v=v).rows(slice(0, 400)), swing(v=v).rows(slice(400, 1000))]
    factor, shift, left = _compared(pieces, "v", "q", 0)
    assert factor == pytest.approx(1.3, rel=2e-3)
    assert shift == pytest.approx(late, abs=1e-3)
    assert left == pytest.approx(0.04 / (0.04 + 2.6**2), rel=0.1)
    assert _compared([swing(v=0.0 * v)], "v", "q", 0) is None
    assert _compared([swing(rows=12)], "v", "q", 0) is None


@pytest.mark.parametrize(("few", "found"), [(19, False), (20, True)])
@pytest.mark.parametrize("name", ["u", "q"])
def test_registers_without_a_sign_are_decoded(name, few, found):
    wave = np.abs((np.arange(1000) - 37) % (2 * (100 + few)) - 100 - few) - few
    for stored in (np.where(wave < 0, 32768 - wave, wave), np.where(wave < 0, 65536 + wave, wave)):
        log = swing(**{name: stored.astype(float)})
        decoded, doubts = without_registers(log)
        assert [(each.about, each.numbers) for each in doubts] == found * [("registers", {"quantity": name})]
        np.testing.assert_allclose(decoded.u, wave[:, None] if found and name == "u" else log.u, atol=1.0)
    turned = swing(q=np.mod(0.01 * np.arange(1000) + 3.0, 2.0 * np.pi))
    assert without_registers(turned)[1] == []


@pytest.mark.parametrize(
    ("factor", "lag", "noise", "found"),
    [
        (1.0, 0.1, 0.0, True),
        (180.0 / np.pi, 0.3, 0.0, True),
        (1.08, 0.1, 0.0, True),
        (1.12, 0.1, 0.0, False),
        (0.92, 0.48, 0.0, True),
        (0.88, 0.1, 0.0, False),
        (1.0, 0.6, 0.0, False),
        (1.0, 0.1, 0.12, True),
        (1.0, 0.1, 0.18, False),
    ],
)
def test_targets_are_positions_up_to_half_a_second_later(factor, lag, noise, found):
    time = np.arange(1000) / 100.0
    ahead = np.sin(2.0 * (time + lag)) + np.sin(13.0 * (time + lag))
    u = factor * (ahead + noise * np.random.default_rng(0).standard_normal(1000))
    doubts = target_doubts(CheckInput.as_recorded(swing(q=np.sin(2.0 * time) + np.sin(13.0 * time), u=u), MODEL))
    assert [each.about for each in doubts] == found * ["targets"]
    assert not found or doubts[0].numbers["lag"] == pytest.approx(lag, abs=0.021)


@pytest.mark.parametrize(("offset", "drops", "found"), [(0.011, 2, 2), (0.011, 1, 0), (0.009, 2, 0)])
def test_zeros_are_lost_rows_where_steps_of_ten_times_the_usual_lead_there(offset, drops, found):
    q = offset + 1e-3 * np.abs(np.arange(1000) % 200 - 100)
    q[100 + 200 * np.arange(drops)] = 0.0
    lost = _drop_outs(swing(q=q), "q")
    assert lost.sum() == found
    assert lost[[100, 300]].sum() == found


@pytest.mark.parametrize(("rate", "width"), [(50.0, 1), (100.0, 3), (250.0, 7), (1000.0, 15)])
def test_running_means_take_three_hundredths_of_a_second_within_an_episode(rate, width):
    log = replace(swing(rate, 400), episode=np.repeat([0, 1], 200), noise_std=np.ones(1))
    smooth, found = _smoothed(log)
    assert found == width
    means = [
        np.convolve(log.u[own, 0], np.full(width, 1.0 / width), "valid") for own in (slice(0, 200), slice(200, 400))
    ]
    np.testing.assert_allclose(smooth.u[:, 0], np.concatenate(means), atol=1e-12)
    times = [log.time[own][width // 2 : 200 - width // 2] for own in (slice(0, 200), slice(200, 400))]
    np.testing.assert_allclose(smooth.time, np.concatenate(times))
    assert _smoothed(log.rows(slice(0, 10 * width - 1)))[1] == 1


def test_three_stretches_of_a_long_log_are_looked_at():
    log = swing(rows=3000)
    found = _few_stretches(replace(log, episode=np.repeat([0, 1], 1500)))
    rows = np.r_[0:400, 1300:1700, 2600:3000]
    np.testing.assert_array_equal(found.time, log.time[rows])
    np.testing.assert_array_equal(found.episode, np.repeat([0, 1, 2, 3], [400, 200, 200, 400]))
    assert len(_few_stretches(log.rows(slice(0, 1200)))) == 1200


@pytest.mark.parametrize(("pause", "episodes"), [(4.9, [0]), (5.1, [0, 1])])
def test_gaps_of_five_steps_end_a_stretch_and_short_stretches_go(pause, episodes):
    log = swing(rows=400)
    time = log.time + 0.01 * (pause - 1.0) * (np.arange(400) >= 150) + 1.0 * (np.arange(400) >= 337)  # 63 rows follow
    even = _even(replace(log, time=time), np.zeros((400, 1), bool))
    assert list(even.episodes) == episodes
    assert even.time[-1] == pytest.approx(time[336], abs=0.01)
    steps = np.concatenate([np.diff(even.time[even.episode == number]) for number in episodes])
    np.testing.assert_allclose(steps, 0.01, rtol=1e-6)
