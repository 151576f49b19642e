"""`forcegp simulate`, `demo` and `reproduce`: without a log of your own."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import forcegp
import forcegp.report
import forcegp.scores
import forcegp.simulation
from forcegp.atomic_files import atomic_file, write_json
from forcegp.cli.command import Command, numbers_of, unless_given, values_of
from forcegp.cli.fit import fit_summary
from forcegp.cli.robot_options import SearchOptions
from forcegp.cli.score import comparison
from forcegp.cli.terminal import Terminal
from forcegp.errors import InvalidInput
from forcegp.parallel import checked_jobs

Scenario = Literal["kuka-surface", "quadruped", "quadrotor"]
TOOL_FRICTION = arg(metavar="LAW[:COEFFICIENT]", help_behavior_hint="(default: viscous)")
JOINT_FRICTION = arg(metavar="LAW,...", help_behavior_hint="(default: none; of quadruped stribeck)")
OF_THE_TOOL = ("tool_friction", "surface")  # options of the scenario that has a tool
NOISE = 0.1  # rad/s^2, as in the paper
SEED = 21  # not 1 to 6: those trajectories served to choose the hyperprior, so they would flatter the model

BEST = "S-GP + analytical mean"  # its name in the paper
EXPERIMENTS = Path("benchmarks", "paper", "reproduction.py")


@dataclass(frozen=True, kw_only=True)
class Simulate(Command):
    """Simulate a robot and write what it measured, with the ground truth, to one file.

    kuka-surface: a KUKA iiwa slides its tool on a surface with unmodelled friction, as in Rath, Geist, Trimpe (2021),
    or moves above it. quadruped: a robot on a floating base that shifts its weight and lifts its feet, with an unknown
    load of 2 kg. quadrotor: a drone on a path in wind, with late rotors. Give train and test different seeds.

    For example:
      forcegp simulate kuka-surface --seconds 100 --seed 1 --out train.h5
      forcegp simulate kuka-surface --tool-friction coulomb:.2 --joint-friction coulomb --out rough.h5
      forcegp simulate kuka-surface --surface none --joint-friction stribeck --out free.h5
      forcegp simulate quadrotor --seconds 60 --seed 1 --wind 4 --out drone.h5
    """

    scenario: Annotated[Positional[Scenario], arg(metavar="SCENARIO")]
    """What to simulate: kuka-surface, quadruped or quadrotor."""
    out: Annotated[Path, arg(metavar="FILE.h5")]
    """The dataset to write (HDF5)."""
    seconds: Annotated[float, arg(metavar="S")] = 200.0
    """Recorded time in s, 240 rows per second."""
    seed: Annotated[int, arg(metavar="K")] = 0
    """Draws the way-points and, from a stream of its own, the noise."""
    noise: Annotated[float, arg(metavar="SIGMA")] = 0.1
    """Standard deviation of the noise on the measured acceleration in rad/s²; 0 for none."""
    tool_friction: Annotated[str | None, TOOL_FRICTION] = None
    """Friction of the tool: viscous, 1 N/(m/s) unless given, or a law of dry friction by name, 0.3 of the load."""
    joint_friction: Annotated[str | None, JOINT_FRICTION] = None
    """Unmodelled friction of the joints: none, or viscous and laws by name, as for --forces."""
    surface: Literal["plane", "tilted", "none"] = "plane"
    """What the tool slides on: a plane, one tilted by 10 degrees, or nothing."""
    wind: Annotated[float | None, unless_given("M/S", "4; only of quadrotor", float)] = None
    """Mean wind of a quadrotor in m/s, from a random side, with gusts."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Simulate and save."""
        self.require_free_file(self.out)
        start, dataset = time.monotonic(), simulate_with_progress(terminal, self.scenario, **self._config())
        with atomic_file(self.out, overwrite=self.overwrite) as temporary:
            dataset.save(temporary)
        seconds = time.monotonic() - start
        terminal.show(
            f"{self.out}: {len(dataset)} rows ({self.seconds:g} s), seed {self.seed}, "
            f"noise {self.noise:g} rad/s², simulated in {seconds:.1f} s"
        )
        return {
            "out": str(self.out), "scenario": self.scenario, "rows": len(dataset),
            "joint_names": list(dataset.joint_names),
            "noise_std": None if dataset.noise_std is None else dataset.noise_std.tolist(),
            "truth": list(dataset.truth), "config": dict(dataset.metadata["config"]), "wall_seconds": seconds,
        }  # fmt: skip

    def _config(self) -> dict[str, Any]:
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
    """Run a scenario with a progress bar. Raises InvalidInput for bad options."""
    with terminal.progress(f"simulating seed {options['seed']}"):
        return forcegp.simulation.simulate(scenario, **options)


