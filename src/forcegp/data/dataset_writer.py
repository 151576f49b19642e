"""`DatasetWriter`: a dataset file written in pieces, for data that need not fit into memory.

Columns are written by more than one thread: HDF5's deflate takes more time than reading, interpolating and
differentiating together, and runs on one.
"""

from __future__ import annotations

import os
import zlib
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float

import forcegp.mechanics
from forcegp.atomic_files import atomic_file
from forcegp.data.dataset_fields import finite_columns, frozen_json, validated_units
from forcegp.data.hdf5 import COMPRESSION, NewFile, describe
from forcegp.errors import DatasetError

Rows = Float[np.ndarray, "rows nv"]

ROWS_PER_CHUNK = 8192
TABLES = ("q", "v", "u", "a")
THREADS = min(4, os.cpu_count() or 1)
MOST_JOBS = 16
"""Chunks that are being compressed while rows go on coming, 0.5 MiB each with seven joints."""


class DatasetWriter:
    """A context that writes what `Dataset.load` reads: rows by `append`, episode after episode, then `finish`.

    The file appears under its name when `finish` was called and the context ends without error. `joint_names` and
    `units` are those of a Dataset; with a `model`, its robot's.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        joint_names: Sequence[str],
        units: Mapping[str, Any],
        model: forcegp.Model | None,
    ) -> None:
        self.path = Path(path)
        self.joint_names = tuple(joint_names)
        self.units = validated_units(units, self.joint_names)
        self.model = model
        names: dict[str, tuple[str, ...]] = dict.fromkeys(TABLES, self.joint_names)
        if model is not None:
            names |= {"q": model.robot.position_names, "u": model.inputs}
        self.columns = names
        self.rows = 0
        self._last: tuple[int, float] | None = None
        self._waiting: list[dict[str, np.ndarray]] = []
        self._count = 0
        self._finished = False
        self._jobs: deque[tuple[h5py.Dataset, int, Future[bytes]]] = deque()
        self._pool: ThreadPoolExecutor
        self._stack = ExitStack()
        self._file: NewFile

    def __enter__(self) -> DatasetWriter:
        with ExitStack() as stack:
            temporary = stack.enter_context(atomic_file(self.path))
            self._file = stack.enter_context(NewFile(temporary))
            self._pool = ThreadPoolExecutor(THREADS)
            stack.callback(self._pool.shutdown, cancel_futures=True)
            self._stack = stack.pop_all()
        for name in self._stored:
            width = (len(self.columns[name]),) if name in TABLES else ()
            self._file.create_dataset(
                name,
                shape=(0, *width),
                maxshape=(None, *width),
                chunks=(ROWS_PER_CHUNK, *width),
                dtype=np.int64 if name == "episode" else np.float64,
                **COMPRESSION,
            )
        return self

    @property
    def _stored(self) -> list[str]:
        """What is written in chunks; a table without columns has none."""
        return [*(name for name in TABLES if self.columns[name]), "time", "episode"]

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: Any) -> bool | None:
        if error is None and not self._finished:
            error = DatasetError(f"{self.path} was not finished; call finish(metadata) after the last rows.")
            self._stack.__exit__(DatasetError, error, None)
            raise error
        return self._stack.__exit__(kind, error, trace)

    def append(
        self,
        *,
        q: Float[np.ndarray, "rows nq"],
        v: Rows,
        u: Float[np.ndarray, "rows nu"],
        a: Rows,
        time: Float[np.ndarray, " rows"],
        episode: int,
    ) -> None:
        """Add rows of one episode after those that are there. Raises DatasetError as a Dataset does."""
        given = {"q": q, "v": v, "u": u, "a": a}
        block = {name: finite_columns(name, values, self.columns[name], len(q)) for name, values in given.items()}
        block["time"] = finite_columns("time", time, None, len(q))
        before = [self._last[1]] if self._last is not None and self._last[0] == episode else []
        if not (np.diff(np.concatenate([before, block["time"]])) > 0).all():
            raise DatasetError(f"time does not increase in episode {episode} after row {self.rows}.")
        self._last = (episode, float(block["time"][-1]))
        block["episode"] = np.full(len(q), episode, np.int64)
        self.rows += len(q)
        self._waiting.append(block)
        self._count += len(q)
        if self._count >= 2 * ROWS_PER_CHUNK:
            self._write(self._count - self._count % ROWS_PER_CHUNK)

    def finish(self, metadata: Mapping[str, Any]) -> None:
        """Write what is left and what describes the rows. Raises DatasetError if there are no rows."""
        if self.rows == 0:
            raise DatasetError("a Dataset has at least one row.")
        self._write(self._count)
        self._store(0)
        for name in TABLES:
            if not self.columns[name]:
                self._file.create_dataset(name, data=np.zeros((self.rows, 0)))
        fields = {"time_ordered": True, "units": self.units, "joint_names": self.joint_names, "model": self.model}
        describe(fields | {"metadata": frozen_json(metadata)}, self._file)
        self._finished = True

    def _write(self, count: int) -> None:
        """Put the first `count` waiting rows into the file: whole chunks, but for the last ones of all."""
        rest: dict[str, np.ndarray] = {}
        for name in self._stored:
            joined = np.concatenate([block[name] for block in self._waiting])
            stored = self._file[name]
            assert isinstance(stored, h5py.Dataset)
            begin = len(stored)
            stored.resize(begin + count, axis=0)
            for start in range(0, count, ROWS_PER_CHUNK):
                chunk = joined[start : min(start + ROWS_PER_CHUNK, count)]
                self._jobs.append((stored, begin + start, self._pool.submit(_compressed, chunk)))
            rest[name] = joined[count:]
        self._waiting = [rest]
        self._count -= count
        self._store(MOST_JOBS)

    def _store(self, left: int) -> None:
        """Write compressed chunks in their order until only `left` are being compressed."""
        while len(self._jobs) > left:
            stored, row, job = self._jobs.popleft()
            stored.id.write_direct_chunk((row, 0)[: stored.ndim], job.result())
        self._file.require_written()


def _compressed(chunk: np.ndarray) -> bytes:
    """A chunk as HDF5's filters shuffle and deflate store it; one that is not full is filled with zeros."""
    full = np.zeros((ROWS_PER_CHUNK, *chunk.shape[1:]), chunk.dtype)
    full[: len(chunk)] = chunk
    shuffled = np.ascontiguousarray(full.reshape(-1, 1).view(np.uint8).T)
    return zlib.compress(shuffled.data, COMPRESSION["compression_opts"])
