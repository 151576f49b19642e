"""Rests in which something else holds the robot: brakes of an emergency stop, drives that are off."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from forcegp.checks.check_input import CheckInput
from forcegp.checks.torques import WIDTHS, with_gravity
from forcegp.data import Dataset
from forcegp.data.views import consecutive, rests, runs
from forcegp.doubts import Doubt, look
from forcegp.model import Model
from forcegp.robots import Robot

MOST_ROWS = 1000
HELD = 3.0  # of the dry friction and of what remains in motion, from which on no gear holds the joint


def without_stops(log: Dataset, model: Model | None = None) -> tuple[Dataset, list[Doubt]]:
    """The log without rests whose torques are not those of this posture, and what is said of them.

    Torques in motion say what a posture needs, under any gravity and with any masses.
    """
    model = log.model if model is None else model
    plain = log.time_ordered and not model.robot.layout.groups and not model.contacts and log.u.shape == log.v.shape
    if not plain or not (found := rests(log)) or sum(map(len, found)) > len(log) // 2:
        return log, []
    inputs, still = CheckInput.quick(_cut(log, found), model), np.unique(np.concatenate(found))
    if inputs.compared is None:
        return log, []
    rows, at = replace(inputs, most_rows=MOST_ROWS).rows(), log.rows(still)
    columns, standing, held = _needs(inputs.robot, rows), _needs(inputs.robot, at), np.zeros(len(still), bool)
    for k, (u, v, a) in enumerate(zip(rows.u.T, rows.v.T, rows.a.T, strict=True)):
        slow = np.sqrt(np.square(v).mean()) + 1e-300
        dry = np.stack([np.tanh(v / (width * slow)) for width in WIDTHS], axis=1)
        both = np.c_[columns[:, k], a, v, dry]
        size = np.linalg.norm(both, axis=0) + 1e-300
        number = np.linalg.lstsq(both / size, u, rcond=1e-6)[0] / size
        most = np.abs(dry @ number[-len(WIDTHS) :]).max() + np.std(u - both @ number)
        held |= np.abs(at.u[:, k] - standing[:, k] @ number[: columns.shape[-1]]) > HELD * most
    stops = [each for each in found if held[np.isin(still, each)].mean() > 0.5]
    if not stops:
        return log, []
    within = np.isin(np.arange(len(log)), np.concatenate(stops))
    spans = [(float(log.time[begin]), float(log.time[end - 1])) for begin, end in runs(within)]
    seconds = ", ".join(f"{begin:.4g} to {end:.4g}" for begin, end in spans)
    doubt = look(
        about="stop",
        what=f"all joints stand still from {seconds} s, and their torques are not those that this posture needs: "
        "brakes hold the robot, or its drives are off.",
        do="These rows are left out of all checks, and of forcegp auto; of other fits leave them out yourself.",
        numbers={"seconds": spans},
    )
    return _cut(log, stops), [doubt]


def _cut(log: Dataset, found: list[np.ndarray]) -> Dataset:
    """Without these rows; what was before and behind them are episodes."""
    kept = ~np.isin(np.arange(len(log)), np.concatenate(found))
    begins = np.diff(kept, prepend=True) | ~np.insert(consecutive(log)[:-1], 0, True)
    return replace(log.rows(kept), episode=np.cumsum(begins)[kept])


def _needs(robot: Robot, rows: Dataset) -> Float[np.ndarray, "rows nv k"]:
    """What bodies of any mass need under any gravity, and an offset."""
    q, v, a = (torch.tensor(x, device=robot.device) for x in (rows.q, rows.v, rows.a))
    with torch.no_grad():
        needs = [
            with_gravity(robot, each).kinematics(q, v).torque_regressor(a).flatten(-2).cpu().numpy()
            for each in (np.zeros(3), *np.eye(3))
        ]
    return np.concatenate([*needs, np.ones((*rows.v.shape, 1))], axis=-1)
