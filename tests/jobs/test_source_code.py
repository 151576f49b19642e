"""The digest of a job's code follows all of forcegp, and the package of a module that stands outside."""

import subprocess
import sys

import pytest

from forcegp.jobs import code_digest


@pytest.fixture
def toolbox(tmp_path, monkeypatch):
    (tmp_path / "toolbox" / "parts").mkdir(parents=True)
    for name in ("toolbox/__init__.py", "toolbox/task.py", "toolbox/parts/shapes.py", "toolbox/loop.c", "alone.py"):
        (tmp_path / name).write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name in [name for name in sys.modules if name.partition(".")[0] in ("toolbox", "alone")]:
        del sys.modules[name]


def now(*modules: str) -> str:
    """The digest that a new process would find."""
    code_digest.cache_clear()
    return code_digest(*modules)


@pytest.mark.parametrize("name", ["task.py", "parts/shapes.py", "loop.c"])
def test_a_changed_line_of_the_package_changes_it(toolbox, name):
    before, other = now("toolbox.task"), now("alone")
    (toolbox / "toolbox" / name).write_text("more\n")
    assert now("toolbox.task") != before
    assert now("alone") == other


def test_a_module_without_package_counts_by_itself(toolbox):
    before = now("forcegp.jobs", "alone")
    assert before != now("forcegp.jobs")
    (toolbox / "neighbour.py").write_text("x = 1\n")
    assert now("forcegp.jobs", "alone") == before
    (toolbox / "alone.py").write_text("x = 1\n")
    assert now("forcegp.jobs", "alone") != before


def test_equal_in_every_process():
    code = "from forcegp.jobs import code_digest; print(code_digest('forcegp.jobs'))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == code_digest("forcegp.jobs") + "\n"
