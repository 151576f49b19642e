"""What else explains the log of a payload: gains of drives, or lengths of links, and how far it would move the numbers.

Beside J of the numbers x, other causes c with columns C lower the squares of the whitened residual r at the best x
(Frisch & Waugh 1933): c = -(C' C - C' J F^-1 J' C + S^-2)^-1 C' r with F = J' J + prior, and x moves by -F^-1 J' C c.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from forcegp.doubts import Doubt, look
from forcegp.evidence.least_squares import Fit
from forcegp.evidence.recorded_rows import RecordedRows
from forcegp.fit.doubts import CLEARLY_MORE, LEAST, RIGHT
from forcegp.forces import Actuation
from forcegp.model import Model

CAUSES = {"gains": 0.2, "lengths": 0.1, "masses": 0.2}
"""Logarithms of factors that are usual: standard deviations. Of two causes the first is named, unless the other
explains a tenth more."""
STEP = 1e-4
"""Of a length, for its derivative."""
WRONG = 0.03
"""Logarithm of the largest factor below which a cause is not worth a word."""
REMEDIES = {
    "gains": "Estimate gains (--forces gain,... beside the URDF's masses), or calibrate them with a load (--mass).",
    "lengths": "Correct the URDF's lengths.",
    "masses": "Give a baseline (a log without the payload), or identify all links.",
}
SAID = {
    "gains": "torques of the log times",
    "lengths": "lengths before the joints times",
    "masses": "masses of the links times",
}


def misfit(
    model: Model,
    rows: Sequence[RecordedRows],
    a: Sequence[Float[np.ndarray, "rows nv"]],
    mean: Callable[[np.ndarray], np.ndarray],
    fit: Fit,
) -> tuple[Doubt, Float[np.ndarray, " k"]] | None:
    """The cause that explains most, if far more than `model`, and how far the coordinates move with it.

    `model` has the numbers of the fit, `a` are accelerations of the rows, `mean` makes equations of what rows have.
    """
    [actuation] = [law for law in model.laws if isinstance(law, Actuation)]
    gains = 1.0 if actuation.is_exact else actuation.values["gain"].cpu().numpy()[:, None]
    white, J = fit.white.ravel(), fit.white_jacobian.reshape(fit.white.size, -1)
    inverse, cost = np.linalg.inv(fit.information + fit.prior_information), 0.5 * float((fit.white**2).sum())
    best, found = max(CLEARLY_MORE, LEAST * cost), None
    scales = [10 * k for k, each in enumerate(rows[0].space.carried) if each.payload is not None]
    if np.linalg.norm(fit.residual) <= RIGHT * np.linalg.norm(0.5 * fit.jacobian[..., scales]):
        return None  # of the torques of payloads, next to nothing is left
    for cause, usual in CAUSES.items():
        if cause != "lengths" and not actuation.is_exact:
            continue  # a factor of all masses is one of the gains that are estimated
        parts = [_columns(cause, model, part, each) for part, each in zip(rows, a, strict=True)]
        names, C = parts[0][0], np.concatenate([each for _, each in parts])
        C = mean(C) / gains
        if cause == "gains":  # as the log has them: with the torques, what is needed would vanish, too
            C = C - fit.residual[:, :, None] * np.eye(C.shape[1])
        C = (C / fit.noise[:, None]).reshape(white.size, -1)
        across = J.T @ C
        own = C.T @ C - across.T @ inverse @ across
        change = -np.linalg.solve(own + np.eye(C.shape[1]) / usual**2, C.T @ white)
        more, off, factors = -0.5 * float(white @ C @ change), abs(change) > WRONG, np.exp(change)
        if more > best and off.any():
            told = ", ".join(f"{names[k]} {factors[k]:.3g}" for k in np.flatnonzero(off))
            doubt = look(
                about="payload",
                what=f"{SAID[cause]} these factors would leave {more / cost:.0%} less of the log: {told}. "
                "The intervals hold what that would change.",
                do=REMEDIES[cause],
                joints=tuple(np.array(names)[off].tolist()),
                numbers={cause: dict(zip(names, factors.tolist(), strict=True))},
            )
            best, found = 1.1 * more, (doubt, -inverse @ (across @ change))
    return found


def _columns(
    cause: str, model: Model, rows: RecordedRows, a: Float[np.ndarray, "rows nv"]
) -> tuple[list[str], Float[np.ndarray, "rows nv causes"]]:
    """Names of joints or links, and derivatives of torques needed less those measured in logarithms of factors."""
    robot = model.loaded_robot if rows.loaded else model.robot
    if cause == "gains":
        return list(robot.joint_names), -rows.delivered[:, :, None] * np.eye(robot.nv)
    if cause == "masses":
        return [body.child for body in robot.layout.bodies], rows.by_body(a)
    q, v, at = (torch.as_tensor(np.array(x), device=robot.device) for x in (rows.q, rows.v, a))
    names, columns = [], []
    for body, drive in enumerate(robot.layout.drives):
        if robot.layout.parents[body] >= 0 and bool(robot.tree.rest[body, :3, 3].any()):
            rest = robot.tree.rest.clone()
            rest[body, :3, 3] *= 1.0 + STEP
            longer = replace(robot, tree=replace(robot.tree, rest=rest))
            change = longer.inverse_dynamics(q, v, at) - robot.inverse_dynamics(q, v, at)
            names.append(robot.joint_names[drive.joint])
            columns.append(change.cpu().numpy() / STEP)
    return names, np.stack(columns, axis=-1) if columns else np.zeros((*a.shape, 0))
