"""Sentences that belong beside the scores of a model: what a reader would have to find out otherwise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from forcegp.data import Dataset
from forcegp.models.protocol import Posterior

WORSE = 1.01
"""Error of the model over that of its known forces alone, from which it is pointed out."""

FEWEST_INSIDE = 0.9
"""Least coverage of 95 % intervals, over all joints, about which nothing is said."""

MARGIN, POSTURE = 0.25, 0.1
"""How far beyond the training range of a joint a value may lie: a fraction of that range, and of the widest range of
all joints (a joint that is held in its posture moves little, and a little more of it is nothing new).
"""

MOST_OUTSIDE = 0.01
"""Share of the rows that may lie further outside."""


def unfinished_search(posterior: Posterior) -> Iterator[str]:
    """A sentence where the search for the parameters did not converge."""
    if "optimizer" in posterior.settings and not posterior.result.converged:
        yield (
            f"the search for the parameters of this model did not converge ({posterior.result.status}); its mean and "
            "its intervals may be far from those at the optimum"
        )


def rows_outside(posterior: Posterior, dataset: Dataset) -> Iterator[str]:
    """A sentence where many rows lie outside of the range of q and v that the model was trained in."""
    names = posterior.joint_names
    found = []
    outside = np.zeros(len(dataset), dtype=bool)
    for quantity in ("q", "v"):
        trained, given = getattr(posterior.training, quantity).cpu().numpy(), getattr(dataset, quantity)
        low, high = trained.min(axis=0), trained.max(axis=0)
        room = MARGIN * (high - low) + POSTURE * float((high - low).max())
        beyond = np.maximum(low - given, given - high) - room
        outside |= (beyond > 0.0).any(axis=1)
        for joint, name in enumerate(names):
            share = float((beyond[:, joint] > 0.0).mean())
            low_high = f"{low[joint]:.3g} to {high[joint]:.3g}"
            reached = f"{given[:, joint].min():.3g} to {given[:, joint].max():.3g}"
            found.append((share, f"{quantity} of {name} is {reached} here and was {low_high} in training"))
    if outside.mean() > MOST_OUTSIDE:
        yield (
            f"{outside.mean():.0%} of the rows lie outside of the range that the model was trained in (worst: "
            f"{max(found)[1]}); errors may be larger there, and intervals rest on the prior"
        )


def poor_scores(scores: Mapping[str, Any]) -> Iterator[str]:
    """Sentences about the scores of an `Evaluation`: worse than the known forces alone, and intervals that miss."""
    for error, known, what in (
        ("mae_noise_free_per_joint", "known_physics_mae_noise_free_per_joint", "noise-free MAE"),
        ("mae_per_joint", "known_physics_mae_per_joint", "MAE"),
    ):
        if scores.get(error) is None or scores.get(known) is None:
            continue
        mine, alone = (float(np.mean(scores[name])) for name in (error, known))
        if mine > WORSE * alone:
            yield (
                f"the model is worse here than its known forces alone ({what} {mine:.3g} against {alone:.3g}): "
                "what it has learned does not hold here; do not use it for motions like these"
            )
        break  # against the truth where it is known, for noise hides the difference
    for name, what in (
        ("coverage_95_per_joint", "measurements"),
        ("coverage_95_noise_free_per_joint", "true accelerations"),
    ):
        inside = scores.get(name)
        if inside is not None and float(np.mean(inside)) < FEWEST_INSIDE:
            yield (
                f"the 95 % intervals hold {float(np.mean(inside)):.0%} of the {what}: the model is surer than it is "
                "right; a force is missing, the noise is larger than stated, or these motions differ from the training"
            )


def doubts(posterior: Posterior, dataset: Dataset, scores: Mapping[str, Any]) -> tuple[str, ...]:
    """All of them, for the scores of this model on this dataset."""
    return (*unfinished_search(posterior), *rows_outside(posterior, dataset), *poor_scores(scores))
