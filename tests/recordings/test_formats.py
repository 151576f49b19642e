"""Every format passes the same tests."""

import json
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pytest
import scipy.io
from numpy.testing import assert_array_equal
from tests.data.samples import model
from tests.recordings import log_files
from tests.recordings.log_files import EPOCH, JOINTS, motion, table
from tests.recordings.source_conformance import SourceConformance

from forcegp.errors import DataWarning, FileFormatError, InvalidInput
from forcegp.recordings import ColumnMapping, import_recordings, open_source, tables
from forcegp.recordings.source import require_distinct


class Tables(SourceConformance):
    def open(self, path):
        return open_source(path)

    def expected(self):
        return table(motion())


class TestCsv(Tables):
    def write(self, folder):
        return log_files.write_text(folder / "log.csv", table(motion()))

    def truncated(self, path):
        cut = path.read_text().rindex(path.read_text().splitlines()[-1]) + 10  # in the middle of the last line
        path.write_text(path.read_text()[:cut])
        return None


class TestCompressedCsv(Tables):
    def write(self, folder):
        return log_files.write_text(folder / "log.csv.gz", table(motion()))


class TestBlanksAndComments(TestCsv):
    def write(self, folder):
        return log_files.write_text(
            folder / "log.txt", table(motion()), delimiter="   ", before="# a robot\n\n# 2 joints\n"
        )


class TestHeaderInComment(TestCsv):
    def write(self, folder):
        return log_files.write_text(folder / "log.dat", table(motion()), delimiter=" ", before="# ")


class TestHeaderless(TestCsv):
    def write(self, folder):
        values, path = np.stack(list(table(motion()).values()), axis=1), folder / "log.txt"
        path.write_text("\n".join(repr(float(value)) for value in values.ravel()) + "\n")
        return path

    def open(self, path):
        return open_source(path, headerless=7)

    def expected(self):
        return {f"c{index + 1}": values for index, values in enumerate(table(motion()).values())}


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "cp1252"])
@pytest.mark.parametrize(
    ("head", "row", "begin"),
    [
        ("Trace 2\nDate;2024-01-01\n\ns;rad\nt;größe", "{0},5;0,25", 0.5), ("t,größe", "{0}.5,.25", 0.5),
        ("t größe\n[s] [°]", "  {0}.5   .25 ", 0.5), ("t;größe", "{0}.5;.25;", 0.5),
        ("t;größe", "12:00:0{0},5;0,25", 43200.5), ("t,größe", "1970-01-02T00:00:0{0}.5Z,.25", 86400.5),
        ("t;größe", "2.1.1970 00:00:0{0},5;0,25", 86400.5),
    ],
)  # fmt: skip
def test_texts_of_other_programs(tmp_path, encoding, head, row, begin):
    lines = [row.format(second) for second in range(8)]
    (tmp_path / "log.txt").write_bytes("\n".join([head, *lines]).encode(encoding))
    source = open_source(tmp_path / "log.txt")
    read = source.read(["t", "größe"])
    assert ("its letters are taken for cp1252" in source.notes()) == (encoding == "cp1252")
    assert not any("rad" in note for note in source.notes()), "units are used"
    assert_array_equal(read["t"], begin + np.arange(8.0))
    assert_array_equal(read["größe"], 0.25)


def test_numbers_without_names_have_their_places_for_names(tmp_path):
    (tmp_path / "log.csv").write_text("0,1.5,2\n1,2.5,3\n2,3.5,4\n")
    assert list(open_source(tmp_path / "log.csv").columns()) == ["c1", "c2", "c3"]


def test_the_last_lines_are_rows_whatever_stands_above(tmp_path):
    (tmp_path / "log.csv").write_text("\n".join([*["1,2,3"] * 30, "t;q", *["0;5"] * 20, ""]))
    assert_array_equal(open_source(tmp_path / "log.csv").read(["q"])["q"], [5.0] * 20)


