"""Motions of many windows at once, held to the integrator that takes one step at a time, and to finite differences."""

import pytest
import torch
from tests.posterior.arm import arm_model

from forcegp.integration import midpoint_sensitivities
from forcegp.integration.integrators import VECTORS, implicit_midpoint, rows_jacobian
from forcegp.integration.midpoint_sensitivities import Accelerations, Linear, window_motions
from forcegp.model import Model

H = 0.01
WINDOWS, STEPS = 2, 8
LEVELS = torch.tensor([0.8, 0.5, 0.3], dtype=torch.float64)  # of friction


def accelerations(model: Model, friction: torch.Tensor, width: float) -> Accelerations:
    """With dry friction of these levels (nv,)."""
    nv = model.robot.nv

    def mean(q, v, u):
        return model.dynamics(q, v, u).acceleration(-friction * torch.tanh(v / width))

    def linear(q, v, u, parameters):
        a, slopes = rows_jacobian(lambda x: mean(x[:, :nv], x[:, nv:], u), torch.cat([q, v], dim=-1))
        H_friction = model.dynamics(q, v, u).H * -torch.tanh(v / width)[:, None]
        return Linear(a, *slopes.split(nv, dim=-1), H_friction if parameters else None)

    return Accelerations(mean, linear)


@pytest.fixture(scope="module")
def given():
    """System, q0, v0 and u of the windows, and as guess of the middles that nothing moves."""
    model, generator = arm_model(0), torch.Generator().manual_seed(2)
    nv = model.robot.nv
    q0 = 0.3 * torch.randn(WINDOWS, nv, generator=generator, dtype=torch.float64)
    q0 += torch.tensor([0.2, 0.7, 0.8])
    v0 = 0.4 * torch.randn(WINDOWS, nv, generator=generator, dtype=torch.float64)
    u = 3.0 * torch.randn(WINDOWS, STEPS, model.sizes[2], generator=generator, dtype=torch.float64)
    return model, q0, v0, u, tuple(x[:, None].expand(WINDOWS, STEPS, -1) for x in (q0, v0))


@pytest.mark.parametrize("passes", [20, 1])
def test_motions_are_those_of_the_integrator(given, passes, monkeypatch):
    monkeypatch.setattr(midpoint_sensitivities, "MOST_PASSES", passes)  # one: all are stepped through one by one
    model, q0, v0, u, guess = given
    of = accelerations(model, LEVELS, 0.01)
    found = window_motions(of, q0, v0, u, H, guess)
    assert bool(found.found.all())
    q, v = q0, v0
    for k in range(STEPS):
        step = implicit_midpoint(VECTORS, lambda q, v, k=k: of.mean(q, v, u[:, k]), q, v, H)
        q, v = step.q, step.v
        torch.testing.assert_close(found.q[:, k + 1], q, rtol=0.0, atol=1e-9)
        torch.testing.assert_close(found.v[:, k + 1], v, rtol=0.0, atol=1e-7)
    assert float((found.v[:, 1:] * found.v[:, :-1]).min()) < 0.0  # friction turns round on the way


def test_derivatives_are_those_of_finite_differences(given):
    model, q0, v0, u, guess = given
    small, nv = 1e-6, model.robot.nv

    def q_at(dq, dv, friction):
        return window_motions(accelerations(model, LEVELS + friction, 0.1), q0 + dq, v0 + dv, u, H, guess).q

    found = window_motions(accelerations(model, LEVELS, 0.1), q0, v0, u, H, guess)
    e, f = small * torch.randn(2, 2 * nv, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    for derivative, ends in (  # along one direction of all, which shows every entry
        (found.in_start @ e, [q_at(sign * e[:nv], sign * e[nv:], 0.0) for sign in (1.0, -1.0)]),
        (found.in_parameters @ f[:nv], [q_at(0.0, 0.0, sign * f[:nv]) for sign in (1.0, -1.0)]),
    ):
        torch.testing.assert_close(derivative, (ends[0] - ends[1]) / 2.0, rtol=1e-5, atol=1e-14)


def test_windows_without_an_end_are_reported(given):
    _, q0, v0, u, guess = given

    def away(q, v, u):  # v_m = v + h/2 (v_m^2 + 1) / h has no solution
        return 2.0 * (v.square() + v + 1.0) / H

    def linear(q, v, u, _):
        a, slope = rows_jacobian(lambda v: away(q, v, u), v)
        return Linear(a, torch.zeros_like(slope), slope)

    assert not bool(window_motions(Accelerations(away, linear), q0, v0.abs(), u, H, guess).found.any())
