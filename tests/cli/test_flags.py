"""The grammar of the command line: one list syntax, one meaning for each name, one way to give an option."""

import re
import shlex
from typing import Annotated, get_args, get_origin, get_type_hints

import pytest

from forcegp.cli.command import FIELDS, NUMBERS, split_list
from forcegp.cli.help_pages import command_page
from forcegp.cli.main import ARGUMENTS, COMMANDS, command_class, parse_arguments
from forcegp.errors import InvalidInput

FIT = "fit x.h5 --out run"


def refused(words):
    with pytest.raises(InvalidInput) as error:
        parse_arguments(shlex.split(words))
    return str(error.value)


@pytest.mark.parametrize(
    ("words", "field", "entries"),
    [
        (
            "score x.h5 --out r --forces a,gp:joint:inputs=q/v,kernel=k --forces identified@motions:1",
            "forces",
            ("a,gp:joint:inputs=q/v,kernel=k", "identified@motions:1"),
        ),
        (f"{FIT} --forces viscous,gp:joint-friction", "forces", ("viscous", "gp:joint-friction")),
        (f"{FIT} --forces gp:tool:frame=tool,x=1,viscous", "forces", ("gp:tool:frame=tool,x=1", "viscous")),
        (f"{FIT} --forces 'gp:a:kernel=(k + deep(x, y)),b'", "forces", ("gp:a:kernel=(k + deep(x, y))", "b")),
        (f"{FIT} --evidence torques:mean=.4,motions:1", "evidence", ("torques:mean=.4", "motions:1")),
        (
            f"{FIT} --contact tool@0,-1e-3,0.1:plane:0,0,1,.055,link_2:sphere:0,0,0,1",
            "contact",
            ("tool@0,-1e-3,0.1:plane:0,0,1,.055", "link_2:sphere:0,0,0,1"),
        ),
        ("excite run --out f --limits velocity=1,1,2,torque=5", "limits", ("velocity=1,1,2", "torque=5")),
        (f"{FIT} --lock a=1,b=-0.5", "lock", ("a=1", "b=-0.5")),
        ("reproduce fig3 --points 10,20 --seed-list 7", "points", (10, 20)),
        ("score x.h5 --out r --horizon 0.1,1", "horizon", (0.1, 1.0)),
        ("import x.csv --out f.h5 --q 'Winkel_A{1..6}' --u 'a,b'", "u", "a,b"),
    ],
)
def test_lists_are_written_with_commas(words, field, entries):
    assert getattr(parse_arguments(shlex.split(words)), field) == entries


def test_what_a_list_prints_is_read_again():
    command = parse_arguments(shlex.split(f"{FIT} --forces gp:tool:a=b,b=1,joint --lock a=1,b=2 --gravity=-1,0,0"))
    words = command.words("forces", "lock", "gravity")
    assert words == ["--forces", "gp:tool:a=b,b=1,joint", "--lock", "a=1,b=2", "--gravity=-1,0,0"]
    again = parse_arguments([*shlex.split(FIT), *words])
    assert again == command


def test_what_continues_an_entry():
    continues = {NUMBERS: ("0", "-1.5", ".5", "1e-3", "0.1:plane:0"), FIELDS: ("inputs=q/v", "kernel = x")}
    begins = {NUMBERS: ("tool", "0_link:plane:0", "velocity=1"), FIELDS: ("joint", "gp:tool:frame=x", "a + b")}
    assert [(p, each) for p, found in continues.items() for each in found if not re.fullmatch(p, each)] == []
    assert [(p, each) for p, found in begins.items() for each in found if re.fullmatch(p, each)] == []


@pytest.mark.parametrize("text", ["", "a,", ",a", "a,,b", " , "])
def test_empty_entries_are_refused(text):
    with pytest.raises(ValueError, match="empty entry"):
        split_list(text)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (f"{FIT} --forces a b c", "Unrecognized options: b, c."),
        (f"{FIT} --forces=a --seed 1 --forces b", "--forces is given twice; give it once, a list with commas."),
        (f"{FIT} --force_noise 1 --force-noise 2", "--force-noise is given twice; give it once"),
        (f"{FIT} --seed 1 --seed 2", "--seed is given twice; give it once"),
        ("reproduce fig3 --points 10,x", "'10,x' is no list of whole numbers, as 1,2 is."),
        ("score x.h5 --out r --horizon 1,,2", "'1,,2' holds an empty entry"),
        (f"{FIT} --pionts 3", "forcegp fit has no option --pionts. Did you mean --points? See forcegp fit --help."),
        (f"{FIT} --seed a", "--seed is 'a'; give a whole number. See forcegp fit --help."),
        (f"{FIT} --force-noise 1,5", "--force-noise is '1,5'; give a number. See forcegp fit --help."),
        ("fit --pionts", "has no option --pionts. Did you mean --points?"),
        ("fit --data x.h5 --out run", "has no option --data."),
        ("fit x.h5 --checks --out run", "has no option --checks. Did you mean --no-checks?"),
        ("--json", "Options follow the command"),
        ("", "no command was given"),
    ],
)
def test_what_is_no_list_is_refused_with_the_list(words, message):
    assert message in refused(words)
    assert "\n" not in refused(words)


@pytest.mark.parametrize("command", ARGUMENTS)
def test_what_arguments_are_called_as_options_are_options(command):
    options = {option.replace("-", "_") for option in ARGUMENTS[command].values()}
    assert options <= set(command_class(command).__dataclass_fields__)


VALUES_OF_OTHER_KINDS = {"out": "a file or a folder, which the command names"}
"""Options whose value is of one kind for some commands and of another for others, and why."""


def test_a_name_means_the_same_for_all_commands():
    """The value of an option has the same unit and the same type wherever the option is."""
    found: dict[str, dict[str, set[str]]] = {}
    for command in COMMANDS:
        page = command_page(command, command_class(command))
        types = get_type_hints(command_class(command))
        for flag, value in re.findall(r"^  --([a-z-]+)((?: \S+)?)(?:$|  )", page, re.MULTILINE):
            name = flag.replace("-", "_")
            quantity = "|".join(re.findall(r"[A-Z@]+", value)) or ("words" if value else "switch")
            single = quantity if not re.fullmatch(r"([A-Z]\|?)+", quantity) else quantity.partition("|")[0]
            kind = "switch" if types.get(name) is bool else single
            found.setdefault(name, {}).setdefault(kind, set()).add(command)
    differing = {name: kinds for name, kinds in found.items() if len(kinds) > 1 and name not in VALUES_OF_OTHER_KINDS}
    assert differing == {}
    assert len(found) > 100


def test_an_option_has_one_type():
    """Apart from whether it is optional, and from lists, which have entries of that type."""

    def base(hint):
        if get_origin(hint) is Annotated:
            hint = get_args(hint)[0]
        parts = {part for part in get_args(hint) if part not in (type(None), ...)} or {hint}
        return {part if isinstance(part, type) else str for part in parts}

    types: dict[str, set[type]] = {}
    for command in COMMANDS:
        for name, hint in get_type_hints(command_class(command)).items():
            if name in command_class(command).__dataclass_fields__:
                types.setdefault(name, set()).update(base(hint))
    assert {name: kinds for name, kinds in types.items() if len(kinds) > 1} == {"noise": {str, float}}
