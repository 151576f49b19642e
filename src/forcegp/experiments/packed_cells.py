"""Cells that travel: computed on a machine that does not see the folder of results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from forcegp.experiments.results import Results


@dataclass(frozen=True)
class PackedCell:
    """A finished cell: its name, and its files by their place in the cell's folder."""

    name: str
    files: Mapping[str, bytes]

    @classmethod
    def of(cls, results: Results, name: str) -> PackedCell:
        """The cell of that name, read whole."""
        folder = results.cell_folder(name)
        files = sorted(file for file in folder.rglob("*") if file.is_file())
        return cls(name, {file.relative_to(folder).as_posix(): file.read_bytes() for file in files})

    def write(self, results: Results) -> None:
        """Make it a cell there, whole or not at all."""
        with results.writing(self.name) as folder:
            for place, content in self.files.items():
                file = folder / place
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(content)
