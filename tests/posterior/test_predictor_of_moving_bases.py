"""Predictors and exported C of robots whose base moves, against `predict`, torch's rollouts and differences."""

import ctypes

import numpy as np
import pytest
import torch
from tests.posterior.exported_program import IMPLICIT, PLAIN_AND_SANITIZED, RK4, compiled, ran
from tests.robots.random_positions import random_positions

from forcegp import Contact, Dataset, JointFriction, Model, Noise, Plane, Robot, export_c, fit
from forcegp.errors import InvalidInput
from forcegp.forces import Actuation, JointForces, RigidBodies, Thrusters
from forcegp.mechanics import fixed_frame, fixed_point
from forcegp.posterior import casadi_function, preparation
from forcegp.posterior.casadi_export import export_casadi

HOPPER = """<robot name="hopper"><link name="trunk"><inertial><origin xyz="0.02 -0.01 0.03"/><mass value="5"/>
  <inertia ixx="0.05" iyy="0.06" izz="0.04" ixy="0.002" ixz="0" iyz="0.001"/></inertial></link>
<joint name="knee" type="revolute"><origin xyz="0.1 0 -0.1"/><parent link="trunk"/><child link="foot"/>
  <axis xyz="0 1 0"/>
  <limit lower="-2" upper="2" effort="50" velocity="20"/></joint>
<link name="foot"><inertial><origin xyz="0 0 -0.1"/><mass value="0.5"/>
  <inertia ixx="0.002" iyy="0.002" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
ARM = """<robot name="arm"><link name="base"/>
<joint name="lift" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
  <limit lower="-2" upper="2" effort="50" velocity="20"/></joint>
<link name="upper"><inertial><origin xyz="0 0 0.1"/><mass value="1.5"/>
  <inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="bend" type="revolute"><origin xyz="0 0 0.2"/><parent link="upper"/><child link="hand"/><axis xyz="0 1 0"/>
  <limit lower="-2" upper="2" effort="50" velocity="20"/></joint>
<link name="hand"><inertial><origin xyz="0 0 0.1"/><mass value="0.5"/>
  <inertia ixx="0.004" iyy="0.004" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
ROWS = 24


def hopper():
    robot = Robot.from_urdf_text(HOPPER, base="floating")
    arms = ((0.2, 0.0, 0.0), (-0.1, 0.15, 0.0))
    forces = (Actuation(), Thrusters("trunk", arms, thrust=1.3, torque=(0.05, -0.05)), RigidBodies())
    return Model(robot, fixed_point("foot", (0.0, 0.0, -0.2), switch="stance"), forces)


def fitted(model, prior, seed=0):
    """A posterior of random states, and others near by; every second row has its foot on the ground."""
    generator, robot = torch.Generator().manual_seed(seed), model.robot
    v, u = (torch.randn(ROWS, size, generator=generator, dtype=torch.float64) for size in model.sizes[1:])
    q = random_positions(robot, generator, ROWS)
    if "stance" in model.inputs:
        u[:, -1] = torch.arange(ROWS) % 2
    friction = torch.zeros_like(v)
    friction[:, -1] = -0.3 * torch.tanh(v[:, -1] / 0.2)
    a = model.dynamics(q, v, u).acceleration(friction)
    rows = {name: x.numpy() for name, x in zip("qvua", (q, v, u, a), strict=True)}
    data = Dataset(**rows, time=0.01 * np.arange(ROWS), model=model)
    posterior = fit(model.with_forces(prior, noise=Noise(0.01)), data, points=ROWS, restarts=1)
    v = 0.97 * v + 0.013  # friction curves have kinks at training velocities
    return posterior, q, v, u


@pytest.fixture(scope="module")
def case():
    return fitted(hopper(), JointFriction())


@pytest.fixture(scope="module")
def floating():
    return fitted(hopper(), JointForces())


def close(found, expected, tolerance=1e-10):
    torch.testing.assert_close(found, expected, rtol=0, atol=tolerance * max(1.0, float(expected.abs().max())))


def assert_slopes_of_torch(predictor, posterior, states, tolerance=1e-10):
    found = predictor.linearize(*states)
    expected = posterior.predictor(covariance="none", compile=False).linearize(*states)
    for mine, other in zip(found, expected, strict=True):
        close(mine, other, tolerance)
    return found


def assert_motions_of_torch(predictor, posterior, start, integrator):
    found, expected = (each(*start, integrator=integrator) for each in (predictor.rollouts, posterior.rollout))
    for name in "qva":
        close(getattr(found, name), getattr(expected, name), 1e-9)
    return found


