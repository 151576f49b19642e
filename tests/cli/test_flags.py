"""The grammar of the command line: one list syntax, and one way to give an option."""

import re
import shlex

import pytest

from forcegp.cli.arguments import command_class, one_line
from forcegp.cli.command import FIELDS, NUMBERS, options_of, split_list, values_of
from forcegp.cli.main import ARGUMENTS, parse_arguments
from forcegp.errors import InvalidInput

FIT = "fit x.h5 --out run"


@pytest.mark.parametrize(
    ("words", "field", "entries"),
    [
        (
            "score x.h5 --out r --forces a,gp:joint:inputs=q/v,kernel=k --forces identified@motions:1", "forces",
            ("a,gp:joint:inputs=q/v,kernel=k", "identified@motions:1"),
        ),
        (f"{FIT} --forces gp:tool:frame=tool,x=1,viscous", "forces", ("gp:tool:frame=tool,x=1", "viscous")),
        (f"{FIT} --forces 'gp:a:kernel=(k + deep(x, y)),b'", "forces", ("gp:a:kernel=(k + deep(x, y))", "b")),
        (f"{FIT} --evidence torques:mean=.4,motions:1", "evidence", ("torques:mean=.4", "motions:1")),
        (
            f"{FIT} --contact tool@0,-1e-3,0.1:plane:0,0,1,.055,link_2:sphere:0,0,0,1", "contact",
            ("tool@0,-1e-3,0.1:plane:0,0,1,.055", "link_2:sphere:0,0,0,1"),
        ),
        (f"{FIT} --lock a=1,b=-0.5", "lock", ("a=1", "b=-0.5")),
        ("score x.h5 --out r --horizon 0.1,1", "horizon", (0.1, 1.0)),
        ("import x.csv --out f.h5 --q 'Winkel_A{1..6}' --u 'a,b'", "u", "a,b"),
    ],
)  # fmt: skip
def test_lists_are_written_with_commas(words, field, entries):
    assert values_of(parse_arguments(shlex.split(words)))[field] == entries


def test_what_a_list_prints_is_read_again():
    command = parse_arguments(shlex.split(f"{FIT} --forces gp:tool:a=b,b=1,joint --lock a=1,b=2 --gravity=-1,0,0"))
    words = command.words("forces", "lock", "gravity", "checks")
    assert words == ["--forces", "gp:tool:a=b,b=1,joint", "--lock", "a=1,b=2", "--gravity=-1,0,0"]
    assert parse_arguments([*shlex.split(FIT), *words]) == command


def test_what_continues_an_entry():
    continues = {NUMBERS: ("0", "-1.5", ".5", "1e-3", "0.1:plane:0"), FIELDS: ("inputs=q/v", "kernel = x")}
    begins = {NUMBERS: ("tool", "0_link:plane:0", "velocity=1"), FIELDS: ("joint", "gp:tool:frame=x", "a + b")}
    assert [(p, each) for p, found in continues.items() for each in found if not re.fullmatch(p, each)] == []
    assert [(p, each) for p, found in begins.items() for each in found if re.fullmatch(p, each)] == []


@pytest.mark.parametrize("text", ["", ",a", "a,,b"])
def test_empty_entries_are_refused(text):
    with pytest.raises(ValueError, match="empty entry"):
        split_list(text)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (f"{FIT} --forces a b c", "Unrecognized options: b, c."),
        (f"{FIT} --forces=a --jobs 1 --forces b", "--forces is given twice; give it once, a list with commas."),
        (f"{FIT} --force_noise 1 --force-noise 2", "--force-noise is given twice; give it once"),
        ("score x.h5 --out r --horizon 10,x", "'10,x' is no list of numbers"),
        (f"{FIT} --pionts 3", "forcegp fit has no option --pionts. Did you mean --points? See forcegp fit --help."),
        (f"{FIT} --jobs a", "--jobs is 'a'; give a whole number. See forcegp fit --help."),
        (f"{FIT} --force-noise 1,5", "--force-noise is '1,5'; give a number. See forcegp fit --help."),
        ("auto x.csv --urdf a.urdf --out run", "forcegp auto has no option --urdf. Did you mean --robot?"),
        ("fit x.h5 --checks --out run", "has no option --checks. Did you mean --no-checks?"),
        ("--json", "Options follow the command"),
        ("", "no command was given"),
    ],
)
def test_what_is_no_list_is_refused_in_one_line(words, message):
    with pytest.raises(InvalidInput) as error:
        parse_arguments(shlex.split(words))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["__time", "--stamp"])
def test_a_value_may_begin_with_dashes_or_underscores(name):
    found = parse_arguments(["import", "x.csv", "--time", name, "--q", "__q", "--ned", "--out", "o.h5"])
    assert (found.columns.time, found.columns.q, found.columns.ned) == (name, "__q", True)


@pytest.mark.parametrize("command", ARGUMENTS)
def test_what_arguments_are_called_as_options_are_options(command):
    options = {option.replace("-", "_") for option in ARGUMENTS[command].values()}
    assert options <= set(options_of(command_class(command)))


def test_a_box_becomes_a_sentence():
    box = """╭─ Unrecognized options ─────────────────╮
│ Unrecognized options: --pionts         │
│ ────────────────────────────────────── │
│ Perhaps you meant:                     │
│     --points N                         │
│         Train on so many rows.         │
╰────────────────────────────────────────╯"""
    assert one_line(box) == "Unrecognized options: --pionts. Perhaps you meant: --points N."
    lines = " Required options\n ----- \n  Missing from forcegp fit:\n      --out FOLDER\n          Where.\n  ---"
    assert one_line(lines) == "Missing from forcegp fit: --out FOLDER."
