"""`forcegp simulate`: run a scenario and write its dataset."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from forcegp.cli.command import Command, Debug, Json
from forcegp.cli.terminal import Terminal
from forcegp.cli.whole_folders import require_free_file

if TYPE_CHECKING:
    from forcegp.data import Dataset


@dataclass(frozen=True, kw_only=True)
class Simulate(Command):
    """Simulate a robot and write what it measured, with the ground truth, to one file.

    kuka-surface: a KUKA iiwa slides its tool on a plane with viscous friction that nobody models
    (Rath, Geist, Trimpe 2021). Equal seeds give equal motions; train and test need different ones.

    For instance:
      forcegp simulate kuka-surface --seconds 100 --seed 1 --out train.h5
    """

    scenario: Positional[Literal["kuka-surface"]]
    """What to simulate."""
    out: Annotated[Path, arg(metavar="FILE.h5")]
    """The dataset to write (HDF5)."""
    seconds: Annotated[float, arg(metavar="S")] = 200.0
    """Recorded time of each episode in s, 240 rows per second."""
    seed: Annotated[int, arg(metavar="K")] = 0
    """Draws the way-points and, from a stream of its own, the noise."""
    noise: Annotated[float, arg(metavar="SIGMA")] = 0.1
    """Standard deviation of the noise on the measured acceleration in rad/s²; 0 for none."""
    episodes: Annotated[int, arg(metavar="N")] = 1
    """Number of independent trajectories, each from the start posture."""
    friction: Annotated[float, arg(metavar="F")] = 1.0
    """Viscous friction of the tool on the surface in N/(m/s): the force that nobody models."""
    overwrite: bool = False
    """Replace the file if it exists."""
    json: Json = False
    debug: Debug = False

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Simulate and save."""
        require_free_file(self.out, overwrite=self.overwrite)
        start = time.monotonic()
        options = {name: getattr(self, name) for name in ("seconds", "seed", "noise", "episodes", "friction")}
        dataset = simulate(terminal, self.scenario, **options)
        dataset.save(self.out)
        seconds = time.monotonic() - start
        terminal.say(
            f"{self.out}: {len(dataset)} rows ({self.episodes} x {self.seconds:g} s), seed {self.seed}, "
            f"noise {self.noise:g} rad/s², simulated in {seconds:.1f} s"
        )
        return {
            "out": str(self.out),
            "scenario": self.scenario,
            "rows": len(dataset),
            "joint_names": list(dataset.joint_names),
            "noise_std": None if dataset.noise_std is None else dataset.noise_std.tolist(),
            "truth": list(dataset.truth),
            "config": dict(dataset.metadata["config"]),
            "wall_seconds": seconds,
        }


def simulate(terminal: Terminal, scenario: str, **options: Any) -> Dataset:
    """Run a scenario with a progress bar. Raises InvalidInput for bad options, MissingExtra without PyBullet."""
    from forcegp.simulation import SCENARIOS

    chosen = SCENARIOS[scenario]
    config = chosen.config(**options)
    _import_silently("pybullet")
    with terminal.progress(f"simulating seed {config.seed}") as report:
        return chosen.simulate(config, report)


def _import_silently(name: str) -> None:
    """PyBullet announces the time of its build on the process's stderr, which would stand between our own lines."""
    stderr = os.dup(2)
    with open(os.devnull, "wb") as nothing:  # noqa: PTH123  # a device, not a path
        os.dup2(nothing.fileno(), 2)
    try:
        with contextlib.suppress(ImportError):  # the simulation says what to install
            __import__(name)
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
