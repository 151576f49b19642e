"""Identified inertials go back into the URDF text."""

from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from tests.robots.pinocchio_oracle import Oracle
from tests.robots.robot_models import MODELS, loaded

from forcegp.errors import UnknownJoint
from forcegp.robots import Robot
from forcegp.robots.urdf_file import replace_dynamics, replace_inertial


@pytest.mark.parametrize("model", MODELS)
def test_written_urdf_moves_as_the_numbers_say(model, tmp_path):
    robot = Robot.from_urdf_text(MODELS[model]())
    names = [n for n in robot.link_names if robot.link(n).joint is not None and robot.link(n).mass > 0]
    given = loaded(robot, *names)
    q, v = torch.tensor(np.random.default_rng(1).normal(size=(2, robot.nv)))
    path = tmp_path / "identified.urdf"
    text = given.to_urdf(path)
    assert path.read_text(encoding="utf-8") == text
    assert [entry.name for entry in tmp_path.iterdir()] == ["identified.urdf"]  # no temporary file left
    again = Robot.from_urdf(path)
    assert all(again.link(name) == given.link(name) != robot.link(name) for name in names)
    mass, bias = again.mass_matrix_and_bias(q, v)
    oracle = Oracle(text, again)
    np.testing.assert_allclose(oracle.mass_matrix(q.numpy()), mass, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(oracle.bias_forces(q.numpy(), v.numpy()), bias, rtol=1e-10, atol=1e-11)


TEXT = """<?xml version='1.0'?><!-- Größe --><robot name="r" xmlns:x="x"><link name="a"/><link  name='b'/>
  <!-- kept --><gazebo><joint name="one"/></gazebo><x:macro name="m"/>
  <joint name="one" type="revolute"><parent link="a"/><child link="b"/>%s</joint></robot>"""


@pytest.mark.parametrize("before", ["", '<dynamics friction="1"/>', "<dynamics damping = '3' x=\"7\"/>"])
def test_inertials_and_dynamics_are_replaced_or_added_and_the_rest_stays(before):
    written = replace_dynamics(TEXT % before, "one", {"damping": 0.1, "friction": 0.25}, source="a test")
    element = ElementTree.fromstring(written).find("joint/dynamics")
    assert {**element.attrib, "x": "7"} == {"damping": "0.1", "friction": "0.25", "x": "7"}
    assert all(
        part in written for part in ("<!-- Größe -->", "<!-- kept -->", "<x:macro", '<gazebo><joint name="one"/>')
    )
    for _ in range(2):
        written = replace_inertial(written, "b", 2.0, np.zeros(3), np.eye(3), source="a test")
    assert Robot.from_urdf_text(written).mass == 2.0
    with pytest.raises(UnknownJoint, match="a test: no joint 'two'"):
        replace_dynamics(TEXT % "", "two", {"damping": 0.1}, source="a test")
