"""`RolloutErrors`: how far rollouts are from what was recorded, over time."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from forcegp.data.motion_records import RecordedMotions
from forcegp.model import Model
from forcegp.posterior.rollout import Rollout
from forcegp.robots.manifold import ConfigurationSpace

INTERVAL = (0.025, 0.975)


@dataclass(frozen=True, eq=False)
class RolloutErrors:
    """Errors of B rollouts against recorded motions; NaN where a rollout had diverged.

    joint: (B, T+1, nv) |q - q_recorded| in rad or m; of a base that moves, displacement and turn along its own axes.
    tool: (B, T+1) largest distance of a contact point from the recorded one in m; None without contacts.
    constraint: (B, T+1) largest |c(q)| of a contact in m; None without contacts, and where all of them hold what they
        stand on, wherever it is. recorded_constraint: that of the recording.
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


def rollout_errors(rollout: Rollout, recorded: RecordedMotions, model: Model) -> RolloutErrors:
    """Compare rollouts (B, T+1, nv) with the motions from whose first rows they began."""
    tool = constraint = recorded_constraint = spread = inside = None
    actual = torch.as_tensor(np.array(recorded.q), device=rollout.q.device)
    if model.contacts:
        lost = torch.isnan(rollout.q).any(-1)  # after a divergence
        here, there = (model.robot.kinematics(q) for q in (torch.where(lost[..., None], actual, rollout.q), actual))
        apart = [
            torch.linalg.vector_norm(contact.position(here) - contact.position(there), dim=-1)
            for contact in model.contacts
        ]
        tool = torch.where(lost, torch.nan, torch.stack(apart).amax(0)).cpu().numpy()
        distances = torch.stack([contact.distance(there).abs() for contact in model.contacts]).amax(0)
        if bool(distances.any()) or bool(rollout.constraint.nan_to_num().any()):
            constraint = rollout.constraint.abs().amax(-1).cpu().numpy()
            recorded_constraint = distances.cpu().numpy()
    if rollout.samples is not None or rollout.intervals is not None:
        low, high = (end.cpu().numpy() for end in interval_about(rollout, rollout.q, model.robot.space))
        spread, off = 0.5 * (high - low), apart_from(rollout.q, actual, model.robot.space).cpu().numpy()
        inside = np.where(np.isnan(spread), np.nan, (low <= off) & (off <= high))
    return RolloutErrors(
        time=rollout.time.cpu().numpy(),
        joint=apart_from(actual, rollout.q, model.robot.space).abs().cpu().numpy(),
        tool=tool,
        constraint=constraint,
        recorded_constraint=recorded_constraint,
        spread=spread,
        inside=inside,
        diverged_at=rollout.diverged_at.cpu().numpy(),
    )


def apart_from(q0: Tensor, q1: Tensor, space: ConfigurationSpace) -> Float[Tensor, "*batch nv"]:
    """The way from q0 to q1: their difference, on the manifold where a base moves; NaN where one of them is."""
    if space.is_vector_space:
        return q1 - q0
    lost = torch.isnan(q0).any(-1) | torch.isnan(q1).any(-1)
    neutral = space.neutral().to(q1)
    way = space.difference(*(torch.where(lost[..., None], neutral, q) for q in (q0, q1)))
    return torch.where(lost[..., None], torch.nan, way)


def interval_about(rollout: Rollout, q0: Tensor, space: ConfigurationSpace) -> tuple[Tensor, Tensor]:
    """Ends of the 95 % interval of q as ways from q0 (..., nv)."""
    if space.is_vector_space:
        low, high = rollout.interval()
        return low - q0, high - q0
    if rollout.intervals is None:
        levels = torch.tensor(INTERVAL, dtype=q0.dtype, device=q0.device)
        assert rollout.samples is not None, "without them there is no interval"
        low, high = torch.quantile(apart_from(q0, rollout.samples.q, space), levels, dim=0)
        return low, high
    # what steps from the motion change of the way to it: entries of a step are as if independent
    way, (_, wide) = apart_from(q0, rollout.q, space), rollout.interval()
    half = (space.chart_matrix(way).square() * wide.square()[..., None, :]).sum(-1).sqrt()
    return way - half, way + half
