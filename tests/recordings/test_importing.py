"""From files to a Dataset: what columns and stamps become."""

import dataclasses

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from tests.data.samples import model
from tests.recordings.broken_logs import urdf
from tests.recordings.log_files import JOINTS, STEP, motion, table, write_text

from forcegp import Model, Robot
from forcegp.data import Dataset, differentiate
from forcegp.errors import DatasetError, DataWarning, InvalidInput, MistakenUnit
from forcegp.recordings import ColumnMapping, ImportOptions, import_recordings

NAMES = ColumnMapping(time="time", q=("q_{joints}",), v=("v_{joints}",), u=("u_{joints}",), joints=JOINTS)


def imported(path, mapping, **options) -> Dataset:
    return import_recordings([path], mapping, model=model("continuous"), options=ImportOptions(**options))


def test_a_motion_is_its_dataset(tmp_path):
    data = motion()
    found = imported(write_text(tmp_path / "log.csv", table(data)), NAMES)
    for signal in "qvu":
        np.testing.assert_array_equal(getattr(found, signal), data[signal])
    np.testing.assert_array_equal(found.time, data["time"])
    np.testing.assert_array_equal(found.a, differentiate(data["v"], data["time"]))
    assert (found.joint_names, found.episodes) == (JOINTS, (0,))
    assert not list(tmp_path.glob(".*"))


def uneven(rows=1000, seed=3):
    """Motion at times that jitter by a fifth of a step."""
    data = motion(rows)
    time = data["time"] + STEP * np.random.default_rng(seed).uniform(-0.2, 0.2, rows)
    return {"time": time, **{name: CubicSpline(data["time"], data[name], axis=0)(time) for name in "qvu"}}


@pytest.mark.parametrize("logged", [("q", "u"), ("q", "v", "u")])
def test_even_times_and_differences_are_those_of_another_spline(tmp_path, logged):
    data = uneven()
    columns = {name: x for name, x in table(data).items() if name[0] in (*logged, "t")}
    mapping = dataclasses.replace(NAMES, v=NAMES.v if "v" in logged else None)
    found = imported(write_text(tmp_path / "log.csv", columns), mapping, rate=1.0 / STEP)
    time = STEP * np.arange(len(found))
    expected = {name: CubicSpline(data["time"] - data["time"][0], data[name])(time) for name in logged}
    expected.setdefault("v", differentiate(expected["q"], time))
    expected["a"] = differentiate(expected["v"], time)
    for name, values in expected.items():
        rounding = 1e-13 if name in logged else 1e-13 / STEP**2
        np.testing.assert_allclose(getattr(found, name), values, rtol=0, atol=rounding * np.abs(values).max())


def test_a_combination_that_is_not_finite_is_named_with_its_row(tmp_path):
    columns = table(motion()) | {"b": np.where(np.arange(200) == 7, -1.0, 1.0)}
    mapping = dataclasses.replace(NAMES, u=("u_shoulder/(1 + b)", "u_elbow"))
    with pytest.raises(DatasetError, match=r"'u_shoulder/\(1 \+ b\)' \(u of joint 'shoulder'\) is -?inf at row 7"):
        imported(write_text(tmp_path / "log.csv", columns), mapping)


def test_a_rate_that_is_asked_for_is_the_rate(tmp_path):
    path = write_text(tmp_path / "log.csv", table(motion()))
    np.testing.assert_allclose(np.diff(imported(path, NAMES, rate=1000.0).time), 1e-3, rtol=1e-9)
    with pytest.warns(DataWarning, match="below the 512 Hz of the log"):
        imported(path, NAMES, rate=100.0)


def test_gaps_split_and_repeated_stamps_are_dropped(tmp_path):
    data = motion()
    data["time"][100:] += 1.0
    data["time"][11] = data["time"][10]
    data["time"][197:] += 1.0  # three rows are no episode
    found = imported(write_text(tmp_path / "log.csv", table(data)), NAMES, rate="log")
    done = found.metadata["import"]["recordings"][0]
    assert (done["repeated_stamps_dropped"], done["rows_in_stretches_too_short"]) == (1, 3)
    assert len(done["gaps"]) == 2
    assert done["seconds"] == pytest.approx(data["time"][[99, 196]].sum() - data["time"][[0, 100]].sum())
    kept = np.r_[0:11, 12:197]
    np.testing.assert_array_equal(found.q, data["q"][kept])
    np.testing.assert_array_equal(found.episode, np.where(kept < 100, 0, 1))
    assert imported(tmp_path / "log.csv", NAMES, rate="log", gap=2.0).episodes == (0,)


def test_a_single_gap_of_ten_steps_is_bridged_and_one_more_is_not(tmp_path):
    for missing, episodes in ((9, 1), (10, 2)):
        rows = np.r_[0:100, 100 + missing : 200]
        data = {name: values[rows] for name, values in motion().items()}
        assert len(imported(write_text(tmp_path / "log.csv", table(data)), NAMES).episodes) == episodes


