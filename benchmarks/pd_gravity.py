"""PD control with the weight compensated: what learned forces are compared with, and what moves arms for logs."""

from __future__ import annotations

from typing import Any

from torch import Tensor
from typing_extensions import override

from forcegp import Robot
from forcegp.control.tracking import TrackingController
from forcegp.robots.compiled import CompiledRobot


class PDGravity(TrackingController):
    """u = M(q) (Kd (v_d - v) + Kp (q_d - q)) + g(q): masses alone; `robot` may be `robot.compile()`."""

    def __init__(self, robot: Robot | CompiledRobot, **settings: Any) -> None:
        self._dynamics = robot
        super().__init__(robot.robot if isinstance(robot, CompiledRobot) else robot, **settings)  # type: ignore[arg-type]  # it is a Robot

    @override
    def _torques(self, q: Tensor, v: Tensor, v_d: Tensor, a_d: Tensor, e: Tensor, e_v: Tensor) -> Tensor:
        return self._dynamics.mass_matrix(q) @ self.feedback(e, e_v) + self._dynamics.gravity_forces(q)