def test_clocks_go_on_over_midnight(tmp_path):
    (tmp_path / "log.csv").write_text("t,q\n23:59:59.5,0\n00:00:00.5,0\n00:00:01.5,0\n")
    assert_array_equal(open_source(tmp_path / "log.csv").read(["t"])["t"], 86399.5 + np.arange(3.0))
    (tmp_path / "log.csv").write_text("t,q\n2024-01-02 01:00,0\n2024-01-01 01:00,0\n")
    assert np.diff(open_source(tmp_path / "log.csv").read(["t"])["t"]) == -86400.0  # no clock, but time that runs back


@pytest.mark.parametrize("end", ["7,1", "7,1,-", "7"])
def test_a_line_that_was_cut_is_left_out_with_a_warning(tmp_path, end):
    (tmp_path / "log.csv").write_text("t,q,u\n1,2,3\n4,5,6\n" + end)
    with pytest.warns(DataWarning, match="middle of a line: the 2 whole lines before are read"):
        read = open_source(tmp_path / "log.csv").read(["t", "u"])
    assert_array_equal(read["u"], [3.0, 6.0])
    (tmp_path / "log.csv").write_text("t,q,u\n1,2,3\n4,5\n4,5,6\n" + end)
    with pytest.raises(FileFormatError, match=r"row 1 \(line 3\) has 2 fields instead of 3"):
        open_source(tmp_path / "log.csv").read(["t", "u"])


def test_lines_of_other_widths_and_texts_for_numbers_are_left_out_if_asked_for(tmp_path):
    rows = [f"{row},{row}" for row in range(40)]
    rows[7], rows[20], rows[30] = "-- reconnect --", "20,ERR", "30"
    (tmp_path / "log.csv").write_text("\n".join(["t,q", *rows, ""]))
    with pytest.raises(FileFormatError, match=r"row 7 \(line 9\) has 1 fields instead of 2.*`bad_rows` skip"):
        open_source(tmp_path / "log.csv").read(["q"])
    source = open_source(tmp_path / "log.csv")
    source.lenient = True
    assert_array_equal(source.read(["q"])["q"], [np.nan if x == 20 else x for x in range(40) if x not in (7, 30)])
    assert source.notes() == ("lines left out because they have other than 2 fields: 2",)
    rows[31] = "31"
    (tmp_path / "log.csv").write_text("\n".join(["t,q", *rows, ""]))
    with pytest.raises(FileFormatError, match="3 lines have other than 2 fields"):
        source.read(["q"])


class TestParquet(Tables):
    def write(self, folder):
        return log_files.write_parquet(folder / "log.parquet", table(motion()))


class Arrays(Tables):
    prefix = ""

    def expected(self):
        data = motion()
        columns = {f"{self.prefix}time": data["time"]}
        for signal in "qvu":
            columns |= {f"{self.prefix}{signal}[{index}]": data[signal][:, index] for index in range(2)}
        return columns


class TestParquetOfLists(Arrays):
    def write(self, folder):
        return log_files.write_parquet(folder / "log.parquet", motion())


class TestNumpyArchive(Arrays):
    def write(self, folder):
        np.savez(folder / "log.npz", dt=0.1, name="arm", **motion())
        return folder / "log.npz"


class TestPartOfAnArchive(TestNumpyArchive):
    def write(self, folder):
        np.savez_compressed(folder / "log.npz", **{"run1": np.zeros((3, 2)), "run2": motion()["q"]})
        return folder / "log.npz"

    def open(self, path):
        return open_source(path, within="run2")

    def expected(self):
        return {f"[{index}]": motion()["q"][:, index] for index in range(2)}


class TestHDF5(Arrays):
    prefix = "log/"

    def write(self, folder):
        return log_files.write_hdf5(folder / "log.h5", motion())


class TestMatlab5(Arrays):
    prefix = "log/"

    def write(self, folder):
        return log_files.write_matlab5(folder / "log.mat", motion())


class TestMatlab73(Arrays):
    def write(self, folder):
        return log_files.write_matlab73(folder / "log.mat", motion())


