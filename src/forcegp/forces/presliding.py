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

    `after_step` of one after the other: each leaves its sign times by how much the later ones fall short of hiding it.
    """
    reach = torch.as_tensor(sigma)[..., None] * strokes.abs().cumsum(-1)
    least = reach.detach().flatten(0, -2)
    seen = int((least.amin(0) < HIDDEN).sum()) + 1 if len(least) else 1
    decay = torch.exp(-reach[..., :seen])
    later = torch.cat((torch.ones_like(decay[..., :1]), decay[..., :-1]), dim=-1)
    return (strokes[..., :seen].sign() * (later - decay)).sum(-1) + start * decay[..., -1]
