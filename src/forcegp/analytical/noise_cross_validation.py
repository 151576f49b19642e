"""How wrong an identified system is about motions that it was not identified from: the noise that models of it have.

Residuals of the rows that parameters were fitted to are too small for others: those of a filtered log resemble their
neighbours, so parameters follow them. Here every stretch of the log is predicted by a system identified from the rest
(block cross-validation; Burman, Chow & Nolan 1994), and the levels of noise are those of all these residuals.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from forcegp.analytical.identification import identify_analytical
from forcegp.analytical.noise_levels import NoiseLevels
from forcegp.data import Dataset
from forcegp.data.dataset_arguments import dataset_first
from forcegp.errors import InvalidInput
from forcegp.mechanics import MechanicalSystem

STRETCHES = 4
"""Stretches of time that logs of fewer than three episodes are cut into."""


@dataset_first
def held_out_noise(dataset: Dataset, system: MechanicalSystem, **how: Any) -> NoiseLevels:
    """Noise of accelerations and forces about systems identified without the rows in question.

    `how` are the options of `identify_analytical`; inertias must be consistent. Rows are left out by episodes, where
    there are three or more, else by `STRETCHES` stretches of time.
    Raises InvalidInput for free inertias, whose mass matrix need not be one, and for too few rows.
    """
    if how.get("inertias", "consistent") != "consistent":
        raise InvalidInput("held-out noise needs a mass matrix that can be inverted; use inertias='consistent'.")
    residuals, masses = [], []
    for left_out in _stretches(dataset):
        kept = np.ones(len(dataset), dtype=bool)
        kept[left_out] = False
        found = identify_analytical(dataset.rows(kept), system, **how).system
        rows = dataset.rows(left_out)
        q, v, u = (torch.tensor(x, device=found.robot.device) for x in (rows.q, rows.v, rows.u))
        dynamics = found.dynamics(q, v, u)
        residuals.append(rows.a - dynamics.acceleration_map().offset.cpu().numpy())
        masses.append(dynamics.M.cpu().numpy())
    return NoiseLevels.of(np.concatenate(residuals), np.concatenate(masses))


def _stretches(dataset: Dataset) -> list[np.ndarray]:
    """Row numbers of each stretch."""
    if len(dataset.episodes) >= 3:
        return [np.flatnonzero(dataset.episode == number) for number in dataset.episodes]
    if len(dataset) < 2 * STRETCHES:
        raise InvalidInput(f"the dataset has {len(dataset)} rows; held-out noise needs {2 * STRETCHES} or more.")
    return np.array_split(np.lexsort((dataset.time, dataset.episode)), STRETCHES)
