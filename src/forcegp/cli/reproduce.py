"""`forcegp reproduce`: figures and numbers of the paper, by `benchmarks/paper` of the repository."""

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from forcegp.cli.command import Command, unless_given
from forcegp.cli.terminal import Terminal
from forcegp.errors import InvalidInput
from forcegp.parallel import checked_jobs

EXPERIMENTS = Path("benchmarks", "paper", "reproduction.py")


@dataclass(frozen=True, kw_only=True)
class Reproduce(Command):
    """Compute figures of Rath, Geist, Trimpe (2021) beside the published values. Needs a clone of the repository.

    FIGURE is fig2b, fig2c, fig3, fig4 or all. python -m benchmarks.paper does the same, and takes other numbers of
    training points and other trajectories.

    For example:
      forcegp reproduce all --preset smoke
      forcegp reproduce fig2b --preset paper --jobs 2
    """

    interrupted = "finished pieces are kept, and the same command resumes"
    replaces = False

    figure: Annotated[Positional[str], arg(metavar="FIGURE")]
    """Which figure, or all."""
    preset: Annotated[str, arg(metavar="smoke|paper")] = "smoke"
    """smoke: small, in a few minutes, to see that everything works. paper: the full experiments, CPU-hours."""
    out: Annotated[Path | None, unless_given("FOLDER", "reproduction-PRESET", Path)] = None
    """The folder of results; an unfinished run resumes."""
    jobs: Annotated[int, arg(metavar="J")] = os.cpu_count() or 1
    """Pieces of work at once, each on one core."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Compute what is missing and write all summaries."""
        root = _repository()
        if root not in sys.path:
            sys.path.insert(0, root)
        from benchmarks.paper.reproduction import NAME, PROGRAM, experiments_of, page_of, reproduce

        experiments = experiments_of(self.preset, self.figure)
        out = Path(f"reproduction-{self.preset}") if self.out is None else self.out
        command = f"{PROGRAM} {self.figure} --preset {self.preset}"
        with terminal.progress(f"reproducing {self.figure} ({self.preset})") as report:
            how: dict[str, Any] = {"command": command, "docs": None, "jobs": checked_jobs(self.jobs)}
            summaries = reproduce(experiments, self.preset, out, **how, progress=report)
        page = out / page_of(experiments)
        terminal.show(f"{page} reports the results; figures, JSON and CSV are in {out / NAME}.")
        return {"out": str(out), "preset": self.preset, "figures": summaries}


def _repository() -> str:
    """The clone that this package, or the current folder, belongs to. Raises InvalidInput where neither is one."""
    for root in (Path(__file__).resolve().parents[3], Path.cwd()):
        if (root / EXPERIMENTS).is_file():
            return str(root)
    raise InvalidInput(
        "the experiments of the paper are not in the package but in its repository; run `git clone "
        "https://github.com/forcegp/forcegp`, and the same command in the folder of that clone."
    )
