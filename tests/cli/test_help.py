"""Help pages fit the terminal, and their examples can be pasted."""

import re
import shlex

import pytest

from forcegp.cli.main import COMMANDS, WIDEST, parse_arguments, wrapped


@pytest.mark.parametrize("columns", [70, 100, 200])
@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_no_line_is_wider_than_the_terminal_or_the_widest_page(forcegp, command, columns):
    shown = forcegp(*command.split(), "--help", columns=columns)
    assert shown.returncode == 0
    assert max(map(len, shown.stdout.splitlines())) <= min(columns, WIDEST)


@pytest.mark.parametrize("command", COMMANDS)
def test_examples_are_commands_that_exist(forcegp, command):
    """Whatever the width: a backslash at the end of a line goes on in the next one, as in a shell."""
    page = forcegp(command, "--help", columns=70).stdout.replace("\\\n", " ")
    examples = re.findall(r"^  (forcegp .*)$", page, re.MULTILINE)
    assert examples
    for words in map(shlex.split, examples):
        assert words[1] in COMMANDS
        parse_arguments(words[1 : words.index("|") if "|" in words else None])


@pytest.mark.parametrize("command", COMMANDS)
def test_a_default_is_stated_once(forcegp, command):
    page = re.sub(r"[\s│]+", " ", forcegp(command, "--help").stdout)
    assert "(default: )" not in page
    assert not re.search(r"Default: (?:(?! --\w)[^()])*\(default: ", page)


def test_paragraphs_break_between_words():
    text = "one two three four five six\n  forcegp fit data.h5 --points 100 --out run\n│ a box that is drawn already │"
    assert list(wrapped(text, 24)) == [
        "one two three four five",
        "six",
        "  forcegp fit data.h5 \\",
        "      --points 100 \\",
        "      --out run",
        "│ a box that is drawn already │",
    ]
