import inspect

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from tests.data.samples import dataset

from forcegp.data import farthest_point_sampling, farthest_rows
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
    distance = np.linalg.norm(scaled[:, None] - scaled[None], axis=2)
    chosen = [start]
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
    count = data.draw(st.integers(1, rows))
    start = data.draw(st.integers(0, rows - 1))
    every = farthest_point_sampling(points, rows, start=start)
    assert sorted(every) == list(range(rows))
    assert every[0] == start
    np.testing.assert_array_equal(farthest_point_sampling(points, count, start=start), every[:count])


@given(TABLES)
def test_repeated_rows_come_last(points):
    repeated = np.concatenate([points, points[::-1]])
    distinct = len(np.unique(points, axis=0))
    chosen = farthest_point_sampling(repeated, len(repeated))
    assert len(np.unique(repeated[chosen[:distinct]], axis=0)) == distinct


@given(TABLES, st.integers(-3, 3), st.floats(-10, 10))
def test_scale_and_origin_of_a_column_do_not_matter(points, power, shift):
    points = np.round(points) + np.arange(len(points))[:, None] * 2.0**-20  # no ties for rounding to break
    scaled = points * 2.0**power  # a power of two: exact
    np.testing.assert_array_equal(
        farthest_point_sampling(points, len(points)), farthest_point_sampling(scaled, len(points))
    )


def test_the_sample_covers_better_than_chance():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(2000, 3))

    def hole(index: np.ndarray) -> float:
        return float(np.linalg.norm(points[:, None] - points[index][None], axis=2).min(axis=1).max())

    assert hole(farthest_point_sampling(points, 50)) < 0.6 * hole(rng.choice(2000, 50, replace=False))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": 0}, "from 1 to 5"),
        ({"count": 6}, "from 1 to 5"),
        ({"count": 2.0}, "from 1 to 5"),
        ({"count": True}, "from 1 to 5"),
        ({"count": 2, "start": 5}, "from 0 to 4"),
        ({"count": 2, "start": -1}, "from 0 to 4"),
    ],
)
def test_wrong_arguments(arguments, message):
    with pytest.raises(InvalidInput, match=message):
        inspect.unwrap(farthest_point_sampling)(np.zeros((5, 2)), **arguments)


@pytest.mark.parametrize("points", [np.zeros(5), np.zeros((0, 2)), np.full((5, 2), np.nan), np.full((5, 2), "a")])
def test_wrong_tables(points):
    with pytest.raises(InvalidInput, match="table of finite numbers"):
        inspect.unwrap(farthest_point_sampling)(points, 1)


def test_rows_of_a_dataset_in_sampling_order():
    data = dataset()
    sample = farthest_rows(data, 10, start=1)
    points = np.hstack([data.q, data.v, data.u])
    np.testing.assert_array_equal(sample.a, data.a[farthest_point_sampling(points, 10, start=1)])
    np.testing.assert_array_equal(sample.rows(slice(4)).q, farthest_rows(data, 4, start=1).q)