@dataclass(frozen=True, kw_only=True)
class Demo(Command):
    """A robot arm slides its tool on a surface, and a model learns the friction of the tool.

    Simulates a training and a test trajectory, and fits the model of the paper (Rath, Geist, Trimpe 2021) without and
    with its analytical mean. Scores both on the other trajectory, writes a report, and keeps everything in one folder.

    For example:
      forcegp demo --out demo --points 100
    """

    out: Annotated[Path, arg(metavar="FOLDER")] = Path("demo")
    """The folder to write."""
    seed: Annotated[int, arg(metavar="K")] = SEED
    """The training trajectory has seed K, the test trajectory K + 1."""
    seconds: Annotated[float, arg(metavar="S")] = 100.0
    """Length of each trajectory in s."""
    search: SearchOptions = SearchOptions(points=100)

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """All four steps."""
        if not self.search.points or self.search.points < 2:
            raise InvalidInput(f"--points is {self.search.points}; at least 2 are needed.")
        self.require_free(self.out)
        options = {name: value for name, value in values_of(self).items() if name != "out"}
        begin, models, fits = time.monotonic(), {}, {}
        with self.folder(self.out, {"options": options}) as folder:
            seeds = {"train": self.seed, "test": self.seed + 1}
            how: dict[str, Any] = {"seconds": self.seconds, "noise": NOISE}
            data = {name: simulate_with_progress(terminal, "kuka-surface", seed=k, **how) for name, k in seeds.items()}
            for name, log in data.items():
                log.save(folder / f"{name}.h5")
            unknown = data["train"].model.with_forces(forcegp.JointForces())
            for name, model in (("S-GP", unknown.without_mean()), (BEST, unknown)):
                start, place = time.monotonic(), name.lower().replace(" + ", "-").replace(" ", "-")
                with terminal.progress(f"fitting {name}"):
                    models[name] = forcegp.scores.learn(model, data["train"], **vars(self.search))[0]
                forcegp.save_posterior(models[name], folder / place)
                fits[name] = {"run": str(self.out / place), "fit": fit_summary(models[name], time.monotonic() - start)}
            with terminal.progress("scoring and writing the report"):
                scores = forcegp.score(models, data["test"], horizons=())
                results = {"out": str(self.out), "seeds": seeds, "points": self.search.points, "models": fits}
                results |= {"scores": scores.to_dict(), "wall_seconds": time.monotonic() - begin}
                write_json(folder / "results.json", results)
                page = forcegp.report.model_page(
                    models[BEST],
                    data["test"],
                    title=f"forcegp demo: friction of a tool on a surface, from {self.search.points} points",
                    best=forcegp.report.scores_sentence(scores, BEST),
                    tables=[forcegp.report.scores_table(scores)],
                    next_steps=[("For your robot:", "forcegp auto log.csv --robot arm.urdf --out answer")],
                    details=results,
                    shapes=forcegp.simulation.kuka_file(),
                )
                forcegp.report.write_page(folder / "report.html", page)
            for warning in scores.warnings:
                terminal.warn(warning)
        title = f"{self.search.points} training points, tested on another trajectory (rad/s²; NLPD in nats)"
        kept = f"Models, data and results.json are in {self.out}. Open the report:"
        terminal.show(*comparison(scores, title), kept, f"  {self.out}/report.html", page.best)
        return results


@dataclass(frozen=True, kw_only=True)
class Reproduce(Command):
    """Compute figures of Rath, Geist, Trimpe (2021) beside the published values. Needs a clone of the repository.

    FIGURE is fig2b, fig2c, fig3, fig4 or all. python -m benchmarks.paper does the same, and takes other numbers of
    training points and other trajectories.

    For example:
      forcegp reproduce all --preset smoke
      forcegp reproduce fig2b --preset paper --jobs 2
    """

    interrupted, replaces = "finished pieces are kept, and the same command resumes", False

    figure: Annotated[Positional[str], arg(metavar="FIGURE")]
    """Which figure, or all."""
    preset: Annotated[str, arg(metavar="smoke|paper")] = "smoke"
    """smoke: small, in a few minutes, to see that everything works. paper: the full experiments, CPU-hours."""
    out: Annotated[Path | None, unless_given("FOLDER", "reproduction-PRESET", Path)] = None
    """The folder of results; an unfinished run resumes."""
    jobs: Annotated[int, arg(metavar="J")] = os.cpu_count() or 1
    """Pieces of work at once, each on one core."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Compute what is missing and write all summaries. Raises InvalidInput outside of a clone."""
        places = Path(__file__).resolve().parents[3], Path.cwd()  # what the package, or the current folder, belongs to
        root = next((str(place) for place in places if (place / EXPERIMENTS).is_file()), None)
        if root is None:
            raise InvalidInput(
                "the experiments of the paper are not in the package but in its repository; run `git clone "
                "https://github.com/forcegp/forcegp`, and the same command in the folder of that clone."
            )
        if root not in sys.path:
            sys.path.insert(0, root)
        from benchmarks.paper.reproduction import NAME, PROGRAM, experiments_of, page_of, reproduce

        experiments = experiments_of(self.preset, self.figure)
        out = Path(f"reproduction-{self.preset}") if self.out is None else self.out
        command = f"{PROGRAM} {self.figure} --preset {self.preset}"
        with terminal.progress(f"reproducing {self.figure} ({self.preset})"):
            how: dict[str, Any] = {"command": command, "docs": None, "jobs": checked_jobs(self.jobs)}
            summaries = reproduce(experiments, self.preset, out, **how)
        terminal.show(f"{out / page_of(experiments)} reports the results; figures, JSON and CSV are in {out / NAME}.")
        return {"out": str(out), "preset": self.preset, "figures": summaries}
