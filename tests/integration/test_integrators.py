"""Integrators against closed forms and fine references, and starts on surfaces."""

import math

import pytest
import torch
from tests.integration.motions import CONTACTS, light_arm
from tests.posterior.arm import arm_model

from forcegp.errors import NumericalError
from forcegp.integration import (
    ImplicitMidpoint,
    RungeKutta4,
    SymplecticEuler,
    integrate,
    integrator_named,
    onto_contacts,
    violation,
)
from forcegp.mechanics import Contact, ImplicitSurface, Plane

POINT = """<robot name="point"><link name="base"/>
<link name="mass"><inertial><mass value="2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="rail" type="prismatic"><parent link="base"/><child link="mass"/><axis xyz="1 0 0"/>
<limit lower="-9" upper="9" effort="9" velocity="9"/></joint></robot>"""


def observed_order(errors: list[float]) -> float:
    """Slope of log error over log dt, where each dt is half of the one before."""
    return math.log2(errors[0] / errors[-1]) / (len(errors) - 1)


@pytest.mark.parametrize(
    ("integrator", "order"),
    [
        (SymplecticEuler(), 1),
        (RungeKutta4(), 4),
        (ImplicitMidpoint(), 2),
    ],
    ids=["symplectic-euler", "rk4", "implicit-midpoint"],
)
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
        motion = integrate(integrator, lambda q, v, u: -q - damping * v + u, *begin, force, end / steps)
        errors.append(abs(float(motion.q[-1]) - exact))
    assert observed_order(errors) == pytest.approx(order, abs=0.15)


def test_implicit_midpoint_follows_stiff_friction_where_explicit_steps_fail():
    model, n = light_arm(), 2
    q0 = torch.linspace(-0.3, 0.3, n, dtype=torch.float64)[:, None] + torch.tensor([1.4, 0.2], dtype=torch.float64)
    time = 0.04 * torch.arange(25, dtype=torch.float64)[:, None, None]
    phase = torch.linspace(0.0, 2.0, n, dtype=torch.float64)[:, None] + torch.tensor([0.0, 1.0], dtype=torch.float64)
    u = torch.tensor([0.5, 0.4], dtype=torch.float64) * torch.sin(2.0 * math.pi * time + phase)

    def ends(name, finer):
        method = integrator_named(name, model)
        forces = u.repeat_interleave(finer, 0)
        motion = integrate(
            method,
            lambda q, v, u: model.dynamics(q, v, u).acceleration_map().offset,
            q0,
            0.0 * q0,
            forces,
            0.04 / finer,
        )
        assert (motion.diverged_at == -1).all()
        return motion.q[-1]

    true = ends("rk4", 12)
    error = {
        name: float((ends(name, 1) - true).abs().max()) for name in ("symplectic-euler", "rk4", "implicit-midpoint")
    }
    assert error["symplectic-euler"] > 1.0  # rad, after 1 s of which the arm moved about as much
    assert error["rk4"] > 0.4
    assert error["implicit-midpoint"] < 0.1


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_a_start_is_moved_onto_its_surfaces_whatever_their_scale(scale):
    """Along M^-1 A^T: the velocity solves the dense equations."""
    sphere, twice = CONTACTS["sphere"][0].surface, CONTACTS["plane twice"]
    scaled = Contact("hand", (0.0, 0.0, 0.2), ImplicitSurface(lambda p: scale * sphere.value(p)))
    model = arm_model(baumgarte=None).with_contacts([scaled, *twice])
    q = torch.tensor([[0.3, 0.7, 0.8]], dtype=torch.float64)
    v = torch.tensor([[0.8, -0.5, 0.9]], dtype=torch.float64)
    at, moved = onto_contacts(model, q, v)
    assert model.contacts[1].distance(model.robot.kinematics(at)).abs().max() <= 1e-12
    assert (violation(model, at, moved)[0] / torch.tensor([scale, 1.0, 1.0])).abs().max() <= 1e-12
    M, A = model.robot.mass_matrix(q)[0], model.dynamics(at, v, v).A[0, :2]  # the metric is that of the given position
    dense = torch.cat([torch.cat([M, A.mT], dim=1), torch.cat([A, torch.zeros(2, 2).double()], dim=1)])
    right = torch.cat([M @ v[0], torch.zeros(2, dtype=torch.float64)])
    torch.testing.assert_close(moved[0], torch.linalg.solve(dense, right)[:3], rtol=1e-9, atol=1e-11)
    far = model.with_contacts([Contact("hand", (0.0, 0.0, 0.2), Plane((0.0, 0.0, 1.0), 5.0))])
    with pytest.raises(NumericalError, match=r"state 0 .*nearer"):
        onto_contacts(far, q, v)
