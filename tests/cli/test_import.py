"""`forcegp import`: what it makes, what it says, and what it refuses."""

import numpy as np
import pytest
from tests.data.samples import model
from tests.recordings.broken_logs import BROKEN
from tests.recordings.log_files import motion, table, write_text

from forcegp import Dataset
from forcegp.data import Preparation

FLAGS = ("--time", "time", "--q", "q_{joints}", "--v", "v_{joints}", "--u", "u_{joints}", "--robot", "arm.urdf")

ARM = model("continuous").robot.urdf_text


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM)
    return tmp_path


@pytest.mark.parametrize("name", BROKEN)
def test_what_cannot_be_imported_is_one_line_and_leaves_nothing(forcegp, folder, name):
    broken = BROKEN[name]
    if "bag" in name or "mcap" in name or "topic" in name or "unknown compression" in name:
        pytest.importorskip("rosbags")
    log, before = broken.make(folder), sorted(folder.rglob("*"))
    done = forcegp("import", log.relative_to(folder), *broken.words.split(), "--out", "log_out.h5", folder=folder)
    lines = [line for line in done.stderr.splitlines() if not line.startswith("the columns are mapped by")]
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("forcegp: ")
    assert broken.told in lines[0]
    assert sorted(folder.rglob("*")) == before


def test_a_mapping_beside_the_log_is_found_and_changed_by_flags(forcegp, folder):
    write_text(folder / "log.csv", table(motion()))
    (folder / "log.yaml").write_text("time: time\nq: q_{joints}\nv: v_{joints}\nu: u_{joints}\n")
    for name, words in (("a", FLAGS), ("b", FLAGS[-2:]), ("c", (*FLAGS[-2:], "--sign=u=-1", "--unit", "q=deg"))):
        done = forcegp("import", "log.csv", *words, "--out", f"{name}.h5", folder=folder).ok()
        assert "the columns are mapped by log.yaml" in done.stderr
    a, b, c = (Dataset.load(folder / f"{name}.h5") for name in "abc")
    for name in ("q", "v", "u", "a", "time", "episode"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    np.testing.assert_array_equal(c.u, -a.u)
    np.testing.assert_allclose(c.q, np.deg2rad(a.q), rtol=1e-15)


def test_an_existing_file_is_kept_unless_told_otherwise(forcegp, folder):
    write_text(folder / "log.csv", table(motion()))
    (folder / "log.h5").write_text("years of work")
    words, own = ("import", "log.csv", *FLAGS, "--out", "log.h5"), "is not a dataset of forcegp, so it is not"
    for more, message in (((), "add --overwrite"), (("--overwrite",), f"log.h5 {own} overwritten")):
        forcegp(*words, *more, folder=folder).refused(message)
        assert (folder / "log.h5").read_text() == "years of work"
    (folder / "log.h5").write_text("")
    for _ in range(2):
        forcegp(*words, "--overwrite", folder=folder).ok()
    assert len(Dataset.load(folder / "log.h5")) == 200


def test_what_was_repaired_is_said(forcegp, folder):
    columns = {name: values.copy() for name, values in table(motion()).items()}
    columns["time"][100:] += 0.5
    columns["time"][150] = columns["time"][149]
    columns["time"][20] += 2e-4
    write_text(folder / "log.csv", columns)
    done = forcegp("import", "log.csv", *FLAGS, "--out", "log.h5", folder=folder).ok()
    assert "rows dropped for a repeated time stamp: 1" in done.stderr
    assert "gaps that split it: 1, of up to 0.502 s" in done.stderr
    assert "resampled to 512 Hz: steps deviate by up to" in done.stderr
    assert "episodes: 2" in done.stdout


def test_preparation_while_importing_is_that_of_the_raw_dataset(forcegp, folder):
    write_text(folder / "log.csv", table(motion(1000)))
    flags = ("--cutoff", 30, "--delay", 0.01, "--every", 2, "--trim", 0.1)
    for name, more in (("raw", ()), ("prepared", flags)):
        done = forcegp("import", "log.csv", *FLAGS, *more, "--out", f"{name}.h5", folder=folder).ok()
    assert "30 Hz, order 4, forwards and backwards" in done.stdout
    raw, found = (Dataset.load(folder / f"{name}.h5") for name in ("raw", "prepared"))
    expected = Preparation(cutoff=30.0, delay=0.01, every=2, trim=0.1).apply(raw)
    for name in ("q", "v", "u", "a", "time", "episode"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert found.metadata["preparation"] == expected.metadata["preparation"]
    forcegp("import", "log.csv", *FLAGS, "--cutoff", 300, "--out", "x.h5", folder=folder).refused()
    assert not (folder / "x.h5").exists()
