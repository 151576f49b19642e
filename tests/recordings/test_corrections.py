"""Corrections of a mapping, and mappings as words of a command line."""

import numpy as np
import pytest
from tests.checks.corruptions import two_links

from forcegp.cli.main import parse_arguments
from forcegp.cli.terminal import Terminal
from forcegp.model import Model
from forcegp.recordings import ColumnMapping, import_recordings

JOINTS = ("pan", "lift", "bend")
COLUMNS = {"q": ["q1", "q2", "q3"], "u": ["a", "b", "c"]}


def test_units_replace_and_signs_multiply():
    mapping = ColumnMapping(q=("q{1..3}",), unit={"q": ("deg",), "time": ("ms",)}, sign={"u": (1.0, -1.0, 1.0)})
    found = mapping.corrected_by(
        {"unit": {"q": ("rad", "rad", "rad")}, "sign": {"u": (-1.0, -1.0, 1.0), "q": (1.0, 1.0, -1.0)}}, JOINTS, COLUMNS
    )
    assert found.unit == {"q": ("rad",), "time": ("ms",)}
    kinds = {"q": ("mm", "deg", "deg"), "u": ("kN", "kNm"), "v": ("mm/s", "rpm", "rad/s")}
    assert mapping.corrected_by({"unit": kinds}, JOINTS, COLUMNS).unit == mapping.unit | kinds | {"q": ("mm", "deg")}
    assert found.sign == {"u": (-1.0, 1.0, 1.0), "q": (1.0, 1.0, -1.0)}
    assert found.q == mapping.q


def test_orientation_and_axes_of_a_base_replace():
    mapping = ColumnMapping(axes={"v": ("world",)}, ned=True)
    found = mapping.corrected_by({"orientation": {"q": ("wxyz",)}, "axes": {"a": ("imu",)}}, JOINTS, COLUMNS)
    assert (found.orientation, found.axes, found.ned) == ("wxyz", {"v": ("world",), "a": ("imu",)}, True)
    assert found.q == ("q1", "q2", "q3")
    by_name = ColumnMapping().corrected_by({"orientation": {"q": ("wxyz",)}}, ("pan", "lift", "bend"), COLUMNS)
    assert by_name.q == ("q1", "q2", "q3")
    words = parse_arguments(["import", "log.csv", *found.flags(), "--out", "o.h5"])
    words = words.columns
    assert (words.orientation, words.axes, words.ned) == ("wxyz", "v=world,a=imu", True)


def test_an_order_names_the_columns_that_were_read():
    found = ColumnMapping().corrected_by({"order": {"u": (1, 0, 2), "v": (1, 0, 2)}}, JOINTS, COLUMNS)
    assert found.u == ("b", "a", "c")
    assert found.v is None  # which the log does not have


def test_a_mix_is_read_as_sums_of_the_signed_joints(tmp_path):
    names, robot, weights = ["q1_deg", "q 2_deg", "a_Nm", "b_Nm"], two_links(), np.array([[1.0, 0.0], [-1.0, 1.0]])
    rows = np.c_[np.arange(40) / 100, np.sin(np.arange(40)[:, None] * [0.1, 0.13, 0.2, 0.3])]
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header=",".join(["t", *names]), comments="")
    mapping = ColumnMapping(time="t", q=tuple(names[:2]), u=tuple(names[2:]), sign={"q": (1.0, -1.0)})
    mix = {"q": tuple(weights.tolist()), "u": ((1.0, 0.5), (0.0, 1.0))}
    found = mapping.corrected_by({"mix": mix}, robot.joint_names, {"q": names[:2], "u": names[2:]})
    assert (found.q, found.u) == (("q1_deg", "q1_deg+`q 2_deg`"), ("a_Nm+0.5*b_Nm", "b_Nm"))
    before, after = (import_recordings([tmp_path / "log.csv"], each, model=Model(robot)) for each in (mapping, found))
    assert np.allclose(after.q, before.q @ weights.T, atol=1e-14)
    assert np.allclose(after.u, before.u @ np.array(mix["u"]).T, atol=1e-14)


@pytest.mark.parametrize(
    "mapping",
    [
        ColumnMapping(time="t", q=("pos{1..3}",), u=("tau{1..3}",)),
        ColumnMapping(
            step=0.004,
            q=("q1", "q2", "q3"),
            u=("0",),
            joints=JOINTS,
            unit={"q": ("deg", "deg", "rad"), "time": ("ms",)},
            sign={"u": (1.0, -1.0, 1.0), "q": (-1.0,)},
        ),
        ColumnMapping(time="file:c1", q=("a",), u=("b",), headerless=(1, 7), side_by_side=True, episode="number"),
    ],
)
def test_flags_state_the_mapping(mapping):
    command = parse_arguments(["import", "log.csv", *mapping.flags(), "--out", "log.h5"])
    assert command.columns.mapped([], Terminal(json=True)) == mapping
