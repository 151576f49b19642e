"""What the tool slides on: distance, normal and curvature in numpy, and the height that way-points follow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

import forcegp.mechanics
from forcegp.simulation.kuka_surface_config import KukaSurfaceConfig


@dataclass(frozen=True, eq=False)
class FlatTable:
    """The plane through `middle` (3,) [m] with unit `upward` (3,), which is not horizontal."""

    upward: Float[np.ndarray, "3"]
    middle: Float[np.ndarray, "3"]

    @property
    def offset(self) -> float:
        """`n . p` on the plane [m]."""
        return float(self.upward @ self.middle)

    def distance(self, p: Float[np.ndarray, "3"]) -> float:
        """Signed distance of a point [m], positive above the table; its gradient is the normal."""
        return float(self.upward @ p - self.offset)

    def normal(self, p: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Outward unit normal."""
        return self.upward

    def curvature(self, p: Float[np.ndarray, "3"], velocity: Float[np.ndarray, "3"]) -> float:
        """`p'^T s_pp p'` [m/s^2], the part of the distance's second derivative that is due to curvature."""
        return 0.0

    def height(
        self, xy: Float[np.ndarray, "times 2"]
    ) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, "times 2"], Float[np.ndarray, "times 2 2"]]:
        """Height [m] above the surface's middle, its gradient and its Hessian [1/m] in x and y."""
        slope = -self.upward[:2] / self.upward[2]
        return (xy - self.middle[:2]) @ slope, np.broadcast_to(slope, xy.shape), np.zeros((len(xy), 2, 2))

    def surface(self) -> forcegp.mechanics.Surface:
        """The same for a `Contact`."""
        x, y, z = self.upward.tolist()
        return forcegp.mechanics.Plane((x, y, z), self.offset)


@dataclass(frozen=True, eq=False)
class SphericalTable:
    """The top of a sphere with `center` (3,) and `radius` [m]."""

    center: Float[np.ndarray, "3"]
    radius: float

    def distance(self, p: Float[np.ndarray, "3"]) -> float:
        """As of a plane."""
        return float(np.linalg.norm(p - self.center) - self.radius)

    def normal(self, p: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """As of a plane."""
        ray = p - self.center
        return ray / np.linalg.norm(ray)

    def curvature(self, p: Float[np.ndarray, "3"], velocity: Float[np.ndarray, "3"]) -> float:
        """`(|p'|^2 - (n . p')^2) / |p - center|`."""
        return float((velocity @ velocity - (self.normal(p) @ velocity) ** 2) / np.linalg.norm(p - self.center))

    def height(
        self, xy: Float[np.ndarray, "times 2"]
    ) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, "times 2"], Float[np.ndarray, "times 2 2"]]:
        """`h = sqrt(R^2 - r^2) - R`, `h_x = -r / (h + R)`, `h_xx = -(1 + h_x h_x^T) / (h + R)`."""
        ray = xy - self.center[:2]
        rise = np.sqrt(self.radius**2 - (ray**2).sum(axis=1))
        gradient = -ray / rise[:, None]
        hessian = -(np.eye(2) + gradient[:, :, None] * gradient[:, None, :]) / rise[:, None, None]
        return rise - self.radius, gradient, hessian

    def surface(self) -> forcegp.mechanics.Surface:
        """As of a plane."""
        x, y, z = self.center.tolist()
        return forcegp.mechanics.Sphere((x, y, z), self.radius)


Table = FlatTable | SphericalTable


def table_of(config: KukaSurfaceConfig) -> Table:
    """The table of a scenario; for `surface="none"` the plane that way-points keep above."""
    middle = np.array([np.mean(config.waypoint_x), np.mean(config.waypoint_y), config.surface_height])
    if config.surface == "sphere":
        return SphericalTable(middle - (0.0, 0.0, config.sphere_radius), config.sphere_radius)
    upward = np.array([0.0, 0.0, 1.0])
    if config.surface == "tilted":
        angle, (x, y) = np.deg2rad(config.tilt_degrees), np.array(config.tilt_axis) / np.hypot(*config.tilt_axis)
        # Rodrigues' formula for the vertical unit vector about the horizontal axis (x, y, 0).
        upward = np.array([y * np.sin(angle), -x * np.sin(angle), np.cos(angle)])
    return FlatTable(upward, middle)
