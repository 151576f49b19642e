"""Names that mean something to a terminal, a figure or a spreadsheet are shown as they are."""

import csv

import numpy as np
import pytest

from forcegp import Robot
from forcegp.cli.fleet import table_of
from forcegp.control.informative_motions import excitation
from forcegp.errors import printable
from forcegp.scores.figures import style

NAMES = "[/red],b", "$\\frac{$", "=arm[v2]\x9b31m\u202e"
LINK = """<link name="l{}"><inertial><mass value="1"/><origin xyz="0.1 0 0"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{}" type="revolute"><parent link="{}"/><child link="l{}"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="9" velocity="3"/></joint>"""


@pytest.fixture
def urdf():
    parents = ("base", *(f"l{name}" for name in NAMES))
    parts = (LINK.format(name, name, parent, name) for name, parent in zip(NAMES, parents, strict=False))
    return '<robot name="[/b]$_{"><link name="base"/>' + "".join(parts) + "</robot>"


def test_in_a_terminal(forcegp, urdf, tmp_path):
    (tmp_path / "arm.urdf").write_text(urdf, encoding="utf-8")
    done = forcegp("robot", "arm.urdf", folder=tmp_path).ok()
    for name in NAMES:
        assert printable(name) in done.stdout
    assert "\x9b" not in done.stdout
    assert "\u202e" not in done.stdout
    refused = forcegp("robot", "\x1b[31mno.urdf", folder=tmp_path)
    assert (refused.returncode, "\x1b" in refused.stderr, "\\x1b[31mno" in refused.stderr) == (2, False, True)
    assert len(printable("a" * 10**7)) < 5000
    assert printable("größe 关节\n\t🦾") == "größe 关节\n\t🦾"


def test_in_a_figure():
    figure = style.new_figure(2, 2)
    axes = figure.subplots()
    axes.plot([1, 2], label="$\\frac{$")
    axes.legend()
    axes.set_xticks([0, 1], ["$_{", "b"])
    style.quiet(axes, title="$\\frac{$", x="$a^{")
    assert len(style.Picture("x", "", figure).png) > 100


def test_in_tables(urdf, tmp_path):
    excitation(Robot.from_urdf_text(urdf), seconds=4.0, seed=0, motions=3).save_csv(tmp_path / "x.csv")
    with (tmp_path / "x.csv").open(encoding="utf-8", newline="") as file:
        header, first, *_ = csv.reader(file)
    assert header == ["t", *(f"{what}_{name}" for what in "qvau" for name in NAMES)]
    assert len(first) == len(header)
    assert np.isfinite([float(x) for x in first]).all()
    row = {"log": "=cmd|x", "folder": "f", "error": "", "cpu_seconds": 1.0, "warnings": [], "numbers": {"a": "-2+3"}}
    assert table_of([row]).splitlines()[1] == "'=cmd|x,f,,1.0,0,'-2+3"
