"""Which rows: stretches of time, rows that two logs share, and few rows that cover the visited states evenly."""

import numpy as np
from jaxtyping import Float, Int

from forcegp.data.dataset import Dataset
from forcegp.errors import DatasetError, InvalidInput
from forcegp.robots.arguments import whole_number


def time_blocks(
    time: Float[np.ndarray, " rows"], episode: Int[np.ndarray, " _"], seconds: float
) -> tuple[tuple[int, ...], ...]:
    """Row numbers in blocks: rows of one episode in one stretch of `seconds` form a block, in order of time.

    To leave whole blocks out tests the prediction of a part of the motion that was not seen (block cross-validation;
    Burman, Chow & Nolan 1994, "A cross-validatory method for dependent data").

    `time` [s] and `episode` may come in any order, such as that of `farthest_rows`. Stretches are counted from the
    first of these rows in every episode; those without rows give no block, so that every row is in exactly one.
    Raises InvalidInput for a length that is not positive and finite, and for columns of different lengths.
    """
    if not 0.0 < seconds < float("inf"):
        raise InvalidInput(f"seconds is {seconds}; it must be positive and finite.")
    if time.shape != episode.shape:
        raise InvalidInput(f"time has {len(time)} rows and episode {len(episode)}; give both for the same rows.")
    blocks: dict[tuple[int, int], list[int]] = {}
    first = {int(number): float(time[episode == number].min()) for number in np.unique(episode)}
    for row in np.lexsort((time, episode)):
        number = int(episode[row])
        stretch = int((time[row] - first[number]) / seconds)
        blocks.setdefault((number, stretch), []).append(int(row))
    return tuple(tuple(rows) for rows in blocks.values())


def repeated_rows(trained: tuple[np.ndarray, np.ndarray, np.ndarray], test: Dataset) -> Int[np.ndarray, " repeated"]:
    """Numbers of the rows of `test` whose (q, v, u) is exactly one of those in `trained`, each (rows, k)."""
    # -0.0 becomes 0.0: equal numbers have equal bytes
    known, rows = (np.hstack(each) + 0.0 for each in (trained, (test.q, test.v, test.u)))
    found = {row.tobytes() for row in known}
    return np.array([number for number, row in enumerate(rows) if row.tobytes() in found], dtype=np.int64)


def require_disjoint(train: Dataset, test: Dataset) -> None:
    """Refuse a pair of Datasets in which the test repeats the training.

    Raises DatasetError if a row `(q, v, u)` of `test` is also in `train`, or if both were simulated or recorded with
    the same `metadata` (same seed, same configuration) and share an episode: two samples of one trajectory.
    """
    repeated = repeated_rows((train.q, train.v, train.u), test)
    if repeated.size:
        raise DatasetError(
            f"{repeated.size} of {len(test)} test rows are also training rows (the first: test row {repeated[0]}). "
            "Test on another trajectory: another episode, recording or seed."
        )
    shared = sorted(set(train.episodes) & set(test.episodes))
    if train.metadata and train.metadata == test.metadata and shared:
        raise DatasetError(
            f"training and test rows come from the same trajectory: equal metadata, episodes {shared} in both. "
            "Test on another episode, recording or seed."
        )


ROUNDING = 1e-13  # Standard deviation, relative to the largest entry, below which a column is constant but for rounding


def farthest_point_sampling(
    points: Float[np.ndarray, "rows features"], count: int, *, start: int = 0
) -> Int[np.ndarray, " count"]:
    """Numbers of `count` rows of which each is the farthest from all rows chosen before it.

    Greedy k-centre (Gonzalez 1985, "Clustering to minimize the maximum intercluster distance") with Euclidean distances
    on columns standardised to zero mean and unit standard deviation. The first row is `start`. The
    result is deterministic (the lowest row number wins a tie) and nested: the first n of `count` rows are the sample of
    size n. Repeated rows come only after all distinct ones, and no row number occurs twice.
    Time O(rows * count * features), memory O(rows * features).

    Raises InvalidInput if `points` is not a finite table, or for a `count` or `start` outside the rows.
    """
    table = np.asarray(points)
    if table.ndim != 2 or table.dtype.kind not in "fiu" or table.shape[0] == 0 or not np.isfinite(table).all():
        raise InvalidInput(
            f"points must be a (rows, features) table of finite numbers; given: {table.dtype} {table.shape}."
        )
    rows = table.shape[0]
    count = whole_number("count", count, 1, rows, "the number of rows")
    columns = _standardized_columns(table)
    distance = np.full(rows, np.inf)
    chosen = np.empty(count, dtype=np.int64)
    chosen[0] = whole_number("start", start, 0, rows - 1, "the last row")
    for position in range(count):
        if position:
            chosen[position] = np.argmax(distance)  # the lowest row number among equals
        row = chosen[position]
        # Differences, not |x|^2 - 2 x.y + |y|^2: a repeated row must have distance exactly 0.
        squared = np.zeros(rows)
        for column in columns:
            difference = column - column[row]
            squared += difference * difference
        np.minimum(distance, squared, out=distance)
        distance[row] = -1.0  # never chosen again, not even among repeated rows
    return chosen


def farthest(dataset: Dataset, count: int, *, start: int = 0) -> Int[np.ndarray, " count"]:
    """The rows of a Dataset that cover its inputs `(q, v, u)` best, in the order of `farthest_point_sampling`."""
    return farthest_point_sampling(np.hstack([dataset.q, dataset.v, dataset.u]), count, start=start)


def farthest_rows(dataset: Dataset, count: int, *, start: int = 0) -> Dataset:
    """A Dataset of the rows that are `farthest`: one of fewer points takes the first, `farthest_rows(...)[:100]`."""
    return dataset.rows(farthest(dataset, count, start=start))


def _standardized_columns(table: np.ndarray) -> np.ndarray:
    """(features, rows): contiguous columns with zero mean and unit standard deviation; constant ones become zero."""
    columns = np.ascontiguousarray(table.T, dtype=np.float64)
    scale = np.abs(columns).max(axis=1, keepdims=True)
    columns = columns / np.where(scale > 0, scale, 1.0)  # so that squaring in std cannot overflow or underflow
    spread = columns.std(axis=1, keepdims=True)
    spread[spread < ROUNDING] = 0.0
    centred = columns - columns.mean(axis=1, keepdims=True)
    return np.where(spread > 0, centred / np.where(spread > 0, spread, 1.0), 0.0)