@pytest.mark.parametrize("covariance", ["compressed", "none"])
def test_means_and_covariances_are_those_of_predict(floating, covariance, monkeypatch):
    monkeypatch.setattr(preparation, "TOLERANCE", 1e-6)
    posterior, *states = floating
    predictor, expected = posterior.predictor(covariance=covariance), posterior.predict(*states)
    assert predictor.compiled("mean") is not None
    close(predictor.mean(*states), expected.mean)
    close(predictor.mean(*(x[3] for x in states)), expected.mean[3])
    if covariance != "none":
        mean, found = predictor(*states)
        close(mean, expected.mean)
        close(found, expected.covariance, 1e-5)


@pytest.mark.nightly
def test_derivatives_are_those_in_a_step_from_q(case):
    posterior, q, v, u = case
    space, size = posterior.model.robot.space, 1e-5
    found = assert_slopes_of_torch(posterior.predictor(covariance="none"), posterior, (q, v, u))
    for j in range(space.nv):
        step = torch.zeros(ROWS, space.nv, dtype=torch.float64)
        step[:, j] = size
        ends = [posterior.predict(space.integrate(q, sign * step), v, u, covariance=False).mean for sign in (1, -1)]
        close(found.da_dq[..., j], (ends[0] - ends[1]) / (2 * size), 1e-6)


@pytest.mark.nightly
def test_gradients_are_those_of_predict(case):
    posterior, *states = case
    predictor, weights = posterior.predictor(covariance="none"), torch.linspace(-1, 1, ROWS).double()[:, None]
    leaves = [x.clone().requires_grad_() for x in states]
    leaves[0] = (leaves[0] * (1.0 + 5e-5)).detach().requires_grad_()  # a length that is rounded
    found = torch.autograd.grad((weights * predictor.mean(*leaves)).sum(), leaves)
    expected = torch.autograd.grad((weights * posterior.predict(*leaves, covariance=False).mean).sum(), leaves)
    for mine, other in zip(found, expected, strict=True):
        close(mine, other)


@pytest.mark.parametrize("integrator", ["symplectic-euler", RK4, IMPLICIT])
def test_compiled_motions_stay_on_the_manifold(case, integrator):
    posterior, q, v, u = case
    u, predictor = u[:3, None].expand(-1, 6, -1).clone(), posterior.predictor(covariance="none")
    found = assert_motions_of_torch(predictor, posterior, (q[:3], v[:3], u, 0.004), integrator)
    close(posterior.model.robot.space.normalized(found.q[:, 1:].contiguous()), found.q[:, 1:], 1e-14)
    assert isinstance(predictor._made.get((integrator, 0, 0)), list) == (integrator != "implicit-midpoint")
    q_next, v_next = predictor.step(q[:3], v[:3], u[:, 0], 0.004, integrator)
    close(q_next, found.q[:, 1], 1e-9)
    close(v_next, found.v[:, 1], 1e-9)


@pytest.mark.parametrize("integrator", ["symplectic-euler", RK4, IMPLICIT])
def test_a_linear_step_is_that_of_differences(case, integrator):
    posterior, *states = case
    q, v, u = (x[:2] for x in states)
    predictor, robot, size, dt = posterior.predictor(covariance="none"), posterior.model.robot, 1e-5, 0.02
    step = predictor.linearize_step(q, v, u, dt, integrator)
    nv, x = robot.nv, torch.cat([torch.zeros_like(v), v], -1)
    exact = (step.A @ x[..., None] + step.B @ u[..., None])[..., 0] + step.c
    close(exact, torch.cat([torch.zeros_like(v), step.v], -1))
    for j in range(2 * nv):
        change = torch.zeros(2, 2 * nv, dtype=torch.float64)
        change[:, j] = size
        ends = []
        for sign in (1.0, -1.0):
            at = robot.integrate(q, sign * change[:, :nv]), v + sign * change[:, nv:]
            there = predictor.step(*at, u, dt, integrator)
            ends.append(torch.cat([robot.difference(step.q, there[0]), there[1]], -1))
        close(step.A[..., j], (ends[0] - ends[1]) / (2 * size), 1e-6)


@PLAIN_AND_SANITIZED
def test_the_program_in_c(floating, tmp_path, options):
    posterior, q, v, _ = floating
    written = export_c(posterior, tmp_path / "c", covariance=True, steps=0.005, integrator="rk4")
    # standard deviations are roots of differences
    assert max(x for name, x in written.differences.items() if not name.endswith("deviation")) < 1e-10
    assert max(written.differences.values()) < 1e-9
    folder = tmp_path / "c"
    for program in ("self_test.c", "example.c"):
        assert ran(folder, program, "hopper.c", *options).returncode == 0
    library, made = compiled(folder, "hopper.c"), np.zeros(8)
    step = 0.3 * v[0]
    given = [x.contiguous().numpy() for x in (q[0], step)]
    assert library.hopper_integrate(*(ctypes.c_void_p(x.ctypes.data) for x in (*given, made))) == 0
    close(torch.as_tensor(made), posterior.model.robot.integrate(q[0], step), 1e-13)


