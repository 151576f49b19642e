"""A folder of results that grows: one JSON file per piece of work, whole or not there, so a killed run goes on."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from forcegp.data.whole_files import LOCK, only_one_process, read_json, write_json
from forcegp.errors import FileFormatError, InvalidInput

KIND = "forcegp validate"
CELLS, CONFIGURATION = "cells", "configuration.json"


@dataclass(frozen=True)
class KeptCells:
    """`folder/cells/NAME.json`, under the one configuration in `folder/configuration.json`."""

    folder: Path

    @classmethod
    def open(cls, folder: Path, configuration: Mapping[str, Any], *, overwrite: bool = False) -> KeptCells:
        """The folder, made if it does not exist, for cells under this configuration; emptied of others to `overwrite`.

        Raises InvalidInput for a folder of something else or of another configuration, naming what differs.
        """
        kept, file = cls(folder), folder / CONFIGURATION
        own = file.exists()
        if own:
            stored = read_json(file, f"choose another --out, or delete {folder}")
            kept._require_own(stored)
            if not overwrite:
                kept._require_same(stored["configuration"], configuration)
                return kept
            with kept.locked():
                shutil.rmtree(folder / CELLS, ignore_errors=True)
        elif folder.exists() and (not folder.is_dir() or not all(map(_is_own_start, folder.iterdir()))):
            raise InvalidInput(f"{folder} exists and was not written by `{KIND}`; choose another --out.")
        (folder / CELLS).mkdir(parents=True, exist_ok=True)
        write_json(file, {"kind": KIND, "configuration": dict(configuration)})
        return kept

    def _require_own(self, stored: Mapping[str, Any]) -> None:
        if stored.get("kind") != KIND or not isinstance(stored.get("configuration"), dict):
            raise InvalidInput(f"{self.folder} was not written by `{KIND}`; choose another --out.")

    def _require_same(self, before: Mapping[str, Any], configuration: Mapping[str, Any]) -> None:
        wanted = json.loads(json.dumps(configuration))
        differing = sorted(name for name in {*before, *wanted} if before.get(name) != wanted.get(name))
        if differing:
            raise InvalidInput(
                f"{self.folder} holds results with another {', '.join(differing)}; choose another --out, or add "
                "--overwrite to compute everything anew."
            )

    def locked(self) -> AbstractContextManager[None]:
        """Only one process works on the folder. Raises InvalidInput if another one is at it."""
        return only_one_process(self.folder, KIND)

    def remove_leftovers(self) -> None:
        """Delete what killed runs left half written; call it under the lock."""
        for entry in [*self.folder.glob(".*.tmp"), *(self.folder / CELLS).glob(".*.tmp")]:
            entry.unlink(missing_ok=True)

    def file(self, name: str) -> Path:
        """Where the cell of this name lies, or will lie."""
        return self.folder / CELLS / f"{name}.json"

    def read(self, name: str) -> dict[str, Any] | None:
        """What was kept; None if there is nothing. Raises FileFormatError for a damaged file."""
        file = self.file(name)
        if not file.exists():
            return None
        stored = read_json(file, "delete it and run the same command again: only this one is computed anew")
        if not {"name", "seed", "split", "result", "error"} <= set(stored):
            raise FileFormatError(f"{file} is damaged; delete it and run the same command again.")
        return stored

    def has(self, name: str) -> bool:
        """Whether there is a result, or the reason of a failure, which another run would only repeat."""
        return self.read(name) is not None

    def write(self, name: str, content: Mapping[str, Any]) -> None:
        """Keep a cell, whole."""
        write_json(self.file(name), content)


def _is_own_start(entry: Path) -> bool:
    """What a run leaves that is killed before it has written its configuration."""
    return entry.name in (LOCK, CELLS) or (entry.name.startswith(f".{CONFIGURATION}.") and entry.name.endswith(".tmp"))
