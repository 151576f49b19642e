"""What commands write to: never over what forcegp did not write, and with what is needed to do it again."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from forcegp.atomic_files import atomic_folder, require_writable, write_json
from forcegp.cli.terminal import Terminal
from forcegp.errors import InvalidInput
from forcegp.file_digests import SUMS, added_files, write_digests

CONFIG = "config.json"
LIBRARIES = ("forcegp", "torch", "gpytorch", "numpy", "scipy")


def require_free_file(
    path: Path, *, overwrite: bool, own: Callable[[Path], bool], what: str = "a dataset of forcegp"
) -> None:
    """Refuse what exists, unless it is `own` or empty and --overwrite is given, and what cannot be written.

    Raises InvalidInput or OSError before any work is done.
    """
    if path.is_dir():
        raise InvalidInput(f"{path} is a folder; give --out the name of a file, for example {path / 'data.h5'}.")
    if path.exists() and not path.is_file():
        raise InvalidInput(f"{path} is not a regular file; choose another name.")
    if path.exists() and not overwrite:
        raise InvalidInput(f"{path} exists already; choose another name, or add --overwrite.")
    if not path.parent.is_dir():
        raise InvalidInput(f"the folder {path.parent} does not exist; create it first.")
    if path.exists() and path.stat().st_size and not own(path):
        raise InvalidInput(f"{path} is not {what}, so it is not overwritten; choose another name.")
    require_writable(path)


def require_free_folder(path: Path, *, kind: str, overwrite: bool) -> None:
    """Refuse what exists, unless it is an empty folder, or one that only forcegp wrote to and --overwrite is given.

    Raises InvalidInput, or OSError where nothing can be written, before any work is done.
    """
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        if not path.is_dir() or _config(path).get("kind") != kind:
            raise InvalidInput(
                f"{path} exists and was not written by `{kind}`, so it is not overwritten; choose another name."
            )
        if not overwrite:
            raise InvalidInput(f"{path} exists already; choose another name, or add --overwrite.")
        others = added_files(path)
        if others:
            raise InvalidInput(
                f"{path} holds files that `{kind}` did not write ({', '.join(others[:3])}), so it is not overwritten; "
                "move them away, or choose another name."
            )
    require_writable(path)


@contextmanager
def output_folder(path: Path, kind: str, content: Mapping[str, Any], *, overwrite: bool) -> Iterator[Path]:
    """A new folder to write into, which gets a `config.json` of this content; there once all is in it.

    Raises as `require_free_folder`, also for what appeared meanwhile.
    """
    with atomic_folder(path) as folder:
        folder.mkdir()
        yield folder
        write_config(folder, kind, content)
        require_free_folder(path, kind=kind, overwrite=overwrite)


@contextmanager
def plots_folder(
    terminal: Terminal, path: Path, kind: str, content: Mapping[str, Any], *, overwrite: bool
) -> Iterator[Path]:
    """As `output_folder`, reported on stderr."""
    with output_folder(path, kind, content, overwrite=overwrite) as folder:
        yield folder
    terminal.note(f"plots: {path}")


def write_config(folder: Path, kind: str, content: Mapping[str, Any]) -> None:
    """`config.json`: what is needed to do it again, with versions and the list of files, and the digests of all."""
    present = (file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file())
    versions = {"python": platform.python_version()} | {name: version(name) for name in LIBRARIES}
    files = sorted({CONFIG, SUMS, *present})
    write_json(folder / CONFIG, {"kind": kind, **content, "versions": versions, "files": files})
    write_digests(folder)


def _config(path: Path) -> dict[str, Any]:
    try:
        config = json.loads((path / CONFIG).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return config if isinstance(config, dict) else {}
