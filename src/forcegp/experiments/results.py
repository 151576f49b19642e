"""A folder of finished cells: whatever happens, a cell is there whole or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from forcegp import __version__
from forcegp.data.whole_files import LOCK, only_one_process, read_json
from forcegp.data.whole_files import write_json as write_json
from forcegp.data.whole_files import write_text as write_text
from forcegp.errors import FileFormatError, InvalidInput

KIND = "forcegp reproduce"
FORMAT_VERSION = 1
DESCRIPTION, CELLS = "reproduction.json", "cells"
CELL_FILE = "cell.json"


@dataclass(frozen=True)
class Results:
    """Cells by name in `folder/cells/<name>/cell.json`, each beside the files that it made."""

    folder: Path

    @classmethod
    def open(cls, folder: Path, preset: str) -> Results:
        """The folder, made if it does not exist, for the preset of this name.

        Raises InvalidInput for a folder of something else, or of another preset, and FileFormatError for one that
        another version of forcegp wrote.
        """
        results = cls(folder)
        description = folder / DESCRIPTION
        if description.exists():
            results._require_same(description, preset)
        elif folder.exists() and (not folder.is_dir() or not all(map(_is_own_start, folder.iterdir()))):
            raise InvalidInput(f"{folder} exists and was not written by `{KIND}`; choose another --out.")
        else:
            folder.mkdir(parents=True, exist_ok=True)
            content = {"kind": KIND, "format_version": FORMAT_VERSION, "forcegp_version": __version__}
            write_json(description, {**content, "preset": preset})
        return results

    def _require_same(self, description: Path, preset: str) -> None:
        stored = read_json(description, f"choose another --out, or delete {self.folder}")
        if stored.get("kind") != KIND:
            raise InvalidInput(f"{self.folder} was not written by `{KIND}`; choose another --out.")
        written_by = stored.get("forcegp_version"), stored.get("format_version")
        if written_by != (__version__, FORMAT_VERSION):
            raise FileFormatError(
                f"{self.folder} holds results of forcegp {written_by[0]} (format {written_by[1]}); this is "
                f"{__version__} (format {FORMAT_VERSION}). Choose another --out: the old results stay as they are."
            )
        if stored.get("preset") != preset:
            raise InvalidInput(
                f"{self.folder} holds results of preset {stored.get('preset')!r}, not {preset!r}; choose another --out."
            )

    def locked(self) -> AbstractContextManager[None]:
        """Only one process works on a folder. Raises InvalidInput if another one is at it."""
        return only_one_process(self.folder, KIND)

    def cell_folder(self, name: str) -> Path:
        """Where the cell of this name lies, or will lie."""
        return self.folder / CELLS / name

    def has(self, name: str, digest: str) -> bool:
        """Is this cell finished? Raises as `load`."""
        if not self.cell_folder(name).exists():
            return False
        self.load(name, digest)
        return True

    def load(self, name: str, digest: str | None = None) -> dict[str, Any]:
        """What the cell stored. Raises FileFormatError if it is damaged, or of another digest than the one given."""
        file = self.cell_folder(name) / CELL_FILE
        remedy = f"delete the folder {file.parent} and run the same command again: only this cell is computed anew"
        stored = read_json(file, remedy)
        if not {"digest", "spec", "result"} <= set(stored):
            raise FileFormatError(f"{file} is half written; {remedy}.")
        if digest is not None and stored["digest"] != digest:
            raise FileFormatError(
                f"{file} was computed with other settings, or from cells with other settings; choose another --out, or "
                f"delete {file.parent} to compute it anew."
            )
        return stored

    def result(self, name: str) -> dict[str, Any]:
        """The `result` of a finished cell."""
        return self.load(name)["result"]

    @contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """A temporary folder that becomes the cell at the end, and vanishes on failure."""
        place = self.cell_folder(name)
        place.parent.mkdir(parents=True, exist_ok=True)
        temporary = place.with_name(f".{place.name}.{secrets.token_hex(6)}.tmp")
        temporary.mkdir()
        try:
            yield temporary
            if (place / CELL_FILE).exists():  # by a process of a killed run that ended later than it should
                shutil.rmtree(temporary)
            else:
                os.replace(temporary, place)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise

    def remove_leftovers(self) -> None:
        """Delete the temporary folders of runs that were killed; call it under the lock."""
        for entry in list((self.folder / CELLS).glob("**/.*.tmp")):
            shutil.rmtree(entry, ignore_errors=True)
        for entry in list(self.folder.glob(".*.tmp")):
            entry.unlink(missing_ok=True)


def _is_own_start(entry: Path) -> bool:
    """What a run leaves that is killed before it has written its description."""
    return entry.name == LOCK or (entry.name.startswith(f".{DESCRIPTION}.") and entry.name.endswith(".tmp"))
