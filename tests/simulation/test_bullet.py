import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import torch

from forcegp.errors import MissingExtra, SimulationError
from forcegp.robots import Robot
from forcegp.simulation.kuka_surface import TOOL_LINK, kuka_urdf
from forcegp.simulation.scenarios import KukaSurfaceConfig
from forcegp.simulation.trajectory import BulletArm

pytest.importorskip("pybullet")

POINT = (0.01, -0.02, 0.1)
STEP = 1.0 / 240.0


def urdf(**constants: object) -> str:
    return kuka_urdf(type("Odd", (KukaSurfaceConfig,), {"tool_center_of_mass": (0.01, 0.0, 0.02), **constants})())


@pytest.fixture(scope="module")
def arm():
    with BulletArm(urdf(), gravity=9.8, time_step=STEP, tool_point=POINT) as opened:
        yield opened


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_urdf_text(urdf(), gravity=(0.0, 0.0, -9.8))


def numbers(element: ElementTree.Element, name: str = "xyz") -> list[float]:
    return [float(number) for number in element.get(name).split()]


def states(count: int, spread: float = 2.0):
    rng = np.random.default_rng(0)
    for _ in range(count):
        yield rng.uniform(-spread, spread, 7), rng.normal(size=7)


def test_pybullet_and_robot_agree_on_dynamics_and_kinematics(arm, robot):
    point = torch.tensor(POINT, dtype=torch.float64)
    for q, v in states(20):
        arm.reset(q, v)
        tensors = torch.tensor(q), torch.tensor(v)
        position, quaternion, jacobian, bias = arm.tool(v)
        pose = robot.frame_pose(tensors[0], TOOL_LINK).numpy()
        np.testing.assert_allclose(arm.mass_matrix(q), robot.mass_matrix(tensors[0]), atol=1e-12)
        np.testing.assert_allclose(arm.bias_forces(q, v), robot.bias_forces(*tensors), atol=1e-11)
        np.testing.assert_allclose(position, pose[:3, :3] @ POINT + pose[:3, 3], atol=1e-13)
        np.testing.assert_allclose(jacobian, robot.frame_jacobian(tensors[0], TOOL_LINK, point), atol=1e-12)
        np.testing.assert_allclose(bias, robot.frame_bias_acceleration(*tensors, TOOL_LINK, point), atol=1e-11)
        x, y, z, w = quaternion
        assert x * x + y * y + z * z + w * w == pytest.approx(1.0)
        np.testing.assert_allclose(2 * (x * z + w * y), pose[0, 2], atol=1e-12)


@pytest.mark.parametrize("spread", [2.0, 6.0])  # 6 rad is far outside the joint limits, which must not act
def test_a_step_is_rigid_body_dynamics_and_nothing_else(arm, robot, spread):
    rng = np.random.default_rng(1)
    for q, v in states(20, spread):
        torque = 30 * rng.normal(size=7)
        arm.reset(q, v)
        arm.step(torque)
        q_next, v_next = arm.state()
        expected = robot.forward_dynamics(torch.tensor(q), torch.tensor(v), torch.tensor(torque)).numpy()
        np.testing.assert_allclose((v_next - v) / STEP, expected, rtol=1e-9, atol=1e-8)
        np.testing.assert_allclose(q_next, q + STEP * v_next, atol=1e-14)


def test_inertia_off_the_axes_of_its_link_is_refused():
    turned = urdf().replace('<origin rpy="0 0 0" xyz="0 -0.03 0.12" />', '<origin rpy="0.3 0 0" xyz="0 -0.03 0.12" />')
    assert turned != urdf()
    with pytest.raises(SimulationError, match="along the axes"):
        BulletArm(turned, gravity=9.8, time_step=STEP, tool_point=POINT)


def test_torques_that_are_not_finite_are_refused(arm):
    with pytest.raises(SimulationError, match="diverged"):
        arm.step(np.full(7, np.nan))


def test_loading_prints_nothing_that_would_spoil_json(capfd):
    BulletArm(urdf(), gravity=9.8, time_step=STEP, tool_point=POINT).close()
    assert capfd.readouterr().out == ""


def test_without_pybullet_the_command_to_install_it_is_given(monkeypatch):
    text = urdf()
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(MissingExtra, match=r"pip install 'forcegp\[sim\]'"):
        BulletArm(text, gravity=9.8, time_step=STEP, tool_point=POINT)
    monkeypatch.setitem(sys.modules, "pybullet_data", None)
    with pytest.raises(MissingExtra, match=r"pip install 'forcegp\[sim\]'"):
        urdf()


pybullet_data = pytest.importorskip("pybullet_data")
ODD = {"tool_center_of_mass": (0.01, 0.0, 0.02), "joint_damping": 0.25, "base_height": 0.4}


def test_it_refers_to_no_file_and_keeps_the_licence():
    text = urdf()
    for word in ("filename", "mesh", "<visual", "<collision", "<material"):
        assert word not in text.partition("<robot")[2]
    assert "THIS SOFTWARE IS PROVIDED BY THE COPYRIGHT HOLDERS" in text
    assert "Changed by forcegp" in text


def test_tool_damping_and_base_are_the_ones_given():
    text = kuka_urdf(type("Odd", (KukaSurfaceConfig,), ODD)(tool_mass=3.5))
    tool = ElementTree.fromstring(text).find("link[@name='lbr_iiwa_link_7']/inertial")
    assert tool.find("mass").get("value") == "3.5"
    assert numbers(tool.find("origin")) == [0.01, 0.0, 0.02]
    moments = {name: float(value) for name, value in tool.find("inertia").items()}
    assert moments == {"ixx": 0.005, "iyy": 0.0036, "izz": 0.0047, "ixy": 0, "ixz": 0, "iyz": 0}
    robot = Robot.from_urdf_text(text)
    assert [joint.damping for joint in robot.joints] == [0.25] * 7
    base = robot.frame_pose(torch.zeros(7, dtype=torch.float64), "lbr_iiwa_link_0")
    assert base[:3, 3].tolist() == [0.0, 0.0, 0.4]


def test_joints_and_the_other_links_are_the_originals():
    original = Robot.from_urdf(Path(pybullet_data.getDataPath()) / "kuka_iiwa/model.urdf")
    changed = Robot.from_urdf_text(urdf(joint_damping=0.5))
    assert changed.joints == original.joints
    kept = [f"lbr_iiwa_link_{number}" for number in range(1, 7)]
    assert all(changed.link(name) == original.link(name) for name in kept)
