"""Names, units, combinations and flags: what is understood, and what is refused; and files of options."""

import string

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.goldens.compare import assert_unchanged
from tests.recordings.log_files import JOINTS, motion, table, write_text

from forcegp import Model, Robot
from forcegp.cli.main import parse_arguments
from forcegp.cli.terminal import Terminal
from forcegp.errors import FileFormatError, InvalidInput
from forcegp.recordings import ColumnMapping, beside, by_quantity, listed, mapping, open_source, read_mapping
from forcegp.recordings.mapping import parse_expression
from forcegp.recordings.signal_plan import signal_plan

KNOWN = ("time", "step", "q", "u", "unit", "sign", "axes", "headerless", "side_by_side", "joints", "ned")
TEXT = """
side_by_side: true
step: 0.0002
joints: [one, two]
q: ["0.031 * `pos:Joint 1`", "0.02 * `pos:Joint 2` - pi/2"]
u: ["32 * a", 0]
unit: {time: ms, q: deg}
sign: {u: [1, -1]}
headerless: [2, 2]
axes:
"""
COLUMNS = ("theta1", "theta2", "theta", "a-b", "a", "b", "/js:position.j1", "x[0]", "1e3")
VALUES = {name: np.array([1.0 + k, 0.5 * k]) for k, name in enumerate(COLUMNS)}
WEIGHTS = st.floats(-1e3, 1e3).map(lambda weight: round(weight, 6))


def mapped(*words):
    """The mapping of a command line with these words."""
    return parse_arguments(["import", "log.csv", *words, "--out", "o.h5"]).columns.mapped([], Terminal(json=True))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("theta1", lambda x: x["theta1"]),
        ("2*theta1/4 - 1e-3*theta2", lambda x: x["theta1"] / 2 - x["theta2"] / 1000),
        ("2*(theta1 - (theta2 + 1))", lambda x: 2 * x["theta1"] - 2 * x["theta2"] - 2),
        ("pi/2 - theta", lambda x: np.pi / 2 - x["theta"]), ("a-b", lambda x: x["a-b"]),
        ("a - b", lambda x: x["a"] - x["b"]), ("`a-b` - a", lambda x: x["a-b"] - x["a"]),
        ("/js:position.j1 - x[0]", lambda x: x["/js:position.j1"] - x["x[0]"]), ("1e3", lambda x: x["1e3"]),
        ("-.5e1", lambda x: np.full(2, -5.0)),
        ("20*(a - theta1) - 1.5*b*theta", lambda x: 20 * (x["a"] - x["theta1"]) - 1.5 * x["b"] * x["theta"]),
    ],
)  # fmt: skip
def test_combinations(text, value):
    found = parse_expression(text, COLUMNS, "log.csv")
    np.testing.assert_allclose(found.value(VALUES, 2), value(VALUES), rtol=1e-15)
    assert found.is_column == (text in COLUMNS)


def test_slopes_are_those_of_the_columns():
    found = parse_expression("2*theta1 - theta2/4 + 3", (*COLUMNS, ""), "log")
    assert found.weights == {"theta1": 2.0, "theta2": -0.25}


@given(st.text(alphabet=string.printable, max_size=30))
def test_any_text_is_a_combination_or_refused(text):
    try:
        found = parse_expression(text, COLUMNS, "log.csv")
    except InvalidInput:
        return
    assert set(found.weights) <= set(COLUMNS)


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
        ("pos{1..3}", ["pos1", "pos2", "pos3"]), ("pos{2..1}", ["pos2", "pos1"]),
        ("q{09..11}", ["q09", "q10", "q11"]), ("{left,right}_{1..2}", ["left_1", "left_2", "right_1", "right_2"]),
        ("pos.{joints}", ["pos.shoulder", "pos.elbow"]), ("plain", ["plain"]),
    ],
)  # fmt: skip
def test_patterns(pattern, names):
    assert mapping.expanded(pattern, JOINTS) == names


@pytest.mark.parametrize(
    ("pattern", "texts"),
    [
        ("2*(d{1..2}-q{1..2})", ["2*(d1-q1)", "2*(d2-q2)"]),
        ("{.5,3}*effort.{joints}", [".5*effort.shoulder", "3*effort.elbow"]),
        ("2*a{1..2}_{1..2}", ["2*a1_1", "2*a1_2", "2*a2_1", "2*a2_2"]),
        ("a-{1..2}-{1..2}", ["a-1-1", "a-1-2", "a-2-1", "a-2-2"]),
        ("{1..2}*a{1..3}", ["1*a1", "1*a2", "1*a3", "2*a1", "2*a2", "2*a3"]),
    ],
)
def test_braces_of_a_combination_go_on_together(pattern, texts):
    assert mapping.expanded(pattern, JOINTS, {"a-1-1"}) == texts


def test_lists_are_split_at_the_commas_that_separate():
    assert listed("q{1,2}, `a,b` - c , x[0]") == ["q{1,2}", "`a,b` - c", "x[0]"]
    with pytest.raises(InvalidInput, match="empty place"):
        listed("a,,b")


