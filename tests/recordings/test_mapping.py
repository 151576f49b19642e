"""Names, units, combinations and mapping files: what is understood, and what is refused."""

import string

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.recordings.log_files import JOINTS, motion, table, write_text

from forcegp import Model, Robot
from forcegp.errors import FileFormatError, InvalidInput
from forcegp.recordings import ColumnMapping, mapping_text, open_source, read_mapping
from forcegp.recordings.column_names import expanded, guessed_columns, guessed_time, listed, parse_expression
from forcegp.recordings.mapping import by_quantity, log_unit, mapping_of
from forcegp.recordings.signal_plan import signal_plan

COLUMNS = ("theta1", "theta2", "theta", "a-b", "a", "b", "/js:position.j1", "x[0]", "1e3")


@pytest.mark.parametrize(
    ("text", "weights", "constant"),
    [
        ("theta1", {"theta1": 1.0}, 0.0),
        ("theta2 - theta1", {"theta2": 1.0, "theta1": -1.0}, 0.0),
        ("2*theta1/4 - 1e-3*theta2", {"theta1": 0.5, "theta2": -1e-3}, 0.0),
        ("2*(theta1 - (theta2 + 1))", {"theta1": 2.0, "theta2": -2.0}, -2.0),
        ("pi/2 - theta", {"theta": -1.0}, np.pi / 2),
        ("a-b", {"a-b": 1.0}, 0.0),
        ("a - b", {"a": 1.0, "b": -1.0}, 0.0),
        ("a-b - a", {"a-b": 1.0, "a": -1.0}, 0.0),
        ("/js:position.j1 - x[0]", {"/js:position.j1": 1.0, "x[0]": -1.0}, 0.0),
        ("theta1 - theta1 + 2", {}, 2.0),
        ("1e3", {"1e3": 1.0}, 0.0),
        ("-.5e1", {}, -5.0),
    ],
)
def test_linear_combinations(text, weights, constant):
    found = parse_expression(text, COLUMNS, "log.csv")
    assert dict(found.weights) == weights
    assert found.constant == constant


@pytest.mark.parametrize(
    "text",
    [
        *("", "theta1 theta2", "theta1*theta2", "1/theta1", "theta1/0", "theta3", "theta1**1", "0x1", "1j", "`a"),
        *("theta1 +", "__import__('os')", "theta1; 1", "1e999", "abs(a)", "theta1x"),
    ],
)
def test_what_is_no_linear_combination_is_refused(text):
    with pytest.raises(InvalidInput):
        parse_expression(text, COLUMNS, "log.csv")


@given(st.text(alphabet=string.printable, max_size=30))
def test_any_text_is_a_combination_or_refused(text):
    try:
        found = parse_expression(text, COLUMNS, "log.csv")
    except InvalidInput:
        return
    assert set(found.weights) <= set(COLUMNS)


WEIGHTS = st.floats(-1e3, 1e3).map(lambda weight: round(weight, 6))


@given(st.lists(st.tuples(st.sampled_from("abcd"), WEIGHTS), min_size=1), st.data())
def test_a_combination_has_the_value_of_its_terms(terms, data):
    columns = {name: np.array([data.draw(st.floats(-10, 10)), 1.0]) for name in "abcd"}
    text = " + ".join(f"{weight:.6f}*{name}" for name, weight in terms)
    expected = sum(weight * columns[name] for name, weight in terms)
    found = parse_expression(text, columns, "log").value(columns, 2)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        ("pos{1..3}", ["pos1", "pos2", "pos3"]),
        ("pos{2..1}", ["pos2", "pos1"]),
        ("q{09..11}", ["q09", "q10", "q11"]),
        ("{left,right}_{1..2}", ["left_1", "left_2", "right_1", "right_2"]),
        ("pos.{joints}", ["pos.shoulder", "pos.elbow"]),
        ("plain", ["plain"]),
    ],
)
def test_patterns(pattern, names):
    assert expanded(pattern, JOINTS) == names


@pytest.mark.parametrize("pattern", ["a{1..}", "a{", "a}", "a{b}", "a{}", "a{1..99999}", "{0..99}{0..99}"])
def test_patterns_that_mean_nothing(pattern):
    with pytest.raises(InvalidInput):
        expanded(pattern, JOINTS)


def test_lists_are_split_at_the_commas_that_separate():
    assert listed("q{1,2}, `a,b` - c , x[0]") == ["q{1,2}", "`a,b` - c", "x[0]"]
    with pytest.raises(InvalidInput, match="empty place"):
        listed("a,,b")


@pytest.mark.parametrize(
    ("quantity", "name", "given", "si"),
    [
        ("q", "deg", 180.0, np.pi),
        ("v", "rpm", 60.0, 2 * np.pi),
        ("u", "mNm", 3.0, 3e-3),
        ("a", "deg/s²", 180.0, np.pi),
        ("time", "us", 5.0, 5e-6),
    ],
)
def test_units(quantity, name, given, si):
    np.testing.assert_allclose(log_unit(quantity, name).in_si(np.array([given])), si, rtol=1e-15)


