"""The command line in a head: how many options there are, that each is documented once, and what `--help` prints."""

import re
import shlex
import subprocess
import sys
from collections import Counter
from typing import Annotated, get_args, get_origin

import pytest

from forcegp.cli.arguments import COMMANDS, command_class
from forcegp.cli.command import options_of
from forcegp.cli.main import parse_arguments

EVERY = pytest.mark.parametrize("command", COMMANDS)
MOST_WORDS = 30
TRANSLATED = re.compile(
    r"\b(gone on with|goes on from|nobody|so many|so long|teach\w*|surest|shall|says?|knows?|tells?)\b"
)
OPTIONS = {command: options_of(command_class(command)) for command in COMMANDS}


def plain(page):
    """A page without the frames of its boxes, each option with its text in one paragraph."""
    lines = [line.strip("│╭╰╮╯─ ") if line.startswith(("│", "╭", "╰")) else line for line in page.splitlines()]
    return "\n".join(lines)


def test_pages_of_help_do_not_wait_for_torch():
    code = (
        "import contextlib, sys; from forcegp.cli.main import main\n"
        f"for name in {[*COMMANDS]}:\n with contextlib.suppress(SystemExit): main([name, '--help'])\n"
        "assert not {'torch', 'numpy', 'matplotlib'} & {*sys.modules}"
    )
    subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)


def test_there_are_few_commands_and_few_options():
    names = Counter(name for options in OPTIONS.values() for name, option in options.items() if option.flag(name))
    assert len(COMMANDS) <= 14
    assert sum(names.values()) <= 280
    assert len(names) <= 100


def test_an_option_has_one_type_and_means_the_same_everywhere():
    """Apart from whether it may be left out, and from lists, which have entries of that type."""

    def base(hint):
        if get_origin(hint) is Annotated:
            hint = get_args(hint)[0]
        return {part for part in get_args(hint) if isinstance(part, type) and part is not type(None)} or {
            hint if isinstance(hint, type) else str
        }

    types: dict[str, set[type]] = {}
    for options in OPTIONS.values():
        for name, option in options.items():
            types.setdefault(name, set()).update(base(option.hint))
    assert {name: kinds for name, kinds in types.items() if len(kinds) > 1} == {"noise": {str, float}}


@EVERY
def test_every_option_is_on_the_page_once_with_its_text(forcegp, command):
    shown = forcegp(command, "--help")
    assert (shown.returncode, shown.stderr) == (0, "")
    page = plain(shown.stdout)
    flags = [flag for name, option in OPTIONS[command].items() if (flag := option.flag(name))]
    assert sorted(re.findall(r"^(--[a-z-]+)(?: \S+)?(?:$|  )", page, re.MULTILINE)) == sorted(flags)
    assert "(fixed to" not in page
    for text in re.split(r"\n(?=--)", page)[1:]:
        assert re.search(r"\w+ \w+", text), text  # every option says what it is
        assert text.count("(default:") + text.count("(required)") <= 1, text


@EVERY
def test_examples_are_commands_that_exist(forcegp, command):
    section = forcegp(command, "--help").stdout.partition("\nFor example:\n")[2].partition("\n\n")[0]
    examples = [shlex.split(line) for line in section.splitlines()]
    assert examples
    assert all(words[:2] == ["forcegp", command] for words in examples)
    for words in examples:
        parse_arguments(words[1 : words.index("|") if "|" in words else None])


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_sentences_are_short_and_in_words_of_the_field(forcegp, command):
    page = plain(forcegp(*command.split(), "--help").stdout)
    assert not TRANSLATED.findall(page)
    prose = re.sub(r"(?m)^  forcegp .*$", "", page)  # without examples
    for part in re.split(r"\n\n|\n(?=--|  )|\(default: ", prose):
        for sentence in re.split(r"(?<=[.!?:])\s", part):
            assert len(sentence.split()) <= MOST_WORDS, sentence
