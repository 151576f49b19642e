"""What every surface must do. A new surface is tested by one subclass whose name begins with `Test`:

class TestTorus(SurfaceConformance):
    surface = Torus(...)
"""

import json

import pytest
import torch

from forcegp.errors import ContactError
from forcegp.mechanics import Surface
from forcegp.mechanics.surfaces import surface_from_dict, surface_to_dict

BATCHES = [(), (1,), (0,), (4,), (2, 3), (3, 0, 2)]


def assert_rounded(given: torch.Tensor, expected: torch.Tensor) -> None:
    """Equal but for rounding: an entry is the result of less than 50 additions and products of numbers of its size."""
    # Vector instructions differ with processor, layout and batch shape: no bit is promised across them
    scale = max(1.0, float(expected.abs().max())) if expected.numel() else 1.0
    torch.testing.assert_close(given, expected, rtol=0.0, atol=50.0 * torch.finfo(torch.float64).eps * scale)


class SurfaceConformance:
    """Value, gradient, Hessian, batches, transforms and storage of `surface`."""

    surface: Surface
    storable = True  # False for surfaces that hold code
    signed_distance = True  # |s_p| = 1 everywhere

    def points(self, *batch: int) -> torch.Tensor:
        """Points at which the surface is smooth; override where random ones within 1 m of the origin are not."""
        return torch.randn(*batch, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    @pytest.mark.parametrize("batch", BATCHES, ids=str)
    def test_batch_dimensions_are_arbitrary(self, batch):
        p, shapes = self.points(*batch), {"value": (), "gradient": (3,), "hessian": (3, 3)}
        for name, trailing in shapes.items():
            function = getattr(self.surface, name)
            result = function(p)
            assert result.shape == (*batch, *trailing)
            assert result.dtype == torch.float64
            one_by_one = [function(point) for point in p.reshape(-1, 3)]
            if one_by_one:
                assert_rounded(result.reshape(-1, *trailing), torch.stack(one_by_one))

    def test_gradient_and_hessian_against_autograd(self):
        for point in self.points(10):
            gradient = torch.autograd.functional.jacobian(self.surface.value, point)
            torch.testing.assert_close(self.surface.gradient(point), gradient, rtol=1e-12, atol=1e-12)
            hessian = torch.autograd.functional.hessian(self.surface.value, point)
            torch.testing.assert_close(self.surface.hessian(point), hessian, rtol=1e-12, atol=1e-12)

    def test_everything_is_differentiable_in_the_points(self):
        for name in ("value", "gradient", "hessian"):
            assert torch.autograd.gradcheck(getattr(self.surface, name), (self.points(2).requires_grad_(),)), name

    def test_a_signed_distance_has_unit_normals(self):
        p = self.points(20)
        normal = self.surface.gradient(p)
        assert bool(((normal.norm(dim=-1) - 1.0).abs() < 1e-12).all()) == self.signed_distance
        if self.signed_distance:
            assert float((self.surface.hessian(p) @ normal[..., None]).abs().max()) < 1e-12
            assert float(self.surface.value(p - self.surface.value(p)[:, None] * normal).abs().max()) < 1e-12

    def test_it_survives_a_file_exactly_or_says_that_it_cannot(self):
        if self.storable:
            again = surface_from_dict(json.loads(json.dumps(surface_to_dict(self.surface))))
            assert again == self.surface
            assert type(again) is type(self.surface)
            assert surface_to_dict(again) == surface_to_dict(self.surface)
        else:
            with pytest.raises(ContactError, match="cannot be stored: files carry numbers, never code"):
                surface_to_dict(self.surface)
