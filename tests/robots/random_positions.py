"""Positions that a robot can have, drawn."""

import math

import torch

from forcegp.robots import Robot
from forcegp.robots.manifold import TURN


def random_positions(robot: Robot, generator: torch.Generator, rows: int = 1) -> torch.Tensor:
    """Within the limits of the joints (rows, nq), else within half a turn or 1 m; turns of any direction."""
    spread = torch.tensor([math.pi if joint.type != "prismatic" else 1.0 for joint in robot.joints])
    lower, upper = (
        torch.tensor([getattr(joint, side) for joint in robot.joints], dtype=torch.float64)
        for side in ("lower", "upper")
    )
    lower, upper = torch.maximum(lower, -spread), torch.minimum(upper, spread)
    share = torch.rand(rows, robot.nv, dtype=torch.float64, generator=generator)
    q = robot.space.integrate(robot.space.neutral(), lower + share * (upper - lower))
    for group in robot.layout.groups:  # directions of Gaussian vectors are uniform
        q[:, group.places][:, TURN] = torch.randn(rows, 4, dtype=torch.float64, generator=generator)
    return robot.space.normalized(q).to(robot.device)
