"""`forcegp reproduce`: every figure and number of the paper, by `benchmarks/paper` of the repository."""

import os
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from forcegp.cli.command import Resuming, listed, unless_given
from forcegp.cli.terminal import Terminal
from forcegp.errors import InvalidInput
from forcegp.parallel import checked_jobs

EXPERIMENTS = Path("benchmarks", "paper", "reproduction.py")


@dataclass(frozen=True, kw_only=True)
class Reproduce(Resuming):
    """Compute figures of Rath, Geist, Trimpe (2021) beside the published values. Needs a clone of the repository.

    FIGURE is fig2b, fig2c, fig3, fig4 or all. Finished work is kept in the folder; after an interruption the same
    command resumes.

    For example:
      forcegp reproduce all --preset smoke
      forcegp reproduce fig2b --preset paper --jobs 2
      forcegp reproduce fig2b --points 50,100 --seed-list 7,8 --out my-curves
    """

    figure: Annotated[Positional[str], arg(metavar="FIGURE")]
    """Which figure, or all."""
    preset: Annotated[str, arg(metavar="smoke|paper")] = "smoke"
    """smoke: small, in a few minutes, to see that everything works. paper: the full experiments, CPU-hours."""
    out: Annotated[Path | None, unless_given("FOLDER", "reproduction-PRESET")] = None
    """The folder of results; an unfinished run resumes."""
    docs: Annotated[Path | None, unless_given("FOLDER", "only into --out")] = None
    """Write the page (reproduction.md), its figures, JSON and CSV into this folder, too."""
    points: Annotated[tuple[int, ...], listed("N,...", "the preset's", of=int)] = ()
    """Other numbers of training points."""
    seed_list: Annotated[tuple[int, ...], listed("K,...", "the preset's", of=int)] = ()
    """Other trajectories."""
    jobs: Annotated[int | None, unless_given("J", "as many as cores", int)] = None
    """Pieces of work at once, each on one core."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Compute what is missing and write all summaries."""
        if any(seed < 0 for seed in self.seed_list):
            raise InvalidInput(f"--seed-list is {self.seed_list}; give numbers of at least 0.")
        root = _repository()
        jobs = checked_jobs(os.cpu_count() or 1 if self.jobs is None else self.jobs)
        start = time.monotonic()
        if root not in sys.path:
            sys.path.insert(0, root)
        from benchmarks.paper.reproduction import PAPER_PAGE, experiments_of, reproduce

        experiments = experiments_of(self.preset, self.figure)
        if self.points:
            experiments = tuple(experiment.with_points(self.points) for experiment in experiments)
        if self.seed_list:
            experiments = tuple(experiment.with_seeds(self.seed_list) for experiment in experiments)
        out = Path(f"reproduction-{self.preset}") if self.out is None else self.out
        with terminal.progress(f"reproducing {self.figure} ({self.preset})") as report:
            summaries = reproduce(
                experiments, self.preset, out, command=self._command(), docs=self.docs, jobs=jobs, progress=report
            )
        page, beside = out / PAPER_PAGE.file(experiments), out / PAPER_PAGE.name
        terminal.show(f"{page} reports the results; figures, JSON and CSV are in {beside}.")
        terminal.note(f"{time.monotonic() - start:.0f} s")
        return {"out": str(out), "preset": self.preset, "figures": summaries}

    def _command(self) -> str:
        """The command line that gives the same numbers."""
        words = ["forcegp reproduce", self.figure, "--preset", self.preset, *self.words("points", "seed_list")]
        return " ".join(words)


def _repository() -> str:
    """The clone that this package, or the current folder, belongs to. Raises InvalidInput where neither is one."""
    for root in (Path(__file__).resolve().parents[3], Path.cwd()):
        if (root / EXPERIMENTS).is_file():
            return str(root)
    raise InvalidInput(
        "the experiments of the paper are not in the package but in its repository; run `git clone "
        "https://github.com/forcegp/forcegp`, and the same command in the folder of that clone."
    )