def nested(rows=7):
    """Entries of a list that are rows, and episodes of other lengths."""
    alike = [{"t": 0.5 * row, "q": [row, -row], "mode": "auto"} for row in range(rows)]
    return {"log": alike, "runs": [{"t": [0.0, 1.0]}, {"t": [2.0, 3.0, 4.0]}]}


def write_json(folder):
    (folder / "log.json").write_text(json.dumps(nested()))
    return folder / "log.json"


def write_cells(folder):
    """An array of structs, and a cell of structs."""
    log = np.array(
        [(each["t"], np.array(each["q"], float)) for each in nested()["log"]], dtype=[("t", "O"), ("q", "O")]
    )
    runs = np.empty(2, object)
    runs[:] = [{"t": np.array(run["t"])} for run in nested()["runs"]]
    scipy.io.savemat(folder / "log.mat", {"log": log, "runs": runs, "name": "arm"})
    return folder / "log.mat"


def write_cells73(folder):
    with h5py.File(folder / "log.mat", "w") as file:
        for field, values in (("t", [0.5 * row for row in range(7)]), ("q", [[[row], [-row]] for row in range(7)])):
            inside = [file.create_dataset(f"#refs#/{field}{row}", data=value).ref for row, value in enumerate(values)]
            file.create_dataset(f"log/{field}", data=np.array([inside]).T, dtype=h5py.ref_dtype)
        for run, values in enumerate(nested()["runs"], 1):
            file[f"runs/{run}/t"] = np.array(values["t"])[:, None]
    return folder / "log.mat"


@pytest.mark.parametrize("write", [write_json, write_cells, write_cells73])
def test_lists_of_objects_are_rows_or_episodes(tmp_path, write):
    source = open_source(write(tmp_path))
    assert set(source.columns()) == {"log/t", "log/q[0]", "log/q[1]", "runs/1/t", "runs/2/t"}
    read = source.read(["log/t", "log/q[1]"])
    assert_array_equal(read["log/t"], 0.5 * np.arange(7))
    assert_array_equal(read["log/q[1]"], -np.arange(7))
    assert_array_equal(open_source(tmp_path / source.path.name, within="runs/2").read(["t"])["t"], [2, 3, 4])


def test_lines_of_json_are_rows_and_the_last_may_be_cut(tmp_path):
    lines = [
        {"stamp": stamp, "names": ["b", "a"], "pos": [row, 2 * row], "u": None if row else 3}
        for row, stamp in enumerate([f"2024-01-01T00:00:0{row}.5Z" for row in range(4)])
    ]
    (tmp_path / "log.jsonl").write_text("\n".join(map(json.dumps, lines))[:-5])
    with pytest.warns(DataWarning, match="the 3 whole lines before are read"):
        read = open_source(tmp_path / "log.jsonl").read(["stamp", "pos/a", "u"])
    assert_array_equal(read["stamp"] - read["stamp"][0], [0, 1, 2])
    assert_array_equal(read["pos/a"], [0, 2, 4])
    assert_array_equal(read["u"], [3, np.nan, np.nan])
    (tmp_path / "log.jsonl").write_text('{"t": 1\n{"t": 2}\n')
    with pytest.raises(FileFormatError, match=r"log\.jsonl cannot be read as JSON"):
        open_source(tmp_path / "log.jsonl").columns()


class Bags(Tables):
    @pytest.fixture(autouse=True, scope="class")
    @classmethod
    def rosbags(cls):
        pytest.importorskip("rosbags")

    def expected(self):
        data, topic = motion(), "/joint_states"
        stamps = EPOCH + np.round(data["time"] * 1e9).astype(np.int64)
        columns = {f"{topic}:header.stamp": stamps, f"{topic}:log_time": stamps + 1000}
        for signal, name in (("q", "position"), ("v", "velocity"), ("u", "effort")):
            columns |= {f"{topic}:{name}.{joint}": data[signal][:, i] for i, joint in enumerate(JOINTS)}
        return columns


class TestRos1Bag(Bags):
    def write(self, folder):
        return log_files.write_bag1(folder / "log.bag", motion())


