"""`DatasetWriter`: a dataset file written in pieces, for data that need not fit into memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import h5py
import numpy as np
from jaxtyping import Float

from forcegp.data.columns import finite_columns
from forcegp.data.frozen_dict import frozen_json
from forcegp.data.hdf5 import COMPRESSION, describe, file_written_whole
from forcegp.data.units import validated_units
from forcegp.errors import DatasetError

if TYPE_CHECKING:
    from forcegp.mechanics import MechanicalSystem

ROWS_PER_CHUNK = 8192
TABLES = ("q", "v", "u", "a")


class DatasetWriter:
    """A context that writes what `Dataset.load` reads: rows by `append`, episode after episode, then `finish`.

    The file appears under its name when `finish` was called and the context ends without error. `joint_names` and
    `units` are those of a Dataset; with a `system`, its robot's.
    """

    __no_type_check__: ClassVar[bool] = True

    def __init__(
        self, path: str | Path, *, joint_names: Sequence[str], units: Mapping[str, Any], system: MechanicalSystem | None
    ) -> None:
        self.path = Path(path)
        self.joint_names = tuple(joint_names)
        self.units = validated_units(units, self.joint_names)
        self.system = system
        self.rows = 0
        self._last: tuple[int, float] | None = None
        self._waiting: list[dict[str, np.ndarray]] = []
        self._count = 0
        self._finished = False
        self._stack = ExitStack()
        self._file: h5py.File

    def __enter__(self) -> DatasetWriter:
        with ExitStack() as stack:
            temporary = stack.enter_context(file_written_whole(self.path))
            self._file = stack.enter_context(h5py.File(temporary, "x"))
            self._stack = stack.pop_all()
        nv = len(self.joint_names)
        for name in (*TABLES, "time", "episode"):
            width = (nv,) if name in TABLES else ()
            self._file.create_dataset(
                name,
                shape=(0, *width),
                maxshape=(None, *width),
                chunks=(ROWS_PER_CHUNK, *width),
                dtype=np.int64 if name == "episode" else np.float64,
                **COMPRESSION,
            )
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: Any) -> bool | None:
        if error is None and not self._finished:
            error = DatasetError(f"{self.path} was not finished; call finish(metadata) after the last rows.")
            self._stack.__exit__(DatasetError, error, None)
            raise error
        return self._stack.__exit__(kind, error, trace)

    def append(
        self,
        *,
        q: Float[np.ndarray, "rows nv"],
        v: Float[np.ndarray, "rows nv"],
        u: Float[np.ndarray, "rows nv"],
        a: Float[np.ndarray, "rows nv"],
        time: Float[np.ndarray, " rows"],
        episode: int,
    ) -> None:
        """Add rows of one episode after those that are there. Raises DatasetError as a Dataset does."""
        given = {"q": q, "v": v, "u": u, "a": a}
        block = {name: finite_columns(name, values, self.joint_names, len(q)) for name, values in given.items()}
        block["time"] = finite_columns("time", time, None, len(q))
        before = [self._last[1]] if self._last is not None and self._last[0] == episode else []
        if not (np.diff(np.concatenate([before, block["time"]])) > 0).all():
            raise DatasetError(f"time does not increase in episode {episode} after row {self.rows}.")
        self._last = (episode, float(block["time"][-1]))
        block["episode"] = np.full(len(q), episode, np.int64)
        self.rows += len(q)
        self._waiting.append(block)
        self._count += len(q)
        if self._count >= 8 * ROWS_PER_CHUNK:
            self._write(self._count - self._count % ROWS_PER_CHUNK)

    def finish(self, metadata: Mapping[str, Any]) -> None:
        """Write what is left and what describes the rows. Raises DatasetError if there are no rows."""
        if self.rows == 0:
            raise DatasetError("a Dataset has at least one row.")
        self._write(self._count)
        fields = {"time_ordered": True, "units": self.units, "joint_names": self.joint_names, "system": self.system}
        describe(fields | {"metadata": frozen_json(metadata)}, self._file)
        self._finished = True

    def _write(self, count: int) -> None:
        """Put the first `count` waiting rows into the file: whole chunks, so that none is compressed twice."""
        rest: dict[str, np.ndarray] = {}
        for name in (*TABLES, "time", "episode"):
            joined = np.concatenate([block[name] for block in self._waiting])
            stored = self._file[name]
            assert isinstance(stored, h5py.Dataset)
            end = len(stored) + count
            stored.resize(end, axis=0)
            stored[end - count : end] = joined[:count]
            rest[name] = joined[count:]
        self._waiting = [rest]
        self._count -= count
