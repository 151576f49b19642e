"""Rows set aside on the disk: read once from a log of any format, then again in any order.

Rates and gaps are known only after the last row, and reading most formats costs more than everything after it. Episodes
are cut, interpolated and differentiated from here, in pieces with halos, so that the result depends neither on the
format nor on the size of the pieces that a reader gives.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float


class Spool:
    """A table of float64 in a file without a name, which is gone with the process whatever ends it.

    Rows are appended in blocks and read back by number; memory holds only what is read.
    """

    def __init__(self, folder: Path, width: int) -> None:
        self.width = width
        self.rows = 0
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  # closed by __exit__

    def __enter__(self) -> Spool:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def append(self, table: Float[np.ndarray, "rows width"]) -> None:
        """Put rows at the end."""
        self._file.write(np.ascontiguousarray(table, dtype=np.float64).data)
        self.rows += len(table)

    def read(self, start: int, end: int) -> Float[np.ndarray, "rows width"]:
        """Rows start to end, the latter excluded, as an array of its own."""
        self._file.seek(start * self.width * 8)
        data = self._file.read((end - start) * self.width * 8)
        return np.frombuffer(data, np.float64).reshape(-1, self.width)
