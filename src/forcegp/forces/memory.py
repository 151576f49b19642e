"""What laws remember of the motion before: columns of u, carried along an episode and along predicted motions."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.forces.force import Force, Law
from forcegp.robots import Robot


class Memory:
    """The numbers that all laws of a model remember, side by side.

    `names` are their columns of u. None of the laws that forcegp brings remembers anything; a law of one's own does
    with `memory_names` and `remember` (`tests/forces/test_memory.py` has one).
    """

    def __init__(self, forces: Sequence[Force], robot: Robot) -> None:
        laws = [force for force in forces if isinstance(force, Law)]
        self._laws = [(law, len(names)) for law in laws if (names := law.memory_names(robot))]
        self.robot = robot
        self.names = tuple(name for law, _ in self._laws for name in law.memory_names(robot))

    @property
    def titles(self) -> tuple[str, ...]:
        """The laws that remember."""
        return tuple(law.title for law, _ in self._laws)

    @property
    def start(self) -> Float[Tensor, " m"]:
        """Before anything has moved."""
        return torch.cat([law.memory_start(self.robot) for law, _ in self._laws])

    def after(self, memory: Float[Tensor, "*batch m"], step: Float[Tensor, "*batch nv"], dt: float) -> Tensor:
        """The memory after the joints have moved by `step` in dt."""
        parts = memory.split([size for _, size in self._laws], dim=-1)
        return torch.cat([law.remember(x, step, dt) for (law, _), x in zip(self._laws, parts, strict=True)], dim=-1)

    def along(self, q: Float[Tensor, "T nq"], time: Float[Tensor, " T"]) -> Float[Tensor, "T m"]:
        """The memory at every row of one episode, from `start` at the first."""
        steps = self.robot.difference(q[:-1], q[1:])
        rows = [self.start]
        for step, dt in zip(steps, time.diff().tolist(), strict=True):
            rows.append(self.after(rows[-1], step, dt))
        return torch.stack(rows)