FULL = ColumnMapping(
    time="t",
    q=("a", "b - a"),
    v=("v{1..2}",),
    u=("0",),
    joints=JOINTS,
    unit={"q": ("deg",), "time": ("ms",)},
    sign={"q": (1.0, -1.0)},
    episode="run",
    episodes="piece*",
    headerless=(1, 7),
    delimiter=";",
    side_by_side=True,
)


def test_a_mapping_survives_its_file(tmp_path):
    for mapping in (
        FULL,
        ColumnMapping(q=("a,b",)),
        ColumnMapping(),
        ColumnMapping(step=0.001, q=("x",), joints=("only",)),
    ):
        (tmp_path / "m.yaml").write_text(mapping_text(mapping))
        if mapping == ColumnMapping():
            (tmp_path / "m.yaml").write_text("{}")
        assert read_mapping(tmp_path / "m.yaml") == mapping


def test_what_is_said_later_counts():
    changed = FULL.changed_by(ColumnMapping(step=0.01, unit={"u": ("mNm",)}, q=("c",)))
    assert (changed.time, changed.step, changed.q, changed.v) == (None, 0.01, ("c",), FULL.v)
    assert changed.unit == {"q": ("deg",), "time": ("ms",), "u": ("mNm",)}


@pytest.mark.parametrize(
    "content",
    [
        *("q: [a, {b: c}]", "unit: deg", "unit: {q: metres}", "unit: {x: m}", "sign: {q: 2}", "scale: {u: 2}"),
        *("sign: {q: 0}", "headerless: seven", "headerless: 0", "side_by_side: yes please", "step: fast"),
        *("step: -1", "time: t\nstep: 1", "joints: [a, a]", "q: &x [a]\nv: *x", "- q", "time: 3"),
        *("sign: {q: .inf}", "q: []", "sign: {q: true}"),
    ],
)
def test_mapping_files_that_mean_nothing_are_refused_by_name(tmp_path, content):
    (tmp_path / "m.yaml").write_text(content)
    with pytest.raises(FileFormatError, match=r"m\.yaml"):
        read_mapping(tmp_path / "m.yaml")


def test_short_forms_of_the_command_line():
    assert by_quantity("unit", "q=deg,m,time=ms") == {"q": ["deg", "m"], "time": ["ms"]}
    assert mapping_of({"sign": by_quantity("sign", "u=1,-1")}).sign == {"u": (1.0, -1.0)}
    assert mapping_of({"sign": ["1", "-1"]}).sign["q"] == (1.0, -1.0)
    for wrong in ("deg", "q=", "q=deg,q=rad"):
        with pytest.raises(InvalidInput):
            by_quantity("unit", wrong)


def test_names_are_guessed_only_where_nothing_else_can_be_meant(tmp_path):
    columns = table(motion(10))
    source = open_source(write_text(tmp_path / "log.csv", columns))
    assert guessed_columns("q", JOINTS, source) == ("q_shoulder", "q_elbow")
    assert guessed_columns("a", JOINTS, source) is None
    assert guessed_columns("q", ("shoulder", "wrist"), source) is None
    assert guessed_time(source, []) == "time"
    both = columns | {f"position_{joint}": columns[f"q_{joint}"] for joint in JOINTS} | {"t": columns["time"]}
    source = open_source(write_text(tmp_path / "both.csv", both))
    with pytest.raises(InvalidInput, match=r"q_shoulder, q_elbow .*position_shoulder, position_elbow"):
        guessed_columns("q", JOINTS, source)
    with pytest.raises(InvalidInput, match="time could be time or t"):
        guessed_time(source, [])


BODY = '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'
JOINT = """<link name="{1}">{2}</link><joint name="{0}" type="continuous"><parent link="base"/><child link="{1}"/>
<axis xyz="0 1 0"/></joint>"""
ARM = (
    f'<robot name="arm"><link name="base">{BODY}</link>'
    f"{JOINT.format('shoulder', 'arm', BODY)}{JOINT.format('finger', 'tip', BODY)}</robot>"
)


def test_joints_without_a_column_are_named_with_what_holds_them(tmp_path):
    columns = {"time": np.arange(3.0), "pos_shoulder": np.zeros(3), "eff_shoulder": np.zeros(3)}
    source = open_source(write_text(tmp_path / "log.csv", columns))
    with pytest.raises(InvalidInput, match=r"no columns for q .*named after finger \(`locked`"):
        signal_plan(ColumnMapping(), source, Model(Robot.from_urdf_text(ARM)))
    held = Model(Robot.from_urdf_text(ARM, locked={"finger": 0.0}))
    assert signal_plan(ColumnMapping(), source, held).guessed[1] == "u = eff_shoulder"  # as ROS abbreviates effort
