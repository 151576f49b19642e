import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.data.samples import NAMES, arrays, assert_equal, columns, complete, dataset, model

from forcegp.data import units_for
from forcegp.errors import DatasetError, InvalidInput

# ---------------------------------------------------------------- what it holds


def test_arrays_are_private_float64_contiguous_and_read_only():
    given = {name: np.asfortranarray(values) for name, values in columns().items()}
    given["u"] = np.arange(80).reshape(40, 2)  # integers
    data = dataset(**given)
    before = {name: values.copy() for name, values in arrays(data).items()}
    for values in given.values():
        values[:] = 99
    for name, values in arrays(complete()).items():
        assert values.dtype == (np.int64 if name == "episode" else np.float64)
        assert values.flags.c_contiguous
        assert not values.flags.writeable
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 1
    for name, values in arrays(data).items():
        np.testing.assert_array_equal(values, before[name])


def test_fields_cannot_be_replaced_and_metadata_are_a_copy():
    given = {"nested": {"list": (1, 2.5, None, True)}}
    data = dataset(metadata=given)
    with pytest.raises(dataclasses.FrozenInstanceError):
        data.q = np.zeros((40, 2))  # type: ignore[misc]
    given["nested"]["list"] = ()
    assert data.metadata == {"nested": {"list": [1, 2.5, None, True]}}


# ---------------------------------------------------------------- what it refuses


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"q": np.zeros(40)}, r"q has shape \(40,\)"),
        ({"q": np.zeros((40, 3))}, r"q has shape \(40, 3\); expected \(rows, 2\)"),
        ({"v": np.zeros((39, 2))}, "v has 39 rows; expected 40"),
        ({"time": np.zeros((40, 1))}, r"time has shape \(40, 1\)"),
        ({"u": np.zeros((40, 2), dtype=complex)}, "u must be an array of real numbers"),
        ({"u": [[1.0, 2.0], [1.0]]}, "u is not an array of real numbers"),
        ({"episode": np.zeros(40)}, "episode must be an array of integers"),
        ({"noise_std": np.array([0.1, 0.0])}, "'elbow' is 0.0; it must be > 0"),
        ({"noise_std": np.array([0.1])}, "noise_std has 1 joints; expected 2"),
        ({"noise_std": np.full((40, 2), 0.1)}, r"noise_std has shape \(40, 2\)"),
        ({"noise_std": np.array([np.nan, 0.1])}, "noise_std is nan"),
        ({"noise_std": [[0.1, 0.1], [0.1]]}, "noise_std is not an array of real numbers"),
        ({"truth": {"force": np.zeros((40, 2))}}, "truth has no"),
        ({"truth": {"a": np.zeros((40, 3))}}, r"truth\['a'\] has shape"),
        ({"metadata": {"x": float("nan")}}, "metadata cannot be written as JSON"),
    ],
)
def test_wrong_fields_are_named(changes, message):
    with pytest.raises(DatasetError, match=message):
        dataset(**changes)


@given(
    st.sampled_from(["q", "v", "u", "a"]), st.integers(0, 39), st.integers(0, 1),
    st.sampled_from([np.nan, np.inf, -np.inf, 1e16, -1e308]),
)  # fmt: skip
def test_the_row_and_column_of_a_bad_number_are_named(name, row, column, value):
    given = columns()
    given[name][row, column] = value
    with pytest.raises(DatasetError) as error:
        dataset(**given)
    assert str(error.value).startswith(f"{name} is {value} at row {row}, column {column} ({NAMES[column]})")


def test_time_increases_within_an_episode_but_may_start_again_in_the_next():
    time = 0.01 * np.arange(40)
    dataset(time=np.r_[time[:20], time[:20]])
    for wrong in (time[4], time[4] - 1.0, time[4] + 1e-12):
        broken = time.copy()
        broken[5] = wrong
        with pytest.raises(DatasetError, match=r"time does not increase at row 5 \(episode 0"):
            dataset(time=broken)
    assert dataset(time=np.repeat(time[:20], 2), episode=np.tile([0, 1], 20)).episodes == (0, 1)


# ---------------------------------------------------------------- units and model


def test_a_robot_is_needed():
    with pytest.raises(InvalidInput, match=r"model is a NoneType; give a Model, such as Model\(Robot.from_file"):
        dataset(model=None)


def test_units_may_differ_between_joints():
    units = {"q": ("rad", "m"), "v": ("rad/s", "m/s"), "u": ("Nm", "N"), "a": ("rad/s^2", "m/s^2"), "time": "s"}
    assert dataset(model=model("prismatic")).units == units_for(model("prismatic").robot) == units
    assert dataset().units == units_for(model().robot)
    assert dataset().units == {"q": "rad", "v": "rad/s", "u": "Nm", "a": "rad/s^2", "time": "s"}


# ---------------------------------------------------------------- choosing rows


def test_rows_by_slice_mask_and_numbers():
    data = complete()
    mask = data.q[:, 0] > 0
    assert_equal(data.rows(mask), data.rows(np.flatnonzero(mask)))
    assert_equal(data.rows(slice(3, 9, 2)), data.rows([3, 5, 7]))
    assert_equal(data.rows([-1]), data.rows([39]))
    part = data.rows([5, 3])
    np.testing.assert_array_equal(part.q, data.q[[5, 3]])
    np.testing.assert_array_equal(part.truth["a"], data.truth["a"][[5, 3]])
    np.testing.assert_array_equal(part.noise_std, data.noise_std)


def test_rows_out_of_order_are_marked_and_may_be_sorted_again():
    sample = dataset().rows([11, 2, 30])
    assert not sample.time_ordered
    assert sample.rows(np.argsort(sample.time)).time_ordered
    with pytest.raises(DatasetError, match="does not increase"):
        dataclasses.replace(sample, time_ordered=True)
    with pytest.raises(DatasetError, match="occurs twice in episode 0"):
        dataset(time=np.zeros(40), time_ordered=False)


@pytest.mark.parametrize(
    ("index", "message"),
    [
        ([40], "Dataset.rows was given .* index 40 is out of bounds .* size 40"),
        ([1, 1], "time 0.01 s occurs twice in episode 0; drop the repeated rows"),
        ([1, -39], "time 0.01 s occurs twice"), (slice(0, 0), "q has no rows"),
        (np.zeros(40, bool), "q has no rows"), (np.ones(39, bool), "Dataset.rows was given .* size of axis is 40"),
        (np.array([0.5]), "must be of integer"),
    ],
)  # fmt: skip
def test_rows_that_do_not_exist_are_named(index, message):
    with pytest.raises((InvalidInput, DatasetError), match=message):
        dataset().rows(index)


def test_episodes_are_selected_whole():
    data = dataset(episode=np.repeat([7, 3, 5, 9], 10))
    assert data.episodes == (7, 3, 5, 9)
    assert data.select_episodes([5, 7]).episodes == (7, 5)
    with pytest.raises(InvalidInput, match=r"no episodes \[4\]; this Dataset has \[7, 3, 5, 9\]"):
        data.select_episodes([4])
    with pytest.raises(InvalidInput, match="none asked for"):
        data.select_episodes([])
