"""The digest of a job's code follows what its module imports, and nothing else."""

import subprocess
import sys
from pathlib import Path

import pytest

from forcegp.jobs.job import _file, _source, code_digest, imported_files

FILES = {
    "__init__.py": "",
    "task.py": """
from toolbox.parts import area
import toolbox.numbers as numbers
def run():
    return area(numbers.TWO)
""",
    "parts/__init__.py": "from .shapes import area\nfrom .words import say\n",
    "parts/shapes.py": "def area(x):\n    from ..inner import factor\n    return factor * x\n",
    "parts/words.py": "def say():\n    return 'hello'\n",
    "numbers.py": "TWO = 2\n",
    "inner.py": """
from typing import TYPE_CHECKING
if TYPE_CHECKING:
    from toolbox.only_types import T
factor = 3
""",
    "only_types.py": "T = int\n",
    "unrelated.py": "x = 1\n",
    "compiled.py": "TEXT = 'loop.c'\n",
    "loop.c": "int one;\n",
    "lazy/__init__.py": """
import lazy_loader
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
""",
    "lazy/__init__.pyi": "from .one import One\nfrom .two import Two\n",
    "lazy/one.py": "One = 1\n",
    "lazy/two.py": "Two = 2\n",
    "uses_dotted.py": "import toolbox.lazy\ndef run():\n    return toolbox.lazy.One.real\n",
    "uses_lazy.py": "from toolbox.lazy import One\n",
    "uses_room.py": "from toolbox import lazy\n",
    "names.py": "TASK = 'forcegp.errors:f'\n",
}


@pytest.fixture
def toolbox(tmp_path, monkeypatch):
    for name, text in FILES.items():
        file = tmp_path / "toolbox" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path / "toolbox"
    for name in [name for name in sys.modules if name.partition(".")[0] == "toolbox"]:
        del sys.modules[name]


def now(*modules: str) -> str:
    """The digest that a new process would find."""
    code_digest.cache_clear()
    _source.cache_clear()
    _file.cache_clear()
    return code_digest(*modules)


def change(file: Path, text: str = "more = 1\n") -> None:
    file.write_text(file.read_text() + text)


@pytest.mark.parametrize("name", ["task", "parts/shapes", "inner", "numbers", "parts/__init__"])
def test_a_changed_line_of_what_is_imported_changes_it(toolbox, name):
    before = now("toolbox.task")
    change(toolbox / f"{name}.py")
    assert now("toolbox.task") != before


@pytest.mark.parametrize("name", ["unrelated", "parts/words", "only_types", "lazy/one"])
def test_what_is_not_imported_does_not_count(toolbox, name):
    before = now("toolbox.task")
    change(toolbox / f"{name}.py")
    assert now("toolbox.task") == before


def test_comments_docstrings_and_line_breaks_do_not_count(toolbox):
    before = now("toolbox.task")
    (toolbox / "inner.py").write_text('"""Said."""\n\n# why\n' + (toolbox / "inner.py").read_text())
    shapes = """
def area(x):
    "Said."
    from ..inner import factor

    return (  # why
        factor * x)
"""
    (toolbox / "parts/shapes.py").write_text(shapes)
    assert now("toolbox.task") == before


def test_names_of_lazy_packages_lead_to_their_modules(toolbox):
    before = {name: now(f"toolbox.{name}") for name in ("uses_lazy", "uses_dotted", "uses_room")}
    change(toolbox / "lazy/two.py")
    assert now("toolbox.uses_lazy") == before["uses_lazy"]
    assert now("toolbox.uses_dotted") == before["uses_dotted"]
    assert now("toolbox.uses_room") != before["uses_room"]
    change(toolbox / "lazy/one.py")
    assert now("toolbox.uses_lazy") != before["uses_lazy"]
    assert now("toolbox.uses_dotted") != before["uses_dotted"]


def test_modules_named_in_texts_count(toolbox):
    assert set(imported_files("toolbox.names")) == {"toolbox.names", "forcegp.errors"}


def test_more_modules_count(toolbox):
    before = now("toolbox.task", "toolbox.unrelated")
    assert before != now("toolbox.task")
    change(toolbox / "unrelated.py")
    assert now("toolbox.task", "toolbox.unrelated") != before


def test_modules_without_source_count_by_name(toolbox):
    assert now("no_such_module") != now("no_such_module_either")
    assert imported_files("math") == {"math": None}


def test_the_task_of_a_figure_rests_on_models_and_not_on_other_figures_or_commands():
    found = imported_files("forcegp.experiments.fits")
    for module in ("models.structured.gp", "inference.likelihood", "robots.kinematics", "mechanics.gauss_principle"):
        assert f"forcegp.{module}" in found, module
    assert "forcegp.simulation.kuka_surface" in imported_files("forcegp.experiments.data")
    assert not [name for name in found if name.startswith(("forcegp.cli", "forcegp.validation", "forcegp.checks"))]
    assert None not in found.values()
    assert "forcegp.experiments.fig3" not in found


def test_equal_in_every_process():
    code = "from forcegp.jobs import code_digest; print(code_digest('forcegp.experiments.fits'))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == code_digest("forcegp.experiments.fits") + "\n"


def test_c_text_beside_a_module_counts_with_it(toolbox):
    before = now("toolbox.compiled")
    (toolbox / "loop.c").write_text("int two;\n")
    assert now("toolbox.compiled") != before
