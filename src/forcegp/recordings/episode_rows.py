"""Rows of one stretch as a Dataset has them: at even times if asked for, with v and a where these were not logged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

from forcegp.data import differentiate
from forcegp.recordings.spool import Spool
from forcegp.recordings.time_stamps import Stretch

ROWS_AT_A_TIME = 16384

SPLINE_HALO = 64
"""Rows on either side that a piece of a spline is fitted with: the rest moves it by less than 0.27^64 of itself."""

DIFFERENCE_HALO = 3
"""Rows on either side that two differences reach: 2 where both are central, 3 where one is one-sided at an end."""


@dataclass(frozen=True)
class EpisodeRows:
    """The rows of a stretch in pieces, equal to those of the whole stretch at once up to rounding.

    Parameters: `kept` as in `Stamps`; `logged` signals in the order of the spool's columns, `nv` of each; `step` [s]
    between even times, or None for the times of the log.
    """

    stretch: Stretch
    kept: np.ndarray
    logged: tuple[str, ...]
    nv: int
    step: float | None

    def pieces(self, spool: Spool, rows: int = ROWS_AT_A_TIME) -> Iterator[dict[str, np.ndarray]]:
        """Time and the signals q, v, u, a, `rows` at a time."""
        log = self._LogRows(self, spool)
        time = self._times(log.time)
        for start in range(0, len(time), rows):
            end = min(start + rows, len(time))
            low, high = max(start - DIFFERENCE_HALO, 0), min(end + DIFFERENCE_HALO, len(time))
            table = log.rows(low, high) if self.step is None else log.interpolated(time[low:high])
            signals = {name: table[:, self.nv * i : self.nv * (i + 1)] for i, name in enumerate(self.logged)}
            if "v" not in signals:
                signals["v"] = differentiate(signals["q"], time[low:high])
            if "a" not in signals:
                signals["a"] = differentiate(signals["v"], time[low:high])
            own = slice(start - low, end - low)
            yield {"time": time[start:end]} | {name: values[own] for name, values in signals.items()}

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self._times(self.stretch.recording.time[self._numbers]))

    @property
    def _numbers(self) -> np.ndarray:
        """Rows of the recording that are used."""
        stretch = self.stretch
        return stretch.start + np.flatnonzero(self.kept[stretch.start : stretch.end])

    def _times(self, stamps: np.ndarray) -> np.ndarray:
        if self.step is None:
            return stamps
        count = int(np.floor((stamps[-1] - stamps[0]) / self.step * (1 + 1e-12))) + 1
        return np.minimum(stamps[0] + self.step * np.arange(count), stamps[-1])

    class _LogRows:
        """The rows of the log that are used, by number."""

        def __init__(self, owner: EpisodeRows, spool: Spool) -> None:
            self.spool = spool
            self.first = owner.stretch.recording.first
            self.numbers = owner._numbers
            self.time = owner.stretch.recording.time[self.numbers]

        def rows(self, start: int, end: int) -> np.ndarray:
            numbers = self.numbers[start:end]
            table = self.spool.read(self.first + int(numbers[0]), self.first + int(numbers[-1]) + 1)
            return table if len(table) == len(numbers) else table[numbers - numbers[0]]

        def interpolated(self, time: np.ndarray) -> np.ndarray:
            low = max(int(np.searchsorted(self.time, time[0])) - SPLINE_HALO, 0)
            high = min(int(np.searchsorted(self.time, time[-1])) + SPLINE_HALO, len(self.time))
            return make_interp_spline(self.time[low:high], self.rows(low, high), k=3)(time)
