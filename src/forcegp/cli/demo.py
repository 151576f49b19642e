"""`forcegp demo`: simulate, learn, score and report, in one go."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

import forcegp
import forcegp.posterior
import forcegp.report
import forcegp.scores
import forcegp.simulation
from forcegp.atomic_files import write_json
from forcegp.cli.command import Command, values_of
from forcegp.cli.fit import fit_summary
from forcegp.cli.robot_options import SearchOptions
from forcegp.cli.score import comparison
from forcegp.cli.simulate import simulate_with_progress
from forcegp.cli.terminal import Terminal
from forcegp.errors import InvalidInput

NOISE = 0.1  # rad/s^2, as in the paper
SEED = 21  # not 1 to 6: those trajectories served to choose the hyperprior, so they would flatter the model

BEST = "S-GP + analytical mean"
MODELS = {"S-GP": ("s-gp", False), BEST: ("s-gp-analytical-mean", True)}
"""Name in the paper -> (folder, whether known forces are the mean)."""


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
        start = time.monotonic()
        with self.folder(self.out, {"options": options}) as folder:
            data, seeds = {}, {"train": self.seed, "test": self.seed + 1}
            for name, seed in seeds.items():
                how: dict[str, Any] = {"seconds": self.seconds, "seed": seed, "noise": NOISE}
                data[name] = simulate_with_progress(terminal, "kuka-surface", **how)
                data[name].save(folder / f"{name}.h5")
                terminal.note(f"simulated {name}: {len(data[name])} rows, seed {seed}")
            train, test = data.values()
            models, fits = {}, {}
            for name, (place, mean) in MODELS.items():
                models[name], fits[name] = self._fitted(terminal, folder / place, train, name, mean)
            with terminal.progress("scoring") as report:
                scores = forcegp.score(models, test, horizons=(), progress=report)
            for warning in scores.warnings:
                terminal.warn(warning)
            results: dict[str, Any] = {
                "out": str(self.out),
                "seeds": seeds,
                "points": self.search.points,
                "seconds": self.seconds,
                "models": {name: {"run": str(self.out / MODELS[name][0]), "fit": fit} for name, fit in fits.items()},
                "scores": scores.to_dict(),
                "wall_seconds": time.monotonic() - start,
            }
            write_json(folder / "results.json", results)
            sentence = self._write_report(terminal, folder, models[BEST], test, scores, results)
        title = f"{self.search.points} training points, tested on another trajectory (rad/s²; NLPD in nats)"
        terminal.show(
            *comparison(scores, title),
            f"Models, data and results.json are in {self.out}. Open the report:",
            f"  {self.out}/report.html",
            sentence,
        )
        return results

    def _write_report(
        self,
        terminal: Terminal,
        folder: Path,
        posterior: forcegp.posterior.Posterior,
        test: forcegp.Dataset,
        scores: forcegp.scores.Scores,
        results: Mapping[str, Any],
    ) -> str:
        """The page with everything, whose best sentence is returned."""
        best = forcegp.report.scores_sentence(scores, BEST)
        with terminal.progress("writing the report") as progress:
            pictures, missing = forcegp.scores.model_pictures(posterior, test, progress)
            page = forcegp.report.model_page(
                posterior,
                test,
                pictures,
                title=f"forcegp demo: a tool slides on a surface, friction learned from {self.search.points} points",
                best=best,
                findings=[
                    ("robot", "KUKA iiwa in PyBullet; it presses and slides its tool on a table"),
                    ("model", "S-GP with analytical mean of Rath, Geist and Trimpe (CoRL 2021)"),
                    ("tested on", f"{len(test)} rows of a trajectory with another seed"),
                ],
                tables=[forcegp.report.scores_table(scores)],
                next_steps=[
                    ("The same for your robot:", "forcegp auto log.csv --robot arm.urdf --out answer"),
                    ("More of the motion:", f"forcegp view {self.out}/s-gp-analytical-mean {self.out}/test.h5"),
                ],
                details=results,
                shapes=forcegp.simulation.kuka_file(),
                missing=missing,
            )
            forcegp.report.write_page(folder / "report.html", page)
        return best

    def _fitted(
        self, terminal: Terminal, run: Path, train: forcegp.Dataset, name: str, mean: bool
    ) -> tuple[forcegp.posterior.Posterior, dict[str, Any]]:
        """The fitted model, and what the fit came to."""
        assert train.model is not None
        start = time.monotonic()
        model = train.model.with_forces(forcegp.JointForces())
        model = model if mean else model.without_mean()
        with terminal.progress(f"fitting {name}") as report:
            posterior: Any = forcegp.scores.learn(model, train, report=report, **vars(self.search))[0]
        seconds = time.monotonic() - start
        forcegp.save_posterior(posterior, run)
        iterations = len(posterior.result.history) - 1
        terminal.note(f"fitted {name}: {iterations} iterations ({seconds:.1f} s)")
        return posterior, fit_summary(posterior, seconds)
