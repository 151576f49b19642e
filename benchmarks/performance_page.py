"""docs/benchmarks/performance.md from results.json: every key, its bound, and whether it is kept; tested."""

from __future__ import annotations

import json
import operator
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

QUESTIONS: dict[str, dict[str, Any]] = tomllib.loads(Path(__file__).with_name("questions.toml").read_text("utf-8"))
"""By question its title, and by key the bound and the meaning; in the order in which they are asked."""
DOCS = Path(__file__).resolve().parent.parent / "docs" / "benchmarks"
PAGE = DOCS / "performance.md"
SCALING = DOCS / "performance" / "scaling.json"

INTRODUCTION = """# Performance

All numbers are measured. `make bench` writes this page from [benchmarks/results.json](../../benchmarks/results.json), and the command above a table
measures it again. Times are CPU seconds and medians unless stated otherwise; ratios compare both sides in the same process on one thread.

The subjects are explained elsewhere: [engines](../how-to/large-data.md), [predictors](../how-to/control-rate.md),
[compiled dynamics](../explanation/compiled-dynamics.md), [updates](../how-to/incremental.md) and [solvers](../explanation/solvers.md).
No GPU has been measured yet ([GPU](../how-to/gpu.md)).
"""  # noqa: E501  # one line of the page each

COMPARISONS = {"<=": operator.le, ">=": operator.ge}


def performance_page(results: Mapping[str, Any]) -> str:
    """The whole page."""
    parts = [INTRODUCTION]
    for question, asked in QUESTIONS.items():
        known = {key: each for key, each in asked.items() if key in results}
        if not known:
            continue
        rows = ["| what | measured | required | met |", "|:---|---:|:---|:---|"]
        for key, (bound, meaning) in known.items():
            rows.append(f"| {meaning} (`{key}`) | {results[key]:.4g} | {bound} | {kept(results[key], bound)} |")
        parts += [f"## {asked['title']}\n\n`python -m benchmarks {question}`\n", "\n".join(rows) + "\n"]
        if question == "scaling" and SCALING.exists():
            parts += ["![CPU time and memory over the number of training rows](performance/scaling.png)\n", scaling()]
    parts.append(f"{results['machine']}, {results['date']} (the newest of the measurements above).\n")
    return "\n".join(parts)


def kept(value: float, bound: str) -> str:
    """Whether a bound such as "<= 0.5" is kept; empty without one."""
    if not bound:
        return ""
    sign, number = bound.split()
    return "yes" if COMPARISONS[sign](value, float(number)) else "**no**"


def scaling() -> str:
    """Time and memory of every case, from what the question `scaling` wrote."""
    measured = json.loads(SCALING.read_text(encoding="utf-8"))
    rows = ["| engine | N | CPU s | MiB |", "|:---|---:|---:|---:|"]
    for engine, found in measured.items():
        rows += [f"| {engine} | {int(n):,} | {x['cpu_s']:.2f} | {x['memory_mib']:.0f} |" for n, x in found.items()]
    return "\n".join(rows) + "\n"
