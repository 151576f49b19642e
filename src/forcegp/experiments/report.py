"""The page of a preset: every number on it comes from the results."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from forcegp.evaluation.summary_statistics import markdown_table
from forcegp.experiments.experiment import Experiment
from forcegp.experiments.pages import TRIAL_PRESETS, page_of


def report(experiments: Sequence[Experiment], documents: Mapping[str, Mapping[str, Any]]) -> str:
    """Markdown from the documents of the experiments: one section for each, then the times."""
    preset = documents[experiments[0].name]["preset"]
    page = page_of(preset)
    parts = [f"# {page.title}"]
    parts.append(page.introduction.format(command=documents[experiments[0].name]["command"]))
    if preset in TRIAL_PRESETS:
        parts.append(f"**Preset `{preset}`: a test of the machinery. Its numbers mean nothing for the models.**")
    for experiment in experiments:
        document = documents[experiment.name]
        parts.append(f"## {experiment.title}")
        parts += [f"![{experiment.title}]({page.name}/{name}.png)" for name in document["figures"]]
        parts.append(experiment.section(document["summary"]))
        parts += _warnings(document["warnings"])
    seconds = {name: value for document in documents.values() for name, value in document["cpu_seconds"].items()}
    machines = sorted({machine for document in documents.values() for machine in document["machines"]})
    parts += ["## Time", _times(" and ".join(machines), seconds)]
    return "\n\n".join(parts) + "\n"


def _warnings(by_job: Mapping[str, Sequence[str]]) -> list[str]:
    """What the computation warned of, with the number of jobs and one of them; numbers in the text are that one's."""
    kinds: dict[str, list[tuple[str, str]]] = {}
    for job, messages in by_job.items():
        for message in messages:
            kinds.setdefault(re.sub(r"\d[\d.e+-]*", "#", message), []).append((job, message))
    if not kinds:
        return []
    lines = [f"* jobs: {len(found)}, for example `{found[0][0]}`: {found[0][1]}" for found in kinds.values()]
    return ["Warnings while this was computed:\n\n" + "\n".join(lines)]


def _times(machine: str, times: Mapping[str, float]) -> str:
    groups: dict[str, list[float]] = {}
    for name, seconds in times.items():
        kind, *rest = name.split("/")
        group = f"{kind}/{rest[0]}/{rest[-1]}" if kind == "fits" else kind
        groups.setdefault(group, []).append(seconds)
    rows = [[group, str(len(each)), f"{max(each):.0f}", f"{sum(each):.0f}"] for group, each in groups.items()]
    text = (
        f"{sum(times.values()) / 3600:.2f} CPU-hours for {len(times)} jobs, on {machine}. A job includes loading and "
        "scoring, not only the search."
    )
    return f"{text}\n\n{markdown_table(['jobs', 'number', 'longest [CPU s]', 'all [CPU s]'], rows)}"
