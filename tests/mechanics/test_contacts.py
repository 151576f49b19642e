"""A and b of one contact against Pinocchio and against the distance along a trajectory."""

import numpy as np
import pytest
import torch
from tests.mechanics.systems import POINT, assert_close, robot, states, surfaces
from tests.robots.pinocchio_oracle import Oracle
from tests.robots.robot_models import FRAMES, MODELS

from forcegp.errors import InvalidInput
from forcegp.mechanics import Baumgarte, Contact, Plane, State
from forcegp.model import Model

SURFACES = list(surfaces())
FLOOR = Plane((0.0, 0.0, 1.0), 0.0)


def contact(model: str, surface: str) -> Contact:
    return Contact(FRAMES[model], POINT, surfaces()[surface])


def constraint(model: str, surface: str, baumgarte, q, v, u):
    return contact(model, surface).constraint(State(q, v, u, robot(model)), baumgarte)


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("model", MODELS)
def test_against_pinocchio(model, surface):
    """A = s_p J and b = -(s_p a_classical + v^T s_pp v), J and a_classical from Pinocchio."""
    touching, built = contact(model, surface), robot(model)
    q, v, u = states(built.nv, 10)
    A, b, gradient = constraint(model, surface, None, q, v, u)
    place = built.frame_pose(q, FRAMES[model])[:, :3] @ homogeneous()
    assert_close(touching.position(built.kinematics(q)), place, 1e-12)
    oracle = Oracle(MODELS[model](), built)
    index = oracle.with_point(FRAMES[model], np.array(POINT))
    for row in range(len(q)):
        pose, jacobian, acceleration = (
            torch.as_tensor(x.copy()) for x in oracle.frame(q[row].numpy(), v[row].numpy(), index)
        )
        p, J = pose[:3, 3], jacobian[:3]
        assert_close(touching.position(built.kinematics(q[row])), p, 1e-12)
        assert_close(gradient[row], touching.surface.gradient(p), 1e-11)
        assert_close(A[row], touching.surface.gradient(p) @ J, 1e-10)
        velocity = J @ v[row]
        curvature = velocity @ touching.surface.hessian(p) @ velocity
        assert_close(b[row], -(touching.surface.gradient(p) @ acceleration[:3] + curvature), 1e-10)
        assert_close(touching.distance(built.kinematics(q[row])), touching.surface.value(p), 1e-12)


def homogeneous() -> torch.Tensor:
    return torch.tensor([*POINT, 1.0], dtype=torch.float64)


def along(motion, step: float):
    """First and second derivative at 0 by central differences of fourth order."""
    values = [motion(k * step) for k in (-2, -1, 0, 1, 2)]
    first = (values[0] - 8.0 * values[1] + 8.0 * values[3] - values[4]) / (12.0 * step)
    return first, (-values[0] + 16.0 * values[1] - 30.0 * values[2] + 16.0 * values[3] - values[4]) / (12.0 * step**2)


@pytest.mark.parametrize(("omega", "zeta"), [(10.0, 1.0), (3.0, 0.2), (0.0, 1.0), (4.0, 0.0)])
@pytest.mark.parametrize("surface", SURFACES)
def test_baumgarte_turns_the_distance_into_a_damped_oscillator(surface, omega, zeta):
    """c'' + 2 zeta omega c' + omega^2 c = 0, with c and its derivatives from finite differences."""
    touching, built, baumgarte = contact("chain", surface), robot("chain"), Baumgarte(omega, zeta)
    model = Model(built, (touching,), baumgarte=baumgarte)
    q, v, u = states(built.nv, 5, seed=2)
    u = 0.01 * u
    a = model.dynamics(q, v, u).acceleration(torch.zeros_like(u))
    step = 1e-3 / max(1.0, float(a.abs().max()) ** 0.5)
    rate, second = along(lambda t: touching.distance(built.kinematics(q + v * t + 0.5 * a * t**2)), step)
    distance = touching.distance(built.kinematics(q))
    assert_close(second, -2.0 * zeta * omega * rate - omega**2 * distance, 1e-5)
    without = constraint("chain", surface, None, q, v, u)
    assert_close(
        constraint("chain", surface, baumgarte, q, v, u)[1] - without[1],
        -2.0 * zeta * omega * (without[0] * v).sum(-1) - omega**2 * distance,
        1e-12,
    )


# ---------------------------------------------------------------- values


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        (Contact, ("tool", (0, 0), FLOOR), r"Contact point is \(0, 0\); give 3 finite numbers"),
        (Contact, ("tool", "123", FLOOR), "Contact point is '123'"),
        (Contact, (7, (0, 0, 0), FLOOR), "Contact frame is 7; give the name of a link"),
        (Contact, ("tool", (0, 0, 0), lambda p: p[2]), "Contact surface is a function; give a Plane"),
        (Contact, ("tool", (0, 0, 0), FLOOR, ""), "Contact switch is ''; give the name of an input"),
        (Baumgarte, (-1.0,), "Baumgarte omega is -1.0; it must be a finite number >= 0"),
        (Baumgarte, ("10",), "Baumgarte omega is '10'"),
        (Baumgarte, (10.0, -0.1), "Baumgarte zeta is -0.1"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",  # a function's address would differ between processes
)
def test_wrong_contacts_and_stabilisations_are_named(kind, arguments, message):
    with pytest.raises(InvalidInput, match=message):
        kind(*arguments)
