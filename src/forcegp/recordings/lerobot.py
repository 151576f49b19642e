"""LeRobot datasets, versions 2.1 and 3.0: a folder with meta/info.json and Parquet files."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from typing_extensions import override

from forcegp.errors import FileFormatError
from forcegp.recordings.parquet import ParquetFile
from forcegp.recordings.source import Columns, Source, reading

INFO = Path("meta") / "info.json"
VERSIONS = ("v2.0", "v2.1", "v3.0")
LARGEST_INFO = 16 * 2**20  # bytes


class LeRobotFolder(Source):
    """A LeRobot dataset as one table: all rows of its data files in the order of their numbers.

    Columns are those of the Parquet files; where `info.json` names the elements of a list, they are
    `observation.state.<name>`. `timestamp` is the time and `episode_index` the episode. Videos are not looked at.
    Raises FileFormatError if the files do not hold what `info.json` states.
    """

    suggested_time = "timestamp"
    suggested_episode = "episode_index"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        info = self._info()
        version = info.get("codebase_version")
        if version not in VERSIONS:
            raise FileFormatError(
                f"{path} is a LeRobot dataset of version {version!r}; read are {', '.join(VERSIONS)}."
            )
        features = info.get("features")
        if not isinstance(features, dict):
            raise FileFormatError(f"{path / INFO} lists no features; it is damaged.")
        names = {name: given for name, feature in features.items() if (given := _element_names(feature))}
        self._parts = [ParquetFile(file, names=names) for file in self.data_files]
        self._check(info, features)

    def _info(self) -> Mapping[str, Any]:
        with reading(self.path / INFO, "JSON"):
            if (self.path / INFO).stat().st_size > LARGEST_INFO:
                raise FileFormatError(f"{self.path / INFO} is larger than 16 MiB; that is no description of a dataset.")
            info = json.loads((self.path / INFO).read_text(encoding="utf-8"))
        if not isinstance(info, dict):
            raise FileFormatError(f"{self.path / INFO} must be a JSON object.")
        return info

    @cached_property
    def data_files(self) -> tuple[Path, ...]:
        """data/chunk-000/file-000.parquet (3.0) or data/chunk-000/episode_000000.parquet (2.1), in order."""
        found = tuple(sorted((self.path / "data").glob("chunk-*/*.parquet")))
        if not found:
            raise FileFormatError(f"{self.path} has no data/chunk-*/*.parquet; the dataset was not copied whole.")
        outside = [file for file in found if not file.resolve().is_relative_to(self.path.resolve())]
        if outside and not self.path.is_symlink():
            raise FileFormatError(f"{outside[0]} is a link to a file outside of the dataset; copy the file there.")
        return found

    def _check(self, info: Mapping[str, Any], features: Mapping[str, Any]) -> None:
        rows, stated = sum(part.rows for part in self._parts), info.get("total_frames")
        if rows != stated:
            raise FileFormatError(
                f"{self.path}: meta/info.json has {stated} frames, the data files hold {rows}; copy the dataset again."
            )
        first = self._parts[0].columns()
        for part in self._parts[1:]:
            if part.columns() != first:
                raise FileFormatError(f"{part.path} has other columns than {self._parts[0].path}.")
        for name, feature in features.items():
            shape = feature.get("shape") if isinstance(feature, dict) else None
            width = len(self._parts[0].vectors.get(name, ()))
            if width and shape and list(shape) != [width]:
                raise FileFormatError(
                    f"{self.path}: meta/info.json states that {name!r} has the shape {list(shape)}; "
                    f"the data files have {width} elements."
                )

    @override
    def columns(self) -> tuple[str, ...]:
        return self._parts[0].columns()

    @property
    @override
    def vectors(self) -> Mapping[str, tuple[str, ...]]:
        return self._parts[0].vectors

    @override
    def files(self) -> tuple[Path, ...]:
        return (self.path / INFO, *self.data_files)

    @override
    def chunks(self, names: Sequence[str], rows: int) -> Iterator[Columns]:
        self.require(names)
        for part in self._parts:
            yield from part.chunks(names, rows)


def _element_names(feature: Any) -> list[str]:
    """What info.json calls the elements: a list of names, or a mapping to one (`{"motors": [...]}`)."""
    names = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))
    if not isinstance(names, list) or not all(isinstance(name, str) and name for name in names):
        return []
    return names if len(set(names)) == len(names) else []
