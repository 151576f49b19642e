"""Motions of many windows at once, held to the integrator that takes one step at a time, and to finite differences."""

import pytest
import torch
from tests.models.arm import arm_system

from forcegp.integration import midpoint_sensitivities
from forcegp.integration.integrators import ImplicitMidpoint, rows_jacobian
from forcegp.integration.midpoint_sensitivities import Accelerations, Linear, window_motions

H = 0.01
WINDOWS, STEPS = 3, 12


def accelerations(friction: torch.Tensor, width: float) -> Accelerations:
    """Of the arm in the air with dry friction of these levels (3,) in its joints."""
    system = arm_system(0)

    def mean(q, v, u):
        return system.dynamics(q, v, u).acceleration(-friction * torch.tanh(v / width))

    def linear(q, v, u, parameters):
        a, slopes = rows_jacobian(lambda x: mean(*x.split(3, dim=-1), u), torch.cat([q, v], dim=-1))
        H_friction = system.dynamics(q, v, u).H * -torch.tanh(v / width)[:, None]
        return Linear(a, *slopes.split(3, dim=-1), H_friction if parameters else None)

    return Accelerations(mean, linear)


@pytest.fixture(scope="module")
def given():
    """q0, v0 and u of the windows, and as guess of the middles that nothing moves."""
    generator = torch.Generator().manual_seed(2)
    q0 = torch.tensor([0.2, 0.7, 0.8]) + 0.3 * torch.randn(WINDOWS, 3, generator=generator, dtype=torch.float64)
    v0 = 0.4 * torch.randn(WINDOWS, 3, generator=generator, dtype=torch.float64)
    u = 3.0 * torch.randn(WINDOWS, STEPS, 3, generator=generator, dtype=torch.float64)
    rest = q0[:, None].expand(WINDOWS, STEPS, 3), v0[:, None].expand(WINDOWS, STEPS, 3)
    return q0, v0, u, rest


LEVELS = torch.tensor([0.8, 0.5, 0.3], dtype=torch.float64)


@pytest.mark.parametrize(("width", "passes"), [(0.4, 20), (0.01, 20), (0.01, 1)])
def test_motions_are_those_of_the_integrator(given, width, passes, monkeypatch):
    monkeypatch.setattr(midpoint_sensitivities, "MOST_PASSES", passes)  # one: all are stepped through one by one
    q0, v0, u, guess = given
    of = accelerations(LEVELS, width)
    found = window_motions(of, q0, v0, u, H, guess, derivatives=False)
    assert bool(found.found.all())
    q, v = q0, v0
    for k in range(STEPS):
        step = ImplicitMidpoint().step(lambda q, v, k=k: of.mean(q, v, u[:, k]), q, v, H)
        q, v = step.q, step.v
        torch.testing.assert_close(found.q[:, k + 1], q, rtol=0.0, atol=1e-9)
        torch.testing.assert_close(found.v[:, k + 1], v, rtol=0.0, atol=1e-7)
    assert float((found.v[:, 1:] * found.v[:, :-1]).min()) < 0.0  # friction turns round on the way


def test_derivatives_are_those_of_finite_differences(given):
    q0, v0, u, guess = given
    small = 1e-6

    def q_at(dq, dv, friction):
        return window_motions(accelerations(friction, 0.1), q0 + dq, v0 + dv, u, H, guess, derivatives=False).q

    found = window_motions(accelerations(LEVELS, 0.1), q0, v0, u, H, guess, derivatives=True)
    for k, e in enumerate(small * torch.eye(3, dtype=torch.float64)):
        for derivative, ends in (
            (found.in_start[..., k], (q_at(e, 0.0, LEVELS), q_at(-e, 0.0, LEVELS))),
            (found.in_start[..., 3 + k], (q_at(0.0, e, LEVELS), q_at(0.0, -e, LEVELS))),
            (found.in_parameters[..., k], (q_at(0.0, 0.0, LEVELS + e), q_at(0.0, 0.0, LEVELS - e))),
        ):
            torch.testing.assert_close(derivative, (ends[0] - ends[1]) / (2.0 * small), rtol=1e-5, atol=1e-8)


def test_windows_without_an_end_are_reported(given):
    q0, v0, u, guess = given

    def away(q, v, u):  # v_m = v + h/2 (v_m^2 + 1) / h has no solution
        return 2.0 * (v.square() + v + 1.0) / H

    def linear(q, v, u, _):
        a, slope = rows_jacobian(lambda v: away(q, v, u), v)
        return Linear(a, torch.zeros_like(slope), slope)

    found = window_motions(Accelerations(away, linear), q0, v0.abs(), u, H, guess, derivatives=False)
    assert not bool(found.found.any())
