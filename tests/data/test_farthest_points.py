import inspect

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from forcegp.data import farthest_point_sampling
from forcegp.errors import InvalidInput

TABLES = hnp.arrays(
    np.float64,
    st.tuples(st.integers(1, 20), st.integers(1, 4)),
    elements=st.floats(-1e3, 1e3).map(lambda value: round(value, 1)),
)


def by_definition(points: np.ndarray, count: int, start: int) -> list[int]:
    """All distances at once; quadratic in memory."""
    spread = points.std(axis=0)
    scaled = (points - points.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    distance, chosen = np.linalg.norm(scaled[:, None] - scaled[None], axis=2), [start]
    while len(chosen) < count:
        nearest = distance[:, chosen].min(axis=1)
        nearest[chosen] = -1
        chosen.append(int(nearest.argmax()))
    return chosen


@pytest.mark.parametrize("seed", range(5))
def test_it_is_the_definition(seed):
    points = np.random.default_rng(seed).normal(size=(60, 3)) * [1.0, 100.0, 1e-6] + [0.0, 5.0, 1.0]
    np.testing.assert_array_equal(farthest_point_sampling(points, 25, start=seed), by_definition(points, 25, seed))


@given(TABLES, st.data())
def test_it_is_nested_without_repetition_and_deterministic(points, data):
    rows = len(points)
    count, start = data.draw(st.integers(1, rows)), data.draw(st.integers(0, rows - 1))
    every = farthest_point_sampling(points, rows, start=start)
    assert (sorted(every), every[0]) == (list(range(rows)), start)
    np.testing.assert_array_equal(farthest_point_sampling(points, count, start=start), every[:count])


@given(TABLES)
def test_repeated_rows_come_last(points):
    repeated, distinct = np.concatenate([points, points[::-1]]), len(np.unique(points, axis=0))
    assert len(np.unique(repeated[farthest_point_sampling(repeated, len(repeated))[:distinct]], axis=0)) == distinct


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": 0}, "from 1 to 5"), ({"count": 6}, "from 1 to 5"), ({"count": 2.0}, "from 1 to 5"),
        ({"count": True}, "from 1 to 5"), ({"count": 2, "start": 5}, "from 0 to 4"),
        ({"count": 2, "start": -1}, "from 0 to 4"),
    ],
)  # fmt: skip
def test_wrong_arguments(arguments, message):
    with pytest.raises(InvalidInput, match=message):
        inspect.unwrap(farthest_point_sampling)(np.zeros((5, 2)), **arguments)
