"""`python -m benchmarks.paper FIGURE`: figures of Rath, Geist, Trimpe (2021) beside the published values.

Finished work is kept in the folder; after an interruption the same command resumes.
"""

import argparse
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.paper.reproduction import ALL, PROGRAM, experiments_of, page_of, reproduce
from forcegp.errors import ForceGPError
from forcegp.parallel import checked_jobs
from forcegp.progress import watched


def _numbers(text: str) -> tuple[int, ...]:
    numbers = tuple(map(int, text.split(",")))
    if min(numbers) < 0:
        raise ValueError
    return numbers


def main(words: Sequence[str] | None = None) -> int:
    """Compute what is missing and write all summaries; returns the exit code."""
    parser = argparse.ArgumentParser(prog=PROGRAM, description=__doc__)
    parser.add_argument("figure", help=f"fig2b, fig2c, fig3, fig4 or {ALL}")
    parser.add_argument("--preset", default="smoke", help="smoke: in a few minutes. paper: CPU-hours")
    parser.add_argument("--out", type=Path, help="the folder of results (default: reproduction-PRESET)")
    parser.add_argument("--docs", type=Path, help="write the page and what belongs to it into this folder, too")
    parser.add_argument("--points", type=_numbers, default=(), help="other numbers of training points: N,...")
    parser.add_argument("--seed-list", type=_numbers, default=(), help="other trajectories: K,...")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="pieces of work at once")
    parser.add_argument("--json", action="store_true", help="print the summaries as JSON")
    given = parser.parse_args(words)
    command = [PROGRAM, given.figure, "--preset", given.preset]
    out = given.out or Path(f"reproduction-{given.preset}")
    try:
        checked_jobs(given.jobs)
        experiments = experiments_of(given.preset, given.figure)
        for option, change in (("points", "with_points"), ("seed_list", "with_seeds")):
            numbers = getattr(given, option)
            if numbers:
                experiments = tuple(getattr(each, change)(numbers) for each in experiments)
                command += [f"--{option.replace('_', '-')}", ",".join(map(str, numbers))]
        how = {"command": " ".join(command), "docs": given.docs, "jobs": given.jobs}
        with watched(_progress):
            summaries = reproduce(experiments, given.preset, out, **how)
    except (ForceGPError, OSError) as error:
        print(f"{PROGRAM}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    page = out / page_of(experiments)
    print(json.dumps({"figures": summaries}) if given.json else f"{page} reports the results")
    return 0


def _progress(done: int, total: int, note: str) -> None:
    print(f"{done / total:.0%}, {note}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
