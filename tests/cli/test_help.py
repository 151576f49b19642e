"""Help pages: they fit the terminal, their examples can be pasted, and every option stands in one group."""

import inspect
import io
import re
import shlex
import sys
from collections import Counter
from dataclasses import fields

import pytest

from forcegp.cli.help_pages import GROUPS, WIDEST, show
from forcegp.cli.main import COMMANDS, command_class, parse_arguments

EVERY = pytest.mark.parametrize("command", COMMANDS)
MOST_WORDS = 30
TRANSLATED = re.compile(
    r"\b(gone on with|goes on from|nobody|so many|so long|teach\w*|surest|shall|says?|knows?|tells?)\b"
)


@pytest.mark.parametrize("columns", [60, 100, 200])
@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_no_line_is_wider_than_the_terminal_or_the_widest_page(forcegp, command, columns):
    shown = forcegp(*command.split(), "--help", columns=columns)
    assert (shown.returncode, shown.stderr) == (0, "")
    long = [line for line in shown.stdout.splitlines() if len(line) > min(columns, WIDEST)]
    assert all(len(line.removesuffix(" \\").split()) <= 2 for line in long), long  # a value that cannot be broken


@EVERY
def test_examples_are_commands_that_exist(forcegp, command):
    """Whatever the width: a backslash at the end of a line goes on in the next one, as in a shell."""
    page = forcegp(command, "--help", columns=60).stdout
    section = page.partition("\nExamples:\n")[2].partition("\n\n")[0].replace("\\\n", " ")
    examples = [shlex.split(line) for line in section.splitlines()]
    assert examples
    assert all(words[:2] == ["forcegp", command] for words in examples)
    for words in examples:
        parse_arguments(words[1 : words.index("|") if "|" in words else None])


@EVERY
def test_every_option_is_on_the_page_once_and_below_a_heading(forcegp, command):
    page = forcegp(command, "--help").stdout
    shown = re.findall(r"^  --(?:no-)?([a-z-]+)", page, re.MULTILINE)
    options = options_of(command)
    assert sorted(shown) == sorted(options)
    headings = re.findall(r"^(\w+):$", page, re.MULTILINE)
    assert [each for each in headings if each in GROUPS] == [each for each in GROUPS if each in headings]
    assert {"Output", "Other"} <= set(headings)


def options_of(command):
    """The options of a command, without those that are no options but arguments."""
    kind = command_class(command)
    sources = "".join(inspect.getsource(each) for each in kind.__mro__ if each.__module__.startswith("forcegp"))
    return [
        name.replace("_", "-")
        for name in (field.name for field in fields(kind))
        if not re.search(rf"^    {name}: (?:Annotated\[)?Positional", sources, re.MULTILINE)
    ]


def test_every_option_is_in_exactly_one_group():
    grouped = Counter(name for names in GROUPS.values() for name in names.split())
    options = {name.replace("-", "_") for command in COMMANDS for name in options_of(command)}
    assert set(grouped) == options
    assert max(grouped.values()) == 1


@EVERY
def test_a_default_is_stated_once_and_in_one_place(forcegp, command):
    page = forcegp(command, "--help").stdout
    for option in re.findall(r"^  --.*(?:\n {6,}.*)*", page, re.MULTILINE):
        text, hint, _ = re.sub(r"\s+", " ", option).partition("(default: ")
        assert not re.search(r"default(?! friction)", text, re.IGNORECASE), option
        assert option.count("(default:") + option.count("(required)") <= 1, option
        assert not hint or not option.rstrip().endswith("(default: )"), option


@EVERY
def test_no_sentence_is_long(forcegp, command):
    page = forcegp(command, "--help").stdout
    prose = re.sub(r"(?m)^  forcegp .*(\n      .*)*$", "", page)  # without examples
    for part in re.split(r"\n\n|\n(?=  \S)|\(default: ", prose):
        for sentence in re.split(r"(?<=[.!?])\s", part):
            assert len(sentence.split()) <= MOST_WORDS, sentence


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_words_are_those_of_the_field(forcegp, command):
    assert not TRANSLATED.findall(forcegp(*command.split(), "--help").stdout)


class Screen(io.TextIOWrapper):
    """A terminal that shows these letters alone."""

    def __init__(self, encoding):
        super().__init__(io.BytesIO(), encoding)

    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("variable", "value", "shown"),
    [("TERM", "xterm", "\x1b[1mOther:\x1b[0m\nkg m?\n"), ("NO_COLOR", "1", "Other:\nkg m?\n")],
)
def test_a_page_takes_the_letters_and_colors_of_the_terminal(monkeypatch, variable, value, shown):
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv(variable, value)
    screen = Screen("ascii")
    monkeypatch.setattr(sys, "stdout", screen)
    show("Other:\nkg m²")
    screen.seek(0)
    assert screen.read() == shown


def test_nothing_is_bold_in_a_file(forcegp):
    page = forcegp("fit", "--help").stdout
    assert "\nOther:\n" in page
    assert "\x1b" not in page
