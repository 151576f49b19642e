"""Integrators against closed forms and fine references; the constraint holds after every projected step."""

import math

import pytest
import torch
from tests.integration.motions import CONTACTS, free_system, light_arm, physics, start
from tests.posterior.arm import arm_model

from forcegp.errors import NumericalError
from forcegp.integration import (
    ConstraintManifold,
    ImplicitMidpoint,
    Projected,
    RungeKutta4,
    SymplecticEuler,
    integrate,
    integrator_named,
)
from forcegp.mechanics import Contact, ImplicitSurface, Plane
from forcegp.model import Model
from forcegp.robots import Robot

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
        (Projected(ConstraintManifold(Model(Robot.from_urdf_text(POINT)))), 2),
    ],
    ids=["symplectic-euler", "rk4", "implicit-midpoint", "projected without contacts"],
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


def test_implicit_midpoint_is_cayleys_transform_of_a_linear_system():
    generator = torch.Generator().manual_seed(0)
    K, D = (torch.randn(2, 3, 3, dtype=torch.float64, generator=generator)).unbind()
    q, v = torch.randn(2, 4, 3, dtype=torch.float64, generator=generator).unbind()
    step = ImplicitMidpoint().step(lambda q, v: -q @ K.mT - v @ D.mT, q, v, 0.3)
    F = torch.cat([torch.cat([0.0 * K, torch.eye(3).double()], 1), torch.cat([-K, -D], 1)])
    identity = torch.eye(6, dtype=torch.float64)
    dense = torch.linalg.solve(identity - 0.15 * F, (identity + 0.15 * F) @ torch.cat([q, v], -1).mT).mT
    assert step.found.all()
    torch.testing.assert_close(torch.cat([step.q, step.v], -1), dense, rtol=1e-12, atol=1e-12)


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


@pytest.mark.parametrize("contacts", ["plane twice", "sphere"])
def test_the_projected_scheme_is_of_second_order_on_every_surface(contacts):
    model = free_system(contacts)
    q0, v0 = start(model)
    acceleration, end = physics(model), 0.2

    def last(integrator, steps):
        force = torch.zeros(steps, 2, 3, dtype=torch.float64)
        motion = integrate(integrator, acceleration, q0, v0, force, end / steps)
        return torch.cat([motion.q[-1], motion.v[-1]], dim=-1)

    reference = last(RungeKutta4(), 80)  # its drift off the surface is far below the errors measured here
    errors = [
        float((last(Projected(ConstraintManifold(model)), steps) - reference).abs().max()) for steps in (10, 20, 40)
    ]
    assert observed_order(errors) == pytest.approx(2.0, abs=0.25)


def test_the_projected_scheme_stays_on_the_surface_for_5_s():
    # Steps of 1/60 s are coarser, so harder, than the 1/240 s of recordings, and four times as fast.
    model = free_system("cylinder")
    q0, v0 = start(model)
    force = 0.3 * torch.randn(300, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    motion = integrate(Projected(ConstraintManifold(model)), physics(model), q0, v0, force, 1 / 60)
    c, rate = ConstraintManifold(model).violation(motion.q, motion.v)
    assert (motion.diverged_at == -1).all()
    assert (motion.q[-1] - motion.q[0]).abs().max() > 0.1  # it did move
    assert c.abs().max() <= 1e-11
    assert rate.abs().max() <= 1e-12


def test_the_velocity_projection_solves_the_dense_equations():
    model = free_system("sphere").with_contacts((*CONTACTS["sphere"], *CONTACTS["plane"]))
    q = torch.tensor([[0.3, 0.7, 0.8]], dtype=torch.float64)
    v = torch.tensor([[0.8, -0.5, 0.9]], dtype=torch.float64)
    manifold = ConstraintManifold(model)
    at = manifold.project_position(q)
    projected = manifold.project_velocity(at, v)
    M = model.robot.mass_matrix(q)[0]  # the metric is that of the given position
    A = model.dynamics(at.q, v, v).A[0]
    zero = torch.zeros(2, 2, dtype=torch.float64)
    dense = torch.cat([torch.cat([M, A.mT], dim=1), torch.cat([A, zero], dim=1)])
    right = torch.cat([M @ v[0], torch.zeros(2, dtype=torch.float64)])
    torch.testing.assert_close(projected[0], torch.linalg.solve(dense, right)[:3], rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_the_position_tolerance_is_a_distance_whatever_the_scale_of_the_surface(scale):
    plane = Plane((0.2, 0.0, 1.0), 0.4)
    surface = ImplicitSurface(lambda p: scale * plane.value(p))
    model = arm_model(baumgarte=None).with_contacts([Contact("hand", (0.0, 0.0, 0.2), surface)])
    q0, _ = start(free_system("plane"))
    distance = free_system("plane").contacts[0].distance
    assert distance(model.robot.kinematics(q0 + 1e-6)).abs().min() > 1e-7
    for off in (1e-2, 1e-6, 1e-10):  # a tolerance of 1e-12 in c itself would leave the last as it is, 1e-10 m off
        at = ConstraintManifold(model).project_position(q0 + off)
        assert at.converged.all()
        assert distance(model.robot.kinematics(at.q)).abs().max() <= 1e-12


def test_a_start_out_of_reach_is_refused_with_a_remedy():
    model = arm_model(baumgarte=None).with_contacts([Contact("hand", (0.0, 0.0, 0.2), Plane((0.0, 0.0, 1.0), 5.0))])
    q, v = start(free_system("plane"))
    with pytest.raises(NumericalError, match=r"state 0 .*nearer"):
        onto_contacts(model, q, v)
