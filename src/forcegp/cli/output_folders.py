"""What commands write to: never over what forcegp did not write, and with what is needed to do it again."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from forcegp.atomic_files import atomic_folder, write_json
from forcegp.cli.terminal import Terminal
from forcegp.errors import InvalidInput

CONFIG = "config.json"
LIBRARIES = ("forcegp", "torch", "gpytorch", "numpy", "scipy")


def require_free_file(path: Path, *, overwrite: bool) -> None:
    """Refuse a file that exists, or whose folder does not, before any work is done. Raises InvalidInput."""
    if path.is_dir():
        raise InvalidInput(f"{path} is a folder; give --out the name of a file, for example {path / 'data.h5'}.")
    if path.exists() and not overwrite:
        raise InvalidInput(f"{path} exists already; choose another name, or add --overwrite.")
    if not path.parent.is_dir():
        raise InvalidInput(f"the folder {path.parent} does not exist; create it first.")


def require_free_folder(path: Path, *, kind: str, overwrite: bool) -> None:
    """Refuse a path that exists, unless it is an empty folder, or one that forcegp wrote and --overwrite is given.

    Raises InvalidInput before any work is done.
    """
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    if not path.is_dir() or not _written_by_forcegp(path, kind):
        raise InvalidInput(
            f"{path} exists and was not written by `{kind}`, so it is not overwritten; choose another name."
        )
    if not overwrite:
        raise InvalidInput(f"{path} exists already; choose another name, or add --overwrite.")


@contextmanager
def plots_folder(terminal: Terminal, path: Path, kind: str, content: Mapping[str, Any]) -> Iterator[Path]:
    """A new folder to draw into, with its `config.json`, reported on stderr; there once all is in it."""
    with atomic_folder(path) as folder:
        folder.mkdir()
        yield folder
        write_config(folder, kind, content)
    terminal.note(f"plots: {path}")


def holds_only_own_files(path: Path, kind: str) -> bool:
    """Is this a folder that `kind` wrote and nobody added anything to?"""
    if not _written_by_forcegp(path, kind):
        return False
    listed = set(_config(path).get("files", ()))
    return {str(file.relative_to(path)) for file in path.rglob("*") if file.is_file()} <= listed


def write_config(folder: Path, kind: str, content: Mapping[str, Any]) -> None:
    """`config.json`: what is needed to do it again, with versions and the list of files, which must be there by now."""
    files = sorted([CONFIG, *(str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file())])

    versions = {"python": platform.python_version()} | {name: version(name) for name in LIBRARIES}
    write_json(folder / CONFIG, {"kind": kind, **content, "versions": versions, "files": files})


def _written_by_forcegp(path: Path, kind: str) -> bool:
    return _config(path).get("kind") == kind


def _config(path: Path) -> dict[str, Any]:
    try:
        config = json.loads((path / CONFIG).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return config if isinstance(config, dict) else {}
