import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.data.samples import dataset

from forcegp.data import require_disjoint, train_test_split
from forcegp.errors import DatasetError, InvalidInput


def many(episodes: int):
    return dataset(4 * episodes, episode=np.repeat(np.arange(episodes), 4))


def test_named_episodes():
    train, test = train_test_split(many(3), test_episodes=[1])
    assert (train.episodes, test.episodes) == ((0, 2), (1,))
    require_disjoint(train, test)


@given(st.integers(2, 12), st.floats(0.01, 0.99), st.integers(0, 2**32))
def test_a_fraction_takes_whole_episodes_and_the_seed_decides(episodes, fraction, seed):
    data = many(episodes)
    train, test = train_test_split(data, test_fraction=fraction, seed=seed)
    assert sorted([*train.episodes, *test.episodes]) == list(range(episodes))
    assert len(test.episodes) == min(max(round(fraction * episodes), 1), episodes - 1)
    assert train_test_split(data, test_fraction=fraction, seed=seed)[1].episodes == test.episodes


def test_seeds_differ():
    drawn = {train_test_split(many(10), test_fraction=0.3, seed=seed)[1].episodes for seed in range(20)}
    assert len(drawn) > 10


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "either test_episodes or test_fraction"),
        ({"test_episodes": [1], "test_fraction": 0.5}, "either"),
        ({"test_fraction": 0.5}, "give a seed"),
        ({"test_fraction": 0.0, "seed": 0}, "between 0 and 1"),
        ({"test_fraction": 1.0, "seed": 0}, "between 0 and 1"),
        ({"test_episodes": [9]}, "no episodes"),
    ],
)
def test_wrong_arguments(arguments, message):
    with pytest.raises(InvalidInput, match=message):
        train_test_split(many(3), **arguments)


def test_one_episode_is_never_split():
    with pytest.raises(InvalidInput, match="another seed"):
        train_test_split(many(1), test_fraction=0.5, seed=0)


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
    train, test = data.split_by_episode([1])
    require_disjoint(train, test)
