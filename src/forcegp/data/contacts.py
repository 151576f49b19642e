"""In which rows of a log a contact acts, and whether motion and accelerations bear it out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

import forcegp.mechanics
from forcegp.data.dataset import Dataset
from forcegp.data.views import evenly, move_on, tensors, white_noise
from forcegp.doubts import Doubt, Doubts, look, wrong
from forcegp.errors import ContactError, ForceGPError

FARTHEST = 5e-3  # m
LEAST_DISTANCE = 1e-3  # m
ALONG_NORMAL, CREEP = 0.02, 2e-3
"""Velocity along the normal relative to that along the surface, and in m/s, that is none."""

LEAST_ACCELERATION = 0.05  # m/s^2
DEVIATIONS = 4.5
DISTANCE_DEVIATIONS = 20.0


def contact_rows(dataset: Dataset) -> Bool[np.ndarray, "rows m"]:
    """Whether each contact of `dataset.model` acts in each row, from q, v and a alone; `truth` is not looked at.

    A row counts if its point moves along the surface (across it at most 2 % of that and 2 mm/s), `|A a - b|` is at most
    4.5 standard deviations or 0.05 m/s^2, and it is within 5 mm of the surface and where the other rows are. A point at
    rest or gliding just above cannot be told from one in contact. A closed loop acts in every row, a contact with a
    switch where its flag is. Raises ContactError for a dataset without contacts, and for a contact that acts in no row.
    """
    model = dataset.model
    if not model.contacts:
        raise ContactError(
            "the dataset has a model without contacts; rows in contact can only be found for a model that lists its "
            "contacts: dataclasses.replace(dataset, model=...)."
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


MOST_ROWS, FEWEST_ROWS = 240, 10
FAR = 0.01  # m
HARDLY_ANY = 0.2  # share of rows that move along a surface, below which it is another one
BROKEN, NOISE = 0.2, 3.0
"""|A a - b| relative to the acceleration of the point, and to its noise, beyond which the contact does not hold."""

NO_FORCE = 0.3
"""Logarithms of what remains without a contact over what remains with it, over all joints: below, it does nothing."""

MANY_ROWS = 40  # from which on friction may also turn a link about the normal of a contact
SLOW = 0.1  # of the root mean square velocity: where dry friction turns over
FLOOR = 1e-14
LEAVE_OUT = "leave the contact out (`contacts=none`)."


def contact_doubts(dataset: Dataset, model: forcegp.Model | None = None) -> Doubts:
    """What the rows of `dataset` contradict about the contacts of `model` (default: its own); empty where nothing.

    Looks at 240 rows, in order of the file. Fewer than 10 rows, or than twice the friction that may hide among them,
    say nothing. `numbers["kind"]` is "off" (the motion leaves the surface) or "no force". Not for
    contacts that hold several points of one body, closed loops, nor models without `RigidBodies`.
    """
    model = dataset.model if model is None else model
    few = len(dataset) < FEWEST_ROWS or not dataset.u.any()
    if few or not model.contacts or model.loops or model.carries_known_forces:
        return Doubts()
    seen = [white_noise(dataset, signal=name) if move_on(dataset) else None for name in ("v", "a")]
    noise = tuple(np.zeros(dataset.nv) if each is None else np.nan_to_num(each) for each in seen)
    rows = dataset.rows(evenly(dataset, MOST_ROWS))
    with torch.no_grad():
        try:
            touching, off = _on_surfaces(rows, model.to("cpu"), noise)
            if off or touching.sum() < FEWEST_ROWS:
                return Doubts(off)
            return Doubts(_forces(rows.rows(touching), model.to("cpu")))
        except (ForceGPError, np.linalg.LinAlgError, torch.linalg.LinAlgError):
            return Doubts()  # states that no contact bears: who computes with them raises what is wrong


def _on_surfaces(
    rows: Dataset, model: forcegp.Model, noise_seen: tuple[np.ndarray, ...]
) -> tuple[Bool[np.ndarray, " rows"], list[Doubt]]:
    """Rows whose points move along their surfaces, and the first contact whose point does not; none for drawn rows."""
    touching = np.ones(len(rows), dtype=bool)
    motions = point_motions(rows, model, noise_seen)
    for index, (contact, motion) in enumerate(zip(model.contacts, motions, strict=True)):
        acts = np.ones(len(rows), bool)
        if contact.switch is not None:
            acts = rows.u[:, model.inputs.index(contact.switch)] > 0.5
        if not acts.any():
            continue
        motion = PointMotion(*(values[acts] for values in motion))
        distance, rate = np.abs(motion.distance), np.abs(motion.rate)
        residual, acceleration, noise = (
            float(np.median(np.abs(values))) for values in (motion.residual, motion.acceleration, motion.noise)
        )
        recovered = recovery_of(model) * np.minimum(distance, FARTHEST)
        slow = rate <= ALONG_NORMAL * motion.speed + CREEP + recovered + 2.0 * motion.rate_noise
        middle = np.median(motion.distance[slow]) if slow.any() else 0.0
        along = slow & (np.abs(motion.distance - middle) <= FARTHEST)
        moves = motion.speed > 2.0 * (CREEP + motion.speed_noise)
        share = float(along[moves].mean()) if moves.any() else 1.0
        if share < HARDLY_ANY:
            if residual <= max(BROKEN * acceleration, NOISE * noise):  # accelerations obey it: drawn, not recorded
                return np.zeros(len(rows), dtype=bool), []
            far = float(np.median(distance))
            seen = (
                f"only {100.0 * share:.0f} % of the rows move along its surface; the others move through it with "
                f"{np.median(rate):.2g} m/s, and |A a - b| is {residual:.2g} m/s² (medians)."
            )
        elif (far := float(np.median(distance[along] if along.any() else distance))) > FAR:
            seen = f"its point moves along the surface, but {far:.3g} m away from it."
        else:
            touching[acts] &= along
            continue
        numbers = {"kind": "off", "contact": index, "share": share, "distance": far}
        remedy = f"Check its point, its surface and their units (m), or {LEAVE_OUT}"
        what = f"contact {index} (frame {contact.frame!r}): {seen}"
        return touching, [wrong(about="contact", what=what, do=remedy, numbers=numbers)]
    return touching, []


def _forces(rows: Dataset, model: forcegp.Model) -> list[Doubt]:
    """Whether accelerations show a force of the contacts at all."""
    if len(rows) * (rows.nv - len(model.contacts)) < 2 * (3 * rows.nv + 5 * len(model.contacts)):
        return []
    friction = _friction(rows, model, model.dynamics(*tensors(rows)[:3]))
    stated = _left(rows, model, friction, None)
    free = _left(rows, model.with_contacts(()), friction, stated)
    necessary = float(np.log(free / stated).sum())
    if necessary >= NO_FORCE:
        return []
    seen = "the accelerations show no force of the stated contact: they fit as well without it."
    numbers = {"kind": "no force", "gain": necessary}
    return [look(about="contact", what=seen, do=f"If nothing was touched, {LEAVE_OUT}", numbers=numbers)]


def _left(
    rows: Dataset, model: forcegp.Model, friction: Tensor, weights: Float[np.ndarray, " nv"] | None
) -> Float[np.ndarray, " nv"]:
    """Power of each joint's a that friction (rows, nv, k) leaves; joints count by 1 over `weights`, or over it."""
    q, v, u, a = tensors(rows)
    dynamics = model.dynamics(q, v, u)
    X, y = (dynamics.H @ friction).numpy(), (a - dynamics.acceleration_map().offset).numpy()
    X = X / np.maximum(np.linalg.norm(X, axis=(0, 1)), 1e-300)
    power = np.square(y).sum(axis=0) + 1e-300
    left = power if weights is None else weights
    for _ in range(4 if weights is None else 1):
        scale = left**-0.5
        solution = np.linalg.lstsq((X * scale[:, None]).reshape(y.size, -1), (y * scale).ravel(), rcond=1e-6)[0]
        left = np.maximum(np.square(y - X @ solution).sum(axis=0), FLOOR * power)
    return left


