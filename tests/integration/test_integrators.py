"""Integrators against closed forms and fine references, and starts on surfaces."""

import math
from functools import partial

import pytest
import torch
from tests.robots.random_positions import random_positions
from tests.robots.test_moving_bases import LIMBS

from forcegp.errors import InvalidInput, NumericalWarning
from forcegp.integration import INTEGRATORS, SPEED_LIMIT, integrate, integrator_named
from forcegp.integration.integrators import VECTORS, find_roots
from forcegp.model import Model
from forcegp.robots import Robot


def of_vectors(name):
    return partial(INTEGRATORS[name], VECTORS)


@pytest.mark.parametrize(("integrator", "order"), [("symplectic-euler", 1), ("rk4", 4), ("implicit-midpoint", 2)])
def test_order_on_a_damped_oscillator_with_its_closed_form(integrator, order):
    damping, q0, v0, end = 0.4, 0.7, -0.3, 2.0
    rate, omega = damping / 2, math.sqrt(1.0 - damping**2 / 4)
    exact = math.exp(-rate * end) * (
        q0 * math.cos(omega * end) + (v0 + rate * q0) / omega * math.sin(omega * end)
    )  # of q'' = -q - damping q'
    errors = []
    for steps in (20, 40, 80):
        begin = [torch.tensor([[x]], dtype=torch.float64) for x in (q0, v0)]
        force = torch.zeros(steps, 1, 1, dtype=torch.float64)
        motion = integrate(of_vectors(integrator), lambda q, v, u: -q - damping * v + u, *begin, force, end / steps)
        errors.append(abs(float(motion.q[-1]) - exact))
    assert math.log2(errors[0] / errors[-1]) / 2 == pytest.approx(order, abs=0.15)  # steps were halved twice


def implicit_step(friction, joints: int, states: int):
    """The equation of an implicit step of 40 ms with coupled masses from .003 to 3 kg m^2, and where it begins."""
    like = {"dtype": torch.float64, "generator": torch.Generator().manual_seed(0)}
    Q, _ = torch.linalg.qr(torch.randn(states, joints, joints, **like))
    M = (Q * torch.logspace(-2.5, 0.5, joints, dtype=torch.float64)) @ Q.mT
    v, u = torch.randn(2, states, joints, **like).unbind()
    return lambda w: w - v - 0.02 * torch.linalg.solve(M, 2.0 * u - friction(w)), v


def stribeck(v):
    return (2.0 + 2.0 * torch.exp(-((v / 0.1) ** 2))) * torch.tanh(v / 0.01) + 0.01 * v


def sawtooth(v):
    """A mean of Matern-1/2 friction: a kink at each of 100 training velocities."""
    generator = torch.Generator().manual_seed(1)
    at = torch.asinh(torch.randn(v.shape[-1], 100, generator=generator, dtype=torch.float64) * 40.0)
    weights = 0.2 * torch.randn(v.shape[-1], 100, generator=generator, dtype=torch.float64)
    bumps = (torch.exp(-(torch.asinh(v / 0.05)[..., None] - at).abs() / 0.3) * weights).sum(-1)
    return torch.tanh(v / 0.05) * (0.1 + bumps) + 0.01 * v


@pytest.mark.parametrize("friction", [stribeck, sawtooth])
@pytest.mark.parametrize("joints", [2, 7])
def test_all_implicit_steps_are_found(friction, joints):
    residual, v = implicit_step(friction, joints, 40)
    w, found = find_roots(residual, v)
    assert found.all()
    assert residual(w).abs().max() <= 1e-7 * residual(v).abs().max()


def test_where_there_is_no_root_it_is_not_found():
    x = torch.tensor([[0.5], [0.5], [0.5]], dtype=torch.float64)
    shift = torch.tensor([[0.0], [1.0], [float("nan")]], dtype=torch.float64)
    _, found = find_roots(lambda x: x**2 + shift - 0.1, x)
    assert found.tolist() == [True, False, False]


