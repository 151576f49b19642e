"""Identified inertials go back into the URDF text; nothing else in it changes."""

import re

import numpy as np
import pytest
import torch
from tests.robots.pinocchio_oracle import Oracle
from tests.robots.robot_models import MODELS, TREE, loaded

from forcegp.errors import UnknownJoint
from forcegp.robots import Robot
from forcegp.robots.urdf_file import replace_dynamics


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


def without_inertial(text: str, link: str) -> str:
    head, tail = re.split(rf"(?=<link name=.{link}.)", text, maxsplit=1)
    return head + re.sub("<inertial>.*?</inertial>", "<inertial>...</inertial>", tail, count=1, flags=re.DOTALL)


def test_everything_else_stays_byte_for_byte():
    text = TREE.replace('<link name="body">', "<!-- <link name=\"body\"> --><link  name='body'>").replace(
        "</robot>", '<gazebo reference="body"><link name="body"><inertial/></link></gazebo><!-- Größe --></robot>\n\n'
    )
    robot = Robot.from_urdf_text(text)
    written = loaded(robot, "body").urdf_text
    assert written != text
    assert without_inertial(written.replace("link  name", "link name"), "body") == without_inertial(
        text.replace("link  name", "link name"), "body"
    )
    # the other way round: only the last link's own element differs
    start = text.index("<inertial>", text.index("link  name"))
    assert written[:start] == text[:start]
    assert written.endswith(text[text.index("</inertial>", start) :])


JOINT = """<robot name="r"><link name="a"/><link name="b"/>
  <joint name="other" type="fixed"><dynamics damping="9"/></joint>
  <joint name="one" type="revolute">%s
    <parent link="a"/>
  </joint>
</robot>
"""


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("", '\n    <dynamics damping="0.1" friction="0.25"/>'),
        ('<dynamics friction="1"/>', '<dynamics damping="0.1" friction="0.25"/>'),
        ('<dynamics damping = \'3\' friction="1" x="7"/>', '<dynamics damping="0.1" friction="0.25" x="7"/>'),
    ],
)
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_dynamics_of_a_joint_are_replaced_or_added_and_nothing_else_changes(before, after, newline):
    text, expected = ((JOINT % element).replace("\n", newline) for element in (before, after))
    assert replace_dynamics(text, "one", {"damping": 0.1, "friction": 0.25}, source="a test") == expected
    with pytest.raises(UnknownJoint, match="a test: no joint 'two'"):
        replace_dynamics(text, "two", {"damping": 0.1}, source="a test")
