"""`forcegp reproduce`: every figure and number of the paper, from one command."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from tyro.conf import Positional, arg

import forcegp.experiments
from forcegp.cli.command import BackendOptions, Debug, Json, unless_given
from forcegp.cli.terminal import Terminal
from forcegp.errors import InvalidInput


@dataclass(frozen=True, kw_only=True)
class Reproduce(BackendOptions):
    """Compute figures of Rath, Geist, Trimpe (2021) beside the published values, and what goes beyond the paper.

    FIGURE is fig2b, fig2c, fig3, fig4 or all; with the presets of force priors it is
    data-efficiency, friction, other-laws, transfer, unilateral-contact, deep-kernel or all. Every finished piece of
    work is kept in the folder; after an interruption the same command goes on from there.

    For instance:
      forcegp reproduce all --preset smoke
      forcegp reproduce fig2b --preset paper --jobs 2
      forcegp reproduce fig2b --points 50 100 --seeds 7 8 --out my-curves
    """

    interrupted: ClassVar[str] = "finished jobs are kept, and the same command goes on from there"
    replaces: ClassVar[bool] = False

    figure: Annotated[Positional[str], arg(metavar="FIGURE")]
    """Which figure, or all."""
    preset: Annotated[str, arg(metavar="smoke|paper|forces|forces-smoke")] = "smoke"
    """smoke: small, in a few minutes, to see that everything works. paper: the full experiments, CPU-hours.
    forces: what priors on forces are worth; forces-smoke: the same, small."""
    out: Annotated[Path | None, unless_given("FOLDER", "reproduction-PRESET")] = None
    """The folder of results; an unfinished one is gone on with."""
    docs: Annotated[Path | None, unless_given("FOLDER", "only into --out")] = None
    """Write the page (reproduction.md, force-priors.md), its figures, JSON and CSV into this folder, too."""
    points: Annotated[tuple[int, ...], unless_given("N", "the preset's")] = ()
    """Other numbers of training points."""
    seeds: Annotated[tuple[int, ...], unless_given("K", "the preset's")] = ()
    """Other trajectories."""
    jobs: Annotated[int | None, unless_given("J", "as many as cores", int)] = None
    """Pieces of work at once, each on one core."""
    json: Json = False
    debug: Debug = False

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Compute what is missing and write all summaries."""
        if any(seed < 0 for seed in self.seeds):
            raise InvalidInput(f"--seeds are {self.seeds}; give numbers of at least 0.")
        backend = self._backend("joblib")

        start = time.monotonic()
        experiments = forcegp.experiments.experiments_of(self.preset, self.figure)
        if self.points:
            experiments = tuple(experiment.with_points(self.points) for experiment in experiments)
        if self.seeds:
            experiments = tuple(experiment.with_seeds(self.seeds) for experiment in experiments)
        out = Path(f"reproduction-{self.preset}") if self.out is None else self.out
        with terminal.progress(f"reproducing {self.figure} ({self.preset})") as report:
            summaries = forcegp.experiments.reproduce(
                experiments, self.preset, out, command=self._command(), docs=self.docs, backend=backend, progress=report
            )
        terminal.show(
            f"{out / forcegp.experiments.page_name(experiments, self.preset)} reports the results; figures, JSON and "
            f"CSV are in {out / forcegp.experiments.page_of(self.preset).name}."
        )
        terminal.note(f"{time.monotonic() - start:.0f} s")
        return {"out": str(out), "preset": self.preset, "figures": summaries}

    def _command(self) -> str:
        """The command line that gives the same numbers."""
        words = ["forcegp reproduce", self.figure, "--preset", self.preset]
        for name, numbers in (("--points", self.points), ("--seeds", self.seeds)):
            words += [name, *map(str, numbers)] if numbers else []
        return " ".join(words)
