"""The paper's KUKA experiment, computed by an independent implementation, where its data are beside this checkout."""

import re

import numpy as np
import pytest
import torch
from tests.mechanics.systems import assert_close
from tests.robots.robot_models import iiwa

from forcegp.forces import Actuation, RigidBodies
from forcegp.mechanics import Baumgarte, Contact, Plane
from forcegp.model import Model
from forcegp.robots import Robot

TOOL = "lbr_iiwa_link_7"
TOOL_INERTIAL = """<inertial><origin xyz="0 0 0.02" rpy="0 0 0"/><mass value="2.0"/>
  <inertia ixx="0.005" iyy="0.0036" izz="0.0047" ixy="0" ixz="0" iyz="0"/></inertial>"""
MOUNT = """<link name="world"/><joint name="mount" type="fixed"><origin xyz="0 0 0.05"/>
  <parent link="world"/><child link="lbr_iiwa_link_0"/></joint></robot>"""
TOLERANCE = 1e-6


def paper_robot() -> Robot:
    """The iiwa with the tool of the paper in place of link 7, 5 cm above the ground."""
    text, replaced = re.subn(
        rf'(<link name="{TOOL}">.*?)<inertial>.*?</inertial>', rf"\1{TOOL_INERTIAL}", iiwa(), count=1, flags=re.DOTALL
    )
    assert replaced == 1
    text, mounted = re.subn("</robot>", MOUNT, text)
    assert mounted == 1
    return Robot.from_urdf_text(text, gravity=(0.0, 0.0, -9.8))


@pytest.fixture(scope="module")
def model() -> Model:
    built = paper_robot()
    assert built.link(TOOL).mass == 2.0
    contact = Contact(TOOL, (0.0, 0.0, 0.1), Plane((0.0, 0.0, 1.0), 0.055))
    return Model(built, (contact,), (Actuation(), RigidBodies()), baumgarte=Baumgarte(10.0, 1.0))


both_splits = pytest.mark.parametrize("rows", ["test", "train"], indirect=True)


@pytest.fixture(scope="module")
def rows(request, shared) -> dict[str, torch.Tensor]:
    with np.load(shared("reference/kuka_paper.npz"), allow_pickle=False) as stored:
        return {
            name.removeprefix(f"{request.param}_"): torch.as_tensor(stored[name][:1000])
            for name in stored.files
            if name.startswith(request.param)
        }


@pytest.mark.parametrize("rows", ["test"], indirect=True)  # only these rows carry M, f and g
def test_mass_matrix_and_forces(model, rows):
    q, v, u = rows["q"], rows["v"], rows["u"]
    dynamics = model.dynamics(q, v, u)
    gravity = model.robot.gravity_forces(q)
    assert_close(dynamics.M, rows["M"], TOLERANCE)
    assert_close(-gravity, rows["g"], TOLERANCE)
    assert_close(gravity - model.robot.bias_forces(q, v), rows["f"], TOLERANCE)
    assert_close(dynamics.Q_K, rows["f"] + rows["g"] + u, TOLERANCE)


@both_splits
def test_constraint_and_motion(model, rows):
    dynamics = model.dynamics(rows["q"], rows["v"], rows["u"])
    assert_close(dynamics.A, rows["A"], TOLERANCE)
    assert_close(dynamics.b, rows["b"], TOLERANCE)
    assert_close(dynamics.multiplier(rows["Q_U"]), rows["lambda"], TOLERANCE)
    assert_close(dynamics.acceleration(rows["Q_U"]), rows["a"], TOLERANCE)


@both_splits
def test_the_contact_force_is_normal_to_the_plane(model, rows):
    dynamics = model.dynamics(rows["q"], rows["v"], rows["u"])
    force = dynamics.contact_force_map()(rows["Q_U"])
    upwards = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert_close(force, rows["lambda"] * upwards, TOLERANCE)


@both_splits
def test_all_states_can_be_held(model, rows):
    model.check_states(rows["q"], rows["v"], rows["u"])