def test_the_root_is_differentiable_once():
    p = torch.rand(3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()

    def root(p):
        return find_roots(lambda x: x + p * torch.tanh(x / 0.1) - p[:, :1] * x.roll(1, -1) ** 2 - 0.3, 0.0 * p)[0]

    assert torch.autograd.gradcheck(root, p)
    with pytest.raises(InvalidInput, match="differentiable once; leave out create_graph"):
        torch.autograd.grad(root(p).sum(), p, create_graph=True)


def test_without_eigenvalues_the_bound_is_theirs_where_the_jacobian_is_symmetric(monkeypatch):
    """A smallest slope of .05 is raised to .1, so the error halves with every step, either way."""
    A = torch.tensor([[0.525, 0.475], [0.475, 0.525]], dtype=torch.float64)  # of eigenvalues .05 and 1
    calls = []

    def residual(x):
        calls[-1] += 1
        return x @ A - torch.tensor([0.05, -0.05], dtype=torch.float64)

    def fails(_):
        raise torch.linalg.LinAlgError("the algorithm failed to converge")

    for eigenvalues in (torch.linalg.eigvals, fails):
        monkeypatch.setattr(torch.linalg, "eigvals", eigenvalues)
        calls.append(0)
        x, found = find_roots(residual, torch.zeros(1, 2).double())
        assert found.all()
        torch.testing.assert_close(x, torch.tensor([[1.0, -1.0]]).double())
    assert calls[0] == calls[1] > 20


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None]


def explosive(q, v, u):
    """Grows without bound from v > 0, and is not finite beyond q = 1; decays for v <= 0."""
    assert bool(torch.isfinite(q).all() and torch.isfinite(v).all())
    return torch.where(v > 0, 40.0 * v, -v) / (q < 1.0)


@pytest.mark.parametrize("integrator", ["symplectic-euler", "rk4"])
def test_a_diverging_motion_is_nan_from_where_it_says_and_the_others_go_on(integrator):
    q0, v0, force = column(0.0, 0.0, 0.5), column(1.0, -1.0, -2.0), torch.zeros(100, 3, 1, dtype=torch.float64)
    with pytest.warns(NumericalWarning, match=r"1 of 3 motions .*step \d+"):
        motion = integrate(of_vectors(integrator), explosive, q0, v0, force, 0.01)
    row = int(motion.diverged_at[0])
    assert 0 < row < 100
    assert motion.diverged_at[1:].tolist() == [-1, -1]
    for rows in (motion.q, motion.v):
        assert torch.isfinite(rows[:row, 0]).all()
        assert torch.isnan(rows[row:, 0]).all()
    assert torch.isnan(motion.a[row:, 0]).all()
    assert (motion.v[:row, 0].abs() <= SPEED_LIMIT).all()
    alone = integrate(of_vectors(integrator), explosive, q0[1:], v0[1:], force[:, 1:], 0.01)
    # vector instructions round a batch of three otherwise than one of two, at each of 100 steps
    torch.testing.assert_close(motion.q[:, 1:], alone.q, rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(motion.a[:, 1:], alone.a, rtol=1e-11, atol=1e-11)


def test_a_motion_whose_implicit_step_has_no_solution_ends_with_that_reason():
    """Dry friction that jumps at rest has none where the motion stops."""
    q0, v0, force = column(0.0, 0.0), column(0.05, 5.0), torch.zeros(3, 2, 1, dtype=torch.float64)
    said = r"1 of 2 .* Newton's method found no solution of the implicit step\. They"
    with pytest.warns(NumericalWarning, match=said):
        motion = integrate(of_vectors("implicit-midpoint"), lambda q, v, u: -10.0 * v.sign(), q0, v0, force, 0.04)
    assert motion.diverged_at.tolist() == [1, -1]
    torch.testing.assert_close(motion.v[:, 1, 0], 5.0 - 0.4 * torch.arange(4, dtype=torch.float64))


def test_a_start_in_other_units_is_refused():
    force = torch.zeros(4, 1, 1, dtype=torch.float64)
    with pytest.raises(InvalidInput, match=r"v0 has a joint velocity of 1.5e\+03; .* check its units"):
        integrate(of_vectors("symplectic-euler"), lambda q, v, u: -q, column(1.0), column(1500.0), force, 0.1)


def moved(robot, name, dt, seconds, speed=1.0):
    generator = torch.Generator().manual_seed(1)
    q = random_positions(robot, generator)
    v = speed * torch.randn(1, robot.nv, dtype=torch.float64, generator=generator)
    steps = torch.zeros(round(seconds / dt), 1, robot.nv, dtype=torch.float64)
    method = integrator_named(name, Model(robot))
    with torch.no_grad():
        return integrate(method, robot.forward_dynamics, q, v, steps, dt)


def test_steps_have_their_order_on_the_manifold():
    robot, seconds, coarse = Robot.from_urdf_text(LIMBS, base="floating"), 0.06, 0.02
    reference = moved(robot, "rk4", coarse / 8, seconds, 0.5)
    for name, order in (("symplectic-euler", 1), ("implicit-midpoint", 2), ("rk4", 4)):
        ends = [moved(robot, name, dt, seconds, 0.5).q[-1] for dt in (coarse, coarse / 2)]
        errors = [float(robot.difference(reference.q[-1], end).norm()) for end in ends]
        assert errors[1] < errors[0] / 2 ** (order - 0.4), name
