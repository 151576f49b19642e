"""The comparison on real logs, in small; it needs the logs, which are not part of this repository."""

import re
import shlex
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.without_accelerations import Source, Targets, coarse, fitted, multiarm

from forcegp.cli.main import parse_arguments
from forcegp.errors import NumericalWarning
from forcegp.evidence import Windows


@pytest.fixture(scope="module")
def real_logs(repository: Path) -> Path:
    folder = repository.parent / "shared" / "realdata"
    if not (folder / "multiarm_pendulum").is_dir():
        pytest.skip(f"{folder} does not hold the logs of real robots")
    return folder


@pytest.mark.nightly
def test_raw_positions_of_a_real_pendulum_teach_its_dynamics(real_logs):
    rig = multiarm(real_logs)
    few = replace(rig, test=rig.test.select_episodes(rig.test.episodes[:3]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)
        scores = Targets.of(few).scores(fitted(few, Source(Windows(0.08)), 80, seed=0))
    assert max(scores[:2]) < 0.05  # of the standard deviation of the acceleration
    assert scores[2] < 0.01  # rad after 0.1 s


def test_a_coarser_encoder_changes_the_training_positions_alone(real_logs):
    rig = multiarm(real_logs)
    rounded = coarse(rig, 4096)
    turn = 2.0 * np.pi / 4096
    assert np.abs(rounded.train.q - rig.train.q).max() == pytest.approx(0.5 * turn, rel=0.01)
    np.testing.assert_allclose(rounded.train.q / turn, np.round(rounded.train.q / turn), atol=1e-6)
    assert rounded.test is rig.test


def test_a_folder_that_is_not_there_is_one_line(repository, tmp_path):
    words = [sys.executable, "-m", "benchmarks.without_accelerations", str(tmp_path / "absent")]
    done = subprocess.run(words, cwd=repository, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.strip().endswith("does not exist; give the folder with the logs of real robots")


def test_the_commands_of_the_page_parse(repository):
    page = (repository / "docs" / "how-to" / "without-accelerations.md").read_text(encoding="utf-8")
    commands = re.findall(r"^forcegp (.*)$", page, re.MULTILINE)
    assert commands
    for command in commands:
        parse_arguments(shlex.split(command))
