"""The two links with their true friction, to judge plans by."""

import torch
from two_links import DT, TRUE

from forcegp import fit


class TrueArm:
    """Moves in steps ten times shorter than those of plans."""

    def __init__(self, data):
        self.predictor = fit(TRUE, data, points=20, restarts=1).predictor(covariance="none")

    def __call__(self, state, u):
        """States (T + 1, 4) from one under torques (T, 2), each held for DT."""
        state, u = torch.as_tensor(state), torch.as_tensor(u).repeat_interleave(10, dim=0)
        how = {"dt": DT / 10, "integrator": "implicit-midpoint"}
        moved = self.predictor.rollouts(state[:2], state[2:], u, **how)
        return torch.cat([moved.q, moved.v], dim=-1)[::10].numpy()
