"""Systems whose inertial parameters and friction were identified from training rows: models, and means of others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from forcegp.analytical import identify_analytical
from forcegp.data import Dataset
from forcegp.mechanics import MechanicalSystem
from forcegp.models import Noise

START_NOISE = 0.1
"""Where a learned noise begins, as a part of the standard deviation of the measured acceleration of each joint."""


def learned_noise(rows: Dataset, force: float | None = None, measured_torque: bool = False) -> Noise:
    """The noise that every model of a comparison learns, from the same start; `force`, `measured_torque` as in `Noise`.

    It begins at what the dataset states, else at a tenth of the scatter of each joint's acceleration among `rows`.
    """
    if rows.noise_std is not None:
        return Noise(None, force, learn=True, measured_torque=measured_torque)
    scatter = rows.a.std(axis=0)
    largest = float(scatter.max())
    start = START_NOISE * np.where(scatter > 0.0, scatter, largest if largest > 0.0 else 1.0)
    level = tuple(float(value) for value in start)
    return Noise(level, force, learn=True, measured_torque=measured_torque)


@dataclass(frozen=True)
class Identification:
    """One way to identify a system.

    Fields
    ------
    summary: how, as a part of a sentence.
    identify: (given system, training rows) -> identified system.
    all_rows: from all training rows, not from those few that every model learns from: a yardstick.
    """

    summary: str
    identify: Callable[[MechanicalSystem, Dataset], MechanicalSystem]
    all_rows: bool = False


def _identified(system: MechanicalSystem, rows: Dataset, **how: Any) -> MechanicalSystem:
    return identify_analytical(system, rows, **how).system


_LEAST_SQUARES = partial(_identified, inertias="free", likelihood="torque")
_TORQUE = partial(_identified, inertias="consistent", likelihood="torque")
_ACCELERATION = partial(_identified, inertias="consistent", likelihood="acceleration")

IDENTIFICATIONS: dict[str, Identification] = {
    "least-squares": Identification(
        "ordinary least squares of joint forces, whose inertias need not belong to a body", _LEAST_SQUARES
    ),
    "torque": Identification("least squares of joint forces, physically consistent", _TORQUE),
    "acceleration": Identification("maximum likelihood of accelerations, physically consistent", _ACCELERATION),
    "torque-all": Identification("least squares of joint forces of ALL training rows", _TORQUE, all_rows=True),
    "acceleration-all": Identification(
        "maximum likelihood of accelerations of ALL training rows", _ACCELERATION, all_rows=True
    ),
}
"""By name. Add your own: IDENTIFICATIONS["mine"] = Identification("how", identify_mine)."""

DEFAULT_IDENTIFICATION = "acceleration"
"""What `@identified` and the mass matrix of force errors take where nothing else is asked for."""
