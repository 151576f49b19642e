"""`State`: (q, v, u) with its kinematics, computed once and shared by contacts, known forces and priors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.robots import Kinematics, Robot
from forcegp.robots.arguments import Inertials, JointValues


@dataclass(frozen=True, eq=False)
class State:
    """Positions, velocities and actuator forces (..., nv) of equal shape, and the inertial parameters that hold there.

    `inertials` maps link names to log-Cholesky parameters (..., 10), or is None for those of the URDF.
    """

    q: Float[Tensor, "*batch nv"]
    v: Float[Tensor, "*batch nv"]
    u: Float[Tensor, "*batch nv"]
    robot: Robot
    kinematics: Kinematics
    inertials: Mapping[str, Tensor] | None = None

    @classmethod
    def of(
        cls, robot: Robot, q: JointValues, v: JointValues, u: JointValues, inertials: Inertials | None = None
    ) -> State:
        """Checked and broadcast. Raises InvalidInput for wrong shapes, dtypes or devices."""
        q, v, u = (robot.checked_input(name, value) for name, value in (("q", q), ("v", v), ("u", u)))
        try:
            q, v, u = torch.broadcast_tensors(q, v, u)
        except RuntimeError:
            shapes = f"q {tuple(q.shape)}, v {tuple(v.shape)}, u {tuple(u.shape)}"
            raise InvalidInput(f"batch shapes do not broadcast: {shapes}; make them equal, or 1.") from None
        return cls(q, v, u, robot, robot.kinematics(q, v), inertials)
