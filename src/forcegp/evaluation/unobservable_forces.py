"""Is the normal force learned, or does it rest on the prior? Read off a model's directions of force."""

from __future__ import annotations

import torch
from torch import Tensor

from forcegp.models import StructuredPosterior
from forcegp.models.protocol import Posterior

STATES = 20
"""Training states that are looked at; each alone decides."""
INVISIBLE = 1e-7
"""Singular values of H B below this, relative to the largest one, are zero: accelerations show nothing there."""


def normal_force_rests_on_prior(posterior: Posterior) -> bool:
    """Whether processes of the model can press on a contact together without moving the robot.

    True where, at some training state, processes of the same inputs have a combination f with H B f = 0 that changes
    lambda: any function of those inputs may then be added to the normal force, and accelerations show nothing of it.
    So it is for a free force at every joint, and for a Cartesian force that is not kept to the tangents. Friction
    curves that each have an input of their own, and constants (a payload), are no such processes: one state does not
    separate them, but all together do.
    """
    if not isinstance(posterior, StructuredPosterior) or not posterior.model.system.contacts:
        return False
    training = posterior.training
    q, v, u = (x[:STATES] for x in (training.q, training.v, training.u))
    with torch.no_grad():
        dynamics = posterior.model.system.dynamics(q, v, u)
        B, features = posterior.model.prior.mixing(dynamics), posterior.model.prior.features(dynamics)
        pressing = dynamics.multiplier_map().matrix @ B
        return any(_presses_unseen((dynamics.H @ B)[..., which], pressing[..., which]) for which in _groups(features))


def _groups(features: tuple[Tensor, ...]) -> list[list[int]]:
    """Numbers of the processes that have the same inputs."""
    groups: list[list[int]] = []
    for index, z in enumerate(features):
        constant = bool((z == z[:1]).all())  # also without any feature
        same = next((group for group in groups if not constant and torch.equal(features[group[0]], z)), None)
        if same is None:
            groups.append([index])
        else:
            same.append(index)
    return groups


def _presses_unseen(moving: Tensor, pressing: Tensor) -> bool:
    """Whether the null space of `moving` (rows, nv, k) changes lambda through `pressing` (rows, m, k)."""
    _, sizes, rows = torch.linalg.svd(moving)
    largest = sizes[..., :1]
    padded = torch.cat([sizes, sizes.new_zeros(*sizes.shape[:-1], rows.shape[-1] - sizes.shape[-1])], dim=-1)
    unseen = (padded <= INVISIBLE * largest)[..., None] * rows
    effect = pressing @ unseen.mT
    return bool((effect.abs().amax((-2, -1)) > INVISIBLE * pressing.abs().amax((-2, -1))).any())
