"""What dry friction remembers: one state per joint, from the strokes that a joint made before, or carried along.

    z+ = s + (z - s) exp(-sigma |dq|),   s = sign(dq)

(P. Dahl, "A solid friction model", Aerospace Corporation, 1968, with exponent 1.) It is exact for a step of any length
that does not turn back, and does not depend on time. After a reversal friction turns over a displacement of 1 / sigma.
"""

import torch
from jaxtyping import Float
from torch import Tensor

HIDDEN = 40.0  # exponent from which on nothing is left of what was before: exp(-40) is less than rounding
PerJoint = Float[Tensor, "*batch nv"]
Sigma = Float[Tensor, "*#batch nv"] | Float[Tensor, ""]
"""In 1/rad or 1/m, of each joint or of all."""


def after_step(z: PerJoint, step: PerJoint, sigma: Sigma) -> PerJoint:
    """The state after the joints have moved by `step` (rad or m), with sigma in 1/rad or 1/m."""
    toward = step.sign()
    return toward + (z - toward) * torch.exp(-sigma * step.abs())


def after_strokes(strokes: Float[Tensor, "*batch nv strokes"], sigma: Sigma, start: float = 0.0) -> PerJoint:
    """The state after these displacements (rad or m), the last one first, from `start` on; smooth in sigma.

    `after_step` of one after the other: each turn leaves its change of sign times by how far the later strokes hide it.
    """
    way, sigma = strokes.abs().cumsum(-1), torch.as_tensor(sigma)
    reach = sigma.detach()[..., None] * way
    shape, count = reach.shape[:-1], reach.shape[-1]
    at = (reach.flatten() < HIDDEN).nonzero()[:, 0]  # a twentieth of all, mostly
    signs, row = strokes.expand_as(reach).flatten(), at // count
    later = torch.where(at % count == count - 1, start, signs[(at + 1).clamp_max(len(signs) - 1)].sign())
    decay = torch.exp(-sigma.expand(shape).flatten()[row] * way.expand_as(reach).flatten()[at])
    first = strokes[..., 0].sign().expand(shape).flatten()
    return first.index_add(0, row, (later - signs[at].sign()) * decay).view(shape)
