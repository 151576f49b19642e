import numpy as np
import pytest
from tests.data.samples import dataset

from forcegp.data import require_disjoint
from forcegp.errors import DatasetError


def many(episodes: int):
    return dataset(4 * episodes, episode=np.repeat(np.arange(episodes), 4))


def test_rows_in_both_are_found():
    data = many(4)
    with pytest.raises(DatasetError, match=r"1 of 3 test rows .*row 2"):
        require_disjoint(data.rows(slice(0, 8)), data.rows([12, 13, 5]))
    require_disjoint(data.rows(slice(0, 8)), data.rows(slice(8, 16)))


def test_signed_zeros_are_equal():
    zeros = {name: np.zeros((1, 2)) for name in ("q", "v", "u", "a")}
    negative = {name: -values for name, values in zeros.items()}
    with pytest.raises(DatasetError, match="1 of 1"):
        require_disjoint(dataset(1, **zeros), dataset(1, **negative))


def test_two_samples_of_one_trajectory_are_found_though_no_row_repeats():
    data = dataset(metadata={"scenario": "x", "seed": 3})
    with pytest.raises(DatasetError, match=r"same trajectory.*episodes \[0, 1\] in both"):
        require_disjoint(data.rows(slice(0, None, 2)), data.rows(slice(1, None, 2)))
    require_disjoint(data, dataset(seed=1, metadata={"scenario": "x", "seed": 4}))
    require_disjoint(data.select_episodes([0]), data.select_episodes([1]))
