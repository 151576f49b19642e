"""WindowedRows of a log: exact functionals of its acceleration, with independent noise."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tests.data.test_moving_bases import jumbled, tumbling

from forcegp.data import Dataset, Preparation
from forcegp.errors import DatasetError, DataWarning, InvalidInput
from forcegp.evidence import Windows
from forcegp.evidence.evidence import white_noise

HOWS = {
    "weak form on q": Windows(0.1, nodes=10),
    "weak form on v": Windows(0.1, nodes=10, signal="v", order=1),
    "narrow weak form on q": Windows(0.1, nodes=10, order=4),
}


def log(q, v, a, time, episode=None) -> Dataset:
    columns = [np.stack([x, 2.0 * x], axis=1) for x in (q, v, np.sin(q), a)]
    q, v, u, a = columns
    names = ("first", "second")
    return Dataset(q=q, v=v, u=u, a=a, time=time, joint_names=names, episode=episode)


def sine(time, episode=None, frequency=9.0) -> Dataset:
    w = frequency
    return log(np.sin(w * time), w * np.cos(w * time), -(w**2) * np.sin(w * time), time, episode)


def uneven(rows: int, seed: int, step: float = 0.002) -> np.ndarray:
    return np.cumsum(step * np.random.default_rng(seed).uniform(0.5, 1.5, rows))


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(list(HOWS.values())), st.integers(0, 5), st.integers(0, 10_000))
def test_polynomials_are_exact_on_uneven_steps(how, degree, seed):
    """q to the fifth degree, and acceleration_weights on the polynomial that is its second derivative."""
    time = uneven(170, seed)
    how = replace(how, nodes=20)
    coefficients = np.random.default_rng(seed + 1).normal(size=degree + 1)
    motion = np.polynomial.Polynomial(coefficients, domain=[0.0, time[-1]])
    dataset = log(motion(time), motion.deriv(1)(time), motion.deriv(2)(time), time)
    windows = how.windows(dataset)
    rows = round(0.1 / np.median(np.diff(time))) + 1
    inside = time[: len(windows) * rows].reshape(len(windows), -1)
    c = how.acceleration_weights(inside)
    expected = np.einsum("km,km->k", c, motion.deriv(2)(inside))
    scale = 1.0 + np.abs(dataset.a).max()
    np.testing.assert_allclose(windows.observed[:, 0] / scale, expected / scale, atol=1e-8)
    np.testing.assert_allclose(windows.weights.sum(axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize("how", HOWS.values(), ids=HOWS)
def test_the_observed_is_the_weighted_mean_of_the_acceleration(how):
    """Against an adaptive quadrature of phi times the true acceleration."""
    from scipy.integrate import quad

    dataset = sine(0.002 * np.arange(300))
    windows = how.windows(dataset)
    rows = round(0.1 / 0.002) + 1
    for k in range(len(windows)):
        begin, end = dataset.time[k * rows], dataset.time[(k + 1) * rows - 1]

        def phi(t, begin=begin, end=end):
            s = (2.0 * t - begin - end) / (end - begin)
            return (1.0 - s**2) ** how.order

        size = quad(phi, begin, end)[0]
        expected = quad(lambda t, phi=phi: -(9.0**2) * np.sin(9.0 * t) * phi(t), begin, end)[0] / size
        assert windows.observed[k, 0] == pytest.approx(expected, abs=1e-4)
        at_nodes = windows.weights[k] @ (-(9.0**2) * windows.nodes.q[k * 10 : (k + 1) * 10, 0])
        assert at_nodes == pytest.approx(expected, abs=1e-3)  # the acceleration is linear in q


def test_order_two_on_positions_is_the_parabola_of_least_squares():
    time = 0.002 * np.arange(51)
    weights = Windows(0.1).signal_weights(time[None])[0]
    parabola = np.linalg.pinv(np.vander(time - time.mean(), 3))[0] * 2.0
    # exactness to the fifth degree costs a little noise beyond the second
    assert np.linalg.norm(parabola) <= np.linalg.norm(weights) < 1.05 * np.linalg.norm(parabola)
    np.testing.assert_allclose(weights[1:-1], parabola[1:-1], atol=0.12 * np.abs(parabola).max())


@pytest.mark.parametrize("how", HOWS.values(), ids=HOWS)
def test_noise_of_windows_is_independent_and_of_the_stated_size(how):
    time = 0.002 * np.arange(51 * 3000)
    generator, std = np.random.default_rng(0), 1e-3
    noise = std * generator.normal(size=(2, len(time)))
    dataset = log(noise[0], noise[1], 0.0 * time, time)
    np.testing.assert_allclose(white_noise(dataset, how.signal), [std, 2.0 * std], rtol=0.02)
    windows = how.windows(dataset)
    y, stated = windows.observed, windows.nodes.noise_std[:: how.nodes]
    np.testing.assert_allclose(y.std(axis=0) / stated[0], 1.0, rtol=0.05)
    follow = np.corrcoef(y[:-1, 0], y[1:, 0])[0, 1]
    assert abs(follow) < 5.0 / np.sqrt(len(y))


def test_windows_lie_far_apart_and_inside_one_episode_without_gaps():
    time = 0.002 * np.arange(600)
    time[250:] += 0.5
    episode = np.repeat([0, 1], [400, 200])
    dataset = sine(time, episode)
    how = Windows(0.1, nodes=5)
    every, few = how.windows(dataset), how.windows(dataset, 4)
    assert len(every) == 7 - 1 + 3  # one of the first episode spans the gap
    assert len(few) == 4
    assert set(few.nodes.time) <= set(every.nodes.time)
    at = few.nodes.time.reshape(4, 5)
    assert (np.diff(at, axis=1) > 0).all()
    assert (np.ptp(at, axis=1) < 0.1).all()
    assert not few.nodes.time_ordered
    assert few.nodes.metadata["windows"]["name"] == "windows"
    spread = few.nodes.q[:, 0].reshape(4, 5).mean(axis=1)
    assert np.ptp(spread) > 1.2  # of the range from -1 to 1


def test_one_node_for_every_row_keeps_the_rows():
    dataset = sine(0.002 * np.arange(102))
    windows = Windows(0.1, nodes=51).windows(dataset)
    np.testing.assert_allclose(windows.nodes.q, dataset.q, atol=1e-12)
    np.testing.assert_allclose(windows.nodes.u, dataset.u, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Windows(0.0), "seconds is 0.0; it must be positive"),
        (lambda: Windows(0.1, nodes=0), "`nodes=0` must be an integer of at least 1"),
        (lambda: Windows(order=1), "`order=1` must be an integer from 2"),
        (lambda: Windows(order=17), "`order=17` must be an integer from 2 to 16, of windows of q"),
        (lambda: Windows(order=True), "`order=True`"),
        (lambda: Windows(nodes=True), "`nodes=True`"),
        (lambda: Windows(nodes=2.0), "`nodes=2.0`"),
        (lambda: Windows(signal="a"), "signal is 'a'; allowed: 'q'"),
        (lambda: Windows(0.01).windows(sine(0.002 * np.arange(100))), "has 6 rows at steps of 0.002 s; at least 8"),
        (lambda: Windows(0.02).windows(sine(0.002 * np.arange(100)), 99), "points=99` must be an integer from 2 to 9"),
        (lambda: Windows(0.1, nodes=60).windows(sine(0.002 * np.arange(100))), "60 nodes for windows of 51 rows"),
    ],
)
def test_arguments_out_of_range_say_what_is_allowed(make, message):
    with pytest.raises(InvalidInput, match=message):
        make()


def test_bounds_themselves_are_allowed():
    assert Windows(order=2).order == 2
    assert Windows(order=16, nodes=1).order == 16
    assert Windows(signal="v", order=1).order == 1
    log = sine(0.002 * np.arange(100))
    assert len(Windows(0.014, nodes=2).windows(log).nodes.q) > 0  # 8 rows


def test_logs_that_cannot_be_cut_into_windows_are_refused():
    with pytest.raises(DatasetError, match=r"no episode has 5 s without a gap"):
        Windows(5.0).windows(sine(0.002 * np.arange(100)))
    with pytest.raises(DatasetError, match=r"not in order of time"):
        Windows(0.1).windows(sine(0.002 * np.arange(100)).rows([3, 2, 1]))
    time = 0.002 * np.arange(100)
    wrapped = sine(time)
    with pytest.raises(DatasetError, match="the angle wraps"):
        Windows(0.1).windows(replace(wrapped, q=np.where(time[:, None] > 0.1, wrapped.q - 2 * np.pi, wrapped.q)))


def test_a_filtered_log_is_warned_of():
    filtered = Preparation(cutoff=20.0).apply(sine(0.002 * np.arange(1000)))
    with pytest.warns(DataWarning, match="was filtered at 20 Hz"):
        Windows(0.1).windows(filtered)
    kept = Preparation(trim=0.1).apply(sine(0.002 * np.arange(1000)))
    assert len(Windows(0.1).windows(kept)) == 17


def test_windows_of_positions_show_a_tumbling_base_as_windows_of_its_velocity_do():
    """y of q is that of v, whose weights are exact for any path; a turned world changes nothing."""
    log = tumbling()
    speeds, seen = (Windows(0.1, signal=signal).windows(log) for signal in ("v", "q"))
    np.testing.assert_allclose(seen.observed, speeds.observed, atol=1e-4)
    turned = Windows(0.1).windows(tumbling(world=Rotation.from_rotvec([0.3, -1.2, 0.7]), shift=(4.0, -2.0, 1.0)))
    np.testing.assert_allclose(turned.observed, seen.observed, atol=1e-8)
    signs = Windows(0.1).windows(jumbled(log))
    np.testing.assert_allclose(signs.observed, seen.observed, atol=1e-9)
    space, nodes = log.model.robot.space, seen.nodes
    nearest = log.q[np.abs(log.time[:, None] - nodes.time).argmin(axis=0)]
    away = space.difference(torch.tensor(nearest), torch.tensor(nodes.q)).numpy()
    assert np.abs(away).max() < np.abs(log.v).max() / 240.0  # positions of nodes are those of their times


def test_no_window_holds_a_contact_that_is_switched():
    log = tumbling()  # its foot is held during half of every second
    windows = Windows(0.1).windows(log)
    assert set(np.unique(windows.nodes.u[:, 3])) == {0.0, 1.0}
    free = Windows(0.1).windows(replace(log, u=np.column_stack([log.u[:, :3], np.ones(len(log))])))
    assert len(windows) < len(free)
    with pytest.raises(DatasetError, match="or a contact that is switched"):
        Windows(0.6).windows(log)


def test_noise_of_windows_of_a_moving_base_is_of_the_stated_size():
    log, how, std = tumbling(), Windows(0.1), 1e-4
    space, generator, found = log.model.robot.space, np.random.default_rng(0), []
    for _ in range(20):
        moved = space.integrate(torch.tensor(log.q), torch.tensor(std * generator.normal(size=log.v.shape)))
        windows = how.windows(replace(log, q=moved.numpy()))
        found.append(windows.observed)
    stated = windows.nodes.noise_std[:: how.nodes].mean(axis=0)
    np.testing.assert_allclose(np.std(found, axis=0).mean(axis=0) / stated, 1.0, atol=0.1)
