"""Gauss' principle against the KKT equations solved densely, and the identities of H."""

from functools import cache

import pytest
import torch
from tests.mechanics import systems
from tests.mechanics.systems import INDEPENDENT, REDUNDANT, assert_close, robot, states
from tests.robots.robot_models import FRAMES, MODELS

from forcegp.errors import NumericalError
from forcegp.mechanics import Baumgarte, Contact, Sphere
from forcegp.model import Model

TOLERANCE, ALL = 1e-10, [*INDEPENDENT, *REDUNDANT]


@cache
def regular_dynamics(model: str, kind: str):
    built = systems.model_with(model, kind, baumgarte=Baumgarte(10.0, 1.0))
    return built.dynamics(*systems.regular_states(built, 20)), systems.normal(20, built.robot.nv, seed=9)


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("model", MODELS)
class TestAgainstDenseEquations:
    @pytest.fixture
    def solved(self, model, kind):
        return regular_dynamics(model, kind)

    def test_acceleration_and_multiplier(self, solved):
        dynamics, Q_U = solved
        a, multiplier = systems.solve_kkt(dynamics.M, dynamics.Q_K + Q_U, dynamics.A, dynamics.b)
        assert_close(dynamics.acceleration(Q_U), a, TOLERANCE)
        assert_close(dynamics.multiplier(Q_U), multiplier, TOLERANCE)

    def test_H_and_the_constrained_offset(self, solved):
        """H is the response to unit forces; the constraint force gives the offset when nothing else acts."""
        dynamics, Q_U = solved
        at_rest, multiplier = systems.solve_kkt(dynamics.M, torch.zeros_like(Q_U), dynamics.A, dynamics.b)
        assert_close(
            (dynamics.M @ dynamics.constrained_offset[..., None])[..., 0],
            (dynamics.A.mT @ multiplier[..., None])[..., 0],
            TOLERANCE,
        )
        columns = []
        for unit in torch.eye(Q_U.shape[-1], dtype=torch.float64):
            response, _ = systems.solve_kkt(dynamics.M, unit.expand_as(Q_U), dynamics.A, torch.zeros_like(dynamics.b))
            columns.append(response)
        assert_close(dynamics.H, torch.stack(columns, dim=-1), TOLERANCE)
        assert_close(dynamics.acceleration_map()(-dynamics.Q_K), at_rest, TOLERANCE)

    def test_identities(self, solved):
        dynamics, Q_U = solved
        H, M, A, a = dynamics.H, dynamics.M, dynamics.A, dynamics.acceleration(Q_U)
        assert_close((A @ a[..., None])[..., 0], dynamics.b, TOLERANCE)
        assert_close(H @ M @ H, H, TOLERANCE)
        assert torch.equal(H, H.mT)
        scale = float(H.abs().max())
        assert float((H @ A.mT / scale).abs().sum()) < TOLERANCE
        assert float(torch.linalg.eigvalsh(H).min()) > -TOLERANCE * scale
        rank = int(torch.linalg.matrix_rank(A, rtol=1e-9).min()) if A.shape[-2] else 0
        trace = (H @ M).diagonal(dim1=-2, dim2=-1).sum(-1)
        assert_close(trace, torch.full((20,), float(M.shape[-1] - rank)).double(), 1e-9)
        forces = dynamics.Q_K + Q_U + (A.mT @ dynamics.multiplier(Q_U)[..., None])[..., 0]
        assert_close((M @ a[..., None])[..., 0], forces, TOLERANCE)

    def test_forces_of_contacts_are_gradients_times_multipliers(self, solved):
        dynamics, Q_U = solved
        assert_close(dynamics.acceleration_under(dynamics.Q_K + Q_U), dynamics.acceleration(Q_U), TOLERANCE)
        if not dynamics.contacts:
            assert dynamics.off().shape == (20, 0)
            return
        at, multiplier = dynamics.state.kinematics, dynamics.multiplier(Q_U)
        places = [each.position(at).detach().requires_grad_() for each in dynamics.contacts]
        values = [each.surface.value(p) for each, p in zip(dynamics.contacts, places, strict=True)]
        gradients = torch.stack([torch.autograd.grad(x.sum(), p)[0] for x, p in zip(values, places, strict=True)], 1)
        sizes = gradients.norm(dim=-1)
        assert_close(dynamics.off(), torch.stack(values, -1).detach() / sizes, TOLERANCE)
        assert_close(dynamics.contact_force_map()(Q_U), (gradients * multiplier[..., None]).flatten(1), TOLERANCE)
        frame, measured = dynamics.contacts[0].frame, systems.normal(20, 3)
        assert_close(dynamics.force_at(frame)(Q_U), (sizes * multiplier).sum(-1, keepdim=True), TOLERANCE)
        along = torch.nn.functional.normalize(gradients.sum(1), dim=-1)
        assert_close(dynamics.as_measured(frame, measured), (along * measured).sum(-1, keepdim=True), TOLERANCE)


# ---------------------------------------------------------------- derivatives


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("model", ["tree", "chain"])
def test_derivatives(model, kind):
    """With respect to q, v and u, also where contacts are redundant."""
    # Rotor inertia makes the light wrists heavier, so that finite differences keep their digits
    built = systems.model_with(model, kind, baumgarte=Baumgarte(2.0, 0.7))
    built = built.with_robot(built.robot.with_armature([0.5] * built.robot.nv))
    Q_U = systems.normal(built.robot.nv)

    def function(q, v, u):
        dynamics = built.dynamics(q, v, u)
        parts = dynamics.acceleration(Q_U), dynamics.multiplier(Q_U), dynamics.constrained_offset, dynamics.H.sum(-1)
        return torch.cat([part.flatten() for part in parts])

    systems.assert_derivatives(function, *(x[0] for x in systems.regular_states(built, 1)))


# ---------------------------------------------------------------- what it refuses


def test_a_constraint_that_is_not_finite():
    """At the centre of a sphere there is no normal."""
    built = robot("iiwa")
    q, v, u = states(7)
    center = tuple(built.frame_pose(q, FRAMES["iiwa"])[:3, 3].tolist())
    held = Model(built, (Contact(FRAMES["iiwa"], (0.0, 0.0, 0.0), Sphere(center, 0.1)),))
    with pytest.raises(NumericalError, match="constraint matrix A is not finite"):
        held.dynamics(q, v, u)
