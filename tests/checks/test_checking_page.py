"""The example of docs/how-to/checking.md runs as it stands and finds what it says."""

import re

import pytest
from tests.examples import blocks, run_example


def test_the_example_finds_what_was_planted(tmp_path):
    (example,) = blocks("checking")
    printed = run_example(example, tmp_path)
    assert re.search(r"\[wrong\] torque sign: the torque of elbow has the opposite sign", printed)
    delay = re.search(r"\[wrong\] delay: the torque of all joints is logged (\S+) ms .* later", printed)
    assert delay is not None
    assert float(delay[1]) == pytest.approx(20.0, abs=1.5)
    assert printed.count("[wrong]") == 2