def _friction(
    rows: Dataset, model: forcegp.Model, dynamics: forcegp.mechanics.ConstrainedDynamics
) -> Float[Tensor, "rows nv k"]:
    """Joint forces of viscous and dry friction and constants in every joint, and of friction at every contact."""
    state, v = dynamics.state, dynamics.state.v
    slow = SLOW * v.square().mean(0).sqrt() + 1e-12
    constant = torch.eye(rows.nv).to(v).expand(len(v), -1, -1)
    forces = [torch.diag_embed(v), torch.diag_embed(torch.tanh(v / slow)), constant]
    multipliers = dynamics.multiplier_map().offset.abs()
    for index, contact in enumerate(model.contacts):
        J, turning = state.kinematics.frame_jacobian(contact.frame, contact.point).split(3, dim=1)
        velocity = (J @ v[..., None])[..., 0]
        speed = torch.linalg.vector_norm(velocity, dim=-1, keepdim=True)
        direction = velocity / (speed + SLOW * speed.square().mean().sqrt() + 1e-12)
        loaded = direction * multipliers[:, [index]]
        forces.append(J.mT @ torch.stack([velocity, direction, loaded], dim=-1))
        if len(v) >= MANY_ROWS:  # friction beside the stated point turns the link about the normal
            along = turning.mT @ dynamics.normals[:, index, :, None]
            forces.append(along * torch.cat([velocity, loaded], dim=-1)[:, None])
    return torch.cat(forces, dim=-1)
