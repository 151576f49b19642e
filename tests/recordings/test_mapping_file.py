"""Mapping files: their entries are the words of options, and nothing else is read from them."""

import pytest

from forcegp.cli.main import parse_arguments
from forcegp.cli.terminal import Terminal
from forcegp.errors import FileFormatError, InvalidInput
from forcegp.recordings import beside, read_mapping

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


def mapped(*words):
    """The mapping of a command line with these words."""
    return parse_arguments(["import", "log.csv", *words, "--out", "o.h5"]).columns.mapped([], Terminal(json=True))


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
