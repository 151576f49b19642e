"""Random inputs of every kind: refused in one sentence, or used; never anything else. `oracle.py` says what counts.

Day by day other cases, and 40 times as many at night. What was found stands in `test_found.py` by name.
"""

import numpy as np
import pytest
from tests.fuzz import arguments, command_lines, datasets, logs, robots, stored
from tests.fuzz.made import PAIR
from tests.fuzz.oracle import CANARY, require_ended_well, search
from tests.fuzz.values import Hostile, hostile_pickle

pytestmark = pytest.mark.usefixtures("unchecked")

TARGETS = {
    "stored models": stored.TARGET, "models of commands": stored.COMMANDS_TARGET,
    "stored systems": stored.SYSTEMS_TARGET, "robot files": robots.TARGET, "datasets": datasets.TARGET,
    "datasets of commands": datasets.COMMANDS_TARGET, "logs": logs.TARGET, "words": command_lines.WORDS_TARGET,
    "command lines": command_lines.TARGET, "arguments": arguments.TARGET,
}  # fmt: skip


@pytest.mark.parametrize("name", TARGETS)
def test_random_inputs_of_today(name, tmp_path):
    search(TARGETS[name], tmp_path, TARGETS[name].fast)


@pytest.mark.nightly
@pytest.mark.parametrize("name", TARGETS)
def test_random_inputs_of_tonight(name, tmp_path):
    search(TARGETS[name], tmp_path, TARGETS[name].nightly)


def test_there_are_as_many_as_promised():
    assert sum(target.fast for target in TARGETS.values()) >= 250
    assert sum(target.nightly for target in TARGETS.values()) >= 20_000


def test_what_would_run_code_does_not(tmp_path, monkeypatch):
    """And would, with the libraries as they are."""
    monkeypatch.chdir(tmp_path)
    np.savez("log.npz", q=np.array([Hostile()], object), time=np.zeros(1))
    with np.load("log.npz", allow_pickle=True) as file:
        file["q"]
    (tmp_path / CANARY).rmdir()
    folder = tmp_path / "some" / "folders" / "deep"
    folder.mkdir(parents=True)
    (folder / "log.npz").write_bytes((tmp_path / "log.npz").read_bytes())
    (folder / "log.pkl").write_bytes(hostile_pickle())
    flags = ["--time", "time", "--q", "q", "--u", "0", "--robot", "pair.urdf", "--out", "o.h5"]
    (folder / "pair.urdf").write_text(PAIR)
    for log in ("log.npz", "log.pkl"):
        assert require_ended_well(["import", log, *flags], folder) == 2
