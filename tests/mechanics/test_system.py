import contextlib
import math

import pytest
import torch
from tests.mechanics.systems import model_with, normal, robot, states, surfaces
from tests.robots.robot_models import FRAMES, TREE, loaded

from forcegp.errors import ContactError, InvalidInput, NumericalError, UnknownName
from forcegp.forces import Actuation, Coulomb, RigidBodies, Rotor, Viscous
from forcegp.mechanics import Baumgarte, Contact, ImplicitSurface, Plane, Sphere
from forcegp.model import Model
from forcegp.robots import Robot

FLOOR = Plane((0.0, 0.0, 1.0), 0.055)


def complete() -> Model:
    """Every kind of part, a robot that is not as its file says."""
    built = Robot.from_urdf_text(TREE, gravity=(0.1, -0.2, -9.7), locked={"left_gripper": 0.013})
    built = built.with_armature({"torso": 0.25})
    built = loaded(built, "right_hand")
    return Model(
        built,
        (
            Contact("right_hand", (0.1, -0.2, 0.3), Plane((0.3, 0.1, 1.0), 0.123)),
            Contact("camera", (0.0, 0.0, 0.1), Sphere((0.1, 0.2, 0.3), 0.7)),
            Contact("left_arm", (0.3, 0.0, 0.0), Sphere((0.0, 0.1, 0.0), 0.4)),
        ),
        (
            Actuation(), RigidBodies(),
            Viscous({joint.name: joint.damping for joint in built.joints if joint.name in built.single_joint_names}),
            Coulomb({"torso": 0.3}, 0.02), Rotor(0.05),
        ),
        baumgarte=Baumgarte(7.0, 0.8),
    )  # fmt: skip


def assert_same_dynamics(one: Model, other: Model) -> None:
    arguments, Q_U = states(one.robot.nv, 4), normal(4, one.robot.nv)
    for name in ("M", "A", "b", "H", "Q_K"):
        assert torch.equal(getattr(one.dynamics(*arguments), name), getattr(other.dynamics(*arguments), name)), name
    assert torch.equal(one.dynamics(*arguments).acceleration(Q_U), other.dynamics(*arguments).acceleration(Q_U))


# ---------------------------------------------------------------- what it holds


# ---------------------------------------------------------------- parts that do not fit


@pytest.mark.parametrize(
    ("contact", "error", "message"),
    [
        (Contact("toool", (0.0, 0.0, 0.0), FLOOR), UnknownName, "no frame 'toool' in chain; did you mean 'tool'?"),
        (Contact("rail", (0.0, 0.0, 0.0), FLOOR), ContactError, "frame 'rail' of chain is fixed in the world"),
    ],
)
def test_contacts_that_do_not_fit_the_robot(contact, error, message):
    with pytest.raises(error, match=message):
        Model(robot("chain"), (contact,))


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (((5, 1), (5, 4), (5, 4)), r"q has shape \(5, 1\); its last dimension must be 4"),
        (((5, 4), (5, 1), (5, 4)), r"v has shape \(5, 1\)"), (((5, 4), (5, 4), (5, 1)), r"u has shape \(5, 1\)"),
        (((5, 4), (4, 4), (5, 4)), "batch shapes do not broadcast"),
        (((5, 4), (5, 4), (4, 4)), "batch shapes do not broadcast"), (((), (4,), (4,)), "q has shape"),
    ],
    ids=str,
)  # fmt: skip
def test_states_of_wrong_shape_are_never_stretched(shapes, message):
    with pytest.raises(InvalidInput, match=message):
        Model(robot("chain")).dynamics(*(torch.zeros(shape, dtype=torch.float64) for shape in shapes))


# ---------------------------------------------------------------- states that contacts cannot hold


def test_a_gradient_that_vanishes_is_named_by_row_and_contact():
    """p^T p = 0.1 has no direction at the origin."""
    built = robot("chain")
    q, v, u = states(4, 5)
    corner = built.frame_pose(q[3], FRAMES["chain"])[:3, 3]
    bowl = ImplicitSurface(lambda p: (p - corner).square().sum() - 0.1)
    origin = (0.0, 0.0, 0.0)
    held = Model(built, (Contact("forearm", origin, FLOOR), Contact(FRAMES["chain"], origin, bowl)))
    with pytest.raises(ContactError, match=r"contact 1 \(frame 'tool'\) has no direction at row 3"):
        held.check_states(q, v, u)
    held.check_states(q[:3], v[:3], u[:3])


def test_a_point_that_cannot_move_along_the_normal():
    """A hub on a vertical axis cannot be lifted."""
    lift = """<robot name="turntable"><link name="base"/><link name="table">
      <inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
      <joint name="turn" type="continuous">
      <parent link="base"/><child link="table"/><axis xyz="0 0 1"/></joint></robot>"""
    held = Model(Robot.from_urdf_text(lift), (Contact("table", (0.5, 0.0, 0.0), Plane((0.0, 0.0, 1.0), 0.0)),))
    with pytest.raises(ContactError, match="cannot move along it"):
        held.check_states(*states(1, 2))


def test_contacts_contradict_each_other_from_a_millionth_on():
    """At rest b = -omega^2 s, and the acceleration lies between the two: half of omega^2 times the gap is missing."""
    tool, point = FRAMES["iiwa"], torch.tensor([0.0, 0.0, 0.1, 1.0], dtype=torch.float64)
    q, _, u = states(7, 1)
    height = float((robot("iiwa").frame_pose(q[0], tool) @ point)[2])
    for gap, fits in ((1.6e-8, True), (2.6e-8, False)):
        floors = [Plane((0.0, 0.0, 1.0), height + sign * gap / 2) for sign in (-1, 1)]
        contacts = [Contact(tool, (0.0, 0.0, 0.1), floor) for floor in floors]
        held = Model(robot("iiwa"), contacts, baumgarte=Baumgarte(10.0))
        with contextlib.nullcontext() if fits else pytest.raises(ContactError, match="contradict"):
            held.check_states(q, torch.zeros_like(q), u)


def test_states_that_are_not_finite_are_refused():
    for position in range(2):
        arguments = states(7, 4)
        arguments[position][2, 1] = math.nan
        with pytest.raises((ContactError, NumericalError), match=r"row 2|not positive definite"):
            model_with("iiwa", "one").check_states(*arguments)


# ---------------------------------------------------------------- files


def test_a_file_changes_nothing():
    built = complete()
    again = Model.from_json(built.to_json())
    assert (again.to_json(), again.contacts) == (built.to_json(), built.contacts)
    assert (again.baumgarte, again.robot.joint_names) == (built.baumgarte, built.robot.joint_names)
    assert dict(again.robot.locked) == {"left_gripper": 0.013}
    assert torch.equal(again.robot.gravity, built.robot.gravity)
    assert torch.equal(again.robot.armature, built.robot.armature)
    assert [type(force) for force in again.forces] == [type(force) for force in built.forces]
    assert_same_dynamics(again, built)


def test_a_surface_that_holds_code_cannot_be_stored_but_given_again():
    waves = (Contact(FRAMES["chain"], (0.0, 0.0, 0.0), surfaces()["waves"]),)
    built = Model(robot("chain"), waves)
    with pytest.raises(ContactError, match="a Surface of your own with numbers as fields"):
        built.to_json()
    assert_same_dynamics(Model.from_dict(built.with_contacts(()).to_dict()).with_contacts(waves), built)
