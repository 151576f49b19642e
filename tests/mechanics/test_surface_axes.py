"""The axes of a surface: a right-handed rotation, the shortest from the table's own, smooth, defined everywhere."""

import pytest
import torch
from tests.mechanics.systems import normal

from forcegp.mechanics import surface_axes
from forcegp.mechanics.surfaces import TURNED_OVER

STEP = 1e-6
NEAR_DOWN = [(0.0, 0.0, -2.0), (1e-9, 0.0, -1.0), (0.0, -1e-5, -1.0), (0.1, 0.2, -1.0)]


def normals(*shape: int) -> torch.Tensor:
    given = normal(*shape, 3)
    return given / given.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("batch", [(), (1,), (0,), (300,), (2, 3)], ids=str)
def test_columns_are_a_right_handed_rotation_whose_third_is_the_normal(batch):
    gradients = 0.3 * normal(*batch, 3)
    axes = surface_axes(gradients)
    assert axes.shape == (*batch, 3, 3)
    torch.testing.assert_close(axes.mT @ axes, torch.eye(3).double().expand_as(axes), rtol=0.0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(axes), torch.ones(batch).double(), rtol=0.0, atol=1e-14)
    unit = gradients / gradients.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(axes[..., 2], unit, rtol=0.0, atol=1e-14)


def test_on_a_table_the_tangents_are_x_and_y():
    assert torch.equal(surface_axes(torch.tensor([0.0, 0.0, 2.0]).double()), torch.eye(3).double())


def test_it_is_smooth_by_finite_differences():
    steps = STEP * torch.eye(3).double()[:, None]
    points = torch.cat([1.5 * normals(200), torch.tensor([(0.0, 0.0, 1.0), *NEAR_DOWN], dtype=torch.float64)])
    unit_z = points[:, 2] / points.norm(dim=-1)
    points = points[(unit_z - TURNED_OVER).abs() > 1e-3]  # where the axes start from -z instead of z
    numeric = (surface_axes(points + steps) - surface_axes(points - steps)).permute(1, 2, 3, 0) / (2.0 * STEP)
    exact = torch.func.vmap(torch.func.jacrev(surface_axes))(points)
    torch.testing.assert_close(exact, numeric, rtol=0.0, atol=1e-8)
    length = exact.square().sum((-3, -2, -1)).sqrt() * points.norm(dim=-1)
    assert float(length.max()) < 10.0  # nowhere does a small change of the normal turn the tangents by much
