import sys
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import torch

from forcegp.errors import MissingExtra, SimulationError
from forcegp.robots import Robot
from forcegp.simulation.bullet import BulletArm
from forcegp.simulation.kuka_surface import TOOL_LINK, kuka_urdf
from forcegp.simulation.scenarios import KukaSurfaceConfig

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


def test_energy_of_the_free_arm_is_kept_up_to_the_integrator(robot):
    bodies = [
        (float(link.find("inertial/mass").get("value")), numbers(link.find("inertial/origin")), link.get("name"))
        for link in ElementTree.fromstring(urdf()).findall("link")
        if link.find("inertial") is not None
    ]

    def energy(q: np.ndarray, v: np.ndarray) -> float:
        tensor = torch.tensor(q)
        kinetic = 0.5 * v @ robot.mass_matrix(tensor).numpy() @ v
        poses = [(mass, center, robot.frame_pose(tensor, name).numpy()) for mass, center, name in bodies]
        return float(kinetic + sum(mass * 9.8 * (T[:3, :3] @ center + T[:3, 3])[2] for mass, center, T in poses))

    def drift(step: float) -> float:
        with BulletArm(urdf(), gravity=9.8, time_step=step, tool_point=POINT) as arm:
            arm.reset(np.array([0.3, 0.8, -0.2, -1.2, 0.1, 0.4, 0.0]), np.zeros(7))
            start = energy(*arm.state())
            for _ in range(round(0.3 / step)):
                arm.step(np.zeros(7))
            return abs(energy(*arm.state()) - start)

    coarse, fine = drift(1e-3), drift(1e-4)
    assert fine < 0.2 * coarse  # first order, so no hidden damping remains as the step shrinks
    assert fine < 0.05


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
