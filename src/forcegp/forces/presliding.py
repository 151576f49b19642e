"""What dry friction remembers: one state per joint, from the strokes that a joint made before, or carried along.

    z+ = s + (z - s) exp(-sigma |dq|),   s = sign(dq)

(P. Dahl, "A solid friction model", Aerospace Corporation, 1968, with exponent 1.) It is exact for a step of any length
that does not turn back, and does not depend on time. After a reversal friction turns over a displacement of 1 / sigma.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def after_step(
    z: Float[Tensor, "*batch nv"],
    step: Float[Tensor, "*batch nv"],
    sigma: Float[Tensor, "*#batch nv"] | Float[Tensor, ""],
) -> Float[Tensor, "*batch nv"]:
    """The state after the joints have moved by `step` (rad or m), with sigma in 1/rad or 1/m."""
    toward = step.sign()
    return toward + (z - toward) * torch.exp(-sigma * step.abs())


def after_strokes(
    strokes: Float[Tensor, "*batch nv strokes"],
    sigma: Float[Tensor, "*#batch nv"] | Float[Tensor, ""],
    start: float = 0.0,
) -> Float[Tensor, "*batch nv"]:
    """The state after these displacements (rad or m), the last one first, from `start` on; smooth in sigma."""
    z = torch.full_like(strokes[..., 0], start)
    for step in strokes.flip(-1).unbind(-1):
        z = after_step(z, step, sigma)
    return z
