"""Files and folders that appear whole or not at all: written under a temporary name, then renamed.

The temporary name lies in the same folder, because only a rename within one file system is atomic. Whatever is written
gets the permissions that the umask allows, and whatever fails, Ctrl-C included, leaves the old file or folder as it was
and nothing beside it. A process that is killed leaves a hidden `.NAME.*.tmp`, which `remove_leftovers` deletes.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from forcegp.errors import FileFormatError, InvalidInput

TEMPORARY = ".tmp"


@contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """A temporary path at which to write a file, which replaces `path` when the context ends without error.

    Raises InvalidInput if the folder of `path` does not exist or `path` is a folder.
    """
    target = _target(path)
    if not target.parent.is_dir():
        raise InvalidInput(f"cannot write {path}: the folder {target.parent} does not exist; create it first.")
    if target.is_dir():
        raise InvalidInput(f"cannot write {path}: it is a folder; give a file name.")
    temporary = _beside(target, TEMPORARY)
    try:
        yield temporary
        _flush(temporary)
        os.replace(temporary, target)
    finally:  # also after KeyboardInterrupt; after the rename there is nothing of this name
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | Path, *, overwrite: bool = True) -> Iterator[Path]:
    """A temporary path at which to make a folder, which becomes `path` when the context ends without error.

    A folder that is there stays in place until the new one is complete. Without `overwrite` it stays for good and an
    OSError is raised, unless it is empty. Raises InvalidInput if `path` is a file.
    """
    target = _target(path)
    if target.exists() and not target.is_dir():
        raise InvalidInput(f"cannot write the folder {path}: it is a file; choose another name.")
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = _beside(target, TEMPORARY)
    try:
        yield temporary
        for entry in (*temporary.rglob("*"), temporary):
            _flush(entry)
        if target.exists() and (overwrite or not any(target.iterdir())):
            _exchange(temporary, target)
        else:
            temporary.rename(target)  # fails where another process has made the folder meanwhile
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text with the line ends that it has. Raises as `atomic_file`."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file. Raises as `atomic_file`."""
    with atomic_file(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: str | Path, content: Mapping[str, Any]) -> None:
    """Write readable JSON. Raises as `atomic_file`, and ValueError for NaN and infinity, which JSON does not have."""
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def read_json(path: Path, remedy: str) -> dict[str, Any]:
    """Return the JSON object in a file. Raises FileFormatError, which ends in the remedy, for anything else."""
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FileFormatError(f"{path} is half written or damaged ({error}); {remedy}.") from None
    if not isinstance(stored, dict):
        raise FileFormatError(f"{path} is damaged; {remedy}.")
    return stored


def remove_leftovers(folder: Path) -> None:
    """Delete what killed processes left half written in a folder and those inside it, where no other one writes now."""
    for entry in list(folder.rglob(f".*{TEMPORARY}")):
        if entry.is_dir():
            shutil.rmtree(entry, ignore_errors=True)
        else:
            entry.unlink(missing_ok=True)


def _target(path: str | Path) -> Path:
    """Where a rename has to end: a rename onto a symbolic link would replace the link, not what it points to."""
    return Path(os.path.realpath(path))


def _beside(target: Path, ending: str) -> Path:
    # 40 characters of the name, so that the longest names that file systems allow do not become too long
    return target.with_name(f".{target.name[:40]}.{secrets.token_hex(6)}{ending}")


def _flush(path: Path) -> None:
    """Wait until the contents are on the disk.

    File systems may put a rename on the disk before the contents, so that a power cut would leave an empty file under
    the final name and the old contents nowhere.
    """
    folder = path.is_dir()
    if folder and os.name == "nt":  # Windows opens no folders, and orders these writes itself
        return
    descriptor = os.open(path, os.O_RDONLY if folder else os.O_RDWR)  # Windows flushes only what may be written to
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _exchange(new: Path, target: Path) -> None:
    """Rename the new folder to `target`; the old one is renamed aside, and put back if that fails."""
    aside = _beside(target, ".old")
    try:
        target.rename(aside)
        new.rename(target)
    except BaseException:
        if not target.exists():
            aside.rename(target)
        raise
    finally:
        if target.exists():  # else `aside` is the only copy
            with contextlib.suppress(OSError):
                shutil.rmtree(aside)
