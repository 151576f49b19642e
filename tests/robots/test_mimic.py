"""Joints that mimic others: Pinocchio's full model, projected with a constant matrix, is the independent answer."""

import numpy as np
import pinocchio as pin
import pytest
import torch
from tests.robots.robot_models import CHAIN, TREE
from tests.robots.test_urdf_errors import SMALL

from forcegp import errors
from forcegp.robots import Robot

# below its master, above it, on another branch, and a mimic of a mimic; of another kind; with damping
TREE_MIMICS = {
    "right_wrist": ("right_shoulder", 0.5, 0.2), "torso": ("left_shoulder", -0.7, 0.0),
    "second_finger": ("left_gripper", -1.0, 0.01), "left_gripper": ("right_wrist", 0.3, -0.05),
}  # fmt: skip
CHAIN_MIMICS = {"slide": ("tilt", 0.4, 0.1)}


def with_mimics(text: str, mimics: dict[str, tuple[str, float, float]]) -> str:
    for name, (joint, multiplier, offset) in mimics.items():
        head, start, tail = text.partition(f'<joint name="{name}"')
        inside = f'<mimic joint="{joint}" multiplier="{multiplier}" offset="{offset}"/></joint>'
        text = head + start + tail.replace("</joint>", inside, 1)
    return text


def motion(name, mimics, robot, q):
    """Position of a joint and its derivatives in the coordinates, by the definition of <mimic>."""
    if name in mimics and name not in robot.locked:
        joint, multiplier, offset = mimics[name]
        position, row = motion(joint, mimics, robot, q)
        return multiplier * position + offset, multiplier * row
    if name in robot.locked:
        return robot.locked[name], np.zeros(robot.nv)
    place = robot.joint_names.index(name)
    return q[place], np.eye(robot.nv)[place]


class Projected:
    """Pinocchio's model of a text without its mimics, and the matrix G."""

    def __init__(self, text, mimics, robot):
        self.mimics, self.robot = mimics, robot
        self.model = pin.buildModelFromXML(text)
        self.model.gravity.linear = robot.gravity.numpy()
        self.data = self.model.createData()

    def at(self, q):
        place, G = pin.neutral(self.model), np.zeros((self.model.nv, self.robot.nv))
        for name, joint in zip(list(self.model.names)[1:], list(self.model.joints)[1:], strict=True):
            position, G[joint.idx_v] = motion(name, self.mimics, self.robot, q)
            values = [position] if joint.nq == 1 else [np.cos(position), np.sin(position)]
            place[joint.idx_q : joint.idx_q + joint.nq] = values
        return place, G

    def dynamics(self, q, v, a):
        """M, bias, gravity and inverse dynamics."""
        place, G = self.at(q)
        M = np.triu(pin.crba(self.model, self.data, place))
        M = G.T @ (M + np.triu(M, 1).T) @ G + np.diag(self.robot.armature.numpy())
        bias = G.T @ pin.nonLinearEffects(self.model, self.data, place, G @ v)
        gravity = G.T @ pin.computeGeneralizedGravity(self.model, self.data, place)
        tau = G.T @ pin.rnea(self.model, self.data, place, G @ v, G @ a) + self.robot.armature.numpy() * a
        return M, bias, gravity, tau


CASES = {
    "tree": (TREE, TREE_MIMICS, {}),
    "chain": (CHAIN, CHAIN_MIMICS, {}),
    "a locked master": (TREE, TREE_MIMICS, {"locked": {"right_shoulder": 0.4}}),
    "armature": (TREE, TREE_MIMICS, {"armature": {"left_shoulder": 0.3}, "gravity": (1.0, -7.0, 3.0)}),
}


@pytest.fixture(params=CASES)
def case(request):
    text, mimics, options = CASES[request.param]
    robot = Robot.from_urdf_text(with_mimics(text, mimics), **options)
    return robot, Projected(text, mimics, robot), *np.random.default_rng(3).normal(size=(3, 5, robot.nv))


def close(ours, theirs):
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9 * np.abs(np.asarray(theirs)).max())


