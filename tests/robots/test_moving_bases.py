"""Floating joints against Pinocchio, and the manifold of their positions."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import torch
from scipy.special import bernoulli, comb, factorial
from tests.robots.random_positions import random_positions

from forcegp.errors import InvalidInput
from forcegp.robots import Robot, manifold
from forcegp.robots.manifold import ConfigurationSpace

LIMBS = Path(__file__).with_name("limbs.urdf").read_text()
CARRIER = Path(__file__).with_name("carrier.urdf").read_text()
ROOTS, ROWS = {"floating": pin.JointModelFreeFlyer, "fixed": None}, 4


class Pair:
    """A robot of ours and Pinocchio's, with states in both orders."""

    def __init__(self, base):
        text = CARRIER if base == "fixed" else LIMBS
        self.robot = Robot.from_urdf_text(text, base=base)
        root = ROOTS[base]
        self.model = pin.buildModelFromXML(text, root()) if root else pin.buildModelFromXML(text)
        self.data = self.model.createData()
        generator = torch.Generator().manual_seed(3)
        self.q = random_positions(self.robot, generator, ROWS)
        self.v, self.a, self.tau = (
            torch.randn(ROWS, self.robot.nv, dtype=torch.float64, generator=generator) for _ in range(3)
        )
        free = ["x", "y", "z", "qx", "qy", "qz", "qw"], ["x", "y", "z", "rx", "ry", "rz"]
        # places in Pinocchio's q and v of our entries
        self.to_q = self._places(self.robot.position_names, free[0], "idx_q")
        self.to_v = self._places(self.robot.joint_names, free[1], "idx_v")

    def _places(self, names, parts, first):
        split = [name.partition(".") for name in names]
        joints = [self.model.joints[self._joint(name)] for name, _, _ in split]
        return [
            getattr(joint, first) + (parts.index(part) if part else 0)
            for joint, (*_, part) in zip(joints, split, strict=True)
        ]

    def _joint(self, name):
        return self.model.getJointId("root_joint" if name == "base" else name)

    def states(self):
        for k in range(ROWS):
            q, v, a, tau = np.zeros(self.model.nq), *np.zeros((3, self.model.nv))
            q[self.to_q] = self.q[k].numpy()
            for given, own in ((v, self.v), (a, self.a), (tau, self.tau)):
                given[self.to_v] = own[k].numpy()
            yield k, q, v, a, tau


@pytest.fixture(scope="module", params=ROOTS)
def pair(request):
    return Pair(request.param)


@pytest.fixture(scope="module")
def compiled(pair, tmp_path_factory):
    return pair.robot.compile(tmp_path_factory.mktemp("compiled"))


def close(found, expected, scale=1.0):
    expected = torch.as_tensor(np.array(expected))
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9 * max(1.0, float(expected.abs().max())) * scale)


@pytest.mark.parametrize("how", ["by torch", "compiled"])
def test_mass_matrix_bias_and_both_dynamics(pair, compiled, how):
    of = pair.robot if how == "by torch" or pair.robot.base == "fixed" else compiled
    M, bias = of.mass_matrix_and_bias(pair.q, pair.v)
    tau, a = of.inverse_dynamics(pair.q, pair.v, pair.a), of.forward_dynamics(pair.q, pair.v, pair.tau)
    gravity, order = of.gravity_forces(pair.q), pair.to_v
    for k, q, v, acceleration, force in pair.states():
        expected = pin.crba(pair.model, pair.data, q)
        expected = np.triu(expected) + np.triu(expected, 1).T
        close(M[k], expected[np.ix_(order, order)])
        close(bias[k], pin.nonLinearEffects(pair.model, pair.data, q, v)[order])
        close(gravity[k], pin.computeGeneralizedGravity(pair.model, pair.data, q)[order])
        close(tau[k], pin.rnea(pair.model, pair.data, q, v, acceleration)[order])
        close(a[k], pin.aba(pair.model, pair.data, q, v, force)[order], 10.0)


