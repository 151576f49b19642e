"""Messages name arguments in Python and options on the command line, from one text."""

import ast
import re
from pathlib import Path

import pytest

from forcegp.cli.arguments import COMMANDS, command_class
from forcegp.cli.command import options_of
from forcegp.cli.terminal import OTHERWISE, with_option_names

REPOSITORY = Path(__file__).resolve().parents[2]
OF_A_PROGRAM = re.compile(r"(forcegp [a-z]+|xcode-select|start one with)[^;)`]* --[a-z]")


@pytest.mark.parametrize(
    ("message", "words"),
    [
        ("`points=61` must be an integer", "--points 61 must be an integer"),
        ("`jobs=-1` must", "--jobs=-1 must"),
        ("give `engine='exact'`, or fewer `points`", "give --engine exact, or fewer --points"),
        ("add `overwrite=True` or another `folder`", "add --overwrite or another --out"),
        ("another `model` or its `contacts`", "another --robot or its --contact"),
        ("a `tolerance` that only Python has, `forcegp fit`", "a `tolerance` that only Python has, `forcegp fit`"),
        ("`unit` q=deg", "`unit` q=deg"),  # of another command
    ],
)
def test_arguments_become_the_options_of_the_command(message, words):
    assert with_option_names(message, options_of(command_class("fit"))) == words


def test_every_other_name_is_an_option_of_some_command():
    everywhere = {name for command in COMMANDS for name in options_of(command_class(command))}
    assert set(OTHERWISE.values()) <= everywhere


def flags_without_a_command(path):
    """Texts of a module with an option that is not part of a whole command, and so means nothing in Python."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    parts = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in nodes:
        if id(node) in parts:
            continue
        if isinstance(node, ast.JoinedStr):
            text = "".join(part.value if isinstance(part, ast.Constant) else "X" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = node.value
        else:
            continue
        if re.search(r"(?<![-\w])--[a-z]", text) and not OF_A_PROGRAM.search(text):
            yield text


def test_below_the_command_line_no_message_names_a_bare_option():
    package = REPOSITORY / "src" / "forcegp"
    found = {
        (name, text)
        for path in sorted(package.rglob("*.py"))
        if (name := path.relative_to(package).as_posix()).partition("/")[0] != "cli"
        for text in flags_without_a_command(path)
    }
    assert found == set()
