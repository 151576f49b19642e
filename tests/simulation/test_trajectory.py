import numpy as np
import pinocchio as pin
import pytest
import torch

from forcegp.simulation import KukaSurfaceConfig, trajectory
from forcegp.simulation.trajectory import ArmState, SegmentPath

MIDDLE = np.array([0.0, 0.5, 0.055])


def one_segment(length: float, duration: float, acceleration: float) -> SegmentPath:
    points = np.array([[1.0, 2.0, 3.0], [1.0, 2.0 + length, 3.0]])
    return SegmentPath(points, np.array([duration]), np.array([acceleration]))


def test_acceleration_cruise_and_braking_by_hand():
    # 1 s of 2 m/s^2, 3 s at 2 m/s, 1 s of braking: 1 + 6 + 1 = 8 m
    position, velocity, acceleration = one_segment(8.0, 5.0, 2.0).sample(np.array([0.0, 0.5, 1.0, 2.5, 4.0, 4.5]))
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


def test_the_tilted_plane_falls_towards_positive_x_by_its_angle():
    config = KukaSurfaceConfig(surface="tilted")
    np.testing.assert_allclose(trajectory.slope_of(config), [-np.tan(np.deg2rad(10)), 0.0])
    xy = np.random.default_rng(1).uniform((-0.5, 0.4), (0.5, 0.6), (30, 2))
    points = np.column_stack([xy, MIDDLE[2] + (xy - MIDDLE[:2]) @ trajectory.slope_of(config)])
    np.testing.assert_allclose(trajectory.table_of(config).value(torch.from_numpy(points)), 0.0, atol=1e-13)


@pytest.mark.parametrize("kind", ["plane", "tilted"])
def test_velocity_and_acceleration_of_the_bent_path_are_derivatives(kind):
    config, start = KukaSurfaceConfig(surface=kind), np.array([0.1, 0.5, 0.3])
    flat = trajectory.random_path(config, start, 4.0, np.random.default_rng(3))

    def path(time: np.ndarray):
        return trajectory.over_table(config, flat.sample(time))

    expected = start + np.array([0.0, 0.0, (start - MIDDLE)[:2] @ trajectory.slope_of(config)])
    np.testing.assert_allclose(path(np.zeros(1))[0][0], expected, atol=1e-14)
    time, step = np.linspace(0, 4, 1001)[1:-1], 1e-6
    before, after = path(time - step), path(time + step)
    _, velocity, acceleration = path(time)
    np.testing.assert_allclose((after[0] - before[0]) / (2 * step), velocity, atol=1e-4)
    smooth = np.abs(after[2] - before[2]).max(axis=1) < 1e-3  # away from the jumps of acceleration
    assert smooth.mean() > 0.98
    np.testing.assert_allclose((after[1] - before[1])[smooth] / (2 * step), acceleration[smooth], atol=1e-4)


def turned(quaternion: np.ndarray) -> np.ndarray:
    return pin.Quaternion(quaternion).toRotationMatrix()


def test_the_law_is_the_published_one_with_the_pseudo_inverse():
    rng, orientation = np.random.default_rng(0), np.array([0.0, -1.0, 0.0, 0.0])
    posture, selected = np.deg2rad((85, 50, -10, -100, -170, -25, -100)), np.array([0, 1, 1, 0, 1, 0, 0.0])
    for _ in range(20):
        q, v, J, bias = rng.normal(size=7), rng.normal(size=7), rng.normal(size=(6, 7)), rng.normal(size=6)
        position, aim = rng.normal(size=3), tuple(rng.normal(size=(3, 3)))
        present = (values := rng.normal(size=4)) / np.linalg.norm(values)
        state = ArmState(q, v, np.eye(7), np.zeros(7), position, turned(present), J, bias)
        found = trajectory.joint_acceleration(KukaSurfaceConfig(), state, aim)

        velocity = J @ v
        task = np.concatenate(
            [
                aim[2] + 2 * 100 * (aim[1] - velocity[:3]) + 1e4 * (aim[0] - position),
                -2 * 100 * velocity[3:] + 1e4 * pin.log3(turned(orientation) @ turned(present).T),
            ]
        )
        inverse = np.linalg.pinv(J)
        null = (np.eye(7) - inverse @ J) @ (selected * (1e4 * (posture - q) - 100 * v))
        np.testing.assert_allclose(found, inverse @ (task - bias) + null, rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(J @ found + bias, task, rtol=1e-9, atol=1e-6)
