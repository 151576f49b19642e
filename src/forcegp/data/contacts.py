"""In which rows of a log a contact acts, from q, v and a alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

import forcegp.mechanics
from forcegp.data.dataset import Dataset
from forcegp.errors import ContactError

FARTHEST = 5e-3  # m
LEAST_DISTANCE = 1e-3  # m
ALONG_NORMAL, CREEP = 0.02, 2e-3
"""Velocity along the normal relative to that along the surface, and in m/s, that is none."""

LEAST_ACCELERATION = 0.05  # m/s^2
DEVIATIONS = 4.5
DISTANCE_DEVIATIONS = 20.0


def tensors(rows: Dataset) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """q, v, u and a of the rows."""
    return tuple(torch.tensor(getattr(rows, name)) for name in "qvua")  # type: ignore[return-value]


def contact_rows(dataset: Dataset) -> Bool[np.ndarray, "rows m"]:
    """Whether each contact of `dataset.model` acts in each row, from q, v and a alone; `truth` is not looked at.

    A row counts if its point

    1. moves along the surface: the velocity along the normal is at most 2 % of that along the surface plus 2 mm/s, plus
       `omega |distance|` where the motion has Baumgarte's terms, which pull the point back;
    2. follows the constraint: `|A a - b|` is at most 4.5 standard deviations, by `noise_std` or, where that is larger
       or not known, by 1.48 times the median deviation of the rows that pass 1, but not less than 0.05 m/s^2;
    3. is where contact happens: not farther than 5 mm from the surface, and not farther from the median distance of the
       rows that pass 1 and 2 than 1 mm or 20 robust standard deviations of them, whichever is more.

    Rows of an impact break 2 and do not count. A point at rest, or gliding along just above its surface, cannot be
    distinguished from one in contact. A closed loop acts in every row, and a contact with a switch where its flag is.

    Raises ContactError for a dataset without contacts, and for a contact that acts in no row.
    """
    model = dataset.model
    if model is None or not model.contacts:
        raise ContactError(
            f"the dataset has {'no model' if model is None else 'a model without contacts'}; rows in contact can "
            "only be found for a model that lists its contacts: dataclasses.replace(dataset, model=...)."
        )
    recovery = recovery_of(model)
    with torch.no_grad():
        motions = point_motions(dataset, model)
    columns = []
    for index, (contact, motion) in enumerate(zip(model.contacts, motions, strict=True)):
        if isinstance(contact, forcegp.mechanics.LoopClosure) or contact.switch is not None:
            columns.append(np.ones(len(dataset), dtype=bool))
            continue
        columns.append(_acting(motion, recovery))
        if not columns[-1].any():
            raise ContactError(
                f"contact {index} (frame {contact.frame!r}) acts in none of the {len(dataset)} rows: the median "
                f"distance of its point from the surface is {np.median(np.abs(motion.distance)):.3g} m. Check the "
                "surface, the contact's point and the units (m, rad), or leave this contact out."
            )
    return np.stack(columns, axis=1)


def rows_in_contact(dataset: Dataset) -> Dataset:
    """The rows in which every contact of `dataset.model` acts, as `contact_rows` finds them.

    Raises ContactError as `contact_rows` does, and if the contacts never act together.
    """
    acts = contact_rows(dataset)
    together = np.asarray(acts.all(axis=1))
    if not together.any():
        counts = ", ".join(f"{count}" for count in acts.sum(axis=0))
        raise ContactError(
            f"the {acts.shape[1]} contacts act in {counts} of {len(dataset)} rows, but never all in one. Learn from "
            "the rows of fewer contacts: Model.with_contacts."
        )
    return dataset.rows(together)


class PointMotion(NamedTuple):
    """The point of a contact in every row, in m, m/s and m/s^2; `rate` and `residual` A a - b are along the normal.

    `noise` is the standard deviation of A a that the noise on the acceleration makes; 0 where it is not known. Those
    that noise on v makes of the rate and the speed are `rate_noise` and `speed_noise`.
    """

    distance: Float[np.ndarray, " rows"]
    rate: Float[np.ndarray, " rows"]
    speed: Float[np.ndarray, " rows"]
    acceleration: Float[np.ndarray, " rows"]
    residual: Float[np.ndarray, " rows"]
    noise: Float[np.ndarray, " rows"]
    rate_noise: Float[np.ndarray, " rows"]
    speed_noise: Float[np.ndarray, " rows"]


def point_motions(
    dataset: Dataset, model: forcegp.Model, noise_seen: tuple[np.ndarray, ...] | None = None
) -> list[PointMotion]:
    """`noise_seen` on v and a, where the rows show it; that on a is the Dataset's where it states one."""
    q, v, u, a = tensors(dataset)
    state = model.state(q, v, u)
    wander, sigma = map(torch.tensor, noise_seen or (np.zeros(dataset.nv), np.zeros(dataset.nv)))
    if dataset.noise_std is not None:
        sigma = torch.tensor(dataset.noise_std)
    motions = []
    for contact in model.contacts:
        A, b, gradient = contact.constraint(state, model.baumgarte)
        size = torch.linalg.vector_norm(gradient, dim=-1)
        J = state.kinematics.frame_jacobian(contact.frame, contact.point)[:, :3]
        speed, acceleration = (torch.linalg.vector_norm((J @ x[..., None])[..., 0], dim=-1) for x in (v, a))
        distance, rate = contact.distance(state.kinematics) / size, (A * v).sum(-1) / size
        residual = ((A * a).sum(-1) - b) / size
        noises = (A * sigma).norm(dim=-1) / size, (A * wander).norm(dim=-1) / size, (J * wander).flatten(1).norm(dim=-1)
        motions.append(PointMotion(*(x.numpy() for x in (distance, rate, speed, acceleration, residual, *noises))))
    return motions


def recovery_of(model: forcegp.Model) -> float:
    """Baumgarte's omega [1/s]."""
    return 0.0 if model.baumgarte is None else model.baumgarte.omega


def _acting(motion: PointMotion, recovery: float) -> Bool[np.ndarray, " rows"]:
    """The three conditions of `contact_rows`."""
    distance, residual = motion.distance, motion.residual
    along = np.sqrt(np.maximum(motion.speed**2 - motion.rate**2, 0.0))
    slow = np.abs(motion.rate) <= CREEP + ALONG_NORMAL * along + recovery * np.abs(distance)
    sliding = (np.abs(distance) <= FARTHEST) & slow
    if not sliding.any():
        return sliding
    spread = np.maximum(motion.noise, 1.4826 * np.median(np.abs(residual[sliding])))
    constrained = sliding & (np.abs(residual) <= np.maximum(DEVIATIONS * spread, LEAST_ACCELERATION))
    if not constrained.any():
        return constrained
    middle = np.median(distance[constrained])
    width = 1.4826 * np.median(np.abs(distance[constrained] - middle))
    return constrained & (np.abs(distance - middle) <= max(LEAST_DISTANCE, DISTANCE_DEVIATIONS * width))
