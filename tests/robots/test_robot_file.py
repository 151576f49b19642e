"""What lies beside a URDF, and what is expanded to one."""

import sys

import pytest
from tests.robots.robot_models import CHAIN
from tests.robots.test_urdf_errors import SMALL

from forcegp.errors import InvalidNumber, MalformedUrdf, MissingExtra, RobotFileWarning, UnknownJoint
from forcegp.robots import Robot


def test_rotor_inertias_are_written_beside_the_file_and_read_back(tmp_path):
    robot = Robot.from_urdf_text(CHAIN, armature={"spin": 0.1, "tilt": 1 / 3})
    path = tmp_path / "chain.urdf"
    with pytest.warns(RobotFileWarning, match=r"no element for rotor inertias \(spin, tilt\)"):
        text = robot.to_urdf(path)
    assert "<!-- rotor inertias (armature)" in text
    again = Robot.from_urdf(path)
    assert again.armature.equal(robot.armature)
    assert Robot.from_urdf(path, armature={"spin": 0.2}).armature.tolist() == [0.0, 0.2, 0.0, 0.0]
    with pytest.warns(RobotFileWarning):
        assert again.to_urdf(path) == text  # one comment, however often
    robot.with_armature([0.0] * 4).to_urdf(path)
    assert Robot.from_urdf(path).armature.tolist() == [0.0] * 4


def test_without_rotors_nothing_is_beside_the_file_and_nothing_in_it(tmp_path):
    assert Robot.from_urdf_text(CHAIN).to_urdf(tmp_path / "chain.urdf") == CHAIN
    assert [file.name for file in tmp_path.iterdir()] == ["chain.urdf"]


@pytest.mark.parametrize("text", ["", "[1]", '{"hinge": "heavy"}', '{"hinge": null}', "\ud800", "[" * 10**5])
def test_another_file_beside_is_refused(tmp_path, text):
    (tmp_path / "arm.urdf").write_text(SMALL)
    (tmp_path / "arm.armature.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(InvalidNumber, match=r"arm\.armature\.json: holds no rotor inertia per joint"):
        Robot.from_urdf(tmp_path / "arm.urdf")


def test_rotors_of_another_robot_are_refused(tmp_path):
    (tmp_path / "arm.urdf").write_text(SMALL)
    (tmp_path / "arm.armature.json").write_text('{"elbow": 1.0}')
    with pytest.raises(UnknownJoint, match="'elbow'"):
        Robot.from_urdf(tmp_path / "arm.urdf")


MACRO = SMALL.replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ').replace(
    '<mass value="2"/>', '<xacro:property name="m" value="${1 + 1}"/><mass value="${m}"/>'
)


def test_xacro_files_need_the_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "xacro", None)
    (tmp_path / "arm.xacro").write_text(MACRO)
    with pytest.raises(MissingExtra, match=r"arm\.xacro: .*pip install 'forcegp\[xacro\]'"):
        Robot.from_urdf(tmp_path / "arm.xacro")


@pytest.mark.parametrize("name", ["arm.xacro", "arm.urdf.xacro"])
def test_xacro_files_are_expanded(tmp_path, name):
    pytest.importorskip("xacro")
    (tmp_path / name).write_text(MACRO)
    assert Robot.from_urdf(tmp_path / name).link("arm").mass == 2.0
    (tmp_path / name).write_text(MACRO.replace("1 + 1", "1 / 0"))
    with pytest.raises(MalformedUrdf, match="xacro could not expand it"):
        Robot.from_urdf(tmp_path / name)
