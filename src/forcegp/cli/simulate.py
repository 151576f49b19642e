"""`forcegp simulate`: run a scenario and write its dataset."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import forcegp
import forcegp.simulation
from forcegp.atomic_files import atomic_file
from forcegp.cli.command import Command, numbers_of, unless_given
from forcegp.cli.terminal import Terminal
from forcegp.errors import InvalidInput

Scenario = Literal["kuka-surface", "ur5-free", "double-pendulum", "quadruped", "quadrotor"]
TOOL_FRICTION = arg(metavar="LAW[:COEFFICIENT]", help_behavior_hint="(default: viscous)")
JOINT_FRICTION = arg(metavar="LAW,...", help_behavior_hint="(default: none; dry with more near rest for free arms)")
OF_THE_TOOL = ("tool_friction", "surface")
"""Options of the scenario that has a tool."""


@dataclass(frozen=True, kw_only=True)
class Simulate(Command):
    """Simulate a robot and write what it measured, with the ground truth, to one file.

    kuka-surface: a KUKA iiwa slides its tool on a surface with unmodelled friction, as in Rath, Geist,
    Trimpe (2021). ur5-free, double-pendulum: arms that touch nothing, with dry
    friction in every joint, without PyBullet. quadruped: a robot on a floating base that shifts its weight and lifts
    its feet, with an unknown load of 2 kg. quadrotor: a drone on a path in wind, with late rotors.
    Equal seeds give equal motions; train and test need different ones.

    For example:
      forcegp simulate kuka-surface --seconds 100 --seed 1 --out train.h5
      forcegp simulate kuka-surface --tool-friction coulomb:.2 --joint-friction coulomb --out rough.h5
      forcegp simulate ur5-free --seconds 60 --seed 1 --out arm.h5
      forcegp simulate double-pendulum --seconds 60 --joint-friction coulomb --out pendulum.h5
      forcegp simulate quadruped --seconds 30 --seed 1 --out quadruped.h5
      forcegp simulate quadrotor --seconds 60 --seed 1 --wind 4 --out drone.h5
    """

    scenario: Annotated[Positional[Scenario], arg(metavar="SCENARIO")]
    """What to simulate: kuka-surface, ur5-free, double-pendulum, quadruped or quadrotor."""
    out: Annotated[Path, arg(metavar="FILE.h5")]
    """The dataset to write (HDF5)."""
    seconds: Annotated[float, arg(metavar="S")] = 200.0
    """Recorded time in s, 240 rows per second."""
    seed: Annotated[int, arg(metavar="K")] = 0
    """Draws the way-points and, from a stream of its own, the noise."""
    noise: Annotated[float, arg(metavar="SIGMA")] = 0.1
    """Standard deviation of the noise on the measured acceleration in rad/s²; 0 for none."""
    tool_friction: Annotated[str | None, TOOL_FRICTION] = None
    """Unmodelled friction of the tool: viscous, with 1 N/(m/s) unless given, or a law of dry friction by name, with 0.3
    of the normal force while it slides."""
    joint_friction: Annotated[str | None, JOINT_FRICTION] = None
    """Unmodelled friction of the joints: none, or viscous and laws by name, as for --forces."""
    surface: Literal["plane", "tilted", "sphere", "none"] = "plane"
    """What the tool slides on: a plane, one tilted by 10 degrees, the top of a sphere of 1.2 m, or nothing."""
    wind: Annotated[float | None, unless_given("M/S", "4; only of quadrotor", float)] = None
    """Mean wind of a quadrotor in m/s, from a random side, with gusts."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Simulate and save."""
        self.require_free_file(self.out)
        start = time.monotonic()
        dataset = simulate_with_progress(terminal, self.scenario, **self._config())
        with atomic_file(self.out, overwrite=self.overwrite) as temporary:
            dataset.save(temporary)
        seconds = time.monotonic() - start
        terminal.show(
            f"{self.out}: {len(dataset)} rows ({self.seconds:g} s), seed {self.seed}, "
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

    def _config(self) -> dict[str, Any]:
        """The fields of the scenario's configuration that the options set."""
        names = "seconds", "seed", "noise", "joint_friction", "wind"
        fields = {name: value for name in names if (value := getattr(self, name)) is not None}
        own = {"kuka-surface": (*OF_THE_TOOL, "joint_friction"), "quadrotor": ("wind",)}
        others = {*OF_THE_TOOL, "joint_friction", "wind"} - {*own.get(self.scenario, ("joint_friction",))}
        for word in self.words(*sorted(others)):
            raise InvalidInput(f"{word} means nothing to {self.scenario}; leave it out.")
        if self.scenario != "kuka-surface":
            return fields
        law, given, number = (self.tool_friction or "viscous").partition(":")
        if given:
            complaint = f"--tool-friction {self.tool_friction}: {number!r} is no number; give a law, as in coulomb:.2."
            kind = "viscous" if law == "viscous" else "coulomb"
            [fields[f"{kind}_coefficient"]] = numbers_of(number, complaint, one=True)
        return fields | {"friction": law, "surface": self.surface}


def simulate_with_progress(terminal: Terminal, scenario: str, **options: Any) -> forcegp.Dataset:
    """Run a scenario with a progress bar. Raises InvalidInput for bad options, MissingExtra without PyBullet."""
    if scenario == "kuka-surface":
        _import_silently("pybullet")
    with terminal.progress(f"simulating seed {options['seed']}") as report:
        return forcegp.simulation.simulate(scenario, report, **options)


def _import_silently(name: str) -> None:
    """PyBullet announces the time of its build on the process's stderr, which would stand between our own lines."""
    stderr = os.dup(2)
    with open(os.devnull, "wb") as nothing:  # noqa: PTH123  # a device, not a path
        os.dup2(nothing.fileno(), 2)
    try:
        with contextlib.suppress(ImportError):  # the error of the simulation names what to install
            __import__(name)
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
