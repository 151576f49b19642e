"""A dataset written in pieces is the one written at once; nothing else is ever left behind."""

import h5py
import numpy as np
import pytest
from tests.posterior.arm import arm_data, arm_model

import forcegp.data.dataset_writer as dataset_writer
from forcegp.data import REVOLUTE_UNITS, Dataset
from forcegp.data.dataset_writer import DatasetWriter
from forcegp.data.hdf5 import COMPRESSION
from forcegp.errors import DatasetError, InvalidInput

NAMES = ("pan", "lift", "bend")


def rows(count, start=0):
    random = np.random.default_rng(start)
    made = {name: random.normal(size=(count, 3)) for name in "qvua"}
    return made | {"time": 0.01 * np.arange(start, start + count)}


def writer(path, **changes):
    return DatasetWriter(path, **{"joint_names": NAMES, "units": REVOLUTE_UNITS, "model": None, **changes})


@pytest.mark.parametrize("chunk", [1, 7, 8, 100])
@pytest.mark.parametrize("sizes", [(1,), (7, 7, 7), (20, 1, 33), (8, 8)])
def test_pieces_are_the_whole(tmp_path, monkeypatch, chunk, sizes):
    monkeypatch.setattr(dataset_writer, "ROWS_PER_CHUNK", chunk)
    given, start = [], 0
    with writer(tmp_path / "log.h5") as file:
        for episode, size in enumerate(sizes):
            given.append(rows(size, start))
            file.append(**given[-1], episode=episode // 2)
            start += size
        file.finish({"from": "a test"})
    whole = {name: np.concatenate([piece[name] for piece in given]) for name in given[0]}
    expected = Dataset(
        **whole,
        joint_names=NAMES,
        units=REVOLUTE_UNITS,
        episode=np.repeat(np.arange(len(sizes)) // 2, sizes),
        metadata={"from": "a test"},
    )
    found = Dataset.load(tmp_path / "log.h5")
    for name in ("q", "v", "u", "a", "time", "episode"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert (found.metadata, found.units, found.joint_names) == (expected.metadata, expected.units, NAMES)
    found.save(tmp_path / "again.h5")
    expected.save(tmp_path / "expected.h5")
    assert (tmp_path / "again.h5").read_bytes() == (tmp_path / "expected.h5").read_bytes()


def test_chunks_are_what_the_filters_of_hdf5_would_have_made(tmp_path):
    with writer(tmp_path / "log.h5") as file:
        file.append(**rows(20_000), episode=0)
        file.finish({})
    with h5py.File(tmp_path / "log.h5") as stored, h5py.File(tmp_path / "own.h5", "w") as own:
        q = stored["q"]
        assert (q.compression, q.shuffle, q.chunks) == ("gzip", True, (8192, 3))
        same = own.create_dataset("q", data=q[()], chunks=q.chunks, **COMPRESSION)
        for row in range(0, 20_000, 8192):
            assert q.id.read_direct_chunk((row, 0)) == same.id.read_direct_chunk((row, 0))


def test_the_robot_comes_along(tmp_path):
    data, model = arm_data(20, seed=0), arm_model()
    with writer(tmp_path / "log.h5", units=data.units, model=model) as file:
        signals = {name: getattr(data, name) for name in ("q", "v", "u", "a", "time")}
        file.append(**signals, episode=0)
        file.finish({})
    assert Dataset.load(tmp_path / "log.h5").model.robot.joint_names == NAMES


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time": np.array([0.0, 0.02, 0.01])}, "time does not increase"),
        ({"time": np.array([0.1, 0.2, 0.3]) - 1}, "time does not increase"),
        ({"q": np.full((3, 3), np.nan)}, "q is nan at row 0"),
    ],
)
def test_rows_that_no_dataset_may_have_leave_nothing(tmp_path, change, message):
    def write():
        with writer(tmp_path / "log.h5") as file:
            file.append(**rows(5), episode=0)
            file.append(**rows(3, 5) | change, episode=0)

    with pytest.raises(DatasetError, match=message):
        write()
    assert not list(tmp_path.iterdir())


def test_what_is_not_finished_is_not_there(tmp_path):
    (tmp_path / "log.h5").write_text("years of work")
    with pytest.raises(DatasetError, match="was not finished"), writer(tmp_path / "log.h5") as file:
        file.append(**rows(5), episode=0)
    with pytest.raises(DatasetError, match="at least one row"), writer(tmp_path / "log.h5") as file:
        file.finish({})
    with pytest.raises(InvalidInput, match="does not exist"), writer(tmp_path / "nowhere" / "log.h5"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["log.h5"]
    assert (tmp_path / "log.h5").read_text() == "years of work"
