"""docs/how-to/validation.md: its commands can be read, its example runs, and its pictures exist."""

import re
import shlex
from pathlib import Path

import pytest
from tests.examples import run_example
from tests.validation.moving_arm import moving_arm

from forcegp.cli.main import parse_arguments
from forcegp.cli.validate import Validate
from forcegp.validation.candidates import candidates, default_models, usual_identification

PAGE = Path(__file__).resolve().parent.parent.parent / "docs" / "how-to" / "validation.md"


@pytest.fixture(scope="module")
def page() -> str:
    return PAGE.read_text(encoding="utf-8")


def test_its_commands_can_be_read(page):
    commands = []
    for block in re.findall(r"```sh\n(.*?)```", page, re.DOTALL):
        for words in re.findall(r"^ *forcegp (.*)$", block.replace("\\\n", " "), re.MULTILINE):
            commands.append(parse_arguments(shlex.split(words)))
    assert any(isinstance(command, Validate) for command in commands)


def test_its_links_lead_somewhere(page):
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", page) if not link.startswith("http")]
    assert not [link for link in links if not (PAGE.parent / link).exists()]


def test_every_model_that_it_names_exists(page):
    model = moving_arm(0.1, 1).model
    (table,) = re.findall(r"\| `--models` \|.*?\n\n", page, re.DOTALL)
    cells = [row.split("|")[1] for row in table.splitlines()[2:] if row.startswith("|")]
    named = {name for cell in cells for name in re.findall(r"`([\w +:@-]+)`", cell) if not name.startswith("forcegp")}
    named = {name for name in named if not name.startswith("-")}
    assert set(candidates(sorted(named - {"motions:S"}), model, usual_identification(model))) == named
    assert {name for name in default_models(model) if "+" not in name} <= named


def test_its_example_runs(page, tmp_path):
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    moving_arm(1.5, 2).save(tmp_path / "log.h5")
    printed = run_example(example, tmp_path)
    assert "Does a Gaussian process on forces beat the best parametric model?" in printed
    assert "mine / identified" in printed
    assert "'median'" in printed.splitlines()[-1]
    assert (tmp_path / "mine" / "report.md").exists()
