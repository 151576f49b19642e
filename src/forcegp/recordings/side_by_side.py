"""Several files that make up one recording: one signal in each, row by row."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from typing_extensions import override

from forcegp.errors import FileFormatError, InvalidInput
from forcegp.recordings.source import Columns, Source


class SideBySide(Source):
    """The columns of several tables of equally many rows, called `STEM:name` with the file name up to its first dot.

    A stem by itself stands for all columns of its file. Raises InvalidInput for two files of one stem.
    """

    def __init__(self, sources: Sequence[Source]) -> None:
        super().__init__(Path(", ".join(str(source.path) for source in sources)))
        self.sources = {stem(source.path): source for source in sources}
        if len(self.sources) < len(sources):
            raise InvalidInput(f"{self.path}: two files have the same name up to the first dot; rename one.")

    @cached_property
    def _owners(self) -> Mapping[str, tuple[Source, str]]:
        return {
            f"{name}:{column}": (source, column) for name, source in self.sources.items() for column in source.columns()
        }

    @override
    def columns(self) -> tuple[str, ...]:
        return tuple(self._owners)

    @property
    @override
    def vectors(self) -> Mapping[str, tuple[str, ...]]:
        """The vectors of each file, and the stem of each for all of its columns."""
        found = {}
        for name, source in self.sources.items():
            found[name] = tuple(f"{name}:{column}" for column in source.columns())
            for vector, elements in source.vectors.items():
                found[f"{name}:{vector}"] = tuple(f"{name}:{element}" for element in elements)
        return found

    @override
    def files(self) -> tuple[Path, ...]:
        return tuple(file for source in self.sources.values() for file in source.files())

    @override
    def notes(self) -> tuple[str, ...]:
        return tuple(note for source in self.sources.values() for note in source.notes())

    @override
    def chunks(self, names: Sequence[str], rows: int) -> Iterator[Columns]:
        self.require(names)
        used = list(dict.fromkeys(self._owners[name][0] for name in names))
        own = {source: [self._owners[name][1] for name in names if self._owners[name][0] is source] for source in used}
        streams = [_exact(source.chunks(list(dict.fromkeys(own[source])), rows), rows) for source in used]
        counts = dict.fromkeys(used, 0)
        while True:
            pieces = [next(stream, None) for stream in streams]
            lengths = [len(next(iter(piece.values()))) if piece else 0 for piece in pieces]
            for source, length in zip(used, lengths, strict=True):
                counts[source] += length
            if len(set(lengths)) > 1:
                for source, stream in zip(used, streams, strict=True):
                    counts[source] += sum(len(next(iter(piece.values()))) for piece in stream)
                listed = ", ".join(f"{source.path.name} {count}" for source, count in counts.items())
                raise FileFormatError(f"files side by side must have equally many rows; these have: {listed}.")
            found = {source: piece for source, piece in zip(used, pieces, strict=True) if piece is not None}
            if not found:
                return
            yield {name: found[self._owners[name][0]][self._owners[name][1]] for name in names}


def stem(path: Path) -> str:
    """The name of a file up to its first dot."""
    return path.name.split(".")[0]


def _exact(pieces: Iterator[Columns], rows: int) -> Iterator[Columns]:
    """The same rows in pieces of exactly `rows`, but for the last."""
    waiting: list[Columns] = []
    count = 0
    for piece in pieces:
        waiting.append(piece)
        count += len(next(iter(piece.values())))
        while count >= rows:
            joined = {name: np.concatenate([part[name] for part in waiting]) for name in piece}
            yield {name: values[:rows] for name, values in joined.items()}
            waiting, count = [{name: values[rows:] for name, values in joined.items()}], count - rows
    if count:
        yield {name: np.concatenate([part[name] for part in waiting]) for name in waiting[0]}
