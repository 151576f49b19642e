"""The public page and the papers of the package say the same thing everywhere."""

import re
from importlib import import_module, metadata

import pytest

import forcegp


def test_one_version_everywhere(repository):
    version = metadata.version("forcegp")
    citation = re.search(r"^version: [\"']?([^\"'\s]+)", (repository / "CITATION.cff").read_text(), re.M)
    released = re.findall(r"^## \[(\d[^\]]*)\]", (repository / "CHANGELOG.md").read_text(), re.M)
    declared = re.search(r'^version = "(.+)"$', (repository / "pyproject.toml").read_text(), re.M)
    assert declared is not None
    assert citation is not None
    assert version == declared[1], "the installation is stale: install again with `make check`"
    assert version == citation[1] == released[0] == forcegp.__version__


@pytest.mark.parametrize("name", forcegp.__all__)
def test_public_names_are_public_in_their_rooms_and_documented(name, repository):
    value = getattr(forcegp, name)
    page = (repository / "src/forcegp/__init__.pyi").read_text()
    room = re.search(rf"^from \.(\w+) import {name} as {name}$", page, re.M)
    assert room is not None
    assert value is getattr(import_module(f"forcegp.{room[1]}"), name)
    assert value.__doc__, f"{name} has no docstring"
    assert name in dir(forcegp)


def test_unknown_public_name_lists_the_known_ones():
    with pytest.raises(AttributeError, match=r"no attribute 'Robbot'.*Robot"):
        forcegp.Robbot  # noqa: B018


def test_every_error_says_what_it_means():
    from forcegp import errors

    classes = [value for value in vars(errors).values() if isinstance(value, type) and issubclass(value, Exception)]
    for error in classes:
        assert error.__doc__, f"{error.__name__} has no docstring"
        assert issubclass(error, errors.ForceGPError | Warning), f"{error.__name__} is outside the tree of errors"


def test_the_installed_package_carries_its_types_and_its_command():
    files = import_module("importlib.resources").files("forcegp")
    assert (files / "py.typed").is_file()
    assert (files / "data/__init__.pyi").is_file()  # read at run time, too
    commands = metadata.entry_points(group="console_scripts", name="forcegp")
    assert [command.value for command in commands] == ["forcegp.cli.main:main"]
