"""The pages that results are written to: one for the paper, one for what goes beyond it."""

from __future__ import annotations

from dataclasses import dataclass

PAPER_INTRODUCTION = """Rath, Geist and Trimpe, "Using Physics Knowledge for Learning Rigid-body Forward Dynamics with \
Gaussian Process Force Priors" (CoRL 2021), figure by figure, and what goes beyond it. This page, its tables and its \
figures are written by

    {command}

and never by hand; the numbers lie beside it as JSON and CSV. Every pair of training and test trajectory has its own \
way-points and noise, so no test row is a training row. Medians over seeds come with the least and the largest value."""

FORCES_INTRODUCTION = """What priors on forces are worth: data efficiency, friction as it is, other \
contacts, and the parts of the posterior. [forces.md](forces.md) explains the priors. This page, its tables and its \
figures are written by

    {command}

and never by hand; the numbers lie beside it as JSON and CSV. One experiment by its name: `forcegp reproduce NAME \
--preset forces`. Every training and every test trajectory has its own way-points and noise, the noise of the \
acceleration is 0.1 rad/s², “noise-free” errors are against the acceleration without it. Medians over seeds come with \
the least and the largest value."""


@dataclass(frozen=True)
class Page:
    """`name` is that of the file and of the folder beside it; `introduction` holds `{command}`."""

    name: str
    title: str
    introduction: str


PAPER = Page("reproduction", "Reproduction of the paper", PAPER_INTRODUCTION)
FORCES = Page("force-priors", "Force priors: results", FORCES_INTRODUCTION)

TRIAL_PRESETS = ("smoke", "forces-smoke")
"""Presets that test the machinery; their numbers mean nothing for the models."""


def page_of(preset: str) -> Page:
    """The page of the results of that preset."""
    return FORCES if preset.startswith("forces") else PAPER
