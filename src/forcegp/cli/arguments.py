"""From words on the command line to a command with its options; what is wrong with them becomes one line."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from typing import Annotated, Any

import tyro
from tyro.conf import FlagCreatePairsOff, subcommand

from forcegp.cli.check import Check
from forcegp.cli.command import Command
from forcegp.cli.compare import Compare
from forcegp.cli.demo import Demo
from forcegp.cli.evaluate import Evaluate
from forcegp.cli.export import Export
from forcegp.cli.fit import Fit
from forcegp.cli.identify import Identify
from forcegp.cli.import_log import Import
from forcegp.cli.prepare import Prepare
from forcegp.cli.reproduce import Reproduce
from forcegp.cli.rollout import Rollout
from forcegp.cli.simulate import Simulate
from forcegp.cli.validate import Validate
from forcegp.errors import InvalidInput

DESCRIPTION = """Learn the forces that nobody modelled, inside the rigid-body dynamics that are known.

Begin with:
  forcegp demo

or step by step:
  forcegp simulate kuka-surface --seconds 100 --seed 1 --out train.h5
  forcegp simulate kuka-surface --seconds 100 --seed 2 --out test.h5
  forcegp fit train.h5 --points 100 --out run
  forcegp evaluate run test.h5 --plots figures

Every command has --help, --json and --debug. forcegp --version prints the version."""

COMMANDS: dict[str, tuple[type[Command], str]] = {
    "demo": (Demo, "the whole story in a minute: simulate, learn, evaluate, draw"),
    "simulate": (Simulate, "make a dataset with ground truth"),
    "import": (Import, "make a dataset of logs: CSV, Parquet, npz, MATLAB, HDF5, ROS bags, LeRobot"),
    "check": (Check, "what would spoil a model of this log, and what to do about it"),
    "prepare": (Prepare, "filter and differentiate a raw log, and report what that costs"),
    "fit": (Fit, "learn the unknown forces from a dataset"),
    "compare": (Compare, "which kind of unknown force the data support"),
    "identify": (Identify, "estimate masses, inertias and friction coefficients, and their standard errors"),
    "evaluate": (Evaluate, "score a fitted model on another dataset"),
    "validate": (Validate, "models side by side on rows of a log that none of them has seen"),
    "rollout": (Rollout, "predict whole motions and compare them with the recorded ones"),
    "export": (Export, "write a fitted model as a C program"),
    "reproduce": (Reproduce, "every figure and number of the paper, from one command"),
}
"""A new command is a file with a subclass of Command, and an entry here."""


def parse_arguments(words: Sequence[str]) -> Command:
    """The command that the words ask for. `--help` prints and raises SystemExit(0).

    Raises InvalidInput, with a message of one line, for words that make no command.
    """
    if words and words[0] in COMMANDS:
        kind, _ = COMMANDS[words[0]]
        return _parse(kind, words[1:], prog=f"forcegp {words[0]}")
    kinds: Any = None
    for name, (kind, summary) in COMMANDS.items():
        kind = Annotated[kind, subcommand(name, description=summary, prefix_name=False)]
        kinds = kind if kinds is None else kinds | kind
    return _parse(kinds, words, prog="forcegp", description=DESCRIPTION)


def _parse(kind: Any, words: Sequence[str], prog: str, description: str | None = None) -> Command:
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(kind, prog=prog, description=description, args=words, config=(FlagCreatePairsOff,))
    except SystemExit as end:
        if not end.code:
            raise
        raise InvalidInput(f"{one_line(complaint.getvalue())} See {prog} --help.") from None


def one_line(box: str) -> str:
    """The sentence inside a box that tyro draws about wrong arguments: without frame, headings and repeated help.

    ╭─ Unrecognized options ─────────────────╮
    │ Unrecognized options: --pionts         │
    │ ────────────────────────────────────── │
    │ Perhaps you meant:                     │
    │     --points N                         │
    │         Train on so many rows.         │
    ╰────────────────────────────────────────╯

    becomes "Unrecognized options: --pionts. Perhaps you meant: --points N."
    """
    lines = [line.strip("│|")[1:].rstrip() for line in box.splitlines() if not line.startswith(("╭", "╰", "+"))]
    sections: list[list[str]] = [[]]
    for line in lines:
        if line.strip("─-") == "" and line:
            sections.append([])
        elif line.strip() and not line.startswith(" " * 8):  # what is indented so far is the help of an option
            sections[-1].append(line.strip())
    sentences = [" ".join(section) for section in sections if section]
    sentences = [section for section in sentences if not section.startswith(("For full helptext", "Argument helptext"))]
    return " ".join(section if section.endswith(".") else f"{section}." for section in sentences)
