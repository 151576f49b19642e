"""The rules of docs/architecture.md, kept: which package imports which, and what an import may cost."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
PACKAGE = REPOSITORY / "src" / "forcegp"

# The packages in the order in which data flows, and which packages each may import: the table of docs/architecture.md.
PACKAGES = {
    "errors": set(), "summary": set(), "doubts": {"errors"}, "atomic_files": {"errors"}, "sandbox": {"errors"},
    "codegen": {"errors", "atomic_files"}, "parallel": {"errors"}, "jobs": {"errors", "atomic_files", "parallel"},
    "robots": {"errors", "summary", "atomic_files", "sandbox", "codegen"}, "mechanics": {"errors", "robots"},
    "forces": {"errors", "robots", "mechanics"}, "noise": {"errors"},
    "model": {"errors", "summary", "robots", "mechanics", "forces", "noise"},
}  # fmt: skip
MODEL = {"errors", "summary", "doubts", "robots", "mechanics", "forces", "noise", "model"}
PACKAGES |= {
    "data": MODEL | {"atomic_files"}, "recordings": MODEL | {"atomic_files", "sandbox", "data"},
    "inference": {"errors", "codegen"}, "integration": {"errors", "robots", "mechanics", "model"},
    "evidence": MODEL | {"data", "inference"},
    "posterior": MODEL | {"atomic_files", "codegen", "data", "inference", "integration", "evidence"},
    "fit": MODEL | {"parallel", "data", "inference", "integration", "evidence", "posterior"},
    "checks": MODEL | {"data", "evidence", "fit"},
    "control": MODEL | {"atomic_files", "codegen", "data", "inference", "integration", "evidence", "posterior"},
    "simulation": {"errors", "robots", "mechanics", "forces", "model", "data"},
}  # fmt: skip
PACKAGES["scores"] = set(PACKAGES) - {"simulation"}
PACKAGES["report"] = set(PACKAGES) - {"simulation"}
PACKAGES["cli"] = set(PACKAGES)
PACKAGES["__main__"] = {"cli"}
for allowed in PACKAGES.values():  # whatever takes long says how far it is
    allowed.add("progress")
PACKAGES["progress"] = set()

# Optional or slow to import: imported inside the function that uses them. Modules named here may import them
# at once, since `from forcegp import *` does not load those.
IMPORTED_WHERE_USED = {
    "casadi": (), "viser": (), "trimesh": (), "jinja2": ("forcegp.report.page",),
    "gymnasium": ("forcegp.control.environments",), "mujoco": ("forcegp.control.mujoco_forces",), "pybullet_data": (),
    "matplotlib": ("forcegp.scores.figures", "forcegp.report"), "joblib": (), "rosbags": (), "tyro": ("forcegp.cli",),
    "rich": ("forcegp.cli",),
}  # fmt: skip

LONGEST_MODULE = 450  # lines; 100 to 300 are the rule, and what is one idea stays together
NAMES_THAT_SAY_NOTHING = {"utils", "util", "helpers", "helper", "misc", "common", "tools", "stuff"}


@dataclass(frozen=True)
class Import:
    """One imported name, `forcegp.robots.inertia` or `numpy`, and when Python carries it out."""

    name: str
    line: int
    at_module_import: bool


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def package_of(module: str) -> str:
    """The package of a module; the public page `forcegp/__init__.py` stands above all packages and has none."""
    return module.split(".")[1] if "." in module else ""


def exports(stub: Path) -> dict[str, str]:
    """Name -> module that defines it, of the names that a package imports at their first use."""
    return {
        alias.name: f"{module_name(stub)}.{node.module}"
        for node in ast.walk(ast.parse(stub.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}
EXPORTS = {module_name(stub): exports(stub) for stub in sorted(PACKAGE.rglob("__init__.pyi"))}


def defined_in(name: str) -> str:
    """`forcegp.Robot` and `forcegp.robots.Robot` -> `forcegp.robots.robot.Robot`; other names as they are."""
    package, _, rest = name.partition(".")
    while rest:
        first, _, attributes = rest.partition(".")
        if first in EXPORTS.get(package, {}) and f"{package}.{first}" not in MODULES:
            return defined_in(f"{EXPORTS[package][first]}.{rest}")
        package, rest = f"{package}.{first}", attributes
    return name


def imports(path: Path) -> Iterator[Import]:
    package = module_name(path) if path.stem == "__init__" else module_name(path).rpartition(".")[0]

    def visit(node: ast.AST, at_import: bool, types_only: bool) -> Iterator[Import]:
        if isinstance(node, ast.Attribute) and ast.unparse(node).startswith("forcegp."):
            # `forcegp.data.Dataset` after `import forcegp.data`: the name is imported when this line runs
            yield Import(defined_in(ast.unparse(node)), node.lineno, False)
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            source = ".".join([*parents, *([node.module] if node.module else [])])
            names = [f"{source}.{alias.name}" for alias in node.names]
        else:
            names = []
        for name in names:
            name = defined_in(name)
            yield Import(name, node.lineno, at_import and not types_only)
        in_function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        for child in ast.iter_child_nodes(node):
            guarded = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test) and child in node.body
            yield from visit(child, at_import and not in_function, types_only or guarded)

    yield from visit(ast.parse(path.read_text(encoding="utf-8")), True, False)


imports_of = cache(lambda module: tuple(imports(MODULES[module])))


def modules_loaded_by(code: str) -> set[str]:
    """Top-level packages in `sys.modules` after `code` ran in a fresh interpreter."""
    report = "import atexit, sys; atexit.register(lambda: print('LOADED', *{x.split('.')[0] for x in sys.modules}))"
    run = subprocess.run([sys.executable, "-c", f"{report}\n{code}"], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return set(run.stdout.rpartition("LOADED")[2].split())


def test_the_table_in_the_docs_is_the_one_kept_here():
    text = (REPOSITORY / "docs/architecture.md").read_text()
    groups = dict(re.findall(r"(\*\w+\*)(?: stands)? for ([^;.]+)[;.]", text))  # a group may hold another
    for _ in groups:
        for name, stands_for in groups.items():
            text = text.replace(f"| {name}", f"| {stands_for}")
            groups = {other: given.replace(name, stands_for) for other, given in groups.items()}
    rows = re.findall(r"^\| `(\w+)(?:/|\.py)` \|.*\| ([^|]+) \|$", text, re.M)
    above: list[str] = []
    table = {}
    for name, allowed in rows:
        named = set(re.findall(r"`(\w+)`", allowed))
        if allowed.startswith(("all of the above", "everything")):
            table[name] = set(above) - named  # "all of the above but `simulation`"
        else:
            assert named or allowed == "nothing", f"docs/architecture.md, row {name}: cannot read {allowed!r}"
            table[name] = named
        above.append(name)
    assert {name: own | ({"progress"} - {name}) for name, own in table.items()} == PACKAGES


def test_every_module_belongs_to_a_room():
    strangers = sorted({package_of(module) for module in MODULES} - PACKAGES.keys() - {""})
    assert not strangers, f"packages that docs/architecture.md does not list: {strangers}"


@pytest.mark.parametrize("module", [module for module in MODULES if module != "forcegp"])
def test_imports_go_only_to_allowed_rooms(module):
    allowed = PACKAGES[package_of(module)]
    offences = [
        f"{MODULES[module].relative_to(REPOSITORY)}:{item.line} imports {item.name}"
        for item in imports_of(module)
        if item.name.split(".")[0] == "forcegp"
        and package_of(item.name) not in allowed | {package_of(module)}
        and item.name not in ("forcegp", "forcegp.__version__")
    ]
    assert not offences, "\n".join([*offences, f"{package_of(module)} may import {sorted(allowed) or 'no package'}"])


def longest_module(name: str) -> str:
    """The module that a dotted name lies in; packages do not count, for they import nothing by themselves."""
    while name and name not in MODULES:
        name = name.rpartition(".")[0]
    return name if name and MODULES[name].stem != "__init__" else ""


def test_no_module_imports_itself_through_others():
    graph: dict[str, set[str]] = {}
    for module in MODULES.keys() - {"forcegp"}:
        needed = [item.name for item in imports_of(module)]  # those under TYPE_CHECKING, too
        graph[module] = {source for name in needed if (source := longest_module(name))} - {module}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"cycle of imports: {' <- '.join(error.args[1])}")


@pytest.mark.parametrize("package", IMPORTED_WHERE_USED)
def test_slow_and_optional_packages_are_imported_where_they_are_used(package):
    offences = [
        f"{MODULES[module].relative_to(REPOSITORY)}:{item.line}"
        for module in MODULES
        for item in imports_of(module)
        if item.at_module_import
        and item.name.split(".")[0] == package
        and not module.startswith(IMPORTED_WHERE_USED[package] or "-")
    ]
    assert not offences, f"import {package} inside the function that needs it: {', '.join(offences)}"


@pytest.mark.nightly
def test_an_exported_name_that_is_a_module_too_comes_from_there():
    """`forcegp.fit` of `forcegp.fit.fit`: then lazy_loader keeps the module from taking the place of the name."""
    parts = [name.rpartition(".") for name in MODULES]
    both = [(package, name) for package, _, name in parts if name in EXPORTS.get(package, {})]
    assert len(both) > 2
    assert all(EXPORTS[package][name] == f"{package}.{name}" for package, name in both)
    code = "import os, gpytorch, h5py, scipy.optimize; from importlib import import_module as load\n"
    code += f"for package, name in {both}:\n"
    code += "    if not os.fork(): load(f'{package}.{name}'); getattr(load(package), name).__call__; os._exit(0)\n"
    code += "    assert os.wait()[1] == 0, f'{package}.{name}'"  # each in a process without any of ours
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("package", EXPORTS)
def test_every_exported_name_is_there(package):
    module = import_module(package)
    assert set(module.__all__) == EXPORTS[package].keys()
    for name, defined in EXPORTS[package].items():
        assert getattr(module, name) is getattr(import_module(defined), name)


def test_import_forcegp_loads_no_library():
    loaded = modules_loaded_by("import forcegp; forcegp.__version__")
    assert not loaded & {"torch", "gpytorch", "numpy", "scipy", "h5py", *IMPORTED_WHERE_USED}


def test_the_whole_public_api_loads_neither_simulator_nor_plots_nor_command_line():
    loaded = modules_loaded_by("from forcegp import *")
    assert "torch" in loaded
    assert not loaded & IMPORTED_WHERE_USED.keys()


@pytest.mark.parametrize("words", ["--help", "import --help", "fit --pionts 3", "fti"])
def test_help_and_usage_errors_need_neither_torch_nor_numpy(words):
    loaded = modules_loaded_by(
        "import contextlib; from forcegp.cli.main import main\n"
        f"with contextlib.suppress(SystemExit): main({words.split()})"
    )
    assert not loaded & {"torch", "gpytorch", "numpy", "scipy", "h5py", "matplotlib"}


def test_a_missing_input_is_refused_before_anything_slow_is_imported():
    loaded = modules_loaded_by("from forcegp.cli.main import main; assert main(['score', 'nope', 'test.h5']) == 2")
    assert not loaded & {"torch", "gpytorch", "numpy", "scipy", "h5py", "matplotlib"}


@pytest.mark.parametrize("module", MODULES)
def test_one_idea_per_module(module):
    lines = len(MODULES[module].read_text(encoding="utf-8").splitlines())
    assert lines <= LONGEST_MODULE, f"{module} has {lines} lines, more than {LONGEST_MODULE}: split it by idea"
    assert not NAMES_THAT_SAY_NOTHING & set(module.split(".")), f"{module}: name it by what it owns"
