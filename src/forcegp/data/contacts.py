"""In which rows of a log a contact acts, and whether the motion bears it out."""

import numpy as np
import torch
from jaxtyping import Bool

import forcegp.mechanics
from forcegp.data.dataset import Dataset
from forcegp.data.views import evenly, move_on, tensors, white_noise
from forcegp.doubts import Doubt, Doubts, wrong
from forcegp.errors import ContactError, ForceGPError

FARTHEST = 5e-3  # m
ALONG_NORMAL, CREEP = 0.02, 2e-3
"""Velocity along the normal relative to that along the surface, and in m/s, that is none."""
MOST_ROWS, FEWEST_ROWS = 240, 10
FAR = 0.01  # m
HARDLY_ANY = 0.2  # share of rows that move along a surface, below which it is another one
BROKEN, NOISE = 0.2, 3.0
"""|A a - b| relative to the acceleration of the point, and to its noise, beyond which the contact does not hold."""


def rows_in_contact(dataset: Dataset) -> Dataset:
    """The rows in which the points of all contacts of `dataset.model` move along their surfaces, from q and v alone.

    A point at rest or gliding just above cannot be told from one in contact. A contact with a switch acts
    where its flag is. Raises ContactError for a contact off its surface, and where no row is left.
    """
    with torch.no_grad():
        touching, off = _on_surfaces(dataset, dataset.model.to("cpu"), _noise(dataset), flagged=False)
    if off or not touching.any():
        raise ContactError(str(off[0]) if off else "the points of the contacts never move along their surfaces.")
    return dataset.rows(touching)


def contact_doubts(dataset: Dataset, model: forcegp.Model | None = None) -> Doubts:
    """What the rows of `dataset` contradict about the contacts of `model` (default: its own); empty where nothing.

    Looks at 240 rows, in order of the file, for motion that leaves a surface, of 10 or more. Not without `RigidBodies`.
    """
    model = dataset.model if model is None else model
    if len(dataset) < FEWEST_ROWS or not dataset.u.any() or not model.contacts or model.carries_known_forces:
        return Doubts()
    rows = dataset.rows(evenly(dataset, MOST_ROWS))
    with torch.no_grad():
        try:
            return Doubts(_on_surfaces(rows, model.to("cpu"), _noise(dataset))[1])
        except (ForceGPError, np.linalg.LinAlgError, torch.linalg.LinAlgError):
            return Doubts()  # states that no contact bears: who computes with them raises what is wrong


def _noise(dataset: Dataset) -> tuple[np.ndarray, ...]:
    """Standard deviations of white noise on v and a, where the rows show it."""
    seen = [white_noise(dataset, signal=name) if move_on(dataset) else None for name in ("v", "a")]
    return tuple(np.zeros(dataset.nv) if each is None else np.nan_to_num(each) for each in seen)


def _on_surfaces(
    rows: Dataset, model: forcegp.Model, noise_seen: tuple[np.ndarray, ...], *, flagged: bool = True
) -> tuple[Bool[np.ndarray, " rows"], list[Doubt]]:
    """Rows whose points move along their surfaces, and the first contact whose point does not; none for drawn rows.

    `noise_seen` on v and a, where the rows show it; that on a is the Dataset's where it states one.
    """
    touching = np.ones(len(rows), dtype=bool)
    q, v, u, a = tensors(rows)
    state, (wander, sigma) = model.state(q, v, u), map(torch.tensor, noise_seen)
    sigma = sigma if rows.noise_std is None else torch.tensor(rows.noise_std)
    omega = 0.0 if model.baumgarte is None else model.baumgarte.omega
    for index, contact in enumerate(model.contacts):
        if contact.switch is not None and not flagged:
            continue
        acts = np.broadcast_to(contact.acts(u, model.inputs).numpy(), len(rows))
        if not acts.any():
            continue
        A, b, gradient = contact.constraint(state, model.baumgarte)
        size = torch.linalg.vector_norm(gradient, dim=-1)
        A, b, away = A / size[:, None], b / size, contact.distance(state.kinematics) / size
        J = state.kinematics.frame_jacobian(contact.frame, contact.point)[:, :3]
        speed, acceleration = (torch.linalg.vector_norm((J @ x[..., None])[..., 0], dim=-1) for x in (v, a))
        noise, rate_noise, speed_noise = (A * sigma).norm(dim=-1), (A * wander).norm(dim=-1), (J * wander).flatten(1)
        parts = away, speed, rate_noise, speed_noise.norm(dim=-1), (A * v).sum(-1).abs()
        away, speed, rate_noise, speed_noise, rate = (x.numpy()[acts] for x in parts)
        medians = (A * a).sum(-1) - b, acceleration, noise
        residual, acceleration, noise = (float(np.median(np.abs(x.numpy()[acts]))) for x in medians)
        distance = np.abs(away)
        slow = rate <= ALONG_NORMAL * speed + CREEP + omega * np.minimum(distance, FARTHEST) + 2.0 * rate_noise
        middle = np.median(away[slow]) if slow.any() else 0.0
        along, moves = slow & (np.abs(away - middle) <= FARTHEST), speed > 2.0 * (CREEP + speed_noise)
        share = float(along[moves].mean()) if moves.any() else 1.0
        if share < HARDLY_ANY:
            if residual <= max(BROKEN * acceleration, NOISE * noise):  # accelerations obey it: drawn, not recorded
                return np.zeros(len(rows), dtype=bool), []
            far = float(np.median(distance))
            few = f"only {100.0 * share:.0f} % of the rows move along its surface"
            speeds = f"{np.median(rate):.2g} m/s, and |A a - b| is {residual:.2g} m/s² (medians)"
            seen = f"{few}; the others move through it with {speeds}."
        elif (far := float(np.median(distance[along] if along.any() else distance))) > FAR:
            seen = f"its point moves along the surface, but {far:.3g} m away from it."
        else:
            touching[acts] &= along
            continue
        numbers = {"contact": index, "share": share, "distance": far}
        remedy = "Check its point, its surface and their units (m), or leave the contact out (`contacts=none`)."
        what = f"contact {index} (frame {contact.frame!r}): {seen}"
        return touching, [wrong(about="contact", what=what, do=remedy, numbers=numbers)]
    return touching, []
