"""Which reader reads which file: `open_source`; and several files that make up one recording."""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path

from typing_extensions import override

from forcegp.data import is_dataset
from forcegp.errors import FileFormatError, InvalidInput
from forcegp.recordings.arrays import ArrayFile, HDF5Arrays, NumpyArchive, matlab_file
from forcegp.recordings.ros_bag import RosBag
from forcegp.recordings.source import Columns, Source
from forcegp.recordings.tables import DelimitedText, ParquetFile


class SideBySide(Source):
    """The columns of several tables of equally many rows, called `STEM:name` with the file name up to its first dot.

    A stem by itself stands for all columns of its file. Raises InvalidInput for two files of one stem.
    """

    def __init__(self, sources: Sequence[Source]) -> None:
        super().__init__(Path(", ".join(str(source.path) for source in sources)))
        self.sources = {source.path.name.split(".")[0]: source for source in sources}
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
    def table(self, names: Sequence[str]) -> Columns:
        own: dict[Source, dict[str, str]] = {}
        for name in names:
            source, column = self._owners[name]
            own.setdefault(source, {})[name] = column
        read = {source: source.read(list(columns.values())) for source, columns in own.items()}
        rows = {source.path.name: len(next(iter(columns.values()))) for source, columns in read.items()}
        if len(set(rows.values())) > 1:
            listed = ", ".join(f"{name} {count}" for name, count in rows.items())
            raise FileFormatError(f"files side by side must have equally many rows; these have: {listed}.")
        return {name: read[source][column] for name, (source, column) in self._owners.items() if name in names}


TEXT = (".csv", ".tsv", ".txt", ".dat")
ARRAYS: dict[str, Callable[..., ArrayFile]] = {
    ".npz": NumpyArchive,
    ".mat": matlab_file,
    ".h5": HDF5Arrays,
    ".hdf5": HDF5Arrays,
}
TABLES: dict[str, Callable[[Path], Source]] = {
    ".parquet": ParquetFile,
    ".pq": ParquetFile,
    ".bag": RosBag,
    ".mcap": RosBag,
    ".db3": RosBag,
}
"""A new format is a subclass of `Source`, and an entry here (or in `ARRAYS`) with its extension."""

READABLE = ", ".join([*(f"{name}[.gz]" for name in TEXT), *TABLES, *ARRAYS]) + ", folders of ROS 2 bags"
PICKLES = {".pkl", ".pickle", ".npy", ".pt", ".pth", ".joblib"}


def open_source(
    path: Path, *, headerless: int | None = None, delimiter: str | None = None, within: str | None = None
) -> Source:
    """The reader for a log, chosen by its extension or, for a folder, by what is in it.

    Parameters: `headerless` and `delimiter` as for `DelimitedText`, `within` as for `ArrayFile`.
    Raises FileFormatError for what cannot be read, InvalidInput for parameters that mean nothing to the format.
    """
    kind = _kind(path)
    if kind not in TEXT and (headerless or delimiter):
        raise InvalidInput(f"`headerless` and `delimiter` mean nothing to {path}; they are for text files.")
    if kind not in ARRAYS and within is not None:
        raise InvalidInput(f"`episodes` means nothing to {path}; it is for {', '.join(ARRAYS)} files.")
    if kind in TEXT:
        return DelimitedText(path, headerless=headerless, delimiter=delimiter)
    if kind in ARRAYS:
        if kind != ".npz" and is_dataset(path):
            raise FileFormatError(f"{path} is a dataset of forcegp already; there is nothing to import.")
        return ARRAYS[kind](path, within=within)
    return RosBag(path) if kind == "ros2" else TABLES[kind](path)


def _kind(path: Path) -> str:
    """The extension without .gz, or "ros2"."""
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return "ros2"
        raise FileFormatError(f"{path} is a folder, but no ROS 2 bag (metadata.yaml); give the files in it.")
    if not path.is_file():
        raise FileFormatError(f"{path} does not exist; give the path of a log.")
    suffixes = [suffix.lower() for suffix in path.suffixes]
    kind = suffixes[-1] if suffixes else ""
    if kind == ".gz" and suffixes[-2:-1] and suffixes[-2] in TEXT:
        kind = suffixes[-2]
    if kind in PICKLES:
        raise FileFormatError(f"{path} may hold Python objects, and reading those runs code; save arrays as .npz.")
    if kind not in (*TEXT, *ARRAYS, *TABLES):
        raise FileFormatError(f"{path}: the extension {kind or 'of no name'!r} is not known. Readable: {READABLE}.")
    if path.stat().st_size == 0:
        raise FileFormatError(f"{path} is empty; give a log with rows.")
    return kind
