"""Contacts: a point of the robot held on a surface, and Baumgarte's stabilisation of the constraint."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.mechanics.state import State
from forcegp.mechanics.surfaces import Surface
from forcegp.robots import Kinematics


@dataclass(frozen=True)
class Baumgarte:
    """Stabilisation of c(q) = 0: c'' = -2 zeta omega c' - omega^2 c (Baumgarte 1972), omega in rad/s."""

    omega: float
    zeta: float = 1.0

    def __post_init__(self) -> None:
        for name in ("omega", "zeta"):
            value = getattr(self, name)
            if not (isinstance(value, int | float) and 0 <= value < 1e15):  # its square must not overflow
                raise InvalidInput(f"Baumgarte {name} is {value!r}; it must be a finite number >= 0 (and < 1e15).")


@dataclass(frozen=True)
class Contact:
    """A point of the robot stays on a surface: one bilateral constraint s(p(q)) = 0.

    `point` is given in m in the axes of the link frame `frame`.
    """

    frame: str
    point: tuple[float, float, float]
    surface: Surface

    def __post_init__(self) -> None:
        if not isinstance(self.frame, str):
            raise InvalidInput(f"Contact frame is {self.frame!r}; give the name of a link.")
        if not isinstance(self.surface, Surface):
            raise InvalidInput(
                f"Contact surface is a {type(self.surface).__name__}; give a Plane, Sphere, Cylinder, "
                "ImplicitSurface ..."
            )
        try:
            point = () if isinstance(self.point, str) else tuple(float(entry) for entry in self.point)
        except (TypeError, ValueError):
            point = ()
        if len(point) != 3 or not all(math.isfinite(entry) for entry in point):
            raise InvalidInput(
                f"Contact point is {self.point!r}; give three finite numbers x, y, z in m, in frame {self.frame!r}."
            )
        object.__setattr__(self, "point", point)

    def position(self, kinematics: Kinematics) -> Float[Tensor, "*batch 3"]:
        """World position p(q) of the contact point (..., 3) in m."""
        pose = kinematics.frame_pose(self.frame)
        local = torch.tensor(self.point, dtype=pose.dtype, device=pose.device)
        return pose[..., :3, :3] @ local + pose[..., :3, 3]

    def distance(self, kinematics: Kinematics) -> Float[Tensor, "*batch"]:
        """c(q) = s(p(q)): 0 where the constraint holds."""
        return self.surface.value(self.position(kinematics))

    def constraint(
        self, state: State, baumgarte: Baumgarte | None
    ) -> tuple[Float[Tensor, "*batch nv"], Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """One row of A (..., nv), one entry of b (...), and the surface gradient s_p (..., 3), with A a = b.

        A = s_p J_p and b = -(s_p Jdot_p v + (J_p v)^T s_pp (J_p v)) - 2 zeta omega A v - omega^2 s: the second time
        derivative of s(p(q)) = 0 (Rath et al. 2021, section 2).
        """
        kinematics = state.kinematics
        p = self.position(kinematics)
        J = kinematics.frame_jacobian(self.frame, self.point)[..., :3, :]
        bias_acceleration = kinematics.frame_bias_acceleration(self.frame, self.point)[..., :3]
        gradient = self.surface.gradient(p)
        A = (gradient[..., None, :] @ J)[..., 0, :]
        velocity = (J @ state.v[..., None])[..., 0]
        curvature = (velocity[..., None, :] @ self.surface.hessian(p) @ velocity[..., None])[..., 0, 0]
        b = -((gradient * bias_acceleration).sum(-1) + curvature)
        if baumgarte is not None:
            rate = (gradient * velocity).sum(-1)
            b = b - 2.0 * baumgarte.zeta * baumgarte.omega * rate - baumgarte.omega**2 * self.surface.value(p)
        return A, b, gradient
