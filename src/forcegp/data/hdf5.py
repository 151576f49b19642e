"""The dataset file: HDF5 (docs/how-to/data-format.md): numbers, texts and JSON, of which nothing is executed."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

import forcegp.mechanics
from forcegp import __version__
from forcegp.atomic_files import atomic_file
from forcegp.errors import FileFormatError, ForceGPError

FORMAT = "forcegp-dataset"
VERSION = 1
COLUMNS = ("q", "v", "u", "a", "time", "episode")

COMPRESSION = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
_LARGEST_COMPRESSION = 1100  # deflate reaches at most 1032:1; anything that claims more holds no such data


def write_fields(path: Path, fields: Mapping[str, Any], units: Mapping[str, Any]) -> None:
    """Write the fields of a Dataset, as `atomic_file` writes and raises."""
    arrays = {name: fields[name] for name in (*COLUMNS, "noise_std") if fields[name] is not None}
    arrays |= {f"truth/{name}": values for name, values in fields["truth"].items()}
    if names := list(fields["measured"]):  # of frames, which may hold a slash
        # a torque is the first of three columns
        arrays["measured"] = np.stack([np.pad(x, ((0, 0), (0, 3 - x.shape[1]))) for x in fields["measured"].values()])
    if fields["strokes"] is not None and fields["transmission"] is None:
        arrays["strokes"] = fields["strokes"]
    # in memory until it is whole: HDF5 2.0.0 that cannot write cannot close its file either, and crashes at the end
    memory = {"driver": "core", "backing_store": False, "block_size": 2**24}
    with atomic_file(path) as temporary, h5py.File("new", "w", **memory) as file:
        for name, values in arrays.items():
            file.create_dataset(name, data=values, **(COMPRESSION if values.size else {}))
        file.attrs["format"] = fixed_text(FORMAT)
        file.attrs["format_version"] = VERSION
        file.attrs["written_by"] = fixed_text(f"forcegp {__version__}")
        file.attrs["time_ordered"] = fields["time_ordered"]
        for name, unit in units.items():
            file[name].attrs["units"] = fixed_text(unit)
        if names:
            file["measured_names"] = fixed_text(names)
        file["joint_names"] = fixed_text(fields["model"].robot.joint_names)
        file["metadata"] = fixed_text(json.dumps(fields["metadata"]))
        file["model"] = fixed_text(fields["model"].to_json())
        file.flush()
        temporary.write_bytes(file.id.get_file_image())


def fixed_text(text: Any) -> np.ndarray:
    """Texts of a fixed length: HDF5 keeps others in a heap, and reads a damaged one for ever, beyond any interrupt."""
    raw = np.strings.encode(np.asarray(text, dtype=str), "utf-8")
    return raw.astype(h5py.string_dtype("utf-8", max(raw.dtype.itemsize, 1)))


def _attribute(file: h5py.File, name: str) -> Any:  # number or text; None for texts that no file of ours holds
    if name not in file.attrs or file.attrs.get_id(name).dtype.hasobject:
        return None
    value = file.attrs[name]
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


def is_dataset(path: Path) -> bool:
    """Whether a file is a dataset of this or another version."""
    if not path.is_file():  # a pipe would be waited for
        return False
    try:
        with h5py.File(path, "r") as file:
            return isinstance(kind := _attribute(file, "format"), str) and kind == FORMAT
    except (OSError, RuntimeError, KeyError, ValueError, TypeError):  # whatever h5py meets in a damaged file
        return False


def read_fields(path: Path) -> dict[str, Any]:
    """The fields of the Dataset in a file. Raises FileFormatError."""
    if not path.is_file():
        raise FileFormatError(f"{path} is not a file; give the path of a dataset written by forcegp (.h5).")
    try:
        with h5py.File(path, "r") as file:
            return _Reader(path, file).fields()
    except FileFormatError:
        raise
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:  # whatever h5py meets in a damaged file
        kind = "is damaged" if h5py.is_hdf5(path) else "is not an HDF5 file"
        raise FileFormatError(f"{path} {kind}: {error}. Write it again, or `forcegp import` the log.") from error


@dataclass
class _Reader:
    path: Path
    file: h5py.File

    def require(self, fits: bool | np.bool_, problem: str) -> None:
        if not fits:
            raise FileFormatError(f"{self.path}{problem}")

    def fields(self) -> dict[str, Any]:
        file, required = self.file, (*COLUMNS, "metadata", "model")
        kind, version = _attribute(file, "format"), _attribute(file, "format_version")
        ours = f"is an HDF5 file, but not a forcegp dataset (its 'format' is {kind!r}, not {FORMAT!r})."
        self.require(isinstance(kind, str) and kind == FORMAT, f" {ours}")
        seen = f" has format version {version!r}; this forcegp ({__version__}) reads {VERSION}"
        advice = f"Use what wrote it ({_attribute(file, 'written_by')!r}), or convert the log again."
        self.require(isinstance(version, int | np.integer) and version == VERSION, f"{seen}. {advice}")
        missing = [name for name in required if name not in file]
        self.require(not missing, f" has no {', '.join(missing)}; a dataset needs {', '.join(required)}.")
        values: dict[str, Any] = {name: self.array(name) for name in COLUMNS}
        values["metadata"] = json.loads(self.text("metadata"))
        self.require(isinstance(values["metadata"], dict), ": 'metadata' must be a JSON object.")
        values |= {name: self.array(name) if name in file else None for name in ("noise_std", "strokes")}
        truth = file["truth"] if isinstance(file.get("truth", getlink=True), h5py.HardLink) else None
        self.require("truth" not in file or isinstance(truth, h5py.Group), ": 'truth' must be a group in this file.")
        names = list(truth) if isinstance(truth, h5py.Group) else []
        values["truth"] = {name: self.array(f"truth/{name}") for name in names}
        measured = self.texts("measured_names") if "measured_names" in file else []
        arrays = self.array("measured") if measured else ()
        self.require(len(arrays) == len(measured), ": 'measured' needs one table for each of 'measured_names'.")
        pairs = zip(measured, arrays, strict=True)
        values["measured"] = {name: x[:, :1] if name.startswith("torque.") else x for name, x in pairs}
        values["time_ordered"] = "time_ordered" not in file.attrs or bool(_attribute(file, "time_ordered"))
        try:
            values["model"] = forcegp.Model.from_json(self.text("model"))
        except ForceGPError as error:
            raise FileFormatError(f"{self.path}: its robot or contacts cannot be used: {error}") from error
        return values

    def stored(self, name: str) -> h5py.Dataset:
        """The HDF5 dataset of that name, which must lie inside this very file."""
        found = self.file[name] if isinstance(self.file.get(name, getlink=True), h5py.HardLink) else None
        if not isinstance(found, h5py.Dataset) or found.external or found.is_virtual:
            seen = f"{self.path}: {name!r} must be a dataset stored in this file"
            raise FileFormatError(f"{seen}, not a group or a link elsewhere.")
        return found

    def array(self, name: str) -> np.ndarray:
        stored = self.stored(name)
        self.require(stored.dtype.kind in "fiu", f": {name!r} must hold numbers; it holds {stored.dtype}.")
        held = stored.size * stored.dtype.itemsize <= _LARGEST_COMPRESSION * stored.id.get_storage_size()
        self.require(held, f": {name!r} claims the shape {stored.shape}, but the file does not hold that much.")
        return stored[()]

    def texts(self, name: str) -> list[str]:
        stored = self.stored(name)
        self.require(stored.dtype.kind == "S", f": {name!r} must hold text of fixed length; it holds {stored.dtype}.")
        return np.atleast_1d(stored.asstr()[()]).ravel().tolist()

    def text(self, name: str) -> str:
        texts = self.texts(name)
        self.require(len(texts) == 1, f": {name!r} must hold one text; it holds {len(texts)}.")
        return texts[0]
