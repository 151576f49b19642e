"""Folders that hold a pipe where a file belongs: to open it would wait for a writer for ever."""

import os

import pytest

from forcegp import load_posterior
from forcegp.atomic_files import SUMS, require_unchanged
from forcegp.errors import FileFormatError


def test_a_pipe_as_model_or_as_digests_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "model.json")
    with pytest.raises(FileFormatError, match=r"holds no model\.json"):
        load_posterior(tmp_path)
    os.mkfifo(tmp_path / SUMS)
    with pytest.raises(FileFormatError, match=f"{SUMS} is not a regular file; fit again"):
        require_unchanged(tmp_path, "fit again")