def test_dynamics_are_those_of_the_projected_model(case):
    robot, oracle, q, v, a = case
    states = [torch.from_numpy(x) for x in (q, v, a)]
    expected = [np.stack(parts) for parts in zip(*map(oracle.dynamics, q, v, a), strict=True)]
    for of in (robot, robot.compile()) if robot.locked or robot.armature.any() else (robot,):
        close(of.mass_matrix(states[0]), expected[0])
        close(of.bias_forces(*states[:2]), expected[1])
        close(of.gravity_forces(states[0]), expected[2])
        close(of.inverse_dynamics(*states), expected[3])
        close(of.forward_dynamics(*states[:2], torch.from_numpy(expected[3])), a)


def test_frames_move_with_the_coordinates(case):
    robot, oracle, q, v, _ = case
    frame, at = robot.link_names[-1], robot.kinematics(torch.from_numpy(q[0]), torch.from_numpy(v[0]))
    index = oracle.model.getFrameId(frame, pin.FrameType.BODY)
    place, G = oracle.at(q[0])
    world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    close(at.frame_jacobian(frame), pin.computeFrameJacobian(oracle.model, oracle.data, place, index, world) @ G)
    pin.forwardKinematics(oracle.model, oracle.data, place, G @ v[0], np.zeros(oracle.model.nv))
    close(at.frame_pose(frame), pin.updateFramePlacement(oracle.model, oracle.data, index).homogeneous)
    bias = pin.getFrameClassicalAcceleration(oracle.model, oracle.data, index, world).vector
    close(at.frame_bias_acceleration(frame), bias)


def test_a_gear_reflects_inertia_damping_and_friction():
    """A rod that turns n times as fast counts n^2 times, whatever it is fixed to."""
    spun = SMALL.replace("0.1 0 0", "0 0 0").replace("</robot>", "")
    rotor = '<link name="rotor"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0"'
    rotor += (
        ' izz="0.01"/></inertial></link><joint name="gear" type="continuous"><parent link="base"/><child link="rotor"/>'
    )
    rotor += '<axis xyz="0 0 1"/><dynamics damping="0.2" friction="0.5"/><mimic joint="hinge" multiplier="-20"/>'
    robot = Robot.from_urdf_text(spun + rotor + "</joint></robot>")
    assert robot.joint_names == ("hinge",)
    assert robot.layout.bodies[robot.frame("rotor")[0]].name == "gear"
    assert robot.mass_matrix(torch.zeros(1).double()).item() == pytest.approx(0.1 + 400 * 0.01)
    assert (robot.joint("hinge").damping, robot.joint("hinge").friction) == pytest.approx((80.0, 10.0))


@pytest.mark.parametrize(
    ("mimic", "message"),
    [
        ({"tilt": ("tilt", 1.0, 0.0)}, "joint 'tilt' mimics 'tilt', and so at last itself"),
        (
            {"tilt": ("skew", 1.0, 0.0), "skew": ("tilt", 1.0, 0.0)},
            "joint 'skew' mimics 'tilt'; joint 'tilt' mimics 'skew', and so at last itself",
        ),
        ({"tilt": ("tlit", 1.0, 0.0)}, "joint 'tilt' mimics 'tlit', which the file lacks"),
    ],
)
def test_what_cannot_be_followed_is_named_and_can_be_locked(mimic, message):
    with pytest.raises(errors.RobotModelError, match=message) as caught:
        Robot.from_urdf_text(with_mimics(CHAIN, mimic))
    assert caught.value.remedy == {"locked": dict.fromkeys(sorted(mimic), 0.0)}
    assert Robot.from_urdf_text(with_mimics(CHAIN, mimic), **caught.value.remedy).nv == 4 - len(mimic)


def test_mimics_that_do_nothing():
    """Of a fixed joint, with a note; of a joint that stands still; with a multiplier of zero."""
    with pytest.warns(
        errors.RobotFileWarning, match=r"<mimic> of a fixed joint is ignored \(joint 'flange', joint 'tip'\)"
    ):
        robot = Robot.from_urdf_text(with_mimics(CHAIN, {"flange": ("tilt", 1.0, 0.0), "tip": ("no", 1.0, 0.0)}))
    assert robot.tree.equals(Robot.from_urdf_text(CHAIN).tree)
    for mimic in ({"tilt": ("flange", 3.0, 0.4)}, {"tilt": ("skew", 0.0, 0.4)}):
        still = Robot.from_urdf_text(with_mimics(CHAIN, mimic))
        assert still.tree.equals(Robot.from_urdf_text(CHAIN, locked={"tilt": 0.4}).tree)
