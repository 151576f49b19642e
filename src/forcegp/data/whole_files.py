"""Text and JSON files that are there whole or not at all, in folders that one process works on at a time."""

from __future__ import annotations

import fcntl
import json
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from forcegp.errors import FileFormatError, InvalidInput

LOCK = ".lock"


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Readable JSON under a temporary name, then renamed."""
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Text under a temporary name, then renamed."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.tmp")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read_json(path: Path, remedy: str) -> dict[str, Any]:
    """A JSON object that was written whole. Raises FileFormatError with the remedy for anything else."""
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FileFormatError(f"{path} is half written or damaged ({error}); {remedy}.") from None
    if not isinstance(stored, dict):
        raise FileFormatError(f"{path} is damaged; {remedy}.")
    return stored


@contextmanager
def only_one_process(folder: Path, kind: str) -> Iterator[None]:
    """Only one process works on a folder of `kind`; the lock dies with its process.

    Raises InvalidInput if another one is at it.
    """
    with (folder / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InvalidInput(
                f"another `{kind}` is at work in {folder}; wait for it, or choose another --out."
            ) from None
        yield
