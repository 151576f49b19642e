"""The example of docs/how-to/checking.md runs as it stands and finds what it says."""

import re

import pytest
from tests.examples import run_example


@pytest.fixture(scope="module")
def page(repository):
    return (repository / "docs" / "how-to" / "checking.md").read_text(encoding="utf-8")


def test_the_example_finds_what_was_planted(page, tmp_path):
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    printed = run_example(example, tmp_path)
    assert re.search(r"\[wrong\] torque sign: the torque of elbow has the opposite sign", printed)
    delay = re.search(r"\[wrong\] delay: the torque of all joints is logged (\S+) ms .* later", printed)
    assert delay is not None
    assert float(delay[1]) == pytest.approx(20.0, abs=1.5)
    assert printed.count("[wrong]") == 2