@pytest.mark.parametrize(
    ("quantity", "name", "given", "si"),
    [
        ("q", "deg", 180.0, np.pi), ("v", "rpm", 60.0, 2 * np.pi), ("u", "mNm", 3.0, 3e-3),
        ("a", "deg/s²", 180.0, np.pi), ("a", "deg/s^2", 180.0, np.pi), ("time", "us", 5.0, 5e-6),
    ],
)  # fmt: skip
def test_units(quantity, name, given, si):
    np.testing.assert_allclose(mapping.log_unit(quantity, name).in_si(np.array([given])), si, rtol=1e-15)
    assert (
        mapping.named_unit(quantity, f"q1 [{name}]")
        == mapping.named_unit(quantity, f"q1 ({name})")
        == mapping.log_unit(quantity, name).name
    )
    assert [mapping.named_unit("q", each) for each in ("q_deg", "q[1]", "q_m", "q_hand", "mm")] == ["deg", *[None] * 4]


READERS = {
    "combination": lambda text: parse_expression(text, COLUMNS, "log.csv"),
    "pattern": lambda text: mapping.expanded(text, JOINTS),
    "flags": lambda text: mapped(*text.split()),
}
MEANINGLESS = {
    "combination": [
        *("", "theta1 theta2", "1/theta1", "theta1/0", "theta3", "theta1**1", "0x1", "1j", "`a", "a" + "+a" * 400),
        *("theta1 +", "__import__('os')", "theta1; 1", "1e999", "abs(a)", "theta1x", "9" * 5000, "(" * 5000),
    ],
    "pattern": ["a{1..}", "a{", "a}", "a{b}", "a{}", "a{1..99999}", "{0..99}{0..99}"],
    "flags": [
        "--unit deg", "--unit q=metres", "--unit x=m", "--sign q=2", "--sign q=0", "--sign q=x", "--headerless seven",
        "--step -1", "--time t --step 1", "--unit q=", "--unit q=deg,q=rad", "--q a,,b",
    ],
}  # fmt: skip


@pytest.mark.parametrize(("kind", "text"), [(kind, text) for kind, texts in MEANINGLESS.items() for text in texts])
def test_texts_that_mean_nothing_are_refused(kind, text):
    with pytest.raises(InvalidInput):
        READERS[kind](text)


def test_short_forms_of_the_command_line():
    assert by_quantity("unit", "q=deg,m,time=ms") == {"q": ("deg", "m"), "time": ("ms",)}
    assert [*by_quantity("force", "imu:l@0,0,1=/imu:acceleration,foot=/w:force")] == ["imu:l@0,0,1", "foot"]
    for flag, signs in (("u=1,-1", {"u": (1.0, -1.0)}), ("1,-1", dict.fromkeys("qvua", (1.0, -1.0)))):
        assert mapped(f"--sign={flag}").sign == signs


def test_names_are_guessed_only_where_nothing_else_can_be_meant(tmp_path):
    columns = table(motion(10))
    source = open_source(write_text(tmp_path / "log.csv", columns))
    assert mapping.guessed_columns("q", JOINTS, source) == ("q_shoulder", "q_elbow")
    assert mapping.guessed_columns("q", ("shoulder_joint", "elbow_joint"), source) == ("q_shoulder", "q_elbow")
    assert mapping.guessed_columns("a", JOINTS, source) is None
    names = [f"{x}_{joint}" for x in ("goal_position", "Present_position", "actual_torque") for joint in JOINTS]
    present = open_source(write_text(tmp_path / "present.csv", {name: columns["time"] for name in names}))
    assert mapping.guessed_columns("q", JOINTS, present) == ("Present_position_shoulder", "Present_position_elbow")
    assert mapping.guessed_columns("u", JOINTS, present) == ("actual_torque_shoulder", "actual_torque_elbow")
    assert mapping.guessed_columns("q", ("shoulder", "wrist"), source) is None
    assert mapping.guessed_time(source, []) == "time"
    both = columns | {f"position_{joint}": columns[f"q_{joint}"] for joint in JOINTS} | {"t": columns["time"]}
    source = open_source(write_text(tmp_path / "both.csv", both))
    with pytest.raises(InvalidInput, match=r"q_shoulder, q_elbow .*position_shoulder, position_elbow"):
        mapping.guessed_columns("q", JOINTS, source)
    with pytest.raises(InvalidInput, match="time could be time or t"):
        mapping.guessed_time(source, [])
    of_messages = {f"/a:{x}.{joint}": columns["time"] for x in ("state.positions", "position") for joint in JOINTS}
    source = open_source(write_text(tmp_path / "messages.csv", of_messages))
    assert mapping.guessed_columns("q", JOINTS, source) == ("/a:position.shoulder", "/a:position.elbow")
    source = open_source(write_text(tmp_path / "plot.csv", {"__time": columns["time"], "q_elbow": columns["time"]}))
    assert mapping.guessed_time(source, []) == "__time"
    for signal, text in (text.split(":") for text in COUNTED):
        names, found = (part.split() for part in text.split(">"))
        counted = open_source(write_text(tmp_path / "counted.csv", dict.fromkeys(names, columns["time"])))
        assert mapping.counted_columns(signal, 2, counted) == (tuple(found) or None)
    one = open_source(write_text(tmp_path / "one.csv", dict.fromkeys(("q", "q_des"), columns["time"])))
    assert mapping.counted_columns("q", 1, one) == ("q",)


