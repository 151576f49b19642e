"""Directives that read the stubs `__init__.pyi`, so that the reference lists exactly what is public.

    ```{public-names} forcegp.data
    ```

describes every name of a package; `{public-themes}` lists the names of `forcegp` itself, by the comments of its stub.
"""

import ast
import importlib
import inspect
import re
from pathlib import Path

from docstrings import as_rst, escaped, with_one_markup
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective


def stub(package: str) -> str:
    """The text of the stub of a package."""
    source = importlib.import_module(package).__file__
    assert source is not None, f"{package} has no file"
    return Path(source).with_suffix(".pyi").read_text(encoding="utf-8")


def public_names(package: str) -> dict[str, str]:
    """The names that the stub of a package exports, in its order, with the modules that define them."""
    imports = (node for node in ast.parse(stub(package)).body if isinstance(node, ast.ImportFrom))
    return {alias.asname or alias.name: f"{package}.{node.module}" for node in imports for alias in node.names}


def described(package: str, name: str, module: str) -> list[str]:
    """The directive of one name, in reStructuredText."""
    value = getattr(importlib.import_module(package), name)
    if inspect.isclass(value):
        return [f".. autoclass:: {package}.{name}", "   :members:", ""]
    if inspect.isroutine(value):
        return [f".. autofunction:: {package}.{name}", ""]
    texts = ModuleAnalyzer.for_module(module).find_attr_docs()  # a constant has its docstring in the source alone
    return [f".. py:data:: {package}.{name}", "", *("   " + line for line in as_rst(texts.get(("", name), []))), ""]


def themes() -> list[str]:
    """The names of `forcegp` as links to their packages, with their purpose; a list for each comment of the stub."""
    lines: list[str] = []
    for line in stub("forcegp").splitlines():
        name = re.fullmatch(r"from \.(\w+) import (\w+) as \w+", line)
        if name is not None:
            purpose = (inspect.getdoc(getattr(importlib.import_module("forcegp"), name[2])) or "").partition("\n")[0]
            lines += [f"* :py:obj:`{name[2]} <forcegp.{name[1]}.{name[2]}>`: {escaped(with_one_markup(purpose))}"]
        elif line.startswith("# ") and "__init__.py" not in line:
            theme = line[2:]
            lines += ["", f".. rubric:: {theme[0].upper()}{theme[1:]}", ""]
    return lines


class PublicNames(SphinxDirective):
    """What a package is for, then one entry per public name."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The nodes of all entries."""
        package = self.arguments[0]
        names = public_names(package)
        purpose = inspect.getdoc(importlib.import_module(package)) or ""
        lines = [*as_rst(purpose.splitlines()), "", f".. py:currentmodule:: {package}", ""]
        return parsed(self, lines + [line for item in names.items() for line in described(package, *item)])


class PublicThemes(SphinxDirective):
    """The whole public API by theme."""

    def run(self) -> list[nodes.Node]:
        """The nodes of all lists."""
        return parsed(self, themes())


def parsed(directive: SphinxDirective, lines: list[str]) -> list[nodes.Node]:
    """The nodes of reStructuredText in a page of Markdown."""
    text = StringList(["```{eval-rst}", *lines, "```"], source=directive.get_source_info()[0])
    return directive.parse_text_to_nodes("\n".join(text))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.add_directive("public-names", PublicNames)
    app.add_directive("public-themes", PublicThemes)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