def test_start_and_end_count_from_the_first_row_of_each_episode(tmp_path):
    data = motion()
    columns, mapping = table(data) | {"run": np.repeat([4.0, 7.0], 100)}, dataclasses.replace(NAMES, episode="run")
    span = {"start": 10 * STEP, "end": 40 * STEP, "without": tuple(STEP * np.array([15.5, 20.5, 20.5, 27.5]))}
    found = imported(write_text(tmp_path / "log.csv", columns), mapping, **span)
    np.testing.assert_array_equal(found.q, data["q"][np.r_[10:16, 28:41, 110:116, 128:141]])
    assert [episode["number"] for episode in found.metadata["import"]["episodes"]] == [4, 4, 7, 7]


def test_wrapped_angles_are_continued_if_told_so(tmp_path):
    data = motion()
    data["q"] = 9.0 * data["time"][:, None] / data["time"][-1] + np.array([0.0, 1.0])
    path = write_text(tmp_path / "log.csv", table({**data, "q": (data["q"] + np.pi) % (2 * np.pi) - np.pi}))
    with pytest.raises(DatasetError, match="Add `unwrap`"):
        imported(path, NAMES)
    np.testing.assert_allclose(imported(path, NAMES, unwrap=True).q, data["q"], atol=1e-13)


def test_coupled_angles_units_signs_and_constants(tmp_path):
    data = motion()
    q = np.rad2deg(data["q"])
    columns = {"t": 1e3 * data["time"], "upper": q[:, 0], "lower": q.sum(axis=1)}
    how = {"joints": JOINTS, "unit": {"time": ("ms",), "q": ("deg",)}, "sign": {"q": (1.0, -1.0)}}
    mapping = ColumnMapping(time="t", q=("upper", "lower - upper - 90/pi"), u=("0",), **how)
    found = imported(write_text(tmp_path / "log.csv", columns), mapping)
    np.testing.assert_allclose(found.q[:, 0], data["q"][:, 0], atol=1e-14)
    np.testing.assert_allclose(found.q[:, 1], 0.5 - data["q"][:, 1], atol=1e-14)
    np.testing.assert_array_equal(found.u, 0.0)
    np.testing.assert_allclose(found.time, data["time"], atol=1e-15)
    np.testing.assert_array_equal(found.v, differentiate(found.q, found.time))


def test_joints_that_slide_are_in_metres(tmp_path):
    data = motion()
    mapping = dataclasses.replace(NAMES, unit={"q": ("rad", "mm"), "v": ("rad/s", "mm/s"), "u": ("Nm", "N")})
    path, rail = write_text(tmp_path / "log.csv", table(data)), model("prismatic")
    found = import_recordings([path], mapping, model=rail)
    assert found.units["q"] == ("rad", "m")
    np.testing.assert_array_equal(found.q[:, 1], data["q"][:, 1] / 1000)
    called = {"t_ms": 1e3 * data["time"], "p [°]": np.rad2deg(data["q"][:, 0]), "p (mm)": 1e3 * data["q"][:, 1]}
    path = write_text(tmp_path / "called.csv", called)
    mapping = ColumnMapping(q=("p [°]", "p (mm)"), u=("0",), time="t_ms")
    found = import_recordings([path], mapping, model=rail)
    np.testing.assert_allclose(found.q, data["q"], atol=1e-14)
    np.testing.assert_allclose(found.time, data["time"], atol=1e-14)
    assert found.metadata["import"]["guessed"] == ["unit q=deg,mm, as the log says", "unit time=ms, as the log says"]
    mapping = dataclasses.replace(mapping, unit={"q": ("deg", "m")})
    with pytest.raises(MistakenUnit, match="Then add `unit` q=deg,mm"):
        import_recordings([path], mapping, model=rail)
    mapping = dataclasses.replace(mapping, unit={"q": ("rad", "mm")})
    with pytest.raises(InvalidInput, match="q of joint 'elbow' is mm, but the joint turns"):
        imported(path, mapping)


@pytest.mark.parametrize("head", ["NAMES\nms,deg,deg", "[ms],[°],[°]\nNAMES", "NAMES\nms,deg,deg\ntop,arm,arm"])
def test_a_line_of_units_counts_as_units_in_names_do(tmp_path, head):
    path, time, q = tmp_path / "log.csv", 1e3 * motion()["time"], np.rad2deg(motion()["q"])
    names, rows = write_text(path, {"t": time, "q1": q[:, 0], "q2": q[:, 1]}).read_text().split("\n", 1)
    path.write_text(f"{head.replace('NAMES', names)}\n{rows}")
    found = imported(path, ColumnMapping(q=("log:q{1..2}",), u=("0",), time="log:t", side_by_side=True))
    np.testing.assert_allclose(found.q, np.deg2rad(q), atol=1e-14)
    assert found.metadata["import"]["guessed"] == ["unit q=deg, as the log says", "unit time=ms, as the log says"]
    notes = found.metadata["import"]["recordings"][0]["notes"]
    assert ["arm" in note for note in notes] == [True] * ("arm" in head)
    stated = ColumnMapping(q=("q1", "q2"), u=("0",), time="t", unit={"q": ("rad",)})
    np.testing.assert_array_equal(imported(path, stated).q, q)


