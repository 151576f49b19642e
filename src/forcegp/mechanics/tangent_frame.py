"""Axes of a surface: two tangents and the outward normal, chosen smoothly along it.

The shortest turn of the world's axes onto the normal: x and y on a table, so that what was learned along tangents means
the same on a tilted one.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

TURNED_OVER = -0.9
"""z component of a normal below which the axes are turned from -z instead of z, where turning from z is ill-defined."""


def surface_axes(gradients: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Columns t1, t2, n of the rotation that turns the world's z axis the shortest way onto the normal n.

    `gradients` are surface gradients of any positive length. On a table the tangents are x and y; they vary smoothly
    with the normal wherever it does not point nearly straight down (there they start from -z, and t2 is -y). With
    axis w = z x n and c = n_z, the rotation is I + [w] + [w]^2 / (1 + c) (Rodrigues' formula).
    """
    n = gradients / torch.linalg.vector_norm(gradients, dim=-1, keepdim=True)
    down = n[..., 2] < TURNED_OVER
    flip = torch.where(down, -1.0, 1.0)
    x, y, z = n[..., 0], n[..., 1], n[..., 2] * flip  # turned over: mirrored at z = 0, then t2 is mirrored back
    shrink = 1.0 / (1.0 + z)
    t1 = torch.stack([1.0 - x * x * shrink, -x * y * shrink, -x * flip], dim=-1)
    t2 = torch.stack([-x * y * shrink, 1.0 - y * y * shrink, -y * flip], dim=-1) * flip[..., None]
    return torch.stack([t1, t2, n], dim=-1)