COUNTED = (
    "q: t q1 q2 q_des1 q_des2 dq1 dq2 > q1 q2", "q: q_1 q_2 > q_1 q_2", "q: q[1] q[0] > q[0] q[1]", "q: q1 q2 q3 >",
    "q: pos01_deg pos02_deg > pos01_deg pos02_deg", "u: tau1 tau2 u > tau1 tau2",
    "v: qvel[0] qvel[1] > qvel[0] qvel[1]", "v: qd[0] qd[1] a[0] > qd[0] qd[1]", "q: q0 q2 >", "q: des/q[0] des/q[1] >",
    "u: joint_torques1 joint_torques2 > joint_torques1 joint_torques2", "q: q1 q2 position[0] position[1] >",
)  # fmt: skip


BODY = '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'
JOINT = """<link name="{1}">{2}</link><joint name="{0}" type="continuous"><parent link="base"/><child link="{1}"/>
<axis xyz="0 1 0"/></joint>"""
ARM = (
    f'<robot name="arm"><link name="base">{BODY}</link>'
    f"{JOINT.format('shoulder', 'arm', BODY)}{JOINT.format('finger', 'tip', BODY)}</robot>"
)


def test_joints_without_a_column_are_named_with_what_holds_them(tmp_path):
    columns = {"time": np.arange(3.0), **dict.fromkeys(("pos_shoulder", "eff_shoulder", "v1"), np.zeros(3))}
    source = open_source(write_text(tmp_path / "log.csv", columns))
    with pytest.raises(InvalidInput, match=r"no columns for q .*named after finger \(`locked`"):
        signal_plan(ColumnMapping(), source, Model(Robot.from_urdf_text(ARM)))
    held = Model(Robot.from_urdf_text(ARM, locked={"finger": 0.0}))
    assert signal_plan(ColumnMapping(), source, held).guessed[1:] == ("u = eff_shoulder", "time = time")  # without v1


def test_units_are_what_they_were():
    assert_unchanged("recordings/units", {quantity: dict(units) for quantity, units in mapping.UNITS.items()})


def test_a_file_says_what_options_say_and_flags_come_first(tmp_path):
    path = tmp_path / "columns.yaml"
    path.write_text(TEXT)
    words = ["--side-by-side", "--step", "0.0002", "--joints", "one,two", "--u", "32 * a,0", "--headerless", "2,2"]
    words += ["--q", "0.031 * `pos:Joint 1`,0.02 * `pos:Joint 2` - pi/2", "--unit", "time=ms,q=deg", "--sign=u=1,-1"]
    by_flags, changed = mapped(*words), mapped("--mapping", str(path), "--u", "b,c")
    assert mapped("--mapping", str(path)) == by_flags
    assert (changed.u, changed.q) == (("b", "c"), by_flags.q)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("qq: a", "no key 'qq'"), ("q: a\nq: b", "'q' stands twice"), ("q: &x a\nu: *x", "aliases"),
        ("- q", "must be a mapping"), ("q: []", "q is"), ("q: [[a]]", "q is"), ("unit: {q: [true]}", "unit is"),
        ("q: !!python/object/apply:os.system [id]", "YAML"), ("step: soon", "step is 'soon'; give seconds"),
        ("ned: 'no'", "ned is 'no'; give true or false"), ("q: [a", "YAML"),
        ("q: " + "a" * 2**16, "larger than 64 KiB"),
    ],
)  # fmt: skip
def test_what_is_no_mapping_is_one_line_with_the_file(text, told, tmp_path):
    path = tmp_path / "columns.yaml"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=told) as raised:
        read_mapping(path, KNOWN)
    assert "columns.yaml" in str(raised.value)


def test_wrong_values_name_the_file(tmp_path):
    path = tmp_path / "columns.yaml"
    path.write_text("step: -1")
    with pytest.raises(InvalidInput, match=r"columns\.yaml and the flags: step is -1"):
        mapped("--mapping", str(path))
    for text, step in (("2", 2.0), ("1e-3", 0.001)):
        path.write_text(f"step: {text}\nned: true")
        found = mapped("--mapping", str(path))
        assert (found.step, found.ned) == (step, True)


def test_the_file_beside_a_log_is_found(tmp_path):
    assert beside(tmp_path / "run.csv.gz") is None
    (tmp_path / "forcegp.yaml").write_text("time: t")
    assert beside(tmp_path / "run.csv.gz") == tmp_path / "forcegp.yaml"
    (tmp_path / "run.yaml").write_text("time: t")
    assert beside(tmp_path / "run.csv.gz") == tmp_path / "run.yaml"
