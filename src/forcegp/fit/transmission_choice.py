"""Which motors turn with two joints, as those of wrists do, by stretches of a log that are held out."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from forcegp.data import Dataset
from forcegp.evidence import motion_residuals
from forcegp.forces import Actuation
from forcegp.model import Model

WIDTHS = 0.01, 0.1
"""Of smooth signs, over the root mean square velocity: together they stand for dry friction of any width."""
ERRORS, SHARE = 3.0, 0.2
"""Standard errors over the stretches, and share of the squared residual of two joints, by which a coupling must lower
this: motors of most robots turn with one joint."""
RIDGE = 1e-8


def choose_transmission(
    model: Model, bare: Model, log: Dataset, stretch: Int[np.ndarray, " rows"]
) -> Float[np.ndarray, "nv nv"] | None:
    """The transmission under which friction and rotors explain most of held-out stretches; None: that of the joints.

    `model` is one whose numbers are known, `bare` the same without friction and rotors, `stretch` the number of each
    row's. Tried are that of the actuators, and motors that turn with the joint next to theirs as well, of the same
    kind, by the sum of both or the difference. The best is added while it helps clearly.
    """
    noise = np.sqrt((motion_residuals(log, model)[0] ** 2).mean(0))
    weight = 1.0 / np.maximum(noise, 1e-6 * max(float(noise.max()), 1e-12))
    torque = motion_residuals(log, bare)[0] * weight
    q, v, a = (torch.as_tensor(np.array(x), device=model.robot.device) for x in (log.q, log.v, log.a))
    bodies = model.robot.kinematics(q, v).torque_regressor(a).flatten(2).cpu().numpy() * weight[:, None]
    rows = [stretch == k for k in np.unique(stretch)]

    def motor(row: Float[np.ndarray, " nv"]) -> tuple[np.ndarray, ...]:
        """Friction and rotor of a motor that turns by `row` v, with what its joints share of bodies and torques."""
        v, a, w = log.v @ row, log.a @ row, row * weight
        speed = np.sqrt((v**2).mean()).clip(1e-12)
        signs = [np.tanh(v / (width * speed)) for width in WIDTHS]
        C, at = np.stack([v, a, np.ones_like(v), *signs, np.sqrt(abs(v)) * signs[0]], axis=-1), np.flatnonzero(w)
        own, asked = np.einsum("nkc,k->nc", bodies[:, at], w[at]), torque[:, at] @ w[at]
        return C, *(np.stack([C[k].T @ each[k] for k in rows]) for each in (own, asked[:, None]))

    of_bodies, asked = (
        np.stack([np.tensordot(bodies[k], y[k], ((0, 1), (0, 1))) for k in rows]) for y in (bodies, torque[..., None])
    )
    motors = dict[bytes, Any]()  # candidates differ in one of them

    def left(T: Float[np.ndarray, "nv nv"]) -> Float[np.ndarray, "stretches nv"]:
        """Squared residuals of each stretch by the numbers of the others."""
        for row in T:
            if row.tobytes() not in motors:
                motors[row.tobytes()] = motor(row)
        columns, with_bodies, of_motors = zip(*(motors[row.tobytes()] for row in T), strict=True)
        C, shared = np.stack(columns, axis=1), (T * weight) @ (T * weight).T
        size, count = C.shape[-1], of_bodies.shape[-1]
        normal = np.zeros((len(rows), count + C[0].size, count + C[0].size))
        normal[:, :count, :count], across = of_bodies, np.concatenate(with_bodies, axis=1)
        normal[:, count:, :count], normal[:, :count, count:] = across, across.swapaxes(1, 2)
        for m, n in np.argwhere(shared):
            block = np.stack([C[k, m].T @ C[k, n] for k in rows]) * shared[m, n]
            normal[:, count + m * size :, count + n * size :][:, :size, :size] = block
        right, scale = np.concatenate([asked, *of_motors], axis=1), np.sqrt(np.diagonal(normal.sum(0))).clip(1e-100)
        normal, right = normal / np.outer(scale, scale), right / scale[:, None]
        others = normal.sum(0) - normal + RIDGE * np.eye(len(scale))
        each = np.linalg.solve(others, right.sum(0) - right)[..., 0] / scale
        of_rows = zip(rows, each[:, :count], each[:, count:].reshape(len(rows), -1, size), strict=True)
        misses = (torque[k] - bodies[k] @ b - np.einsum("nmc,mc->nm", C[k], m) @ (T * weight) for k, b, m in of_rows)
        return np.stack([(miss**2).sum(0) for miss in misses])

    found = np.eye(log.nv)
    best = left(found)
    while better := [(T, then) for T, joints in _candidates(model, found) if _clearly(best, then := left(T), joints)]:
        found, best = min(better, key=lambda each: each[1].sum())
    return None if np.array_equal(found, np.eye(log.nv)) else found


def _candidates(model: Model, T: Float[np.ndarray, "nv nv"]) -> Iterator[tuple[np.ndarray, list[int]]]:
    """Transmissions with one coupling more, and the joints that it changes."""
    robot, nv = model.robot, len(T)
    named = {joint.name: joint.type == "prismatic" for joint in robot.joints}
    slides = [named.get(name) if name in robot.single_joint_names else None for name in robot.joint_names]
    drives = robot.layout.drives
    bodies = zip(drives, robot.layout.parents, strict=True)
    pairs = {(drive.joint, drives[parent].joint) for drive, parent in bodies if parent >= 0}
    for a, b in sorted(pairs | {pair[::-1] for pair in pairs}):
        if a != b and slides[a] is not None and slides[a] == slides[b] and T[a, b] == 0.0:
            unit = np.outer(np.eye(nv)[a], np.eye(nv)[b])
            for more in (unit, -unit, *([unit - unit.T] if T[b, a] == 0.0 and a < b else [])):  # last, differentials
                new = T + more
                if np.linalg.matrix_rank(new) == nv:
                    yield new, [a, b]
    for force in model.laws:
        if isinstance(force, Actuation) and force.matrix is not None:
            known = np.asarray(torch.as_tensor(force.matrix).cpu()).T
            if known.shape == T.shape and known.diagonal().all():
                known = known / known.diagonal()[:, None]
                changed = np.flatnonzero((known != T).any(0) | (known != T).any(1))
                if len(changed) and np.linalg.matrix_rank(known) == nv:
                    yield known, changed.tolist()


def _clearly(without: Float[np.ndarray, "stretches nv"], best: np.ndarray, joints: list[int]) -> bool:
    """By ratios of each stretch: in absolute numbers those of fast motion would decide alone."""
    gains = np.log(without[:, joints].sum(1) + 1e-300) - np.log(best[:, joints].sum(1) + 1e-300)
    surely = gains.mean() > ERRORS * gains.std(ddof=1) / np.sqrt(len(gains))
    return bool(surely and (without - best).sum() > SHARE * without[:, joints].sum())
