"""Which rows of a log were recorded while a contact acted: detected from the motion alone, not from any force."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float

import forcegp.mechanics
from forcegp.data.dataset import Dataset
from forcegp.errors import ContactError

FARTHEST = 5e-3  # m
LEAST_DISTANCE = 1e-3  # m
SLOPE = 0.02
LEAST_SPEED = 2e-3  # m/s
LEAST_ACCELERATION = 0.05  # m/s^2
DEVIATIONS = 4.5
DISTANCE_DEVIATIONS = 20.0


def contact_rows(dataset: Dataset) -> Bool[np.ndarray, "rows m"]:
    """Whether each contact of `dataset.system` acts in each row, from q, v and a alone; `truth` is not looked at.

    A row counts if its point

    1. moves along the surface: the velocity along the normal is at most 2 % of that along the surface plus 2 mm/s, plus
       `omega |distance|` where the motion has Baumgarte's terms, which pull the point back;
    2. follows the constraint: `|A a - b|` is at most 4.5 standard deviations, by `noise_std` or, where that is larger
       or not known, by 1.48 times the median deviation of the rows that pass 1, but not less than 0.05 m/s^2;
    3. is where contact happens: not farther than 5 mm from the surface, and not farther from the median distance of the
       rows that pass 1 and 2 than 1 mm or 20 robust standard deviations of them, whichever is more.

    Rows of an impact break 2 and do not count. A point at rest, or gliding along just above its surface, cannot be
    distinguished from one in contact.

    Raises ContactError for a dataset without contacts, and for a contact that acts in no row.
    """
    system = dataset.system
    if system is None or not system.contacts:
        raise ContactError(
            f"the dataset has {'no system' if system is None else 'a system without contacts'}; rows in contact can "
            "only be found for a system that lists its contacts: dataclasses.replace(dataset, system=...)."
        )
    q, v, u, a = (torch.tensor(getattr(dataset, name)) for name in ("q", "v", "u", "a"))
    with torch.no_grad():
        state = forcegp.mechanics.State.of(system.robot, q, v, u)
        columns = []
        for index, contact in enumerate(system.contacts):
            A, b, gradient = contact.constraint(state, system.baumgarte)
            jacobian = state.kinematics.frame_jacobian(contact.frame, contact.point)[:, :3, :]
            scale = torch.linalg.vector_norm(gradient, dim=-1)
            velocity = torch.linalg.vector_norm((jacobian @ v[..., None])[..., 0], dim=-1)
            acts = _acting(
                distance=(contact.distance(state.kinematics) / scale).numpy(),
                rate=((A * v).sum(-1) / scale).numpy(),
                speed=velocity.numpy(),
                residual=(((A * a).sum(-1) - b) / scale).numpy(),
                recovery=0.0 if system.baumgarte is None else system.baumgarte.omega,
                noise=_noise_along(dataset, (A / scale[:, None]).numpy()),
            )
            if not acts.any():
                raise _never_in_contact(index, contact, contact.distance(state.kinematics).numpy())
            columns.append(acts)
    return np.stack(columns, axis=1)


def rows_in_contact(dataset: Dataset) -> Dataset:
    """The rows in which every contact of `dataset.system` acts, as `contact_rows` finds them.

    Raises ContactError as `contact_rows` does, and if the contacts never act together.
    """
    acts = contact_rows(dataset)
    together = np.asarray(acts.all(axis=1))
    if not together.any():
        counts = ", ".join(f"{count}" for count in acts.sum(axis=0))
        raise ContactError(
            f"the {acts.shape[1]} contacts act in {counts} of {len(dataset)} rows, but never all in one. Learn from "
            "the rows of fewer contacts: MechanicalSystem.with_contacts."
        )
    return dataset.rows(together)


def _acting(
    distance: Float[np.ndarray, " rows"],
    rate: Float[np.ndarray, " rows"],
    speed: Float[np.ndarray, " rows"],
    residual: Float[np.ndarray, " rows"],
    recovery: float,
    noise: Float[np.ndarray, " rows"],
) -> Bool[np.ndarray, " rows"]:
    """The three conditions of `contact_rows`, in m, m/s and m/s^2; `recovery` is Baumgarte's omega [1/s]."""
    along = np.sqrt(np.maximum(speed**2 - rate**2, 0.0))
    slow = np.abs(rate) <= LEAST_SPEED + SLOPE * along + recovery * np.abs(distance)
    sliding = (np.abs(distance) <= FARTHEST) & slow
    if not sliding.any():
        return sliding
    spread = np.maximum(noise, 1.4826 * np.median(np.abs(residual[sliding])))
    constrained = sliding & (np.abs(residual) <= np.maximum(DEVIATIONS * spread, LEAST_ACCELERATION))
    if not constrained.any():
        return constrained
    middle = np.median(distance[constrained])
    width = 1.4826 * np.median(np.abs(distance[constrained] - middle))
    return constrained & (np.abs(distance - middle) <= max(LEAST_DISTANCE, DISTANCE_DEVIATIONS * width))


def _noise_along(dataset: Dataset, rows: Float[np.ndarray, "rows nv"]) -> Float[np.ndarray, " rows"]:
    """Standard deviation of `A a` that the noise on the acceleration makes; 0 where it is not known."""
    if dataset.noise_std is None:
        return np.zeros(len(rows))
    return np.sqrt(((rows * dataset.noise_std) ** 2).sum(axis=1))


def _never_in_contact(
    index: int, contact: forcegp.mechanics.Contact, distance: Float[np.ndarray, " rows"]
) -> ContactError:
    return ContactError(
        f"contact {index} (frame {contact.frame!r}) acts in none of the {len(distance)} rows: the median distance of "
        f"its point from the surface is {np.median(np.abs(distance)):.3g} m. Check the surface, the contact's point "
        "and the units (m, rad), or leave this contact out."
    )
