"""Doubts that belong beside the scores of a model: what a reader would have to find out otherwise."""

import json
from collections.abc import Iterator

import numpy as np
import torch

from forcegp.data import Dataset, repeated_rows
from forcegp.doubts import Doubt, Doubts, look
from forcegp.posterior.posterior import Posterior
from forcegp.scores.accuracy import ACCELERATION, TRUE_ACCELERATION, Table
from forcegp.summary import listed

WORSE = 1.01  # error of the model over that of its known forces alone, from which it is pointed out
WORSE_JOINT, LEAST_WORSE = 1.2, 0.1
"""The same of one joint, and by how much its error must be larger, in standard deviations of the noise."""

FEWEST_INSIDE = 0.9  # least coverage of 95 % intervals, over all joints, about which nothing is said
MISSED, CHANCE = 0.15, 4.0
"""How much less than 95 % the intervals of one joint may hold: this share, or so many deviations of a count by chance
if that is more."""

MARGIN, POSTURE = 0.25, 0.1
"""How far beyond the training range of a joint a value may lie: a fraction of that range, and of the widest range of
all joints (a joint that is held in its posture moves little, and a little more of it is nothing new).
"""

MOST_OUTSIDE = 0.01  # share of the rows that may lie further outside


def unfinished_search(posterior: Posterior) -> Iterator[Doubt]:
    """A sentence where the search for the parameters did not converge."""
    if "optimizer" in posterior.settings and not posterior.result.converged:
        yield look(
            about="search",
            what=f"the search for the parameters of this model did not converge ({posterior.result.status}); its "
            "mean and its intervals may be far from those at the optimum",
        )


def rows_outside(posterior: Posterior, dataset: Dataset) -> Iterator[Doubt]:
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
        yield look(
            about="rows outside",
            what=f"{outside.mean():.0%} of the rows lie outside of the range that the model was trained in (worst: "
            f"{max(found)[1]}); errors may be larger there, and intervals rest on the prior",
        )


def poor_scores(posterior: Posterior, dataset: Dataset, table: Table) -> Iterator[Doubt]:
    """Sentences about a table of scores: worse than the known forces alone, and intervals that miss.

    On average over the joints, or at some of them, which are named with the worst first.
    """
    names, noise = np.array(posterior.joint_names), posterior.noise_std.detach().cpu().numpy()
    # against the truth where it is known, for noise hides the difference
    quantity, what = (TRUE_ACCELERATION, "noise-free MAE") if TRUE_ACCELERATION in table else (ACCELERATION, "MAE")
    mine, alone = (np.array(table[quantity][score], dtype=float) for score in ("mae", "known_physics_mae"))
    worse = mine > np.maximum(WORSE_JOINT * alone, alone + LEAST_WORSE * noise)
    places = [
        f"{names[joint]} {mine[joint]:.3g} against {alone[joint]:.3g}"
        for joint in sorted(np.flatnonzero(worse), key=lambda joint: alone[joint] / mine[joint])
    ]
    if places or mine.mean() > WORSE * alone.mean():
        where = f" at {len(places)} of {len(names)} joints, {listed(places)}" if places else ""
        yield look(
            about="error",
            what=f"the model is worse here than its known forces alone{where} ({what} {mine.mean():.3g} against "
            f"{alone.mean():.3g} on average): do not use it for motions like these",
        )
    least = 0.95 - max(MISSED, CHANCE * (0.95 * 0.05 / len(dataset)) ** 0.5)
    for quantity, what in ((ACCELERATION, "measurements"), (TRUE_ACCELERATION, "true accelerations")):
        inside = np.array(table.get(quantity, {}).get("coverage_95", [1.0]), dtype=float)
        if not (inside.mean() < FEWEST_INSIDE or inside.min() < least):
            continue
        places = [f"{names[joint]} {inside[joint]:.0%}" for joint in np.argsort(inside) if inside[joint] < least]
        hidden = inside.mean() >= FEWEST_INSIDE
        of = f"{', but fewer at some joints' if hidden else ''} ({listed(places)})" if places else ""
        there = " at these" if hidden else ""
        yield look(
            about="coverage",
            what=f"the 95 % intervals hold {inside.mean():.0%} of the {what}{of}: the model is overconfident{there}; "
            "a force is missing, the noise is larger than stated, or these motions are new to it",
        )


def doubts(posterior: Posterior, dataset: Dataset, table: Table) -> Doubts:
    """All of them, for the scores of this model on this dataset."""
    poor = poor_scores(posterior, dataset, table)
    return Doubts([*unfinished_search(posterior), *rows_outside(posterior, dataset), *poor])


STATES = 20  # training states that are looked at; each alone decides
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
    if not posterior.trained.contacts:
        return False
    training = posterior.training
    q, v, u = (x[:STATES] for x in (training.q, training.v, training.u))
    with torch.no_grad():
        dynamics = posterior.trained.dynamics(q, v, u)
        forces = posterior.trained.unknown
        B, features = forces.direction(dynamics), forces.features(dynamics)
        moving, pressing = dynamics.H @ B, dynamics.multiplier_map().matrix @ B
        for z in features:
            alike = [k for k, other in enumerate(features) if torch.equal(z, other)]
            if (z == z[:1]).all():  # constant, also without any feature
                alike = alike[:1]
            here, there = moving[..., alike], pressing[..., alike]
            unseen = torch.eye(len(alike)).to(B) - torch.linalg.pinv(here, rtol=INVISIBLE) @ here
            if ((there @ unseen).abs().amax((-2, -1)) > INVISIBLE * there.abs().amax((-2, -1))).any():
                return True
    return False


def overlap_warnings(posterior: Posterior, dataset: Dataset) -> Iterator[Doubt]:
    """Warnings about rows or trajectories that training and test share, and about contacts that differ."""
    q, v, u = (getattr(posterior.training, name).cpu().numpy() for name in "qvu")
    repeated = repeated_rows((q, v, u), dataset)
    if repeated.size:
        yield look(
            about="equal rows",
            what=f"{repeated.size} of {len(dataset)} test rows have the very (q, v, u) of training rows (the first: "
            f"row {repeated[0]}); where they are the same rows, these scores flatter the model: test on another one.",
        )
    else:
        source = posterior.settings.get("data") or {}
        metadata = json.loads(json.dumps(dataset.metadata))
        shared = sorted(set(source.get("episodes", ())) & set(dataset.episodes))
        if metadata and shared and json.loads(json.dumps(source.get("metadata"))) == metadata:
            yield look(
                about="same recording",
                what=f"training and test rows come from the same recording (equal metadata, episodes {shared} in "
                "both), so these scores flatter the model; test on another trajectory.",
            )
    own, model = dataset.model, posterior.model
    differ = own is not None and (own.contacts, own.baumgarte) != (model.contacts, model.baumgarte)
    if differ and not posterior.is_black_box:  # which has no contacts, and can be carried nowhere
        yield look(
            about="contacts",
            what="the contacts of the model are not those of the data, on which the constraint error is measured; "
            "predict under them with `posterior.with_model(dataset.model)`",
        )