@pytest.mark.usefixtures("unchecked")  # explicit steps add and scale CasADi's expressions as they do tensors
@pytest.mark.nightly
def test_functions_of_casadi(case, tmp_path):
    posterior, q, v, u = case
    casadi = pytest.importorskip("casadi")
    robot, rows = posterior.model.robot, [x.numpy().T for x in (q, v, u)]
    function = casadi_function(posterior)
    a, q_dot = (torch.as_tensor(np.array(x)).T for x in function.map(ROWS)(*rows))
    close(a, posterior.predict(q, v, u).mean)
    size = 1e-6
    close(q_dot, (robot.integrate(q, size * v) - robot.integrate(q, -size * v)) / (2 * size), 1e-8)
    slope = torch.as_tensor(np.array(function.factory("j", ["q", "v", "u"], ["jac:a:q"])(*(x[:, 3] for x in rows))))
    predictor = posterior.predictor(covariance="none")
    close(slope @ robot.space.tangent(q[3]), predictor.linearize(q[3], v[3], u[3]).da_dq, 1e-9)
    for integrator in ("symplectic-euler", "rk4"):
        step = casadi_function(posterior, steps=0.01, integrator=integrator)
        expected = predictor.step(q, v, u, 0.01, integrator)
        for found, wanted in zip(step.map(ROWS)(*rows), expected, strict=True):
            close(torch.as_tensor(np.array(found)).T, wanted)
    written = export_casadi(posterior, tmp_path, steps=0.01)
    assert len(written) == 2
    assert max(written.values()) < 1e-10
    with pytest.raises(InvalidInput, match="is not 'implicit-midpoint'; give one of 'symplectic-euler', 'rk4'"):
        casadi_function(posterior, steps=0.01, integrator="implicit-midpoint")
    assert casadi.Function.load(str(tmp_path / "hopper.casadi")).n_out() == 2


def test_what_is_refused(floating):
    posterior, q, v, u = floating
    predictor = posterior.predictor(covariance="none")
    for states in ((q, v, u), [x[0] for x in (q, v, u)]):
        with pytest.raises(InvalidInput, match="of length 1"):
            predictor.mean(1.001 * states[0], *states[1:])
    with pytest.raises(InvalidInput, match=r"give q \(..., 8\), v \(..., 7\), u \(..., 4\)"):
        predictor.mean(v, v, u)
    with pytest.raises(InvalidInput, match="no u makes every acceleration"):
        predictor.inverse_dynamics(q, v, v)


@pytest.mark.filterwarnings("ignore:half of the training points:forcegp.errors.DataWarning")
@pytest.mark.parametrize("integrator", ["rk4", IMPLICIT])
def test_an_arm_with_a_switch(integrator, tmp_path):
    """Its base is fixed, and u has more entries than v."""
    robot = Robot.from_urdf_text(ARM)
    stance = Contact("hand", (0.0, 0.0, 0.2), Plane((0.0, 0.0, 1.0), 0.3), switch="stance")
    posterior, q, v, u = fitted(Model(robot, (stance,)), JointFriction())
    predictor, held, dt = posterior.predictor(covariance="none"), u[:3, None].expand(-1, 6, -1), 0.004
    assert_slopes_of_torch(predictor, posterior, (q, v, u))
    assert_motions_of_torch(predictor, posterior, (q[:3], v[:3], held, dt), integrator)
    step, size = predictor.linearize_step(q, v, u, dt, integrator), 1e-5
    for j in range(3):
        change = torch.eye(3, dtype=torch.float64)[j] * size
        ends = [torch.cat(predictor.step(q, v, u + sign * change, dt, integrator), -1) for sign in (1.0, -1.0)]
        close(step.B[..., j], (ends[0] - ends[1]) / (2 * size), 1e-7)
    assert max(export_c(posterior, tmp_path / "c", steps=dt, integrator=integrator).differences.values()) < 1e-8


@pytest.mark.nightly
def test_redundant_contacts_have_right_derivatives():
    """A foot that neither moves nor turns: nine rows of rank six, which velocities contradict."""
    robot = Robot.from_urdf_text(HOPPER, base="floating")
    posterior, q, v, u = fitted(Model(robot, fixed_frame("foot")), JointFriction())
    predictor = posterior.predictor(covariance="none")
    close(predictor.mean(q, v, u), posterior.predict(q, v, u).mean)
    assert_slopes_of_torch(predictor, posterior, (q, v, u), 1e-9)
