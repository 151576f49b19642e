"""Columns and rows of a Dataset by index, and the same as a pandas DataFrame."""

import sys

import numpy as np
import pytest
from tests.data.samples import arrays, assert_equal, complete, dataset

from forcegp.data import REVOLUTE_UNITS, Dataset
from forcegp.errors import DatasetError, InvalidInput, MissingExtra


@pytest.mark.parametrize("name", ["q", "v", "u", "a", "time", "episode"])
def test_columns_by_name(name):
    data = dataset()
    assert data[name] is getattr(data, name)


def test_the_noise_is_a_column_of_every_row():
    assert complete()["noise_std"].shape == (40, 2)
    with pytest.raises(InvalidInput, match="no column 'noise_std' in this Dataset"):
        dataset()["noise_std"]
    with pytest.raises(InvalidInput, match=r"no column 'tau' .* Valid columns: a, episode, q, time, u, v"):
        dataset()["tau"]


@pytest.mark.parametrize("index", [slice(10, 20), [3, 1], np.arange(40) % 2 == 0, np.array([5, 7])])
def test_rows_by_index(index):
    data = complete()
    assert_equal(data[index], data.rows(index))


def test_one_row_is_a_dataset_of_one_row():
    assert_equal(dataset()[7], dataset().rows([7]))
    assert_equal(dataset()[np.int64(-1)], dataset().rows([39]))
    with pytest.raises(InvalidInput, match="row 40 does not exist"):
        dataset()[40]
    with pytest.raises(TypeError, match="not iterable"):
        list(dataset())


def test_without_pandas_the_error_holds_the_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    for call in (dataset().to_pandas, lambda: Dataset.from_pandas(None)):
        with pytest.raises(MissingExtra, match=r"pip install 'forcegp\[pandas\]'"):
            call()


@pytest.fixture
def pandas():
    return pytest.importorskip("pandas")


def test_there_and_back(pandas):
    names = {"joint_names": ("arm.shoulder", "elbow")}
    truth = {**complete().truth, "Q_U.tool-friction": np.ones((40, 2)), "force.tip": np.zeros((40, 3))}
    data = dataset(noise_std=np.full((40, 2), 0.1), truth=truth, **names)
    frame = data.to_pandas()
    assert list(frame.columns[:4]) == ["time", "episode", "q.arm.shoulder", "q.elbow"]
    back = Dataset.from_pandas(frame, units=REVOLUTE_UNITS)
    assert arrays(back).keys() == arrays(data).keys()
    for name, values in arrays(data).items():
        np.testing.assert_array_equal(values, arrays(back)[name], strict=True)
    assert back.joint_names == data.joint_names


def test_frames_that_lack_something(pandas):
    frame = dataset().to_pandas()
    with pytest.raises(DatasetError, match=r"the frame lacks columns of u; it needs time, and q\.JOINT"):
        Dataset.from_pandas(frame.drop(columns=["u.shoulder", "u.elbow"]), units=REVOLUTE_UNITS)
    with pytest.raises(DatasetError, match="the frame has q of shoulder, elbow, but v of elbow"):
        Dataset.from_pandas(frame.drop(columns=["v.shoulder"]), units=REVOLUTE_UNITS)
    frame["a.elbow"] = "text"
    with pytest.raises(DatasetError, match="a must be an array of real numbers"):
        Dataset.from_pandas(frame, units=REVOLUTE_UNITS)
