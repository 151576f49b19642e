import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from forcegp.simulation import KukaSurfaceConfig
from forcegp.simulation.trajectory import SegmentPath, random_path

START = np.array([0.0, 0.5, 0.1])


def one_segment(length: float, duration: float, acceleration: float) -> SegmentPath:
    points = np.array([[1.0, 2.0, 3.0], [1.0, 2.0 + length, 3.0]])
    return SegmentPath(points, np.array([duration]), np.array([acceleration]))


def test_acceleration_cruise_and_braking_by_hand():
    # 1 s of 2 m/s^2, 3 s at 2 m/s, 1 s of braking: 1 + 6 + 1 = 8 m
    path = one_segment(8.0, 5.0, 2.0)
    position, velocity, acceleration = path.sample(np.array([0.0, 0.5, 1.0, 2.5, 4.0, 4.5]))
    np.testing.assert_allclose(position[:, 1], [2.0, 2.25, 3.0, 6.0, 9.0, 9.75], atol=1e-12)
    np.testing.assert_allclose(velocity[:, 1], [0.0, 1.0, 2.0, 2.0, 2.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(acceleration[:, 1], [2.0, 2.0, 0.0, 0.0, -2.0, -2.0], atol=1e-12)
    assert np.ptp(position[:, [0, 2]], axis=0).max() == 0


def test_it_rests_before_after_and_on_a_segment_without_length():
    path = one_segment(0.0, 1.0, 0.5)
    for values, expected in zip(path.sample(np.array([-1.0, 0.0, 0.5, 2.0])), (path.points[0], 0.0, 0.0), strict=True):
        np.testing.assert_array_equal(values, np.broadcast_to(expected, (4, 3)))
    position, velocity, acceleration = one_segment(1.0, 1.0, 4.0).sample(np.array([-0.1, 1.0, 1.1]))
    np.testing.assert_allclose(position[:, 1], [2.0, 3.0, 3.0])
    assert not velocity.any()
    assert not acceleration.any()


@given(st.integers(0, 1000))
def test_velocity_is_the_derivative_of_position_and_acceleration_of_velocity(seed):
    path = random_path(KukaSurfaceConfig(), START, 4.0, np.random.default_rng(seed))
    time = np.linspace(0, 4, 4001)[1:-1]
    step = 1e-7
    before, after = path.sample(time - step), path.sample(time + step)
    _, velocity, acceleration = path.sample(time)
    np.testing.assert_allclose((after[0] - before[0]) / (2 * step), velocity, atol=1e-5)
    smooth = (before[2] == after[2]).all(axis=1)  # away from the jumps of acceleration
    assert smooth.mean() > 0.99
    np.testing.assert_allclose((after[1] - before[1])[smooth] / (2 * step), acceleration[smooth], atol=1e-5)


def test_way_points_are_reached_at_rest_below_the_surface_within_their_ranges():
    config = KukaSurfaceConfig()
    path = random_path(config, START, 60.0, np.random.default_rng(0))
    corners = path.points[1:]
    position, velocity, _ = path.sample(np.cumsum(path.durations))
    np.testing.assert_allclose(position, corners, atol=1e-12)
    np.testing.assert_allclose(velocity, 0.0, atol=1e-12)
    assert path.durations.sum() >= 60.0
    assert (path.durations >= 0.5).all()
    assert (path.durations <= 1.0).all()
    for column, (lower, upper) in enumerate([config.waypoint_x, config.waypoint_y]):
        assert lower <= corners[:, column].min() < lower + 0.1 * (upper - lower)
        assert upper >= corners[:, column].max() > upper - 0.1 * (upper - lower)
    np.testing.assert_allclose(corners[:, 2], 0.055 - 1e-4)


def test_accelerations_are_the_published_rule():
    path = random_path(KukaSurfaceConfig(), START, 30.0, np.random.default_rng(1))
    for start, end, duration, acceleration in zip(
        path.points, path.points[1:], path.durations, path.accelerations, strict=False
    ):
        assert acceleration == pytest.approx(max(0.5, 4 * np.linalg.norm(end - start) / duration**2))
