"""Cut-off from the spectrum, delay from inverse dynamics, and the price of a preparation, against known truth."""

import inspect
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.data.samples import assert_equal, dataset, model
from tests.posterior.arm import arm_model

from forcegp.data import Dataset, Delay, Preparation, differentiated, estimate_delay, low_pass, motion_spectrum
from forcegp.data.delay import rate_of_waves
from forcegp.data.spectrum import _knee_and_floor
from forcegp.errors import DatasetError, DataWarning, InvalidInput

RATE, SIGMA = 500.0, 1e-4


def swings(time: np.ndarray, seed: int, nv: int = 2) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sums of five sines up to 2 Hz with exact derivatives."""
    generator = np.random.default_rng(seed)
    omega = 2 * np.pi * generator.uniform(0.1, 2.0, (5, 1, nv))
    phase, size = generator.uniform(0, 2 * np.pi, (5, 1, nv)), generator.uniform(0.1, 0.3, (5, 1, nv))
    angle = omega * time[:, None] + phase
    q, v, a = (size * np.sin(angle), size * omega * np.cos(angle), -size * omega**2 * np.sin(angle))
    return q.sum(0), v.sum(0), a.sum(0)


def noisy(seconds: float = 12.0, seed: int = 0, sigma: float = SIGMA, rate: float = RATE) -> tuple[Dataset, np.ndarray]:
    """Positions with white noise, raw differences of them, and the exact acceleration."""
    time = np.arange(round(seconds * rate)) / rate
    q, _, a = swings(time, seed)
    measured = q + sigma * np.random.default_rng(seed + 100).normal(size=q.shape)
    return differentiated(Dataset(q=measured, v=0 * q, u=0 * q, a=0 * q, time=time, model=model("continuous")), "q"), a


def arm_log(delay: float = 0.0, seconds: float = 8.0, seed: int = 1, noise: float = 0.02) -> Dataset:
    """The three-joint arm in free motion with the torques of inverse dynamics and friction, logged `delay` s late."""
    model, time = arm_model(contacts=0), np.arange(round(seconds * 200)) / 200
    q, v, a = swings(time, seed, 3)
    late = swings(time - delay, seed, 3)
    u = model.robot.inverse_dynamics(*(torch.tensor(x) for x in late)).numpy()
    u += 0.8 * np.tanh(late[1] / 0.1) + 0.3 * late[1] + noise * np.random.default_rng(seed).normal(size=u.shape)
    return Dataset(q=q, v=v, u=u, a=a, time=time, model=model)


# ---------------------------------------------------------------- spectrum


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_noise_floor_and_acceleration_noise_are_those_of_white_noise(seed):
    data, _ = noisy(seed=seed)
    spectrum = motion_spectrum(data)
    np.testing.assert_allclose(spectrum.floor, 2 * SIGMA**2 / RATE, rtol=0.25)  # one-sided density of white noise
    # (q[k+2] - 2 q[k] + q[k-2]) / (2 h)^2 of independent errors
    np.testing.assert_allclose(spectrum.acceleration_noise(), np.sqrt(6) / 4 * SIGMA * RATE**2, rtol=0.05)


@pytest.mark.parametrize(
    ("derivatives", "turn", "top", "segments", "found"),
    [
        (2, 12.0, 250.0, 1e9, True), (2, 100.0, 250.0, 1.0, True), (1, 12.0, 250.0, 4.0, True),
        (2, 215.0, 250.0, 9.0, False), (2, 12.0, 28.0, 9.0, True), (2, 12.0, 24.0, 9.0, False),
    ],
)  # fmt: skip
def test_knee_floor_and_cutoff_of_a_power_law_over_white_noise(derivatives, turn, top, segments, found):
    """2 F where F (turn / f)^8 is the floor F; the knee is where f^(2 d) times the density is least."""
    frequency = np.arange(0.25, top + 0.1, 0.25)
    density = 3.0 * (1.0 + (turn / frequency) ** 8)
    knee, floor, cutoff = _knee_and_floor(frequency, density, segments, derivatives)
    if not found:
        assert np.isnan([knee, floor, cutoff]).all()  # above .8 of all, or noise that rises tenfold nowhere
        return
    assert knee == pytest.approx(turn * (4.0 / derivatives - 1.0) ** 0.125, rel=0.09)
    seen = density[(frequency >= 1.2 * knee) & (frequency <= min(5.0 * knee, 0.95 * top))]
    assert floor == pytest.approx(np.median(seen) / (1.0 - 1.0 / (9.0 * segments)) ** 3)
    assert cutoff == pytest.approx(turn * (2.0 * floor / 3.0 - 1.0) ** -0.125, rel=0.02)


# ---------------------------------------------------------------- delay


@pytest.mark.parametrize("delay", [-0.015, 0.004, 0.02])
def test_a_delay_is_found_to_a_fraction_of_a_sample(delay):
    found = estimate_delay(arm_log(delay))
    assert (found.common, found.significant) == (pytest.approx(delay, abs=0.0004), found.common)
    np.testing.assert_allclose(found.seconds, delay, atol=2e-3)
    assert abs(found.common - delay) < 5 * found.common_std
    prepared = Preparation(cutoff=20.0, delay="auto", trim=0.2).apply(arm_log(delay))
    assert prepared.metadata["preparation"]["delay"] == pytest.approx(delay, abs=4e-4)
    np.testing.assert_allclose(prepared.u, _at(prepared, low_pass(arm_log(0.0), 20.0)).u, atol=0.2)


NONE = "not more than three standard deviations"
SHOWN = [
    ({}, 0.01, "10.0 ms ± 0.1 ms, which leaves 10 %"),
    ({"seconds": [0.01, 0.01, 0.03, 0.03]}, 0.0, NONE),  # most joints have to show it
    ({"seconds": [0.01, 0.01, 0.0149, 0.03]}, 0.01, "which leaves"),  # by half of it, or three deviations
    ({"seconds": [0.01, 0.01, 0.0151, 0.03]}, 0.0, NONE),
    ({"seconds": [0.01, 0.01, 0.0159, 0.03], "std": [2e-3] * 4}, 0.01, "which leaves"),
    ({"seconds": [0.01, 0.01, 0.0161, 0.03], "std": [2e-3] * 4}, 0.0, NONE),
    ({"seconds": [0.0055, 0.0145]}, 0.01, "which leaves"),  # 3 * 4.5 ms / sqrt(2)
    ({"seconds": [0.0051, 0.0149]}, 0.0, NONE),
    ({"seconds": [0.01, np.nan, np.nan], "std": [1e-4, np.nan, np.nan]}, 0.01, "which leaves"),
    ({"common_std": 0.0032}, 0.01, "which leaves"),
    ({"common_std": 0.0034}, 0.0, "3 to 17 ms cannot be told apart"),
    ({"common_std": 0.15}, 0.0, "-200 to 200 ms cannot be told apart"),
    ({"common_std": 0.0026, "remains": 0.99}, 0.0, "5 to 15 ms cannot be told apart"),
    ({"remains": 0.94}, 0.01, "leaves 94 %"),
    ({"remains": 0.96}, 0.0, "on time: a delay explains hardly anything"),
    ({"common": 6e-4, "common_std": 1e-6, "seconds": [6e-4]}, 6e-4, "0.6 ms ± 0.0 ms, which leaves"),
    ({"common": 4e-4, "common_std": 1e-6, "seconds": [4e-4]}, 0.0, NONE),
    ({"common": np.nan}, 0.0, "the torques show no common delay"),
]


@pytest.mark.parametrize(("numbers", "used", "words"), SHOWN)
def test_a_delay_is_used_where_most_joints_show_it_and_it_explains_something(numbers, used, words):
    told = {"common": 0.01, "common_std": 1e-4, "seconds": [0.01, 0.01, 0.01], "remains": 0.1} | numbers
    each = np.array(told.pop("seconds"))
    delay = Delay(seconds=each, std=np.array(told.pop("std", np.full(len(each), 1e-4))), **told)
    assert delay.significant == used
    assert words in delay.reason


WAVES = [(0.6, 24, 0), (0.4, 24, 0), (0.6, 5, 0), (0.6, 9.8, 0), (0.6, 24, 5), (0.6, 24, 9), (0.6, 1000, 0)]


@pytest.mark.parametrize(("share", "rate", "known"), WAVES)
def test_a_wave_over_positions_that_is_most_of_what_is_left_is_found(share, rate, known):
    noise, q = np.random.default_rng(3).standard_normal(2000), np.sin(np.linspace(0.0, 40.0, 2000)) ** 3
    force = (2.0 * share) ** 0.5 * np.sin(rate * q) + (1.0 - share) ** 0.5 * noise
    basis = np.linspace(-1.0, 1.0, 2000)[:, None] / np.sqrt(2000 / 3)
    found = rate_of_waves(q, force + known * np.sqrt(2000) * basis[:, 0], basis)
    told = share > 0.5 and 3.0 < rate / np.pi < 300.0 and known < 7.0
    assert found == (pytest.approx(rate, rel=3e-3) if told else 0.0)
    assert not rate_of_waves(q[::50], force[::50], np.zeros((40, 0))), "of 40 rows some wave always explains most"
    log = arm_log(0.0)
    assert not estimate_delay(replace(log, u=log.u + 0.3 * log.u.std(axis=0) * np.sin(rate * log.q))).significant


@pytest.mark.parametrize("delay", [-0.08, 0.12])
def test_a_long_delay_is_found_where_no_short_one_fits(delay):
    found = estimate_delay(arm_log(delay))
    assert (found.common, found.significant) == (pytest.approx(delay, abs=0.002), found.common)
    # behind a filter it would be one of 230 Hz, which 200 rows per second do not tell
    assert estimate_delay(arm_log(0.001, noise=1e-4)).significant == pytest.approx(0.001, abs=1e-4)


def _at(prepared: Dataset, whole: Dataset) -> Dataset:
    return whole.rows(np.isin(whole.time, prepared.time))


def test_what_a_delay_needs_is_said():
    with pytest.raises(InvalidInput, match="forces of contacts are not known"):
        estimate_delay(replace(arm_log(), model=arm_model()))
    with pytest.raises(DatasetError, match=r"rows lie more than 0.05 s from the ends.*at least 80"):
        estimate_delay(arm_log().rows(slice(0, 60)))


# ---------------------------------------------------------------- preparation


def test_the_default_changes_nothing():
    data = dataset(80, truth={"a": np.zeros((80, 2))}, noise_std=np.ones(2))
    prepared = Preparation().apply(data)
    assert_equal(replace(prepared, metadata=data.metadata), data)
    assert prepared.metadata["preparation"]["rows"] == [80, 80]
    assert prepared.metadata["preparation"]["differentiate"] is None  # nothing was


def test_it_is_the_filter_the_differences_and_the_rows_that_it_says():
    data, _ = noisy(4.0)
    prepared = Preparation(cutoff=12.0, every=5, trim=0.1).apply(data)
    expected = differentiated(low_pass(data, 12.0, signals=("q", "u")), "q").rows(slice(50, -50, 5))
    for name in ("q", "v", "a", "u", "time"):
        np.testing.assert_array_equal(getattr(prepared, name), getattr(expected, name)[: len(prepared)])
    assert len(prepared) == len(expected) == prepared.metadata["preparation"]["rows"][1]
    assert prepared.metadata["preparation"]["sample_rate"] == pytest.approx([500.0, 100.0])
    assert prepared.metadata["preparation"]["differentiate"] == "q"
    assert prepared.metadata["preparation"]["cutoff"] == 12.0
    assert Preparation(every=2).apply(prepared).metadata["preparation"]["earlier"]["cutoff"] == 12.0


@pytest.mark.parametrize(
    ("cutoff", "late", "seed"), [(6.0, {"delay": 0.013}, 0), (20.0, {"delay": -0.0037}, 1), (80.0, {"lag": 0.02}, 2)]
)
def test_rows_depend_on_those_near_them_only(cutoff, late, seed):
    data, _ = noisy(4.0, seed)
    preparation = Preparation(cutoff=cutoff, **late)
    whole, late, lag = preparation.apply(data), abs(late.get("delay", 0.0)), late.get("lag", 0.0)
    slowest = 2.0 * np.pi * cutoff * np.sin(0.5 * np.pi / 4)  # pole of Butterworth's filter
    reach = round((late + 27.6 * (lag + 1.0 / slowest)) * RATE) + 24  # exp(-27.6) = 1e-12; splines and differences
    first, last = 900, 1100
    piece = preparation.apply(data.rows(slice(max(0, first - reach), last + reach)))
    inner = (piece.time >= data.time[first]) & (piece.time < data.time[last])
    same = (whole.time >= data.time[first]) & (whole.time < data.time[last])
    for name, scale in (("q", 1.0), ("v", RATE), ("a", RATE**2), ("u", 1.0)):
        assert np.abs(getattr(piece, name)[inner] - getattr(whole, name)[same]).max() < 1e-10 * scale


def test_a_delayed_torque_keeps_no_rows_without_one():
    data, _ = noisy(4.0)
    late, early = (Preparation(delay=seconds).apply(data) for seconds in (0.1, -0.05))
    assert (late.time[-1], early.time[0]) == (pytest.approx(data.time[-1] - 0.1), pytest.approx(0.05))
    np.testing.assert_allclose(late.u, data.u[50:][: len(late)], atol=1e-9)
    np.testing.assert_allclose(early.u, data.u[: len(early)], atol=1e-9)


def test_rows_that_no_longer_carry_the_motion_are_warned_of():
    data, _ = noisy(4.0)
    with pytest.warns(DataWarning, match=r"every 50. row is 10 Hz.*the filter passes 12 Hz"):
        Preparation(cutoff=12.0, every=50).apply(data)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"cutoff": -1.0}, "cutoff is -1.0; give a frequency > 0 in Hz"),
        ({"cutoff": "automatic"}, "cutoff is 'automatic'"), ({"delay": "soon"}, "delay is 'soon'; give seconds"),
        ({"lag": np.inf}, "lag is inf; give seconds"), ({"trim": -0.1}, "trim is -0.1; give seconds, at least 0"),
        ({"every": 0}, "`every=0` must be an integer of at least 1"), ({"trim": -1.0}, "trim is -1.0"),
        ({"differentiate": "u"}, "allowed: 'q' or 'v'"),
    ],
)  # fmt: skip
def test_wrong_settings_are_refused(wrong, message):
    with pytest.raises(InvalidInput, match=message):
        inspect.unwrap(Preparation)(**wrong)


def test_what_cannot_be_prepared_is_named():
    data, _ = noisy(4.0)
    with pytest.raises(DatasetError, match=r"episode 0 .*3\.998 s.* 2\.5 s"):
        Preparation(trim=2.5).apply(data)
