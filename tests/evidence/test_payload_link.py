"""A payload is found on the link that is said to carry it."""

import numpy as np
import pytest
import torch
from tests.robots.random_positions import random_positions

from forcegp.data import Dataset
from forcegp.errors import DataWarning
from forcegp.evidence import Torques
from forcegp.fit import fit
from forcegp.forces import Actuation, Payload, RigidBodies, Thrusters, Viscous
from forcegp.model import Model
from forcegp.robots import Robot
from forcegp.robots.urdf_file import replace_inertial

LINK = """<link name="{0}"><inertial><origin xyz="{2}"/><mass value="{1}"/><inertia ixx="{3}" iyy="{4}" izz="{3}"
ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{1}" type="{4}"><origin xyz="{2}"/><parent link="{0}"/><child link="{1}_link"/><axis xyz="{3}"/>
<limit lower="-2" upper="2" effort="30" velocity="9"/></joint>"""


def link(name, mass, center=".0 .0 .15"):
    return LINK.format(name, mass, center, 0.004 * mass, 0.003 * mass)


def chain(name, side):
    upper, lower = f"{name}_upper", f"{name}_lower"
    joints = JOINT.format("trunk", upper, f"0 {side} .1", "0 1 0", "revolute")
    joints += JOINT.format(f"{upper}_link", lower, "0 0 .3", "1 0 0", "revolute")
    return joints + link(f"{upper}_link", 1.0) + link(f"{lower}_link", 0.8)


MASSES = {"trunk": 4.0, "left_lower_link": 0.8, "right_lower_link": 0.8}
TWO_ARMS = f'<robot name="two_arms">{link("trunk", 4.0, "0 0 .02")}{chain("left", 0.2)}{chain("right", -0.2)}</robot>'


def carrying(text: str, name: str, mass: float) -> str:
    """The robot with a small body of this mass on a link."""
    inertial = Robot.from_urdf_text(text, base="floating").description.links[name]
    own, place, whole = np.array(inertial.center_of_mass), np.array([0.02, 0.01, 0.25]), inertial.mass + mass
    d, center = place - own, (inertial.mass * own + mass * place) / whole
    inertia = np.array(inertial.inertia) + inertial.mass * mass / whole * (d @ d * np.eye(3) - np.outer(d, d))
    return replace_inertial(text, name, whole, center, inertia + 1e-3 * np.eye(3), source="a test")


PLACES = (0.3, 0, 0), (-0.3, 0, 0), (0, 0.3, 0), (0, -0.3, 0)
ROTORS = Thrusters("trunk", PLACES, thrust=1.0, torque=[0.1, 0.1, -0.1, -0.1])


def rows(base: str, loaded: str, noise: float) -> Dataset:
    """Random states under joint torques, and thrust on a base that moves; noise is that of accelerations."""
    known = (Actuation(), *([ROTORS] if base == "floating" else []), RigidBodies())
    given, heavier = (Model(Robot.from_urdf_text(text, base=base), (), known) for text in (TWO_ARMS, loaded))
    draw = torch.Generator().manual_seed(0)
    q = random_positions(given.robot, draw, 400)
    v = torch.randn(400, given.robot.nv, generator=draw, dtype=torch.float64)
    u, friction = 8.0 * torch.randn(400, len(given.inputs), generator=draw, dtype=torch.float64), torch.zeros_like(v)
    friction[:, -4:] = -0.2 * v[:, -4:]
    a = heavier.dynamics(q, v, u).acceleration(friction)
    a = a + noise * torch.randn(a.shape, generator=draw, dtype=torch.float64)
    q, v, u, a = (x.numpy() for x in (q, v, u, a))
    return Dataset(q=q, v=v, u=u, a=a, time=0.5 * np.arange(400), model=given)


def payload(data: Dataset, link: str | None = None) -> tuple[str, float]:
    """The link that is found or given, and the mass on it."""
    noisy = "u" if data.model.robot.base == "fixed" else "both"  # noise of a alone would explain any mass of a base
    posterior = fit(data.model.with_forces(Viscous(), Payload(link)), data, Torques(noisy, mean=0.4))
    (found,) = (force for force in posterior.model.forces if isinstance(force, Payload))
    return found.link, found.mass


@pytest.mark.parametrize(("base", "carrier"), [("fixed", "left_lower_link"), *(("floating", name) for name in MASSES)])
def test_the_payload_is_found_where_it_is_said_to_be(base, carrier):
    link, mass = payload(rows(base, carrying(TWO_ARMS, carrier, 0.5), 0.05), carrier)
    assert (link, mass) == (carrier, pytest.approx(0.5, rel=0.05))


def test_without_a_link_it_is_on_the_base_that_moves_or_the_last_link():
    for base, usual in (("fixed", "right_lower_link"), ("floating", "trunk")):
        assert payload(rows(base, TWO_ARMS, 0.05))[0] == usual


def test_a_payload_that_no_body_can_be_is_warned_of():
    """The URDF's hand is too heavy: less than nothing is carried."""
    lighter = replace_inertial(TWO_ARMS, "left_lower_link", 0.6, np.array([0, 0, 0.15]), 2.4e-3 * np.eye(3), source="")
    data = rows("floating", lighter, 0.05)
    for name in (None, "left_lower_link"):
        with pytest.warns(DataWarning, match="no body on .* explains the log"):
            payload(data, name)
