"""Random inputs of every kind: refused in one sentence, or used; never anything else. `oracle.py` says what counts.

Day by day other cases, and 40 times as many at night. What was found stands in `test_found.py` by name.
"""

import pytest
from tests.fuzz import arguments, command_lines, datasets, logs, mappings, robots, stored
from tests.fuzz.oracle import search

TARGETS = {
    "stored models": stored.TARGET,
    "robot files": robots.TARGET,
    "datasets": datasets.TARGET,
    "datasets of commands": datasets.COMMANDS_TARGET,
    "mappings": mappings.TARGET,
    "logs": logs.TARGET,
    "words": command_lines.WORDS_TARGET,
    "command lines": command_lines.TARGET,
    "arguments": arguments.TARGET,
}


@pytest.mark.parametrize("name", TARGETS)
def test_random_inputs_of_today(name, tmp_path):
    search(TARGETS[name], tmp_path, TARGETS[name].fast)


@pytest.mark.nightly
@pytest.mark.parametrize("name", TARGETS)
def test_random_inputs_of_tonight(name, tmp_path):
    search(TARGETS[name], tmp_path, TARGETS[name].nightly)


def test_there_are_as_many_as_promised():
    assert sum(target.fast for target in TARGETS.values()) >= 500
    assert sum(target.nightly for target in TARGETS.values()) >= 20_000
