"""One kinematics pass over a batch of states, from which every dynamic and geometric quantity is read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.robots import algorithms
from forcegp.robots.tree import WORLD

if TYPE_CHECKING:
    from forcegp.robots.robot import Robot

Inertials = Mapping[str, Tensor]
Point = Tensor | Sequence[float]


@dataclass(frozen=True, eq=False)
class Kinematics:
    """Body poses, joint twists and accelerations of ``robot`` at states (q, v); made by ``robot.kinematics(q, v)``.

    All methods are differentiable in q, v and their arguments. ``inertials`` maps link names to log-Cholesky parameters
    (..., 10); links not named keep the inertia of the URDF. Batch dimensions broadcast.
    """

    robot: Robot
    q: Tensor  # (*batch, nv)
    v: Tensor | None  # (*batch, nv), or None: only what needs no velocity
    poses: Tensor  # (nv, *batch, 4, 4)
    twists: Tensor  # (nv, *batch, 3, 4)

    @classmethod
    def of(cls, robot: Robot, q: Tensor, v: Tensor | None) -> Kinematics:
        """Kinematics at checked and broadcast inputs."""
        poses = algorithms.body_poses(robot.tree, q)
        return cls(robot, q, v, poses, algorithms.joint_twists(robot.tree, poses))

    @property
    def batch_shape(self) -> torch.Size:
        """Leading dimensions of the states."""
        return self.q.shape[:-1]

    # ------------------------------------------------------------------ dynamics

    def mass_matrix(self, inertials: Inertials | None = None) -> Float[Tensor, "... nv nv"]:
        """Mass matrix M (..., nv, nv) in kg m^2 or kg, armature on the diagonal."""
        at, inertias = self._with_inertias(inertials)
        return at._mass_matrix(inertias)

    def bias_forces(self, inertials: Inertials | None = None) -> Float[Tensor, "... nv"]:
        """Coriolis, centrifugal and gravity forces (..., nv) in Nm or N: the tau that gives zero acceleration."""
        at, inertias = self._with_inertias(inertials)
        return at._forces(at._bias_accelerations, inertias)

    def mass_matrix_and_bias(
        self, inertials: Inertials | None = None
    ) -> tuple[Float[Tensor, "... nv nv"], Float[Tensor, "... nv"]]:
        """:meth:`mass_matrix` and :meth:`bias_forces` from the same inertias."""
        at, inertias = self._with_inertias(inertials)
        return at._mass_matrix(inertias), at._forces(at._bias_accelerations, inertias)

    def gravity_forces(self, inertials: Inertials | None = None) -> Float[Tensor, "... nv"]:
        """Joint forces (..., nv) in Nm or N that hold the robot still."""
        at, inertias = self._with_inertias(inertials)
        tree = self.robot.tree
        return algorithms.gravity_forces(tree, at.twists, algorithms.composite_inertias(tree, inertias))

    def inverse_dynamics(
        self, a: Float[Tensor, "*#batch nv"], inertials: Inertials | None = None
    ) -> Float[Tensor, "... nv"]:
        """Joint forces (..., nv) that give the accelerations ``a`` (..., nv): ``M a + bias``."""
        self.robot.check_input("a", a)
        self._require_velocity("inverse_dynamics")
        batch = broadcast_shapes(q=self.q, a=a)
        states = self._expand(batch)
        at, inertias = states._with_inertias(inertials)
        a = a.expand(*at.batch_shape, -1)
        tree = self.robot.tree
        force = at._forces(algorithms.body_accelerations(tree, at.twists, at.v, a), inertias)
        return force + tree.armature * a if tree.has_armature else force

    def forward_dynamics(
        self, tau: Float[Tensor, "*#batch nv"], inertials: Inertials | None = None
    ) -> Float[Tensor, "... nv"]:
        """Accelerations (..., nv) under the joint forces ``tau`` (..., nv): ``M^-1 (tau - bias)``."""
        self.robot.check_input("tau", tau)
        batch = broadcast_shapes(q=self.q, tau=tau)
        mass, bias = self._expand(batch).mass_matrix_and_bias(inertials)
        return algorithms.solve_mass_matrix(mass, tau - bias)

    # ------------------------------------------------------------------ frames

    def frame_pose(self, frame: str) -> Float[Tensor, "... 4 4"]:
        """Pose (..., 4, 4) of a link frame in the world, position in m."""
        body, offset = self.robot.frame(frame)
        if body == WORLD:
            return offset.expand(*self.batch_shape, 4, 4)
        return self.poses[body] @ offset

    def frame_jacobian(self, frame: str, point: Point | None = None) -> Float[Tensor, "... 6 nv"]:
        """Jacobian (..., 6, nv), rows [linear; angular] in world axes, of a ``point`` (..., 3) fixed in ``frame`` (m)."""
        body, position = self._world_point(frame, point)
        if body == WORLD:
            return torch.zeros(*position.shape[:-2], 6, self.robot.nv, dtype=self.q.dtype, device=self.q.device)
        linear = (self.twists @ position).squeeze(-1)
        # the angular velocity sits in [w]x at (2, 1), (0, 2), (1, 0)
        angular = self.twists.flatten(-2)[..., [9, 2, 4]].expand_as(linear)
        jacobian = torch.cat([linear, angular], dim=-1).movedim(0, -1)
        return jacobian * self.robot.tree.descendants[:, body]

    def frame_bias_acceleration(self, frame: str, point: Point | None = None) -> Float[Tensor, "... 6"]:
        """Classical acceleration (..., 6), [linear; angular], of a ``point`` fixed in ``frame`` at zero joint acceleration.

        This is ``Jdot v`` for :meth:`frame_jacobian`, in m/s^2 and rad/s^2, without gravity.
        """
        self._require_velocity("frame_bias_acceleration")
        body, position = self._world_point(frame, point)
        if body == WORLD:
            return torch.zeros(*position.shape[:-2], 6, dtype=self.q.dtype, device=self.q.device)
        acceleration = self._bias_accelerations[body]
        linear = (acceleration @ position).squeeze(-1)
        # A = [dw/dt]x + [w]x [w]x: the second is symmetric, so the angular part is the antisymmetric half
        entries = acceleration.flatten(-2)
        angular = 0.5 * (entries[..., [9, 2, 4]] - entries[..., [6, 8, 1]])
        return torch.cat([linear, angular.expand_as(linear)], dim=-1)

    # ------------------------------------------------------------------ inside

    @cached_property
    def _bias_accelerations(self) -> Tensor:
        self._require_velocity("bias_forces")
        return algorithms.body_accelerations(self.robot.tree, self.twists, self.v)

    def _require_velocity(self, what: str) -> None:
        if self.v is None:
            raise InvalidInput(f"{what} needs velocities; make the kinematics with robot.kinematics(q, v).")

    @cached_property
    def _nominal_inertias(self) -> Tensor:
        return algorithms.world_inertias(self.poses, self.robot.tree.inertias)

    def _with_inertias(self, inertials: Inertials | None) -> tuple[Kinematics, Tensor]:
        """These states broadcast against the batch of ``inertials``, and the bodies' pseudo-inertias in the world."""
        if not inertials:
            return self, self._nominal_inertias
        inertias = self.robot.body_inertias(inertials)
        if inertias.dim() == 3:
            return self, algorithms.world_inertias(self.poses, inertias)
        try:
            batch = torch.broadcast_shapes(self.batch_shape, inertias.shape[1:-2])
        except RuntimeError:
            raise InvalidInput(
                f"inertials have batch shape {tuple(inertias.shape[1:-2])} and the states {tuple(self.batch_shape)}, which do "
                "not broadcast; make them equal, or 1 where one value serves all."
            ) from None
        at = self._expand(batch)
        return at, algorithms.world_inertias(at.poses, _expand_batch(inertias, batch, 2))

    def _expand(self, batch: torch.Size) -> Kinematics:
        if batch == self.batch_shape:
            return self
        wider = replace(
            self,
            q=self.q.expand(*batch, -1),
            v=None if self.v is None else self.v.expand(*batch, -1),
            poses=_expand_batch(self.poses, batch, 2),
            twists=_expand_batch(self.twists, batch, 2),
        )
        if "_bias_accelerations" in self.__dict__:
            wider.__dict__["_bias_accelerations"] = _expand_batch(self._bias_accelerations, batch, 2)
        return wider

    def _mass_matrix(self, inertias: Tensor) -> Tensor:
        tree = self.robot.tree
        return algorithms.mass_matrix(tree, self.twists, algorithms.composite_inertias(tree, inertias))

    def _forces(self, accelerations: Tensor, inertias: Tensor) -> Tensor:
        tree = self.robot.tree
        return algorithms.joint_forces(tree, self.twists, algorithms.with_gravity(tree, accelerations), inertias)

    def _world_point(self, frame: str, point: Point | None) -> tuple[int, Tensor]:
        """Body that carries ``frame``, and the homogeneous world position (..., 4, 1) of ``point``."""
        body, offset = self.robot.frame(frame)
        if point is None:
            local = offset[:, 3:]
        else:
            point = self.robot.check_point(point)
            local = offset @ torch.nn.functional.pad(point, (0, 1), value=1.0)[..., None]
        if body == WORLD:
            batch = torch.broadcast_shapes(self.batch_shape, local.shape[:-2])
            return body, local.expand(*batch, 4, 1)
        return body, self.poses[body] @ local


def _expand_batch(values: Tensor, batch: torch.Size, trailing: int) -> Tensor:
    """Broadcast the middle (batch) dimensions of a tensor over joints (n, *batch, trailing dimensions)."""
    lead, tail = values.shape[:1], values.shape[-trailing:]
    missing = len(batch) - (values.dim() - 1 - trailing)
    return values.reshape(*lead, *(1 for _ in range(missing)), *values.shape[1:]).expand(*lead, *batch, *tail)


def broadcast_shapes(**tensors: Tensor) -> torch.Size:
    """Common batch shape of tensors (..., nv); :class:`~forcegp.errors.InvalidInput` where there is none."""
    shapes = {name: tensor.shape[:-1] for name, tensor in tensors.items()}
    try:
        return torch.broadcast_shapes(*shapes.values())
    except RuntimeError:
        listed = ", ".join(f"{name} {tuple(shape)}" for name, shape in shapes.items())
        raise InvalidInput(
            f"batch shapes do not broadcast: {listed}; make them equal, or 1 where one value serves all."
        ) from None
