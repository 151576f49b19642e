"""The cut-off of which the parameters that it leads to predict torques of other stretches of time best.

A low cut-off smears dry friction and takes a part of what rotors need; a high one leaves noise in the acceleration,
under which every inertia looks too small (errors in variables). So a linear model of the torque is fitted behind each
cut-off, and all are judged alike: the model sees signals behind the highest one, in which friction is sharp, and both
its torque and the measured one then pass the lowest, which takes the noise (parallel filtering; Gautier, "Dynamic
identification of robots with power model", ICRA 1997).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

import forcegp.robots
from forcegp.data.dataset import Dataset
from forcegp.data.delay import estimate_delay, shifted, torque_columns
from forcegp.data.filtering import (
    Signal,
    differentiated,
    episodes_in_order,
    low_pass,
    uniform_step,
    zero_phase_low_pass,
)
from forcegp.errors import DatasetError

FACTORS = 0.5, 0.7, 1.0, 1.4, 2.0  # of the cut-off that the spectrum shows
MOST_ROWS, MOST_NUMBERS = 20_000, 2.5e7
FOLDS = 8  # stretches of time: the odd ones judge what the even ones teach, and the other way round
SETTLED = 2.0  # periods of the lowest cut-off at the ends of an episode that filters spoil


def held_out_cutoff(
    dataset: Dataset, robot: forcegp.robots.Robot, cutoff: float, source: Literal["q", "v"] = "q", order: int = 4
) -> tuple[float, dict[float, float]]:
    """The best of `FACTORS` times `cutoff` [Hz], and of each the share of the torques that it leaves unexplained.

    Shares are geometric means over the joints, in time that was held out and below the lowest cut-off. `source` and
    `order` are those of `Preparation`. Raises DatasetError for logs too short for that, and for passive robots.
    """
    best, shares = _judged(dataset, robot, cutoff, source, order)
    if best in (min(shares), max(shares)):  # the best may lie beyond
        best, more = _judged(dataset, robot, best, source, order)
        shares = shares | more
    return best, dict(sorted(shares.items()))


def _judged(
    dataset: Dataset, robot: forcegp.robots.Robot, cutoff: float, source: Literal["q", "v"], order: int
) -> tuple[float, dict[float, float]]:
    columns = 10 * robot.nv + 10
    rows = int(min(MOST_ROWS, MOST_NUMBERS / (robot.nv * columns)))
    log = dataset.rows(slice(0, rows))
    step = uniform_step(log.time[log.episode == log.episodes[0]])
    tried = [cutoff * factor for factor in FACTORS if cutoff * factor < 0.4 / step]
    if len(log) < 5 * FOLDS * columns // robot.nv or len(tried) < 2:
        raise DatasetError(f"{len(log)} rows are too few to choose a cut-off by prediction.")
    if not log.u.any():
        raise DatasetError("no torque acts, so none shows a cut-off.")
    signals: tuple[Signal, ...] = ("q", "u") if source == "q" else ("q", "v", "u")

    def behind(frequency: float) -> Dataset:
        return differentiated(low_pass(log, frequency, order=order, signals=signals), source)

    delay = np.nan_to_num(estimate_delay(behind(cutoff), robot).common)  # the best guess, sure or not
    log = shifted(log, np.full(log.nv, delay))
    away = SETTLED / tried[0] + abs(delay)
    times = [rows.time for _, rows, _ in episodes_in_order(log)]
    inner = np.concatenate([(time >= time[0] + away) & (time <= time[-1] - away) for time in times])
    folds = np.array_split(np.arange(int(inner.sum())), FOLDS)
    sides = [np.concatenate(folds[first::2]) for first in (0, 1)]
    sharp = torque_columns(robot, behind(tried[-1]))

    def judged(values: Float[np.ndarray, "rows columns"]) -> np.ndarray:
        parts = [
            zero_phase_low_pass(values[log.episode == number], 1.0 / step, tried[0], order) for number in log.episodes
        ]
        return np.concatenate(parts)[inner]

    measured, shares = judged(log.u), np.empty((len(tried), log.nv))
    seen = [judged(each) for each in sharp]
    for k, frequency in enumerate(tried):
        smooth = behind(frequency)
        for joint, each in enumerate(torque_columns(robot, smooth)):
            size = np.linalg.norm(each, axis=0) + 1e-300
            learned, u, left = each[inner] / size, smooth.u[inner, joint], 0.0
            for one, other in (sides, sides[::-1]):
                theta = np.linalg.lstsq(learned[one][::4], u[one][::4], rcond=1e-2)[0] / size
                left += float(np.square(measured[other, joint] - seen[joint][other] @ theta).sum())
            shares[k, joint] = left / max(float(np.square(measured[:, joint]).sum()), 1e-300)
    mean = np.exp(np.log(np.maximum(shares, 1e-12)).mean(axis=1))
    best = float(f"{tried[int(np.argmin(mean))]:.3g}")
    return best, {float(f"{f:.3g}"): float(share) for f, share in zip(tried, mean, strict=True)}
