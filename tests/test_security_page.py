"""SECURITY.md: every promise names tests, and these are there."""

import ast
import re
from pathlib import Path


def test_every_promise_names_tests_that_exist(repository: Path):
    page = (repository / "SECURITY.md").read_text(encoding="utf-8")
    promises = re.findall(r"^\| (?!promise|---)(.*?) \| (.*) \|$", page, re.MULTILINE)
    assert len(promises) >= 10
    for promise, held_by in promises:
        named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", held_by)
        assert named, promise
        for file, test in named:
            tree = ast.parse((repository / file).read_text(encoding="utf-8"))
            assert any(isinstance(node, ast.FunctionDef) and node.name == test for node in tree.body), (file, test)
