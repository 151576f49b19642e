"""Do the rows of a log bear out its contacts: their direction, their point, their force, and whether one is missing.

Right contacts leave of `a - a_C(q, v, u)`, with a_C the acceleration of Gauss' principle, friction and noise alone. So
this residual is fitted by friction of the joints and the tool (a linear basis seen through H), and compared with the
same under other contacts: with the point moved, without any, or with one that the motion shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import forcegp.mechanics
from forcegp.data.dataset import Dataset
from forcegp.errors import ForceGPError

MOST_ROWS = 240
FEWEST_ROWS = 10
MANY_ROWS = 40
BLOCKS = 6
"""Stretches that are left out in turn, for the standard deviation of the point."""

STEP = 1e-3  # m
FAR = 0.01  # m
NEAR = 5e-3  # m
SLOPE, LEAST_SPEED = 0.02, 2e-3
"""Velocity along the normal relative to that along the surface, and in m/s, that is none (as for `contact_rows`)."""

HARDLY_ANY = 0.2
"""Share of rows that move along a surface, below which it is another one."""

BROKEN, NOISE = 0.2, 3.0
"""|A a - b| relative to the acceleration of the point, and to its noise, beyond which the contact does not hold."""

MOVED = 5e-3  # m
MOVED_DEVIATIONS = 5.0
MOVED_GAIN = 0.7
NO_FORCE = 0.3
"""Logarithms of what remains without a contact over what remains with it, over all joints: below, it does nothing."""

NEEDED = 2.0
"""And above, a contact that was not stated is needed."""

STAYS = 3e-3
"""Mean square velocity along a direction, relative to what joints that move independently would give."""

ARM = 0.3
"""Size in m of a link: of several points that stay on a surface, one not farther from its frame than that is likely."""

SLOW = 0.1
FLOOR = 1e-14


@dataclass(frozen=True, kw_only=True)
class ContactDoubt:
    """What the rows say against the contacts: `seen` in words with numbers, `remedy`, and `numbers` for programs.

    `kind`: "off" (the motion leaves the surface), "point" (forces act elsewhere), "no force", "missing".
    """

    kind: str
    seen: str
    remedy: str
    numbers: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.seen} {self.remedy}"


def contact_doubts(dataset: Dataset, system: forcegp.mechanics.MechanicalSystem | None = None) -> list[ContactDoubt]:
    """What the rows of `dataset` contradict about the contacts of `system` (default: its own); empty where nothing.

    Looks at 240 rows, in order of the file. Fewer than 10 rows, or than twice the friction that may hide among them,
    say nothing. Not for contacts that hold several points of one body.
    """
    system = dataset.system if system is None else system
    if system is None or len(dataset) < FEWEST_ROWS or not dataset.u.any():
        return []
    rows = dataset.rows(np.unique(np.linspace(0, len(dataset) - 1, MOST_ROWS).astype(int)))
    with torch.no_grad():
        try:
            return _stated(rows, system.to("cpu")) if system.contacts else _missing(rows, system.to("cpu"))
        except (ForceGPError, np.linalg.LinAlgError, torch.linalg.LinAlgError):
            return []  # states that no contact bears: who computes with them raises what is wrong


def _tensors(rows: Dataset) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return tuple(torch.tensor(getattr(rows, name)) for name in "qvua")  # type: ignore[return-value]


def _stated(rows: Dataset, system: forcegp.mechanics.MechanicalSystem) -> list[ContactDoubt]:
    q, v, u, a = _tensors(rows)
    state = forcegp.mechanics.State.of(system.robot, q, v, u)
    touching = np.ones(len(rows), dtype=bool)
    for index, contact in enumerate(system.contacts):
        A, b, gradient = contact.constraint(state, system.baumgarte)
        size = torch.linalg.vector_norm(gradient, dim=-1)
        J = state.kinematics.frame_jacobian(contact.frame, contact.point)[:, :3]
        speed = torch.linalg.vector_norm((J @ v[..., None])[..., 0], dim=-1).numpy()
        rate = ((A * v).sum(-1) / size).abs().numpy()
        residual = float((((A * a).sum(-1) - b) / size).abs().median())  # |A a - b| in m/s^2
        acceleration = float(torch.linalg.vector_norm((J @ a[..., None])[..., 0], dim=-1).median())
        noise = (
            0.0
            if rows.noise_std is None
            else float((A / size[:, None] * torch.tensor(rows.noise_std)).norm(dim=-1).median())
        )
        broken = residual > max(BROKEN * acceleration, NOISE * noise)
        distance = (contact.distance(state.kinematics) / size).numpy()
        recovery = 0.0 if system.baumgarte is None else system.baumgarte.omega
        slow = rate <= SLOPE * speed + LEAST_SPEED + recovery * np.minimum(np.abs(distance), NEAR)
        moves = speed > 2.0 * LEAST_SPEED
        along = slow & (np.abs(distance - np.median(distance[slow]) if slow.any() else distance) <= NEAR)
        what = f"contact {index} (frame {contact.frame!r}): "
        remedy = "Check its point, its surface and their units (m), or leave the contact out (--contact none)."
        share = float(along[moves].mean()) if moves.any() else 1.0
        far = float(np.median(np.abs(distance[along]))) if along.any() else float(np.median(np.abs(distance)))
        if share < HARDLY_ANY:
            if not broken:
                return []  # states that no contact holds, but accelerations that obey it: drawn, not recorded
            return [
                ContactDoubt(
                    kind="off",
                    seen=f"{what}only {100.0 * share:.0f} % of the rows move along its surface; the others move "
                    f"through it with {np.median(rate):.2g} m/s, and |A a - b| is {residual:.2g} m/s² (medians).",
                    remedy=remedy,
                    numbers={"contact": index, "share": share, "distance": float(np.median(np.abs(distance)))},
                )
            ]
        if far > FAR:
            return [
                ContactDoubt(
                    kind="off",
                    seen=f"{what}its point moves along the surface, but {far:.3g} m away from it.",
                    remedy=remedy,
                    numbers={"contact": index, "share": share, "distance": far},
                )
            ]
        touching &= along
    if touching.sum() < FEWEST_ROWS:
        return []
    return _forces(rows.rows(touching), system)


class _Residual:
    """Accelerations that friction and some more columns leave of `a` under a system's contacts, joint by joint."""

    def __init__(
        self,
        rows: Dataset,
        system: forcegp.mechanics.MechanicalSystem,
        friction: Float[Tensor, "rows nv k"] | None = None,
        more: Sequence[forcegp.mechanics.MechanicalSystem] = (),
    ) -> None:
        q, v, u, a = _tensors(rows)
        dynamics = system.dynamics(q, v, u)
        given = dynamics.acceleration_map().offset
        self.friction = _friction(rows, system, dynamics) if friction is None else friction
        moved = [(other.dynamics(q, v, u).acceleration_map().offset - given) / STEP for other in more]
        columns = torch.cat([dynamics.H @ self.friction, *(each[..., None] for each in moved)], dim=-1)
        self.extra = len(moved)
        parts = torch.cat([columns, (a - given)[..., None]], dim=-1).numpy()
        size = np.linalg.norm(parts, axis=(0, 1))
        self.used = size > 1e-9 * max(float(size.max()), 1e-300)
        self.used[-1] = True
        self.size = np.where(self.used, np.maximum(size, 1e-300), 1.0)
        self.blocks = np.array_split(parts / self.size * self.used, BLOCKS)
        self.count = len(rows)

    def grams(self) -> Float[np.ndarray, "blocks nv k k"]:
        return np.stack([np.einsum("rjk,rjl->jkl", block, block) for block in self.blocks])

    def solved(
        self, gram: Float[np.ndarray, "nv k k"], weights: Float[np.ndarray, " nv"], extra: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients (k,), and the power (nv,) that is left in every joint."""
        count = gram.shape[-1] - 1
        used = np.flatnonzero(self.used[:-1] & ((np.arange(count) < count - self.extra) | extra))
        total = np.tensordot(weights, gram, 1)
        solution = np.zeros(count + 1)
        if len(used):
            solution[used] = -np.linalg.lstsq(total[np.ix_(used, used)], total[used, -1], rcond=1e-12)[0]
        solution[-1] = 1.0
        left = np.maximum(np.einsum("k,jkl,l->j", solution, gram, solution), FLOOR * gram[:, -1, -1]) + 1e-300
        return -solution[:-1] / self.size[:-1] * self.size[-1], left * self.size[-1] ** 2

    def fitted(
        self, extra: bool = False, weights: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coefficients, power left, and weights: those given, or in proportion to 1 over the power that is left."""
        gram = self.grams().sum(axis=0)
        if weights is None:
            weights = 1.0 / np.maximum(gram[:, -1, -1], 1e-300)
            for _ in range(3):
                weights = self.size[-1] ** 2 / self.solved(gram, weights, extra)[1]
        return *self.solved(gram, weights, extra), weights


def _friction(
    rows: Dataset, system: forcegp.mechanics.MechanicalSystem, dynamics: forcegp.mechanics.ConstrainedDynamics
) -> Float[Tensor, "rows nv k"]:
    """Joint forces of viscous and dry friction and constants in every joint, and of friction at every contact."""
    state, v = dynamics.state, dynamics.state.v
    slow = SLOW * v.square().mean(0).sqrt() + 1e-12
    forces = [
        torch.diag_embed(v),
        torch.diag_embed(torch.tanh(v / slow)),
        torch.eye(rows.nv).to(v).expand(len(v), -1, -1),
    ]
    multipliers = dynamics.multiplier_map().offset.abs()
    many = len(v) >= MANY_ROWS
    for index, contact in enumerate(system.contacts):
        J = state.kinematics.frame_jacobian(contact.frame, contact.point)[:, :3]
        velocity = (J @ v[..., None])[..., 0]
        speed = torch.linalg.vector_norm(velocity, dim=-1, keepdim=True)
        direction = velocity / (speed + SLOW * speed.square().mean().sqrt() + 1e-12)
        tangential = torch.stack([velocity, direction, direction * multipliers[:, [index]]], dim=-1)
        forces.append(J.mT @ tangential)
        if many:  # friction beside the stated point turns the link about the normal
            turning = state.kinematics.frame_jacobian(contact.frame, contact.point)[:, 3:]
            along = turning.mT @ dynamics.normals[:, index, :, None]
            forces.append(along * torch.cat([velocity, direction * multipliers[:, [index]]], dim=-1)[:, None])
    return torch.cat(forces, dim=-1)


def _forces(rows: Dataset, system: forcegp.mechanics.MechanicalSystem) -> list[ContactDoubt]:
    """Whether forces act at the points that the contacts state, and whether there are any."""
    if len(rows) * (rows.nv - len(system.contacts)) < 2 * (3 * rows.nv + 5 * len(system.contacts)):
        return []
    others, tangents = _moved_points(rows, system)
    given = _Residual(rows, system, more=others)
    solution, left, weights = given.fitted(extra=True)
    stated = given.fitted(weights=weights)[1]
    free = _Residual(rows, system.with_contacts(()), friction=given.friction).fitted(weights=weights)[1]
    necessary = float(np.log(free / stated).sum())
    improved = float(np.log(stated / left).sum())
    grams = given.grams()
    each = np.stack([given.solved(grams.sum(axis=0) - gram, weights, True)[0] for gram in grams])
    deviations = np.std(each, axis=0) * np.sqrt(BLOCKS - 1.0)
    doubts = []
    for index, contact in enumerate(system.contacts):
        places = slice(len(solution) - len(others) + 2 * index, len(solution) - len(others) + 2 * index + 2)
        shift, std = solution[places], deviations[places]
        size, uncertain = float(np.linalg.norm(shift)), float(np.linalg.norm(std))
        if size > max(MOVED, MOVED_DEVIATIONS * uncertain) and improved > MOVED_GAIN:
            point = np.asarray(contact.point) + shift @ tangents[index]
            text = ",".join(f"{value + 0.0:.3g}" for value in np.round(point, 4))
            doubts.append(
                ContactDoubt(
                    kind="point",
                    seen=f"contact {index} (frame {contact.frame!r}): the accelerations show that its force acts about "
                    f"{100.0 * min(size, 1.0):.2g} cm ± {100.0 * uncertain:.1g} cm beside the stated point.",
                    remedy=f"Check the contact's point (near {text}?), or what else presses against the robot.",
                    numbers={"contact": index, "shift": size, "std": uncertain, "point": point.tolist()},
                )
            )
    if not doubts and necessary < NO_FORCE:
        doubts.append(
            ContactDoubt(
                kind="no force",
                seen="the accelerations show no force of the stated contact: they fit as well without it.",
                remedy="If nothing was touched, leave the contact out (--contact none).",
                numbers={"gain": necessary},
            )
        )
    return doubts


def _moved_points(
    rows: Dataset, system: forcegp.mechanics.MechanicalSystem
) -> tuple[list[forcegp.mechanics.MechanicalSystem], list[np.ndarray]]:
    """The system with each contact point moved along the surface, in both directions of the link's frame."""
    kinematics = system.robot.kinematics(torch.tensor(rows.q))
    others, tangents = [], []
    for index, contact in enumerate(system.contacts):
        normal = contact.surface.gradient(contact.position(kinematics))
        local = (kinematics.frame_pose(contact.frame)[:, :3, :3].mT @ normal[..., None])[..., 0].numpy()
        across = np.linalg.eigh(local.T @ local)[1][:, :2].T  # the directions that are least along the normal
        for direction in across:
            point = tuple(np.asarray(contact.point) + STEP * direction)
            contacts = list(system.contacts)
            contacts[index] = replace(contact, point=point)
            others.append(system.with_contacts(contacts))
        tangents.append(across)
    return others, tangents


def _missing(rows: Dataset, system: forcegp.mechanics.MechanicalSystem) -> list[ContactDoubt]:
    """A point of a last link that stays on a plane or sphere, with a force that accelerations need."""
    if len(rows) < 2 * FEWEST_ROWS or rows.nv < 2:
        return []
    robot = system.robot
    parents = set(robot.layout.parents)
    best: tuple[float, forcegp.mechanics.Contact] | None = None
    for body in range(rows.nv):
        if body in parents:
            continue
        for contact in _surfaces(rows, robot, robot.joints[body].child):
            others, _ = _moved_points(rows, system.with_contacts([contact]))
            with_it = _Residual(rows, system.with_contacts([contact]), more=others)
            _, left, weights = with_it.fitted(extra=True)  # the motion may show the surface, and not the point
            free = _Residual(rows, system, friction=with_it.friction).fitted(weights=weights)[1]
            own = _Residual(rows, system, friction=with_it.friction).fitted()[1]
            gain = float(np.log(np.minimum(free, own) / left).sum())
            if gain > NEEDED and (best is None or gain > best[0]):
                best = gain, contact
    if best is None:
        return []
    gain, contact = best
    surface = contact.surface
    if isinstance(surface, forcegp.mechanics.Plane):
        normal = ", ".join(f"{value + 0.0:.2f}" for value in surface.normal)
        where = f"a plane with the normal ({normal})"
    else:
        where = "a sphere" if isinstance(surface, forcegp.mechanics.Sphere) else "a surface"
    return [
        ContactDoubt(
            kind="missing",
            seen=f"no contact is stated, but link {contact.frame!r} stays on {where}, and the accelerations "
            "need a force along its normal.",
            remedy="State the contact (--contact FRAME@x,y,z:SURFACE), or leave out the rows in contact.",
            numbers={"frame": contact.frame, "gain": gain},
        )
    ]


def _surfaces(rows: Dataset, robot: Any, frame: str) -> list[forcegp.mechanics.Contact]:
    """Contacts of an unknown point p of `frame` with a plane or sphere, along which the frame moves.

    A plane with the normal n holds n (v_o + w x R p) = 0, linear in n and n p^T; a sphere adds s (x . dx/dt) with x the
    position of the point. The smallest eigenvalues, relative to joints that move independently, are constraints.
    """
    q, v = torch.tensor(rows.q), torch.tensor(rows.v)
    kinematics = robot.kinematics(q, v)
    J = kinematics.frame_jacobian(frame).numpy()
    pose = kinematics.frame_pose(frame).numpy()
    R, origin = pose[:, :3, :3], pose[:, :3, 3]
    turned = [np.cross(J[:, 3:], R[:, None, :, k], axisa=1, axisb=2).transpose(0, 2, 1) for k in range(3)]  # w x R e_k
    plane = [J[:, i] for i in range(3)] + [turned[k][:, i] for i in range(3) for k in range(3)]
    round_ = [np.einsum("ri,rij->rj", origin, J[:, :3])]
    round_ += [
        np.einsum("ri,rij->rj", origin, turned[k]) + np.einsum("ri,rij->rj", R[:, :, k], J[:, :3]) for k in range(3)
    ]
    spread = np.sqrt(np.square(rows.v).mean(axis=0))
    found = []
    for columns in (plane, plane + round_):
        z = np.stack(columns, axis=1)  # (rows, k, nv)
        z = z / np.maximum(np.sqrt(np.square(z * spread).mean(axis=(0, 2))), 1e-12)[:, None]
        scale = 1.0 / np.maximum(np.sqrt(np.square(np.stack(columns, axis=1) * spread).mean(axis=(0, 2))), 1e-12)
        free = np.einsum("rkj,rlj,j->kl", z, z, spread**2) / len(rows)
        moved = np.einsum("rkj,rj->rk", z, rows.v)
        held = moved.T @ moved / len(rows)
        powers, directions = np.linalg.eigh(free)
        kept = powers > 1e-6 * powers[-1]
        if len(rows) < 3 * kept.sum():
            continue
        basis = directions[:, kept] / np.sqrt(powers[kept])
        ratios, vectors = np.linalg.eigh(basis.T @ held @ basis)
        small = ratios < STAYS
        if not small.any():
            continue
        space = scale[:, None] * (basis @ vectors[:, small])  # constraints, in the columns' own units
        size = np.where(np.arange(len(space)) < 3, 1.0, ARM)
        shape = np.linalg.qr(space / size[:, None])[0]
        nearest = shape @ np.linalg.svd(shape[:3], full_matrices=False)[2][0]  # of several: near the frame's origin
        found.append(_surface(size * nearest, frame, R, origin))
    return [contact for contact in found if contact is not None]


def _surface(
    z: Float[np.ndarray, " k"], frame: str, R: Float[np.ndarray, "rows 3 3"], origin: Float[np.ndarray, "rows 3"]
) -> forcegp.mechanics.Contact | None:
    """The contact of one constraint."""
    normal, product = z[:3], z[3:12].reshape(3, 3)
    size = float(np.linalg.norm(normal))
    if not size > 0.0:
        return None
    point = product.T @ normal / size**2
    position = origin + R @ point
    if len(z) > 12 and abs(z[12]) * np.ptp(position, axis=0).max() > 1e-2 * size:
        center = -normal / z[12]
        radius = float(np.linalg.norm(position - center, axis=1).mean())
        return forcegp.mechanics.Contact(frame, tuple(point), forcegp.mechanics.Sphere(tuple(center), radius))
    normal = normal / size
    return forcegp.mechanics.Contact(
        frame, tuple(point), forcegp.mechanics.Plane(tuple(normal), float((position @ normal).mean()))
    )
