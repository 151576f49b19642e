"""Which motors turn with two joints, as those of wrists do, by stretches of a log that are held out."""

from collections.abc import Iterator

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

    def left(T: Float[np.ndarray, "nv nv"]) -> Float[np.ndarray, "stretches nv"]:
        """Squared residuals of each stretch by the numbers of the others."""
        v, a = log.v @ T.T, log.a @ T.T
        speed = np.sqrt((v**2).mean(0)).clip(1e-12)
        signs = [np.tanh(v / (width * speed)) for width in WIDTHS]
        columns = np.stack([v, a, np.ones_like(v), *signs, np.sqrt(abs(v)) * signs[0]], axis=-1)
        motors = np.einsum("nkc,kj->njkc", columns, T * weight).reshape(*v.shape, -1)
        X = np.concatenate([bodies, motors], axis=-1)
        X = X / np.sqrt((X**2).sum((0, 1))).clip(1e-300)
        sides = X, torque[..., None]
        normal, right = (np.stack([np.tensordot(X[k], y[k], ((0, 1), (0, 1))) for k in rows]) for y in sides)
        others = normal.sum(0) - normal + RIDGE * np.eye(X.shape[-1])
        each = np.linalg.solve(others, right.sum(0) - right)[..., 0]
        return np.stack([((torque[k] - X[k] @ x) ** 2).sum(0) for k, x in zip(rows, each, strict=True)])

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
            for sign in (1.0, -1.0):
                new = T + sign * np.outer(np.eye(nv)[a], np.eye(nv)[b])
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
    gain = (without - best).sum(1)
    least = max(ERRORS * np.sqrt(len(gain)) * gain.std(ddof=1), SHARE * without[:, joints].sum())
    return bool(gain.sum() > least)
