"""Payloads of a simulated UR5 from joint torques, and one command from its log to a validated model.

Logs are those of `examples/ur5_log.py` (MuJoCo; dry friction, rotors, noise, torques 6 ms late), with columns
right, 60 s each: one with a payload of .3 to 3 kg within 8 cm of the tool's frame, one without. Both are filtered and
shifted by `Preparation(cutoff="auto", delay="auto")`. They are fitted as `forcegp payload` does, from the URDF alone or
with `--baseline`. Errors and whether 95 % intervals hold (of the mass and three coordinates), over 20 payloads.

`forcegp auto` gets the example's log of 80 s as it is, with `--correct`: CPU seconds, and what it names.

    python -m benchmarks payload
"""

from __future__ import annotations

import contextlib
import io
import os
import statistics
import tempfile
import time
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np

from forcegp import Dataset, Model, Robot
from forcegp.cli.main import main
from forcegp.cli.payload import with_payload
from forcegp.data import Preparation
from forcegp.forces import GearFriction, Offset, Rotor, Viscous

SEEDS, SECONDS = range(1, 21), 60.0
NUMBERS = ("mass", "center_of_mass.x", "center_of_mass.y", "center_of_mass.z")
ANSWER = Path(__file__).resolve().parent.parent / "docs" / "how-to" / "auto" / "answer.txt"
EXAMPLE = Path(__file__).resolve().parent.parent / "examples" / "ur5_log.py"


def example() -> ModuleType:
    """The module of the example."""
    spec = spec_from_file_location("ur5_log", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def prepared(ur5: Any, seed: int, mass: float, center: np.ndarray) -> Dataset:
    """A log in SI units, filtered and shifted."""
    rows = ur5.recorded(SECONDS, seed, mass, tuple(center))
    logged = ur5.faulty(rows, seed)
    q, v, u = np.deg2rad(logged[:, 1:7]), np.deg2rad(logged[:, 7:13]), logged[:, 13:] * [1, 1, -1, 1, 1, 1]
    robot = Robot.from_urdf_text(ur5.URDF)
    data = {"q": q, "v": v, "u": u, "a": np.gradient(v, rows[:, 0], axis=0), "time": rows[:, 0]}
    raw = Dataset(**data, model=Model(robot))
    return Preparation(cutoff="auto", delay="auto", trim=0.5).apply(raw)


def payloads(ur5: Any) -> dict[str, float]:
    """Errors and coverage without and with a log of the empty arm."""
    masses: dict[str, list[float]] = {"urdf": [], "baseline": []}
    places: dict[str, list[float]] = {"urdf": [], "baseline": []}
    held: dict[str, list[bool]] = {"urdf": [], "baseline": []}
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        mass, center = rng.uniform(0.3, 3.0), rng.uniform(-0.08, 0.08, 3)
        loaded, empty = prepared(ur5, seed, mass, center), prepared(ur5, 100 + seed, 0.0, center)
        model = loaded.model.with_forces(Viscous(), GearFriction(), Offset(), Rotor())
        for name, baseline in (("urdf", None), ("baseline", empty)):
            found = with_payload(model, loaded, "tool0", baseline).parameters
            place = np.array([found[f"payload.{name}"].value for name in NUMBERS[1:]])
            masses[name].append(abs(found["payload.mass"].value / mass - 1.0))
            places[name].append(1e3 * float(np.abs(place - center).max()))
            ends = [found[f"payload.{name}"].interval for name in NUMBERS]
            held[name] += [low <= true <= high for (low, high), true in zip(ends, [mass, *center], strict=True)]
            print(
                f"seed {seed} {name:8s} {mass:.3f} kg: {found['payload.mass'].value / mass - 1.0:+.4f}, "
                f"{places[name][-1]:.2f} mm",
                flush=True,
            )
    out = {}
    for name in masses:
        out[f"payload_mass_{name}"] = 100.0 * max(masses[name])
        out[f"payload_place_{name}"] = max(places[name])
        out[f"payload_held_{name}"] = statistics.mean(map(float, held[name]))
    return out


def answer(ur5: Any) -> dict[str, float]:
    """CPU seconds of `forcegp auto` on the example's log, and how many of its seven faults the answer names."""
    with tempfile.TemporaryDirectory() as place, contextlib.chdir(place):
        names = ["time"] + [f"{name}_A{k}" for name in ("angle", "speed", "torque") for k in range(1, 7)]
        header = {"header": ";".join(names), "comments": "", "delimiter": ";", "fmt": "%.7g"}
        np.savetxt("log.csv", ur5.faulty(ur5.recorded()), **header)
        Path("ur5.urdf").write_text(ur5.URDF, encoding="utf-8")
        columns = ["--time", "time", "--q", "angle_A{1..6}", "--v", "speed_A{1..6}", "--u", "torque_A{1..6}"]
        words, shown = (
            ["auto", "log.csv", *columns, "--robot", "ur5.urdf", "--correct", "--out", "answer"],
            io.StringIO(),
        )
        begin = time.process_time()
        with contextlib.redirect_stdout(shown), patch.dict(os.environ, COLUMNS="100"):
            assert main(words) == 0
        seconds = time.process_time() - begin
    text = " ".join(shown.getvalue().split())
    ANSWER.write_text("\n".join(line.rstrip() for line in shown.getvalue().splitlines()) + "\n", encoding="utf-8")
    print(shown.getvalue())
    named = ("q=deg", "time=ms", "v=deg/s", "sign u=1,1,-1,1,1,1", "ms late", "(20, 0, 50) mm of tool0", "steps up to")
    return {"auto_cpu_seconds": seconds, "auto_named": float(sum(words in text for words in named))}


def run() -> dict[str, float]:
    ur5 = example()
    return answer(ur5) | payloads(ur5)
