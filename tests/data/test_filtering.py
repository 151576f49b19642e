import inspect

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.data.samples import arrays, dataset, model

from forcegp.data import Dataset, LowPass, differentiate, differentiated, lagged, low_pass, resample, uniform_step
from forcegp.errors import DatasetError, InvalidInput

RATE = 1000.0
TIME = np.arange(2000) / RATE
INNER = slice(500, 1500)  # away from the transients of the ends


def motion(time: np.ndarray = TIME, **changes: object) -> Dataset:
    """q = (sin 10 t, t^2), with exact derivatives."""
    fields = {
        "q": np.stack([np.sin(10 * time), time**2], 1), "v": np.stack([10 * np.cos(10 * time), 2 * time], 1),
        "a": np.stack([-100 * np.sin(10 * time), np.full_like(time, 2)], 1),
        "u": np.stack([np.cos(time), np.sin(time)], 1), "time": time, "model": model("continuous"), **changes,
    }  # fmt: skip
    return Dataset(**fields)


# ---------------------------------------------------------------- low-pass


LAG = 0.02


@pytest.mark.parametrize(
    ("smooth", "gain", "accuracy"),
    [
        (LowPass(20.0), lambda f: LowPass(20.0).gain(np.array([f]), RATE)[0], 2e-6),
        (lambda values, time: lagged(values, time, LAG), lambda f: 1.0 / (1.0 + 2j * np.pi * f * LAG), 2e-3),
    ],
)
@pytest.mark.parametrize("frequency", [5.0, 40.0])
def test_a_sine_comes_out_with_the_gain_of_the_filter(smooth, gain, accuracy, frequency):
    wave = np.exp(2j * np.pi * frequency * TIME)
    real, imaginary = (smooth(x[:, None], TIME)[:, 0] for x in (wave.real, wave.imag))
    np.testing.assert_allclose(((real + 1j * imaginary) / wave)[INNER], gain(frequency), atol=accuracy)


def test_the_memory_of_noise_is_where_its_autocorrelation_is_one_half():
    """By the theorem of Wiener and Khinchin, from the gain."""
    rate = 1000.0
    correlation = np.fft.irfft(LowPass(2.0).gain(np.linspace(0.0, 0.5 * rate, 2**15 + 1), rate) ** 2)
    at = np.interp(LowPass(2.0).memory * rate, np.arange(400), correlation[:400] / correlation[0])
    assert at == pytest.approx(0.5, abs=1e-4)


@pytest.mark.parametrize("cutoff", [50.0, 0.0, np.nan])
def test_a_cutoff_beyond_half_the_sample_rate_is_refused(cutoff):
    with pytest.raises(InvalidInput, match=r"below 50 Hz, half the sample rate"):
        LowPass(cutoff)(np.zeros((100, 1)), np.arange(100) / 100.0)


def test_episodes_are_filtered_apart():
    data = dataset(80)
    filtered = low_pass(data, 20.0)
    for number in (0, 1):
        alone = low_pass(data.select_episodes([number]), 20.0)
        for name in ("q", "v", "u", "a"):
            np.testing.assert_array_equal(getattr(alone, name), getattr(filtered.select_episodes([number]), name))


def test_only_the_named_signals_change_and_the_noise_of_a_is_then_unknown():
    data = dataset(80, noise_std=np.ones(2), truth={"a": np.zeros((80, 2))})
    kept = {name: values.copy() for name, values in arrays(data).items()}
    filtered = low_pass(data, 20.0, signals=("v", "u"))
    np.testing.assert_array_equal(filtered.q, data.q)
    np.testing.assert_array_equal(filtered.a, data.a)
    assert np.abs(filtered.v - data.v).max() > 0.1
    np.testing.assert_array_equal(filtered.noise_std, data.noise_std)
    assert low_pass(data, 20.0, signals=("a",)).noise_std is None
    for name, values in arrays(data).items():
        np.testing.assert_array_equal(values, kept[name])


def test_truth_goes_where_the_rows_it_belongs_to_change():
    data = dataset(80, truth={"a": np.zeros((80, 2))})
    for signal in ("q", "v", "u"):
        assert low_pass(data, 20.0, signals=(signal,)).truth == {}
    assert differentiated(data, "q").truth == {}
    for kept in (low_pass(data, 20.0, signals=("a",)), differentiated(data, "v")):
        np.testing.assert_array_equal(kept.truth["a"], data.truth["a"])


def test_what_cannot_be_filtered_is_named():
    data = dataset(80)
    with pytest.raises(InvalidInput, match="below 50"):
        low_pass(data, 51.0)
    with pytest.raises(InvalidInput, match="allowed: one or more of q, v, u, a"):
        low_pass(data, 10.0, signals=())
    with pytest.raises(InvalidInput, match="allowed: one or more"):
        inspect.unwrap(low_pass)(data, 10.0, signals=("time",))
    with pytest.raises(DatasetError, match="episode 1: 12 rows are too few"):
        low_pass(data.rows(slice(0, 52)), 10.0)
    with pytest.raises(DatasetError, match="not in order of time"):
        low_pass(data.rows([3, 1]), 10.0)
    with pytest.raises(DatasetError, match=r"episode 0: .*row 9 .*Resample"):
        low_pass(data.rows(np.delete(np.arange(80), 10)), 10.0)


def test_an_angle_that_wraps_is_refused():
    time = np.arange(100) / 100
    turning = motion(time, q=np.stack([(7 * time + np.pi) % (2 * np.pi) - np.pi, time], 1))
    with pytest.raises(DatasetError, match=r"episode 0: q of joint 'shoulder' .*row 44.*unwrap"):
        low_pass(turning, 10.0)
    with pytest.raises(DatasetError, match="wraps"):
        differentiated(turning, "q")
    with pytest.raises(DatasetError, match="wraps"):
        resample(turning, 0.02)
    low_pass(turning, 10.0, signals=("v",))


# ---------------------------------------------------------------- differentiation


@given(st.lists(st.floats(0.001, 1.0), min_size=2, max_size=20), st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_a_parabola_is_differentiated_exactly_whatever_the_steps(steps, coefficients):
    time = np.concatenate([[0.0], np.cumsum(steps)])
    c, b, a = coefficients
    values = (a * time**2 + b * time + c)[:, None]
    np.testing.assert_allclose(differentiate(values, time)[:, 0], 2 * a * time + b, atol=1e-8)


# ---------------------------------------------------------------- sampling


def test_uniform_step():
    assert uniform_step(TIME) == pytest.approx(1 / RATE)
    jitter = 1e-3 * np.random.default_rng(0).uniform(-1, 1, len(TIME)) / RATE
    assert uniform_step(TIME + jitter) == pytest.approx(1 / RATE, rel=1e-5)
    with pytest.raises(DatasetError, match="this recording is not sampled uniformly"):
        uniform_step(np.array([0.0, 1.0, 2.0, 3.1]))
    late = np.array([0.0, 0.01, 0.02, 0.03, 0.0402])  # the last step is 2 % longer
    with pytest.raises(DatasetError, match="step after row 3"):
        uniform_step(late)
    assert uniform_step(np.array([0.0, 0.5])) == 0.5
    with pytest.raises(DatasetError, match="at least 2"):
        uniform_step(np.zeros(1))
