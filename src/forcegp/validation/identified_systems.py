"""Systems whose inertial parameters and friction were identified from training rows: models, and means of others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from forcegp.analytical import NoiseLevels, held_out_noise, identify_analytical
from forcegp.data import Dataset
from forcegp.mechanics import MechanicalSystem


@dataclass(frozen=True)
class Identification:
    """One way to identify a system.

    Fields
    ------
    summary: how, as a part of a sentence.
    identify: (given system, training rows, friction laws) -> identified system.
    all_rows: from all training rows, not from those few that every model learns from.
    noise: (given system, training rows, friction laws) -> the noise about it, for models that rest on it; None where
        these learn theirs.
    """

    summary: str
    identify: Callable[[MechanicalSystem, Dataset, Sequence[str]], MechanicalSystem]
    all_rows: bool = False
    noise: Callable[[MechanicalSystem, Dataset, Sequence[str]], NoiseLevels] | None = None


def _identified(system: MechanicalSystem, rows: Dataset, friction: Sequence[str], **how: Any) -> MechanicalSystem:
    return identify_analytical(rows, system, friction=friction, **how).system


def _noise(system: MechanicalSystem, rows: Dataset, friction: Sequence[str], **how: Any) -> NoiseLevels:
    return held_out_noise(rows, system, friction=friction, **how)


def _consistent(likelihood: str, rows: str, all_rows: bool) -> Identification:
    how = {"inertias": "consistent", "likelihood": likelihood}
    method = {"torque": "least squares of joint forces", "acceleration": "maximum likelihood of accelerations"}
    summary = f"{method[likelihood]}{rows}, physically consistent"
    noise = partial(_noise, **how) if all_rows else None
    return Identification(summary, partial(_identified, **how), all_rows, noise)


IDENTIFICATIONS: dict[str, Identification] = {
    "least-squares": Identification(
        "ordinary least squares of joint forces, whose inertias need not belong to a body",
        partial(_identified, inertias="free", likelihood="torque"),
    ),
    "torque": _consistent("torque", "", False),
    "acceleration": _consistent("acceleration", "", False),
    "torque-all": _consistent("torque", " of ALL training rows", True),
    "acceleration-all": _consistent("acceleration", " of ALL training rows", True),
}
"""By name. Add your own: IDENTIFICATIONS["mine"] = Identification("how", identify_mine)."""

FRICTION = ("viscous", "coulomb")
"""Laws that are identified where nothing else is asked for."""

DEFAULT_IDENTIFICATION = "acceleration"
"""What `@identified` and the mass matrix of force errors take where nothing else is asked for."""
