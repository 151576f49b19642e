import math

import pytest
import torch
from tests.mechanics.surface_conformance import SurfaceConformance
from tests.mechanics.systems import normal

from forcegp.errors import ContactError, FileFormatError, InvalidInput
from forcegp.mechanics import ImplicitSurface, Plane, Sphere, Surface, surface_axes
from forcegp.mechanics.surfaces import TURNED_OVER, surface_from_dict


class TestPlane(SurfaceConformance):
    surface = Plane((0.0, 0.0, 1.0), 0.055)


class TestSkewPlane(SurfaceConformance):
    surface = Plane((1.0, -2.0, 0.3), -0.4)


class TestSphere(SurfaceConformance):
    surface = Sphere((0.3, -0.2, 0.5), 0.7)


class TestWavyFloor(SurfaceConformance):
    surface = ImplicitSurface(lambda p: p[2] - 0.1 * torch.sin(3.0 * p[0]) * torch.cos(2.0 * p[1]))
    storable, signed_distance = False, False


class TestQuadric(SurfaceConformance):
    """An ellipsoid that is no signed distance, and whose gradient vanishes at the centre."""

    surface = ImplicitSurface(lambda p: (p.square() * torch.tensor([1.0, 2.0, 4.0]).double()).sum() - 1.0)
    storable, signed_distance = False, False


class Paraboloid(Surface):
    """A surface of the user: only `value`, no dataclass, nothing registered."""

    def value(self, p):
        return p[..., 2] - p[..., 0] ** 2 - 0.5 * p[..., 1] ** 2


class TestSubclassWithValueOnly(SurfaceConformance):
    surface, storable, signed_distance = Paraboloid(), False, False


# ---------------------------------------------------------------- what they mean


def test_signs_and_distances():
    p = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 0.5]], dtype=torch.float64)
    for surface, expected in ((Plane((0, 0, 2), 2), [2.0, -0.5]), (Sphere((0, 0, 0), 1), [2.0, -0.5])):
        torch.testing.assert_close(surface.value(p), torch.tensor(expected, dtype=torch.float64))
        torch.testing.assert_close(surface.gradient(p), torch.tensor([[0.0, 0.0, 1.0]] * 2, dtype=torch.float64))


def test_directions_need_not_be_unit_vectors():
    assert Plane((0, 0, 4), 2) == Plane((0, 0, 1), 0.5)
    assert Plane((0, 0, -1), 0.5) != Plane((0, 0, 1), -0.5)  # the other side is positive


# ---------------------------------------------------------------- what they refuse


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Plane((0, 0, 0), 1), r"Plane normal is \(0, 0, 0\); give a direction"),
        (lambda: Plane((1.7e308, 1.7e308, 0), 1), "give a direction"),
        (lambda: Plane((0, 0), 1), "Plane normal is .* 3 finite numbers"),
        (lambda: Plane((0, 0, math.nan), 1), r"Plane normal is \(0, 0, nan\); give 3 finite numbers"),
        (lambda: Plane((0, 0, 1), math.inf), "Plane offset is inf"),
        (lambda: Plane((0, 0, 1), None), "Plane offset is None; give a number"),
        (lambda: Plane("001", 1.0), "Plane normal is '001'"),
        (lambda: Plane((0, 0, 1), "1"), "Plane offset is '1'"),
        (lambda: Sphere((0, 0, 0), 0.0), "Sphere radius is 0.0; it must be positive"),
        (lambda: Sphere((0, 0, 0), -1.0), "Sphere radius is -1.0"),
        (lambda: Sphere(3.0, 1.0), "Sphere center is 3.0; give 3 finite numbers"),
        (lambda: ImplicitSurface(3.0), "ImplicitSurface function is 3.0"),
    ],
)
def test_wrong_numbers_are_named(make, message):
    with pytest.raises(InvalidInput, match=message):
        make()


@pytest.mark.parametrize("function", [lambda p: p, lambda p: p[:1], lambda p: 3.0], ids=["vector", "entry", "number"])
@pytest.mark.parametrize("batch", [(), (2,)], ids=str)
@pytest.mark.parametrize("what", ["value", "gradient", "hessian"])
def test_a_function_must_return_a_scalar_tensor(function, batch, what):
    with pytest.raises(ContactError, match="return a scalar tensor"):
        getattr(ImplicitSurface(function), what)(torch.ones(*batch, 3, dtype=torch.float64))


@pytest.mark.parametrize(
    "stored",
    [
        {"type": "torus", "radius": 1.0}, {"type": ["plane"]}, {"normal": [0, 0, 1], "offset": 0.0},
        {"type": "plane", "normal": [0, 0, 1]},
        {"type": "plane", "normal": [0, 0, 1], "offset": 0.0, "color": "red"}, "plane", None, [["type", "plane"]],
    ],
    ids=str,
)  # fmt: skip
def test_damaged_surfaces_are_refused(stored):
    with pytest.raises(FileFormatError, match="surface"):
        surface_from_dict(stored)


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
    torch.testing.assert_close(axes[..., 2], gradients / gradients.norm(dim=-1, keepdim=True), rtol=0.0, atol=1e-14)


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
