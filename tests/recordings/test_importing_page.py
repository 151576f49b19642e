"""The example of docs/how-to/importing.md runs as it stands, and its units are those there are."""

import re

import pytest
from tests.data.samples import model
from tests.examples import run_example

from forcegp.recordings.mapping import UNITS


@pytest.fixture(scope="module")
def page(repository):
    return (repository / "docs" / "how-to" / "importing.md").read_text(encoding="utf-8")


def test_the_example_runs(page, tmp_path):
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (tmp_path / "arm.urdf").write_text(model("continuous").robot.urdf_text)
    described, _, error = run_example(example, tmp_path).rstrip().rpartition("\n")
    assert described.splitlines()[:4] == ["Dataset(", "  rows: 375", "  joints: shoulder, elbow", "  episodes: 0"]
    assert float(error.split()[0]) < 1e-14


def test_every_unit_is_on_the_page(page):
    (row,) = re.findall(r"\| `--unit` \|.*\| (.*) \|\n", page)
    told = {part.split(": ")[0]: set(part.split("`")[1].split(", ")) for part in row.split("; ")}
    assert told == {quantity: set(units) for quantity, units in UNITS.items()}