class TestRos2Folder(Bags):
    def write(self, folder):
        return log_files.write_bag2(folder / "log", motion())

    def truncated(self, path):
        return None


class TestRos2FolderOfSqlite(TestRos2Folder):
    def write(self, folder):
        return log_files.write_bag2(folder / "log", motion(), "sqlite3")

    def truncated(self, path):
        return next(path.glob("*.db3"))


class TestCompressedMcap(TestRos2Folder):
    def write(self, folder):
        return log_files.write_bag2(folder / "log", motion(), compressed="STORAGE")


class TestTopicWithTwoPublishers(TestRos2Folder):
    def write(self, folder):
        return log_files.write_bag2(folder / "log", motion(), gripper=True)

    def test_messages_of_the_other_are_counted(self, source):
        source.read(["/joint_states:position.elbow"])
        assert source.notes()[0].endswith(": 67")


class TestAnyMessage(TestRos2Folder):
    def expected(self):
        row = np.arange(200.0)
        columns = {"force.x": row, "force.y": np.full(200, 0.5), "torque.z": row**2}
        return {f"/wrench:wrench.{name}": values for name, values in columns.items()}


def test_sensors_of_other_topics_are_vectors_of_their_messages(tmp_path):
    pytest.importorskip("rosbags")
    own = ("/wrench:wrench.force",)
    mapping = ColumnMapping(force={"one": own, "imu:two@0,0,0.1": own}, unit={"imu": ("g",)})
    log = import_recordings([log_files.write_bag2(tmp_path / "log", motion())], mapping, model=model("continuous"))
    np.testing.assert_allclose(log.measured["force.one"][7], [7.0, 0.5, -1.0])
    np.testing.assert_allclose(log.measured["imu.two@0,0,0.1"][7], 9.80665 * np.array([7.0, 0.5, -1.0]))


def test_no_thread_of_pyarrow_waits_for_python(tmp_path, monkeypatch):
    """It would crash at the end of Python: in a stream of Python's, or in a handler of rows."""
    own, given = tables.arrow_csv.read_csv, []
    monkeypatch.setattr(tables.arrow_csv, "read_csv", lambda *all: (given.append(all), own(*all))[1])
    open_source(log_files.write_text(tmp_path / "log.csv", table(motion()))).read(["time"])
    assert [(isinstance(source, pa.NativeFile), reads.use_threads) for source, reads, *_ in given] == [(True, False)]


def test_columns_of_several_topics_are_refused(tmp_path):
    pytest.importorskip("rosbags")
    source = open_source(log_files.write_bag2(tmp_path / "log", motion(10)))
    with pytest.raises(InvalidInput, match="topics /joint_states, /wrench"):
        source.read(["/joint_states:log_time", "/wrench:log_time"])


def test_a_name_of_a_column_that_is_too_long_is_refused(tmp_path):
    (tmp_path / "log.csv").write_text(f"time,{'n' * 200_000}\n0,1\n")
    with pytest.raises(FileFormatError, match=r"log\.csv cannot be read as text .*field limit"):
        open_source(tmp_path / "log.csv")


def test_options_of_other_formats_are_refused(tmp_path):
    with pytest.raises(InvalidInput, match="`headerless` means nothing to"):
        open_source(log_files.write_parquet(tmp_path / "log.parquet", table(motion(10))), headerless=7)
    with pytest.raises(InvalidInput, match="means nothing to"):
        open_source(log_files.write_text(tmp_path / "log.csv", table(motion(10))), within="run1")


def test_a_dataset_of_our_own_is_not_a_log(tmp_path):
    from tests.posterior.arm import arm_data

    arm_data(20, seed=0).save(tmp_path / "arm.h5")
    with pytest.raises(FileFormatError, match="a dataset of forcegp already"):
        open_source(tmp_path / "arm.h5")


def test_a_great_number_of_columns_is_compared_once():
    require_distinct(Path("log.csv"), [f"c{k}" for k in range(200_000)])