@pytest.mark.parametrize(("share", "units"), [(0.15, "deg,rad"), (0.05, "deg")])
def test_a_joint_that_fits_its_limits_keeps_its_unit_if_it_moves(tmp_path, share, units):
    q = motion()["q"][:, 0]
    path = write_text(tmp_path / "log.csv", {"t": motion()["time"], "q_shoulder": np.rad2deg(q), "q_elbow": share * q})
    with pytest.raises(MistakenUnit, match=f"beyond its limits .* `unit` q={units}. "):
        import_recordings([path], ColumnMapping(u=("0",)), model=Model(Robot.from_urdf_text(urdf(*JOINTS))))


def test_files_side_by_side_are_one_recording(tmp_path):
    data = motion()
    for name, values in data.items():
        (tmp_path / f"run_{name}.txt").write_text("\n".join(repr(float(value)) for value in values.ravel()) + "\n")
    how = {"joints": JOINTS, "headerless": (1, 2, 2, 2), "side_by_side": True}
    mapping = ColumnMapping(time="run_time:c1", q=("run_q:c{1..2}",), v=("run_v",), u=("run_u",), **how)
    paths = [tmp_path / f"run_{name}.txt" for name in data]
    found = import_recordings(paths, mapping, model=model())
    for signal in "qvu":
        np.testing.assert_array_equal(getattr(found, signal), data[signal])
    assert len(found.metadata["import"]["files"]) == 4
    (tmp_path / "run_u.txt").write_text("1.0\n" * 20)
    with pytest.raises(Exception, match=r"run_time\.txt 200, .*run_u\.txt 10"):
        import_recordings(paths, mapping, model=model())


def test_stamps_in_nanoseconds_keep_their_last_digit(tmp_path):
    data = motion()
    stamps = 1_700_000_000_123_456_789 + np.round(data["time"] * 1e9).astype(np.int64)
    rows = zip(stamps, data["q"][:, 0].tolist(), strict=True)
    (tmp_path / "log.csv").write_text("\n".join(["stamp,q1,q2", *(f"{stamp},{q!r},{q!r}" for stamp, q in rows)]))
    mapping = ColumnMapping(time="stamp", q=("q{1..2}",), u=("0",), unit={"time": ("ns",)})
    np.testing.assert_array_equal(imported(tmp_path / "log.csv", mapping).time, data["time"])


def test_velocities_that_hold_no_number_are_derived_and_said(tmp_path):
    data = motion()
    for lacking in ([0, 1], [1]):
        columns = table(data) | {f"v_{JOINTS[joint]}": np.full(200, np.nan) for joint in lacking}
        found = imported(write_text(tmp_path / "log.csv", columns), NAMES, bad_rows="skip")
        expected = np.where(np.isin([0, 1], lacking), differentiate(data["q"], data["time"]), data["v"])
        np.testing.assert_allclose(found.v, expected, rtol=1e-12)
        done = found.metadata["import"]
        assert [f"every v of {', '.join(JOINTS[joint] for joint in lacking)} is missing" in note
                for note in done["recordings"][0]["notes"]] == [True]  # fmt: skip
        assert done["signals"]["v"] == ("" if len(lacking) == 2 else "logged and ") + "central differences of q"


def test_rows_that_lack_a_value_are_left_out_up_to_a_twentieth(tmp_path):
    data = motion()

    def log(*rows, names=("u_elbow",)):
        columns = {name: values.copy() for name, values in table(data).items()}
        for name in names:
            columns[name][list(rows)] = np.nan
        return write_text(tmp_path / "log.csv", columns)

    everything = [name for name in table(data) if name != "time"]
    for names, options in ((["u_elbow"], {"bad_rows": "skip"}), (everything, {}), (["time"], {"bad_rows": "skip"})):
        found = imported(log(0, 50, 51, names=names), NAMES, rate="log", **options)
        np.testing.assert_array_equal(found.q, np.delete(data["q"], [0, 50, 51], axis=0))
        done = found.metadata["import"]["recordings"][0]
        assert done["notes"] == ["rows left out because they lack a value: 3 of 200"]
        assert done["repeated_stamps_dropped"] == 0
    assert imported(log(*range(10, 20)), NAMES, bad_rows="skip").episodes == (0, 1)
    with pytest.raises(DatasetError, match=r"11 of 200 rows lack a value, .* 5% at most"):
        imported(log(*range(10, 21)), NAMES, bad_rows="skip")
    for names in (everything, ["u_elbow"]):
        with pytest.raises(DatasetError, match=r"is missing \(empty or NaN\) at row 10 .*`bad_rows` skip"):
            imported(log(*range(10, 21), names=names), NAMES)
