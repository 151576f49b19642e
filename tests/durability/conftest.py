"""What the commands read, made once."""

from pathlib import Path

import pytest
from tests.cli.in_process import run_here
from tests.durability.commands import make_inputs


@pytest.fixture(scope="session")
def inputs(tmp_path_factory) -> Path:
    """A folder with the files that `commands.COMMANDS` name; nothing in it is changed."""
    folder = tmp_path_factory.mktemp("inputs")
    make_inputs(folder, run_here)
    return folder
