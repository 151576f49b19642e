"""Run every benchmark, print, and write `results.json` and docs/benchmarks/performance.md.

All in one process on one thread, but for those that need processes of their own.

make bench                              all questions
python -m benchmarks likelihood         some of them (the others keep their stored results)
"""

from __future__ import annotations

import json
import sys
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path

from benchmarks.performance_page import PAGE, QUESTIONS, performance_page
from forcegp.atomic_files import write_text
from forcegp.jobs import machine

FOLDER = Path(__file__).resolve().parent
RESULTS = FOLDER / "results.json"


def main(questions: list[str]) -> None:
    """Run the questions named (all by default) and store what they answer."""
    unknown = [name for name in questions if name not in QUESTIONS]
    if unknown:
        raise SystemExit(f"no benchmark {unknown[0]!r}; there are: {', '.join(QUESTIONS)}")
    import torch
    from threadpoolctl import threadpool_limits

    stored = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    torch.set_num_threads(1)
    for name in questions or QUESTIONS:
        print(f"\n== {name}", flush=True)
        module = import_module(f"benchmarks.{name}")
        with threadpool_limits(1):  # entered after the libraries are loaded, or it would miss them
            stored |= module.run()
        stored["machine"] = f"{machine()}; one thread used"
        stored["date"] = datetime.now(UTC).date().isoformat()
        write_text(RESULTS, json.dumps(stored, indent=1, sort_keys=True) + "\n")
    page = performance_page(stored)
    write_text(PAGE, page)
    print(f"\n{page}")


if __name__ == "__main__":
    main(sys.argv[1:])
