"""The inputs that are changed, made once."""

from pathlib import Path

import pytest
from tests.fuzz.made import INPUTS, make


@pytest.fixture(scope="session", autouse=True)
def inputs(tmp_path_factory) -> Path:
    """A folder of whole files; nothing in it is changed."""
    pytest.importorskip("rosbags")
    make(tmp_path_factory.mktemp("whole"))
    return INPUTS.folder
