"""`RolloutErrors`: how far rollouts are from what was recorded, over time."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from forcegp.data.motion_records import RecordedMotions
from forcegp.mechanics import MechanicalSystem
from forcegp.models.rollout import Rollout

INTERVAL = (0.025, 0.975)


@dataclass(frozen=True, eq=False)
class RolloutErrors:
    """Errors of B rollouts against recorded motions; NaN where a rollout had diverged.

    joint: (B, T+1, nv) |q - q_recorded| in rad or m.
    tool: (B, T+1) largest distance of a contact point from the recorded one in m; None without contacts.
    constraint: (B, T+1) largest |c(q)| of a contact in m; None without contacts. recorded_constraint: that of the
        recording.
    spread: (B, T+1, nv) half the width of the 95 % interval of q (`Rollout.interval`); None where there is none.
    inside: (B, T+1, nv) whether the recorded q lies in that interval (NaN after a divergence); None without one.
    diverged_at: (B,) see `Rollout`.
    """

    time: Float[np.ndarray, " rows"]
    joint: Float[np.ndarray, "motions rows nv"]
    tool: Float[np.ndarray, "motions rows"] | None
    constraint: Float[np.ndarray, "motions rows"] | None
    recorded_constraint: Float[np.ndarray, "motions rows"] | None
    spread: Float[np.ndarray, "motions rows nv"] | None
    inside: Float[np.ndarray, "motions rows nv"] | None
    diverged_at: Int[np.ndarray, " motions"]


def rollout_errors(rollout: Rollout, recorded: RecordedMotions, system: MechanicalSystem) -> RolloutErrors:
    """Compare rollouts (B, T+1, nv) with the motions from whose first rows they began."""
    system.robot.require_vectors("scores of rollouts")
    tool = constraint = recorded_constraint = spread = inside = None
    actual = torch.as_tensor(np.array(recorded.q), device=rollout.q.device)
    if system.contacts:
        here, there = (system.robot.kinematics(q) for q in (rollout.q, actual))
        apart = [
            torch.linalg.vector_norm(contact.position(here) - contact.position(there), dim=-1)
            for contact in system.contacts
        ]
        tool = torch.stack(apart).amax(0).cpu().numpy()
        constraint = rollout.constraint.abs().amax(-1).cpu().numpy()
        distances = [contact.distance(there).abs() for contact in system.contacts]
        recorded_constraint = torch.stack(distances).amax(0).cpu().numpy()
    if rollout.samples is not None or rollout.intervals is not None:
        low, high = (end.cpu().numpy() for end in rollout.interval())
        spread = 0.5 * (high - low)
        inside = np.where(np.isnan(spread), np.nan, (low <= recorded.q) & (recorded.q <= high))
    return RolloutErrors(
        time=rollout.time.cpu().numpy(),
        joint=(rollout.q - actual).abs().cpu().numpy(),
        tool=tool,
        constraint=constraint,
        recorded_constraint=recorded_constraint,
        spread=spread,
        inside=inside,
        diverged_at=rollout.diverged_at.cpu().numpy(),
    )
