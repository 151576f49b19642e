"""What regression makes of three real robots, by the protocols of the recordings' README.

    python -m benchmarks.real_identification ../shared/realdata [multiarm|dfki|panda ...]

The recordings are not part of this project. One line per identification: residuals of rows that it has not seen, CPU
seconds, and the condition number of the base parameters.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from tests.evidence.realdata import dfki, dfki_system, multiarm, multiarm_system, panda, panda_system

from forcegp.data import Dataset
from forcegp.evidence import Accelerations, Evidence, Torques, motion_residuals
from forcegp.fit import fit
from forcegp.forces import Viscous, parse_forces
from forcegp.model import Model

DRIVEN = (
    ("bodies,viscous,coulomb,coupled-rotors", Torques()),
    ("bodies,viscous,coulomb,coupled-rotors", Accelerations()),
    ("bodies,viscous,stribeck,coupled-rotors", Accelerations()),
    ("bodies,viscous,load,coupled-rotors", Accelerations()),
    ("bodies,viscous,load,rotor", Accelerations()),
)
MANIPULATOR = (
    ("bodies,viscous,coulomb,offset,rotor", Torques()),
    ("bodies,viscous,coulomb,offset", Torques()),
    ("bodies,viscous,stribeck,offset,rotor", Torques()),
)


def residual_scores(force: np.ndarray, acceleration: np.ndarray, dataset: Dataset) -> dict[str, list[float]]:
    """Per joint: rms of the force, and of the acceleration over its standard deviation."""
    rms = np.sqrt((acceleration**2).mean(0))
    return {"force_rms": np.sqrt((force**2).mean(0)).tolist(), "acceleration_nrmse": (rms / dataset.a.std(0)).tolist()}


def main(words: list[str]) -> None:
    """Run what is named, or all of it."""
    if not words:
        sys.exit(__doc__)
    folder, names = Path(words[0]), words[1:] or ["multiarm", "dfki", "panda"]
    if not (folder / "README.md").exists():
        sys.exit(f"{folder} holds no recordings; name the folder realdata that is kept beside this checkout.")
    if "multiarm" in names:
        published = multiarm_system(Viscous([2.37142783e-4, 1.00000019e-5]))
        data = multiarm(folder, published)
        force, acceleration = (x.cumsum(1) for x in motion_residuals(data, published))
        absolute = replace(data, a=data.a.cumsum(1))
        told(
            "multiarm, published, absolute angles", residual_scores(force, acceleration, absolute), "acceleration_nrmse"
        )
    if "dfki" in names:
        model = dfki_system(folder)
        train, test = (dfki(folder, model, *runs) for runs in ((143524, 143601, 143704, 144115), (143339, 143747)))
        compared("dfki", model, train, test, DRIVEN, "acceleration_nrmse")
    if "panda" in names:
        model = panda_system(folder)
        train, test = panda(folder, model)
        compared("panda", model, train, test, MANIPULATOR, "force_rms")
        compared("panda", model, train, test, MANIPULATOR[1:2], "acceleration_nrmse")


def compared(
    name: str, model: Model, train: Dataset, test: Dataset, choices: Sequence[tuple[str, Evidence]], key: str
) -> None:
    """The system as given and every identification of it, by this score on the test rows."""
    told(f"{name}, as given", residual_scores(*motion_residuals(test, model), test), key)
    for forces, evidence in choices:
        begin = time.process_time()
        found = fit(model.with_forces(parse_forces(forces)), train, evidence)
        seconds = time.process_time() - begin
        state = "" if found.parameters.settled else ", not settled"
        scores = residual_scores(*motion_residuals(test, found.model), test)
        told(f"{name}, {forces}, {evidence} ({seconds:.1f} s{state})", scores, key)


def told(what: str, scores: dict[str, list[float]], key: str) -> None:
    """One line."""
    print(f"{key:>18} {np.array2string(np.array(scores[key]), precision=4, max_line_width=200)}  {what}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
