"""What regression makes of three real robots, by the protocols of the recordings' README.

    python -m benchmarks.real_identification ../shared/realdata [multiarm|dfki|panda ...]

The recordings are not part of this project. One line per identification: residuals of rows that it has not seen, CPU
seconds, and the condition number of the base parameters.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tests.analytical.realdata import dfki, dfki_system, multiarm, multiarm_system, panda, panda_system

from forcegp.analytical import identify_analytical, motion_residuals, residual_scores
from forcegp.data import Dataset
from forcegp.mechanics import MechanicalSystem, ViscousJointFriction

DRIVEN: tuple[dict[str, Any], ...] = (
    {"friction": ("viscous", "coulomb"), "rotors": "rotor", "likelihood": "torque"},
    {"friction": ("viscous", "coulomb"), "rotors": "rotor", "likelihood": "acceleration"},
    {"friction": ("viscous", "coulomb"), "rotors": "rotor", "likelihood": "acceleration", "robust": True},
    {"friction": ("viscous", "stribeck"), "rotors": "rotor", "likelihood": "acceleration"},
    {"friction": ("viscous", "load"), "rotors": "rotor", "likelihood": "acceleration"},
    {"friction": ("viscous", "load"), "rotors": "armature", "likelihood": "acceleration"},
)
MANIPULATOR: tuple[dict[str, Any], ...] = (
    {"friction": ("viscous", "coulomb", "offset"), "inertias": "free"},
    {"friction": ("viscous", "coulomb", "offset"), "inertias": "consistent"},
    {"friction": ("viscous", "coulomb", "offset"), "inertias": "consistent", "rotors": None},
    {"friction": ("viscous", "stribeck", "offset"), "inertias": "consistent"},
    {"friction": ("viscous", "coulomb", "offset"), "inertias": "consistent", "prior_strength": 0.1},
    {"friction": ("viscous", "coulomb", "offset"), "inertias": "consistent", "robust": True},
)


def main(words: list[str]) -> None:
    """Run what is named, or all of it."""
    if not words:
        sys.exit(__doc__)
    folder, names = Path(words[0]), words[1:] or ["multiarm", "dfki", "panda"]
    if not (folder / "README.md").exists():
        sys.exit(f"{folder} holds no recordings; name the folder realdata that is kept beside this checkout.")
    if "multiarm" in names:
        published = multiarm_system(ViscousJointFriction([2.37142783e-4, 1.00000019e-5]))
        data = multiarm(folder, published)
        force, acceleration = (x.cumsum(1) for x in motion_residuals(data, published))
        absolute = replace(data, a=data.a.cumsum(1))
        told(
            "multiarm, published, absolute angles", residual_scores(force, acceleration, absolute), "acceleration_nrmse"
        )
    if "dfki" in names:
        system = dfki_system(folder)
        train, test = (dfki(folder, system, *runs) for runs in ((143524, 143601, 143704, 144115), (143339, 143747)))
        compared("dfki", system, train, test, DRIVEN, "acceleration_nrmse")
    if "panda" in names:
        system = panda_system(folder)
        train, test = panda(folder, system)
        compared("panda", system, train, test, MANIPULATOR, "force_rms")
        compared("panda", system, train, test, MANIPULATOR[1:2], "acceleration_nrmse")


def compared(
    name: str, system: MechanicalSystem, train: Dataset, test: Dataset, choices: tuple[dict[str, Any], ...], key: str
) -> None:
    """The system as given and every identification of it, by this score on the test rows."""
    told(f"{name}, as given", residual_scores(*motion_residuals(test, system), test), key)
    for choice in choices:
        begin = time.process_time()
        found = identify_analytical(train, system, **choice)
        seconds = time.process_time() - begin
        words = " ".join("+".join(v) if isinstance(v, tuple) else f"{k}={v}" for k, v in choice.items())
        state = "" if found.fit.settled else ", not settled"
        told(
            f"{name}, {words} ({seconds:.1f} s, condition {found.condition_number:.0f}{state})", found.scores(test), key
        )


def told(what: str, scores: dict[str, list[float]], key: str) -> None:
    """One line."""
    print(f"{key:>18} {np.array2string(np.array(scores[key]), precision=4, max_line_width=200)}  {what}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
