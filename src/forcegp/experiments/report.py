"""The page `reproduction.md`: every number on it comes from the results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from forcegp.experiments.experiment import Experiment, markdown_table

INTRODUCTION = """Rath, Geist and Trimpe, "Using Physics Knowledge for Learning Rigid-body Forward Dynamics with \
Gaussian Process Force Priors" (CoRL 2021), figure by figure, and what goes beyond it. This page, its tables and its \
figures are written by

    {command}

and never by hand; the numbers lie beside it as JSON and CSV. Every pair of training and test trajectory has its own \
way-points and noise, so no test row is a training row. Medians over seeds come with the least and the largest value."""


def report(experiments: Sequence[Experiment], documents: Mapping[str, Mapping[str, Any]], beside: str) -> str:
    """Markdown from the documents of the experiments: one section for each, then the times.

    `beside` is the folder of the figures, relative to the page.
    """
    preset = documents[experiments[0].name]["preset"]
    figure = experiments[0].name if len(experiments) == 1 else "all"
    parts = ["# Reproduction of the paper"]
    parts.append(INTRODUCTION.format(command=f"forcegp reproduce {figure} --preset {preset}"))
    if preset != "paper":
        parts.append(f"**Preset `{preset}`: a test of the machinery. Its numbers say nothing about the models.**")
    for experiment in experiments:
        document = documents[experiment.name]
        parts.append(f"## {experiment.title}")
        parts += [f"![{experiment.title}]({beside}/{name}.png)" for name in document["figures"]]
        parts.append(experiment.section(document["summary"]))
    seconds = {name: value for document in documents.values() for name, value in document["cpu_seconds"].items()}
    parts += ["## Time", _times(documents[experiments[0].name]["machine"], seconds)]
    return "\n\n".join(parts) + "\n"


def _times(machine: str, times: Mapping[str, float]) -> str:
    groups: dict[str, list[float]] = {}
    for name, seconds in times.items():
        kind, *rest = name.split("/")
        group = f"{kind}/{rest[0]}/{rest[-1]}" if kind == "fits" else kind
        groups.setdefault(group, []).append(seconds)
    rows = [[group, str(len(each)), f"{max(each):.0f}", f"{sum(each):.0f}"] for group, each in groups.items()]
    text = (
        f"{sum(times.values()) / 3600:.2f} CPU-hours for {len(times)} cells, on {machine}. A cell includes loading and "
        "scoring, not only the search."
    )
    return f"{text}\n\n{markdown_table(['cells', 'number', 'longest [CPU s]', 'all [CPU s]'], rows)}"
