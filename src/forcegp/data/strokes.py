"""Strokes of joints, from reversal to reversal: what friction with memory needs of the past, in every row by itself."""

from dataclasses import replace
from math import comb

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from forcegp.data.dataset import Dataset
from forcegp.mechanics import State

COUNT = 12
"""Strokes that a row remembers: of more, what friction still feels is smaller than 12 encoder steps times sigma."""
STEPS = 2.0  # steps of an encoder within which a reversal counts as none
NOISES = 8.0  # standard deviations of white noise in positions within which a reversal counts as none
ORDERS, AGREE = (5, 6), 1.25
"""Differences of both orders find the same noise up to this factor; where motion or rounding dominates they do not."""
Positions = Float[np.ndarray, "rows nv"]
Gears = Float[np.ndarray, "nv nv"] | None  # a `transmission`, or None for joints
NORMAL = 0.6745  # median of absolute values of a standard normal variable
ON_GRID, MOSTLY = 0.1, 0.9
"""Positions lie on a grid where so many of their differences are within this share of a whole number of steps."""


def with_strokes(dataset: Dataset, transmission: Float[np.ndarray, "nv nv"] | Tensor | None = None) -> Dataset:
    """The log whose rows know the motion before them, whichever of them are chosen; as it is where it has no order.

    Strokes are those of joints, or of motors with this `transmission`.
    """
    if dataset.knows_strokes(transmission) or not dataset.time_ordered:
        return dataset
    T = None if transmission is None else np.asarray(torch.as_tensor(transmission).cpu())
    return replace(dataset, strokes=strokes(dataset, transmission=T), transmission=T)


def strokes(dataset: Dataset, count: int = COUNT, transmission: Gears = None) -> Float[np.ndarray, "rows nv count"]:
    """Displacements (rad or m) of each joint up to every row: since the last reversal, of the stroke before, and so on.

    They alternate in sign; those before the first row of an episode are 0. Of joints of several degrees of freedom all
    are. Only positions count, so pauses and thinned rows do no harm. With a `transmission` they are those of motors.
    """
    out = np.zeros((len(dataset), dataset.nv, count))
    positions, steps = motor_positions(dataset, transmission)
    for joint in range(dataset.nv):
        least = max(STEPS * steps[joint], NOISES * white_noise(dataset, positions[:, joint]))
        for episode in dataset.episodes:
            rows = np.flatnonzero(dataset.episode == episode)
            q = positions[rows, joint]
            turns = turning_points(q, least)
            last = np.searchsorted(turns, np.arange(len(q)), side="right") - 1
            last = np.where((turns[last] == np.arange(len(q))) & (last > 0), last - 1, last)  # a stroke has its end
            at = q[turns]
            out[rows, joint, 0] = q - at[last]
            between = np.diff(at, prepend=at[0])
            for k in range(1, count):
                place = last - k + 1
                out[rows, joint, k] = np.where(place > 0, between[np.maximum(place, 0)], 0.0)
    return out


def motor_positions(dataset: Dataset, transmission: Gears = None) -> tuple[Positions, Float[np.ndarray, " nv"]]:
    """Positions of motors with this transmission, None: of joints; and the steps of their encoders."""
    positions = joint_positions(dataset)
    steps = np.array([encoder_step(dataset, q) for q in positions.T])
    return (positions, steps) if transmission is None else (positions @ transmission.T, abs(transmission) @ steps)


def joint_positions(dataset: Dataset) -> Positions:
    """Positions of joints of one degree of freedom; 0 for the others."""
    q, v = torch.tensor(dataset.q), torch.tensor(dataset.v)
    return State(q, v, v, dataset.model.robot).positions.numpy()


def encoder_step(dataset: Dataset, q: Float[np.ndarray, " rows"]) -> float:
    """The step of an encoder [rad or m] in the positions of a joint; 0 where they are as good as continuous."""
    moved = np.abs(np.diff(q))[dataset.episode[1:] == dataset.episode[:-1]]
    some = moved[moved > 1e-9 * max(float(np.abs(q).max()), 1e-12)]
    if not len(some):
        return 0.0
    steps = some / some.min()
    return float(some.min()) if (abs(steps - steps.round()) < ON_GRID).mean() > MOSTLY else 0.0


def white_noise(dataset: Dataset, q: Float[np.ndarray, " rows"]) -> float:
    """Standard deviation [rad or m] of independent noise in the positions of a joint; 0 where motion hides it."""
    # Medians of differences: the d-th of white noise has binom(2 d, d) times its variance (Rice 1984, Ann. Statist. 12)
    found = []
    for order in ORDERS:
        apart = np.abs(np.diff(q, order))[dataset.episode[order:] == dataset.episode[:-order]]
        found.append(float(np.median(apart)) / (NORMAL * comb(2 * order, order) ** 0.5) if len(apart) else 0.0)
    return found[-1] if max(found) < AGREE * min(found) else 0.0


def turning_points(q: Float[np.ndarray, " rows"], least: float) -> Int[np.ndarray, " turns"]:
    """Rows at which the motion turns back by more than `least`, after the first row."""
    steps = np.diff(q)
    moving = np.flatnonzero(steps)
    turned = moving[1:][np.sign(steps[moving[1:]]) != np.sign(steps[moving[:-1]])] if len(moving) else moving
    extremes, turns, extreme, direction = [0, *turned.tolist(), len(q) - 1], [0], 0, 0.0
    for row in extremes[1:]:
        ahead = q[row] - q[extreme]
        if direction == 0.0:
            if abs(ahead) > least:
                direction, extreme = np.sign(ahead), row
        elif direction * ahead >= 0.0:
            extreme = row
        elif abs(ahead) > least:
            turns.append(extreme)
            direction, extreme = -direction, row
    return np.array(turns)