def test_poses_jacobians_and_their_rates(pair):
    frame = pair.robot.link_names[-1]
    pose, jacobian = pair.robot.frame_pose(pair.q, frame), pair.robot.frame_jacobian(pair.q, frame)
    drift = pair.robot.kinematics(pair.q, pair.v).frame_bias_acceleration(frame)
    number, axes = pair.model.getFrameId(frame), pin.LOCAL_WORLD_ALIGNED
    for k, q, v, _, _ in pair.states():
        pin.forwardKinematics(pair.model, pair.data, q, v, 0 * v)
        pin.updateFramePlacements(pair.model, pair.data)
        close(pose[k], pair.data.oMf[number].homogeneous)
        close(jacobian[k], pin.computeFrameJacobian(pair.model, pair.data, q, number, axes)[:, pair.to_v])
        close(drift[k], pin.getFrameClassicalAcceleration(pair.model, pair.data, number, axes).vector)


def test_integrate_and_difference(pair):
    moved, back = pair.robot.integrate(pair.q, pair.v), pair.robot.difference(pair.q, pair.q.flip(0))
    flipped = [q for _, q, *_ in pair.states()][::-1]
    for k, q, v, _, _ in pair.states():
        expected = pin.integrate(pair.model, q, v)[pair.to_q]
        inside, other = torch.linalg.vector_norm(moved[k] - torch.as_tensor(expected)), expected.copy()
        turn = [place for place, name in enumerate(pair.robot.position_names) if ".q" in name]
        other[turn] *= -1.0  # the same turn
        assert min(inside, torch.linalg.vector_norm(moved[k] - torch.as_tensor(other))) < 1e-11
        close(back[k], pin.difference(pair.model, q, flipped[k])[pair.to_v], 10.0)


def test_positions_of_a_fixed_base_add_up():
    space, (q, step) = ConfigurationSpace(2), torch.rand(2, 3, 2, dtype=torch.float64)
    assert torch.equal(space.integrate(q, step), q + step)
    assert torch.equal(space.difference(q, step), step - q)


def test_derivatives_of_forward_dynamics_on_the_manifold(pair):
    def moved(step, k):
        return pair.robot.forward_dynamics(pair.robot.integrate(pair.q[k], step), pair.v[k], pair.tau[k])

    order = np.ix_(pair.to_v, pair.to_v)
    for k, q, v, _, tau in pair.states():
        pin.computeABADerivatives(pair.model, pair.data, q, v, tau)
        found = torch.func.jacrev(moved)(torch.zeros(pair.robot.nv, dtype=torch.float64), k)
        close(found, pair.data.ddq_dq[order], 100.0)


def test_the_chart_is_that_of_the_exponential(pair):
    """d/dt integrate(q0, step(t)) has the body velocity v, by central differences."""
    step, v, dt = 0.3 * pair.v, pair.a, 1e-5
    rate = pair.robot.space.chart_velocity(step, v)
    ends = [pair.robot.integrate(pair.q, step + sign * dt * rate) for sign in (-1, 1)]
    torch.testing.assert_close(pair.robot.difference(*ends) / (2 * dt), v, rtol=0, atol=3e-8 * float(v.abs().max()))


def test_series_near_zero_are_those_of_taylor():
    k, n = np.arange(6), np.arange(7)
    for series, first in ((manifold._SINE, 1), (manifold._VERSINE, 2), (manifold._REST, 3)):
        np.testing.assert_allclose(series, (-1.0) ** k / factorial(2 * k + first), rtol=1e-12)
    np.testing.assert_allclose(manifold._COTANGENT, abs(bernoulli(12)[2::2]) / factorial(2 * k + 2), rtol=1e-9)
    np.testing.assert_allclose(manifold._ARCSINE, comb(2 * n, n) / (4.0**n * (2 * n + 1)), rtol=1e-12)


def test_turns_of_other_length_are_refused():
    robot = Robot.from_urdf_text(LIMBS, base="floating")
    q = robot.neutral()
    assert robot.position_names[:7] == ("base.x", "base.y", "base.z", "base.qx", "base.qy", "base.qz", "base.qw")
    q[3:7] *= 0.7
    with pytest.raises(InvalidInput, match=r"base\.qx, base\.qy.*length 0\.7.*normalized"):
        robot.mass_matrix(q)
    robot.mass_matrix(robot.normalized(q))
