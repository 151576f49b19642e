"""`forcegp robot`, and the options that take a file as it is."""

import json

import pytest
from tests.robots.mjcf_models import OPEN_BARS
from tests.robots.robot_models import CHAIN
from tests.robots.test_base import MANY
from tests.robots.test_mimic import CHAIN_MIMICS, with_mimics

from forcegp import Model, Robot
from forcegp.cli.main import parse_arguments


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_text(with_mimics(CHAIN, CHAIN_MIMICS))
    return path


def test_the_tree_and_the_numbers_are_printed(forcegp, file):
    shown = forcegp("robot", file, "--armature", "spin=0.25")
    assert (shown.returncode, shown.stderr) == (0, "")
    assert "cart 4 kg  slide (prismatic = 0.4 tilt +0.1)" in shown.stdout
    assert "chain: 3 joints, 7.9 kg that move" in shown.stdout
    row = next(line for line in shown.stdout.splitlines() if line.strip().startswith("spin"))
    assert row.split() == ["spin", "–", "–", "–", "–", "0", "0", "0.25"]


def test_one_error_and_its_options_take_the_file(forcegp, file):
    file.write_text(MANY)
    options = forcegp("robot", file).refused().strip().rpartition(", or ")[2].removesuffix(".").split()
    assert options == ["--inertias", "nearest", "--lock", "slip=0", "--base", "floating"]
    taken = forcegp("robot", file, *options, "--json")
    assert taken.returncode == 0
    assert "FL_foot" in taken.stderr
    assert "is replaced by the nearest one" in taken.stderr
    (repaired,) = json.loads(taken.stdout)["repaired"]
    assert repaired in taken.stderr.replace("\n", " ")


def test_the_robot_is_not_overwritten(forcegp, file):
    out = file.with_suffix(".xml")
    assert forcegp("robot", file, "--out", out).returncode == 0
    assert Robot.from_file(out).joint_names == Robot.from_file(file).joint_names
    assert "add --overwrite" in forcegp("robot", file, "--out", out).stderr
    assert "over" in forcegp("robot", file, "--out", file, "--overwrite").stderr  # never the robot itself
    assert "no extension '.html'" in forcegp("robot", file, "--out", file.with_suffix(".html")).stderr


@pytest.mark.filterwarnings("ignore::forcegp.errors.RobotFileWarning")
def test_rotors_beside_a_file_are_not_lost_for_those_of_a_recording(tmp_path):
    recorded = Model(Robot.from_urdf_text(CHAIN))
    recorded.robot.with_armature({"spin": 0.3}).to_urdf(tmp_path / "identified.urdf")
    words = ["fit", "log.h5", "--out", "run", "--robot", str(tmp_path / "identified.urdf")]
    assert parse_arguments(words).robot.chosen(recorded).robot.armature.tolist() == [0.0, 0.3, 0.0, 0.0]
    words += ["--armature", "tilt=1"]
    assert parse_arguments(words).robot.chosen(recorded).robot.armature.tolist() == [0, 0, 0, 1]


def test_mjcf_is_written_by_extension(forcegp, tmp_path):
    (tmp_path / "open.xml").write_text(OPEN_BARS)
    shown = forcegp("robot", tmp_path / "open.xml", "--out", tmp_path / "same.mjcf")
    assert (shown.returncode, "warning" in shown.stderr) == (0, False)
    again = json.loads(forcegp("robot", tmp_path / "same.mjcf", "--out", tmp_path / "same.urdf", "--json").stdout)
    assert [joint["name"] for joint in again["joints"]] == ["crank", "coupler", "rocker"]
    assert again["written"] == str(tmp_path / "same.urdf")
    assert Robot.from_file(tmp_path / "same.urdf").nv == 3
