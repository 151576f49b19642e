"""Derivatives against Pinocchio at 1e-8, against finite differences, and through every transform of torch.func."""

import numpy as np
import pytest
import torch
from tests.robots.pinocchio_oracle import Oracle
from tests.robots.robot_models import CHAIN, MODELS
from torch.autograd import gradcheck, gradgradcheck
from torch.func import hessian, jacfwd, jacrev, vmap

from forcegp.robots import Robot


def relative_error(ours: torch.Tensor, theirs: np.ndarray) -> float:
    return float(abs(ours.numpy() - theirs).max() / abs(theirs).max())


@pytest.fixture(params=[*MODELS])
def case(request):
    text = MODELS[request.param]()
    armature = 0.1 * np.arange(1, 1 + Robot.from_urdf_text(text).nv)
    robot = Robot.from_urdf_text(text, armature=armature)
    states = np.random.default_rng(11).normal(size=(3, robot.nv))
    return robot, Oracle(text, robot), *states


def moving_masses(robot: Robot) -> list[str]:
    links = map(robot.link, robot.link_names)
    return [link.name for link in links if link.joint is not None and link.mass > 0]


@pytest.mark.parametrize("jacobian", [jacrev, jacfwd])
def test_forward_dynamics_with_respect_to_state_and_force(case, jacobian):
    robot, oracle, *states = case
    ours = jacobian(robot.forward_dynamics, argnums=(0, 1, 2))(*map(torch.tensor, states))
    for mine, theirs in zip(ours, oracle.forward_dynamics_derivatives(*states), strict=True):
        assert relative_error(mine, theirs) < 1e-8


def standard_parameters(parameters: torch.Tensor, placement: torch.Tensor) -> torch.Tensor:
    """[m, m c, Ixx, Ixy, Iyy, Ixz, Iyz, Izz] in the frame of the joint, from log-Cholesky ones in that of the link."""
    a, d1, d2, d3, s12, s23, s13, t1, t2, t3 = parameters
    zero, one = torch.zeros(2).double().index_put((torch.tensor([1]),), torch.ones(1).double())
    rows = [d1.exp(), s12, s13, t1], [zero, d2.exp(), s23, t2], [zero, zero, d3.exp(), t3], [zero, zero, zero, one]
    factor = placement @ (a.exp() * torch.stack([torch.stack(row) for row in rows]))
    pseudo = factor @ factor.T
    moment = pseudo[:3, :3]
    inertia = moment.trace() * torch.eye(3).double() - moment
    i, j = [0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]
    return torch.cat([pseudo[3:, 3], pseudo[:3, 3], inertia[i, j]])


def test_inverse_and_forward_dynamics_with_respect_to_all_inertials(case):
    robot, oracle, q, v, a = case
    links = moving_masses(robot)
    parameters = robot.inertial_parameters(*links)
    state = tuple(map(torch.tensor, (q, v, a)))
    tau = robot.inverse_dynamics(*state)
    of_tau = jacrev(lambda p: robot.inverse_dynamics(*state, p))(parameters)
    of_a = jacrev(lambda p: robot.forward_dynamics(*state[:2], tau, p))(parameters)
    inverse_mass = np.linalg.inv(oracle.mass_matrix(q))
    regressor = oracle.torque_regressor(q, v, a)
    for link in links:
        body, placement = oracle.carrier(link)
        chain = jacrev(standard_parameters)(parameters[link], torch.tensor(placement)).numpy()
        theirs = regressor[:, body - 1] @ chain
        assert relative_error(of_tau[link], theirs) < 1e-8
        assert relative_error(of_a[link], -inverse_mass @ theirs) < 1e-8


def test_all_inertials_at_their_own_values_change_nothing(case):
    robot, _, *states = case
    state = tuple(map(torch.tensor, states))
    given = robot.inertial_parameters(*moving_masses(robot))
    torch.testing.assert_close(
        robot.forward_dynamics(*state, given), robot.forward_dynamics(*state), rtol=1e-11, atol=0
    )
    one = dict([given.popitem()])
    torch.testing.assert_close(robot.forward_dynamics(*state, one), robot.forward_dynamics(*state), rtol=1e-11, atol=0)


@pytest.fixture(scope="module")
def chain():
    robot = Robot.from_urdf_text(CHAIN)
    states = torch.tensor(np.random.default_rng(5).normal(size=(3, 2, robot.nv)))
    return robot, *states


def test_first_and_second_derivatives_by_finite_differences(chain):
    robot, q, v, tau = chain
    names = ("cart", "bracket", "wrist")

    def acceleration(q, v, tau, *inertials):
        return robot.forward_dynamics(q, v, tau, dict(zip(names, inertials, strict=True)))

    inputs = [q, v, tau, *robot.inertial_parameters(*names).values()]
    inputs = [x.clone().requires_grad_() for x in inputs]
    assert gradcheck(acceleration, inputs, rtol=1e-5, check_forward_ad=True)
    assert gradgradcheck(acceleration, inputs, rtol=1e-4, atol=1e-4, fast_mode=True)


def test_frame_functions_are_differentiable(chain):
    robot, q, v, _ = chain
    point = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64).requires_grad_()
    q, v = q.clone().requires_grad_(), v.clone().requires_grad_()
    assert gradcheck(lambda q: robot.frame_pose(q, "tool"), [q])
    assert gradcheck(lambda q, p: robot.frame_jacobian(q, "tool", p), [q, point])
    assert gradcheck(lambda q, v, p: robot.frame_bias_acceleration(q, v, "tool", p), [q, v, point])


def test_vmap_and_nested_transforms_agree_with_the_batch(chain):
    robot, q, v, tau = chain
    inertials = robot.inertial_parameters("wrist")
    mapped = vmap(robot.forward_dynamics)(q, v, tau)
    torch.testing.assert_close(mapped, robot.forward_dynamics(q, v, tau))
    mapped = vmap(lambda q, p: robot.mass_matrix(q, {"wrist": p}), in_dims=(None, 0))(
        q, inertials["wrist"].expand(3, 10)
    )
    torch.testing.assert_close(mapped, robot.mass_matrix(q).expand(3, -1, -1, -1))
    for function in (robot.bias_forces, robot.gravity_forces, robot.mass_matrix):
        arguments = (q, v) if function == robot.bias_forces else (q,)
        torch.testing.assert_close(vmap(function)(*arguments), function(*arguments))
    for function in (robot.frame_pose, robot.frame_jacobian):
        torch.testing.assert_close(vmap(lambda q, f=function: f(q, "tool"))(q), function(q, "tool"))
    per_state = vmap(jacrev(robot.forward_dynamics))(q, v, tau)
    torch.testing.assert_close(per_state, vmap(jacfwd(robot.forward_dynamics))(q, v, tau))
    torch.testing.assert_close(per_state[1], jacrev(robot.forward_dynamics)(q[1], v[1], tau[1]))
    second = hessian(lambda v: robot.bias_forces(q[0], v)[0])(v[0])
    assert second.shape == (robot.nv, robot.nv)
    # bias forces are quadratic in v: the Hessian does not depend on it
    torch.testing.assert_close(second, hessian(lambda v: robot.bias_forces(q[0], v)[0])(v[1]))
