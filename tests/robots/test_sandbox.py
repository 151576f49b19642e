"""Robot files that attack their reader: each is one line, within limits, and reads nothing outside of its folder."""

import os

import pytest

from forcegp import Robot, sandbox
from forcegp.errors import RobotModelError

BODY = '<body name="a"><joint/><geom size=".1"/></body>'
BODIES = '<body><geom size=".1"/></body>' * 30
SCENE = "<mujoco>{}<worldbody>{}</worldbody></mujoco>"
SUB = '<asset><model name="s" file="{}"/></asset>'
ATTACH = '<attach model="s" body="a" prefix="p"/>'


def copies(*counts, inside=BODY):
    return "".join(f'<replicate count="{n}" offset="1 0 0">' for n in counts) + inside + "</replicate>" * len(counts)


INCLUDES = "".join(f'<include file="part_{k}.xml"/>' for k in range(80))
ATTACKS = {
    "names itself": (SCENE.format('<include file="robot.xml"/>', BODY), {}, "names this file again"),
    "is its own model": (SCENE.format(SUB.format("robot.xml"), ATTACH), {}, "names this file again"),
    "a circle": (
        SCENE.format(SUB.format("s.xml"), ATTACH), {"s.xml": SCENE.format(SUB.format("s.xml"), BODY)}, "again"),
    "copies": (SCENE.format("", copies(9999, 9999, 9999)), {}, "or needed more than 1 s or 300 MiB"),
    "copies of a model": (
        SCENE.format(SUB.format("s.xml"), ATTACH),
        {"s.xml": SCENE.format("", f'<body name="a">{copies(1000, 1000, 1000, inside=BODIES)}</body>')},
        "or needed more than 1 s or 300 MiB"),
    "many copies": (SCENE.format("", copies(400, 499)), {}, "or needed more than 1 s or 300 MiB"),
    "copies of a file": (
        SCENE.format("", copies(300, 300, inside='<include file="part.xml"/>')),
        {"part.xml": f"<mujoco>{BODY}</mujoco>"}, "or needed more than 1 s or 300 MiB"),
    "many files": (
        SCENE.format("", INCLUDES), {f"part_{k}.xml": f"<mujoco>{BODIES}</mujoco>" for k in range(80)},
        "nbody is 2401, more than the 2000"),
    "keys": (SCENE.format('<size nkey="2000000000"/>', BODY), {}, ""),
    "points": (
        SCENE.format('<asset><mesh name="m" builtin="supersphere" params="20000 1 1"/></asset>', BODY), {},
        "or needed more than 1 s or 300 MiB"),
    "depth": (SCENE.format("", "<body>" * 9000 + "</body>" * 9000), {}, "too deep"),
    "a file above": (SCENE.format('<include file="../secret.xml"/>', BODY), {}, "not below the folder"),
    "a model above": (SCENE.format(SUB.format("../secret.xml"), ATTACH), {}, "not below the folder"),
    "a file by backslashes": (SCENE.format('<include file="..\\secret.xml"/>', BODY), {}, "not below the folder"),
    "a mesh above": (
        SCENE.format('<compiler meshdir=".."/><asset><mesh name="m" file="m.stl"/></asset>',
        BODY.replace('size=".1"', 'type="mesh" mesh="m"')), {}, "not below the folder"),
    "a pipe": (SCENE.format("", '<flexcomp name="f" type="mesh" file="pipe.stl"/>' + BODY), {}, "a pipe or device"),
    "a grid above": (
        SCENE.format("", '<flexcomp name="f" type="mesh" file="../secret.obj"/>' + BODY), {}, "not below the folder"),
}  # fmt: skip


SLOW = "copies of a model", "many copies", "copies of a file"  # each at its limit, as other copies are


@pytest.mark.parametrize("attack", [pytest.param(k, marks=[pytest.mark.nightly] * (k in SLOW)) for k in ATTACKS])
def test_files_of_mujoco_cost_no_more_than_their_limits_and_read_only_their_folder(attack, tmp_path, monkeypatch):
    text, beside, message = ATTACKS[attack]
    monkeypatch.setattr(sandbox, "SECONDS", 1 if "more than 1 s" in message else 30)  # a busy machine is slow
    monkeypatch.setattr(sandbox, "MEMORY", 300 << 20)
    (folder := tmp_path / "robot").mkdir()
    (tmp_path / "secret.xml").write_text(f"<mujoco>{BODY}</mujoco>")
    os.mkfifo(folder / "pipe.stl")
    for name, content in {"robot.xml": text, **beside}.items():
        (folder / name).write_text(content)
    if not message:
        assert Robot.from_file(folder / "robot.xml").nv == 1
        return
    with pytest.raises(RobotModelError, match=message) as caught:
        Robot.from_file(folder / "robot.xml")
    assert "\n" not in str(caught.value)


def test_links_and_absolute_names_lead_nowhere_else(tmp_path):
    (folder := tmp_path / "robot").mkdir()
    (secret := tmp_path / "secret.xml").write_text(f"<mujoco>{BODY}</mujoco>")
    (folder / "link.xml").symlink_to(secret)
    for name in ("link.xml", str(secret)):
        (folder / "robot.xml").write_text(SCENE.format("", f'<include file="{name}"/>'))
        with pytest.raises(RobotModelError, match="not below the folder"):
            Robot.from_file(folder / "robot.xml")
    linked = tmp_path / "installed"  # as ROS installs: every file is a link to one folder
    linked.mkdir()
    parts = {"scene.xml": SCENE.format("", '<include file="part.xml"/>'), "part.xml": f"<mujoco>{BODY}</mujoco>"}
    for name, content in parts.items():
        (folder / name).write_text(content)
        (linked / name).symlink_to(folder / name)
    assert Robot.from_file(linked / "scene.xml").nv == 1


MACRO = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="r"><xacro:property name="m" value="${%s}"/>'
PARTS = """<link name="base"/><joint name="j" type="revolute"><parent link="base"/><child link="arm"/></joint>
<link name="arm"><inertial><mass value="${m['mass']}"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
EXPRESSIONS = {
    "xacro.load_yaml('../secret.yaml')": "only read below its folder",
    "xacro.load_yaml('/etc/hostname')": "only read below its folder",
    "xacro.load_yaml('pipe')": "only read below its folder",
    "10**10**10": "or needed more than 2 s",
    "[0] * 10**12": "could not expand it|or needed more",
}


@pytest.mark.parametrize(
    "expression", [pytest.param(k, marks=[pytest.mark.nightly] * ("**10*" in k)) for k in EXPRESSIONS]
)
def test_macros_read_below_their_folder_within_limits(expression, tmp_path, monkeypatch):
    pytest.importorskip("xacro")
    monkeypatch.setattr(sandbox, "SECONDS", 2)
    monkeypatch.syspath_prepend(tmp_path)  # as `python -m` does with the current folder
    (folder := tmp_path / "robot").mkdir()
    os.mkfifo(folder / "pipe")
    for name in ("secret.yaml", "robot/own.yaml"):
        (tmp_path / name).write_text("mass: 2.0")
    (folder / "arm.xacro").write_text(MACRO % "xacro.load_yaml('own.yaml')" + PARTS)
    assert Robot.from_file(folder / "arm.xacro").link("arm").mass == 2.0
    (folder / "arm.xacro").write_text(MACRO % expression + PARTS)
    with pytest.raises(RobotModelError, match=EXPRESSIONS[expression]) as caught:
        Robot.from_file(folder / "arm.xacro")
    assert "\n" not in str(caught.value)
