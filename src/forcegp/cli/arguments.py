"""The words of a command line as a `Command`: which there are, their pages of help, and one-line complaints."""

import contextlib
import difflib
import importlib
import io
import re
from collections.abc import Mapping, Sequence

import tyro
from tyro.conf import FlagCreatePairsOff, HelptextFromCommentsOff, OmitArgPrefixes

from forcegp.cli.command import Command, options_of, with_texts
from forcegp.errors import InvalidInput

DESCRIPTION = """Learn the forces that a robot model lacks: friction, payload, cables.

Begin with:
  forcegp demo

or step by step:
  forcegp simulate kuka-surface --seconds 100 --seed 1 --out train.h5
  forcegp simulate kuka-surface --seconds 100 --seed 2 --out test.h5
  forcegp fit train.h5 --points 100 --out run
  forcegp score run test.h5 --out scores

Every command has --help, --json, --overwrite and --debug, and takes lists with commas, as in --forces a,b."""

COMMANDS: Mapping[str, str] = {
    "auto": "go from logs and a URDF to a validated model, in one command",
    "demo": "simulate, learn, score and report, in a minute", "simulate": "make a dataset with ground truth",
    "import": "make a dataset from logs (CSV, ROS bags, ...), and filter it",
    "robot": "show a robot file: tree, limits, masses, repairs, and a picture",
    "check": "find mistakes in a log, with the correction of each",
    "fit": "find what a model leaves open: coefficients, bodies, unknown forces",
    "payload": "estimate mass, centre of mass and inertia of a payload",
    "score": "score and compare models on time that they have not seen",
    "view": "show a recording and its learned forces in 3D, in the browser",
    "monitor": "find contacts in a log without a force sensor: time, link and force",
    "excite": "the most informative motion to record next", "export": "write a fitted model as a C program",
    "reproduce": "figures of the paper beside the published values, in a clone of the repository",
}  # fmt: skip
"""A new command is an entry here, and a subclass of Command of that name."""
MODULES = {
    "logs": ("import", "check"), "shown": ("robot", "view"), "deploy": ("export", "monitor", "excite"),
    "simulated": ("simulate", "demo", "reproduce"),
}  # fmt: skip
"""Where commands stand that have no module of their own name."""
MEANT = {"--urdf": "--robot", "--mjcf": "--robot", "--torque": "--u", "--effort": "--u", "--position": "--q"}
MEANT |= {"--velocity": "--v", "--output": "--out"}
"""What others call options."""
NOT_NUMBERS = {
    r"invalid literal for int\(\) with base 10": "a whole number",
    "could not convert string to float": "a number",
}
"""What Python calls a text that is no number, and what would be one."""


def command_class(name: str) -> type[Command]:
    """The class of a command; only its own module is imported, so that --help and errors come at once."""
    place = next((module for module, held in MODULES.items() if name in held), name)
    return getattr(importlib.import_module(f"forcegp.cli.{place}"), name.capitalize())


def parsed(words: Sequence[str]) -> Command:
    """The command that the words ask for. --help prints and raises SystemExit(0)."""
    name, *others = words or [""]
    if name in ("-h", "--help"):
        rows = [f"  {name.ljust(10)}{summary}" for name, summary in COMMANDS.items()]
        print("\n".join(["usage: forcegp COMMAND [OPTIONS]", "", DESCRIPTION, "", "Commands:", *rows]))
        raise SystemExit(0)
    if name not in COMMANDS:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f" Did you mean {close[0]}?" if close else " Options follow the command." if name.startswith("-") else ""
        what = f"there is no command {name!r}.{hint}" if name else "no command was given."
        raise InvalidInput(f"{what} Available subcommands: {', '.join(COMMANDS)}. See forcegp --help.")
    kind = command_class(name)
    config = (FlagCreatePairsOff, HelptextFromCommentsOff, OmitArgPrefixes)
    if {"-h", "--help"} & set(others):
        tyro.cli(with_texts(kind), prog=f"forcegp {name}", args=["--help"], config=config)
    others, complaint = _checked(name, kind, others), io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(kind, prog=f"forcegp {name}", args=others, config=config)
    except SystemExit:
        reason = one_line(complaint.getvalue())
        for pattern, kind_of_number in NOT_NUMBERS.items():
            reason = re.sub(rf"Error parsing (.*?): {pattern}: (.*)\.$", rf"\1 is \2; give {kind_of_number}.", reason)
        raise InvalidInput(f"{reason} See forcegp {name} --help.") from None


def _checked(name: str, kind: type[Command], words: Sequence[str]) -> list[str]:
    """The words, with values that begin with two dashes or underscores joined to their option.

    Raises InvalidInput for options that the command does not have, and for those that are given twice.
    """
    flags = {flag: option for name, option in options_of(kind).items() if (flag := option.flag(name))}
    given, joined, waits = set[str](), list[str](), False
    for place, word in enumerate(words):
        if word == "--":
            return [*joined, *words[place:]]
        flag = "--" + word.partition("=")[0].removeprefix("--").replace("_", "-")
        is_value, waits = waits and word.startswith(("--", "__")) and flag not in flags, False
        if is_value:
            joined[-1] += f"={word}"
            continue
        if word.startswith("--"):
            if flag not in flags:
                close = [MEANT[flag]] if MEANT.get(flag) in flags else difflib.get_close_matches(flag, flags, n=1)
                hint = f" Did you mean {close[0]}?" if close else ""
                raise InvalidInput(f"forcegp {name} has no option {flag}.{hint} See forcegp {name} --help.")
            if flag in given and not flags[flag].repeats:
                raise InvalidInput(f"{flag} is given twice; give it once, a list with commas.")
            given.add(flag)
            waits = "=" not in word and not isinstance(flags[flag].default, bool)
        joined.append(word)
    return joined


def one_line(box: str) -> str:
    """The sentence inside a box that tyro draws about wrong arguments: without frame, headings and repeated help."""
    lines = [line.strip("│|")[1:].rstrip() for line in box.splitlines() if not line.startswith(("╭", "╰", "+"))]
    sections: list[list[str]] = [[]]
    for line in filter(str.strip, lines):
        if not line.strip(" ─-"):
            sections.append([])
        elif not line.startswith(" " * 8):  # what is indented so far is the help of an option
            sections[-1].append(line.strip())
    # without such letters the heading stands above a line of its own
    sentences = [" ".join(section) for section in sections["╭" not in box :] if section]
    told = [each for each in sentences if not each.startswith(("For full helptext", "Argument helptext"))]
    return " ".join(each if each.endswith(".") else f"{each}." for each in told)
