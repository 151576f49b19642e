"""Experiments on force priors: `python -m benchmarks.force_priors --help`. Writes docs/benchmarks/force-priors.md."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.force_priors.presets import PAGE, PRESETS
from benchmarks.paper.reproduction import ALL, experiments_of, reproduce
from forcegp.errors import ForceGPError


def main(words: list[str]) -> int:
    """Compute what is missing and write the page; returns the exit code."""
    parser = argparse.ArgumentParser("python -m benchmarks.force_priors", description=__doc__)
    parser.add_argument("experiment", nargs="?", default=ALL, help="one of them by its name; default: all")
    parser.add_argument("--preset", default="forces", choices=PRESETS, help="forces: CPU-hours; smoke: small")
    parser.add_argument("--points", type=int, nargs="+", default=(), help="other numbers of training points")
    parser.add_argument("--out", type=Path, help="folder of results; an unfinished run resumes")
    parser.add_argument("--docs", type=Path, help="write page, figures, JSON and CSV into this folder, too")
    parser.add_argument("--jobs", type=int, default=1, help="pieces of work at once, each on one core")
    given = parser.parse_args(words)
    out = given.out or Path(f"force-priors-{given.preset}")
    try:
        experiments = experiments_of(given.preset, given.experiment, PRESETS, PAGE.program)
        if given.points:
            experiments = tuple(experiment.with_points(given.points) for experiment in experiments)
        kept = {"--preset": () if given.preset == "forces" else (given.preset,), "--points": given.points}
        options = (str(part) for name, values in kept.items() if values for part in (name, *values))
        command = " ".join([PAGE.program, *([] if given.experiment == ALL else [given.experiment]), *options])
        reproduce(experiments, given.preset, out, command=command, page=PAGE, docs=given.docs, jobs=given.jobs)
    except ForceGPError as error:
        print(f"{PAGE.program}: {error}", file=sys.stderr)
        return 2
    print(f"{out / PAGE.file(experiments)} reports the results; figures, JSON and CSV are in {out / PAGE.name}.")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
