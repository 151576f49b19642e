import numpy as np
import pytest
import torch

from forcegp.simulation import KukaSurfaceConfig
from forcegp.simulation.trajectory import over_table, random_path, table_of

KINDS = ("plane", "tilted", "sphere")
MIDDLE = np.array([0.0, 0.5, 0.055])


@pytest.mark.parametrize("kind", KINDS)
def test_distance_normal_and_curvature_are_those_of_the_datasets_surface(kind):
    table = table_of(KukaSurfaceConfig(surface=kind))
    surface = table.surface()
    rng = np.random.default_rng(0)
    for p, velocity in zip(MIDDLE + 0.3 * rng.normal(size=(20, 3)), rng.normal(size=(20, 3)), strict=True):
        point, moving = torch.tensor(p), torch.tensor(velocity)
        assert table.distance(p) == pytest.approx(float(surface.value(point)), abs=1e-13)
        np.testing.assert_allclose(table.normal(p), surface.gradient(point), atol=1e-13)
        assert table.curvature(p, velocity) == pytest.approx(float(moving @ surface.hessian(point) @ moving), abs=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_heights_lie_on_the_surface_through_its_middle(kind):
    table = table_of(KukaSurfaceConfig(surface=kind))
    xy = np.random.default_rng(1).uniform((-0.5, 0.4), (0.5, 0.6), (30, 2))
    height, _, _ = table.height(xy)
    for x, z in zip(xy, height, strict=True):
        assert table.distance(np.append(x, MIDDLE[2] + z)) == pytest.approx(0.0, abs=1e-13)
    assert table.height(MIDDLE[None, :2])[0] == pytest.approx(0.0, abs=1e-15)


def test_the_tilted_plane_falls_towards_positive_x_by_its_angle():
    height, _, _ = table_of(KukaSurfaceConfig(surface="tilted")).height(np.array([[1.0, 0.5]]))
    assert height[0] == pytest.approx(-np.tan(np.deg2rad(10)))


@pytest.mark.parametrize("kind", KINDS)
def test_velocity_and_acceleration_of_the_bent_path_are_derivatives(kind):
    config = KukaSurfaceConfig(surface=kind)
    start = np.array([0.1, 0.5, 0.3])
    table, flat = table_of(config), random_path(config, start, 4.0, np.random.default_rng(3))

    def path(time: np.ndarray):
        return over_table(table, flat.sample(time))

    np.testing.assert_allclose(path(np.zeros(1))[0][0, :2], start[:2], atol=1e-14)
    time, step = np.linspace(0, 4, 1001)[1:-1], 1e-6
    before, after = path(time - step), path(time + step)
    _, velocity, acceleration = path(time)
    np.testing.assert_allclose((after[0] - before[0]) / (2 * step), velocity, atol=1e-4)
    smooth = np.abs(after[2] - before[2]).max(axis=1) < 1e-3  # away from the jumps of acceleration
    assert smooth.mean() > 0.98
    np.testing.assert_allclose((after[1] - before[1])[smooth] / (2 * step), acceleration[smooth], atol=1e-4)
