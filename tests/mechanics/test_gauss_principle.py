"""Gauss' principle against the KKT equations solved densely, and the identities of H."""

from functools import cache

import pytest
import torch
from tests.mechanics.systems import (
    INDEPENDENT,
    REDUNDANT,
    assert_close,
    assert_derivatives,
    model_with,
    normal,
    regular_states,
    robot,
    solve_kkt,
    states,
)
from tests.robots.robot_models import FRAMES, MODELS

from forcegp.errors import NumericalError
from forcegp.evidence import standard_parameters
from forcegp.mechanics import Baumgarte, Contact, Sphere
from forcegp.model import Model

TOLERANCE = 1e-10
ALL = [*INDEPENDENT, *REDUNDANT]
LINKS = {"iiwa": ("lbr_iiwa_link_7", "lbr_iiwa_link_4"), "tree": ("right_hand", "body"), "chain": ("wrist", "bracket")}


@cache
def regular_dynamics(model: str, kind: str):
    built = model_with(model, kind, baumgarte=Baumgarte(10.0, 1.0))
    return built.dynamics(*regular_states(built, 20)), normal(20, built.robot.nv, seed=9)


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("model", MODELS)
class TestAgainstDenseEquations:
    @pytest.fixture
    def solved(self, model, kind):
        return regular_dynamics(model, kind)

    def test_acceleration_and_multiplier(self, solved):
        dynamics, Q_U = solved
        a, multiplier = solve_kkt(dynamics.M, dynamics.Q_K + Q_U, dynamics.A, dynamics.b)
        assert_close(dynamics.acceleration(Q_U), a, TOLERANCE)
        assert_close(dynamics.multiplier(Q_U), multiplier, TOLERANCE)

    def test_H_and_the_constrained_offset(self, solved):
        """H is the response to unit forces; the constraint force gives the offset when nothing else acts."""
        dynamics, Q_U = solved
        nothing = torch.zeros_like(Q_U)
        at_rest, multiplier = solve_kkt(dynamics.M, nothing, dynamics.A, dynamics.b)
        assert_close(
            (dynamics.M @ dynamics.constrained_offset[..., None])[..., 0],
            (dynamics.A.mT @ multiplier[..., None])[..., 0],
            TOLERANCE,
        )
        columns = []
        for unit in torch.eye(Q_U.shape[-1], dtype=torch.float64):
            response, _ = solve_kkt(dynamics.M, unit.expand_as(Q_U), dynamics.A, torch.zeros_like(dynamics.b))
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
        assert_close(
            (H @ M).diagonal(dim1=-2, dim2=-1).sum(-1), torch.full((20,), float(M.shape[-1] - rank)).double(), 1e-9
        )
        forces = dynamics.Q_K + Q_U + (A.mT @ dynamics.multiplier(Q_U)[..., None])[..., 0]
        assert_close((M @ a[..., None])[..., 0], forces, TOLERANCE)

    def test_affine_maps(self, solved):
        dynamics, Q_U = solved
        for affine, value in (
            (dynamics.acceleration_map(), dynamics.acceleration(Q_U)),
            (dynamics.multiplier_map(), dynamics.multiplier(Q_U)),
        ):
            assert_close(affine(Q_U), value, 1e-14)
            assert_close(affine.offset + (affine.matrix @ Q_U[..., None])[..., 0], value, 1e-14)

    def test_contact_forces_do_the_work_of_the_multiplier(self, solved, model):
        """sum_k J_k^T F_k = A^T lambda, with every F_k along the normal of its surface."""
        dynamics, Q_U = solved
        built = model_with(model, "none")
        forces = dynamics.contact_force_map()(Q_U).unflatten(-1, (-1, 3)) if dynamics.b.shape[-1] else None
        multiplier = dynamics.multiplier(Q_U)
        total = torch.zeros_like(Q_U)
        for index in range(dynamics.b.shape[-1]):
            force = forces[:, index]
            assert_close(force, dynamics.normals[:, index] * multiplier[:, index, None], 1e-14)
            point = self.point_of(dynamics, index, model)
            J = built.robot.frame_jacobian(dynamics.state.q, FRAMES[model], point)[:, :3]
            total = total + (J.mT @ force[..., None])[..., 0]
        assert_close(total, (dynamics.A.mT @ multiplier[..., None])[..., 0], TOLERANCE)
        if not dynamics.b.shape[-1]:
            assert dynamics.contact_force_map()(Q_U).shape == (20, 0)

    @staticmethod
    def point_of(dynamics, index, model):
        kinds = {1: "one", 2: "same twice", 3: "three", 4: "four corners"}
        return model_with(model, kinds[dynamics.b.shape[-1]]).contacts[index].point

    def test_least_constraint(self, solved):
        """Among all accelerations with A a = b, a is nearest to the free one in the metric of M (Gauss 1829)."""
        dynamics, Q_U = solved
        M, a = dynamics.M, dynamics.acceleration(Q_U)
        free = torch.linalg.solve(M, dynamics.Q_K + Q_U)
        allowed = dynamics.H @ M @ normal(20, M.shape[-1], seed=11)[..., None]  # A H = 0

        def constraint(acceleration):
            difference = (acceleration - free)[..., None]
            return (difference.mT @ M @ difference)[..., 0, 0]

        for step in (-0.1, 0.1):
            assert bool((constraint(a + step * allowed[..., 0]) > constraint(a)).all())


def test_redundant_contacts_share_the_force_equally():
    once, twice = model_with("iiwa", "one"), model_with("iiwa", "one")
    twice = twice.with_contacts(once.contacts * 2)
    q_v_u, Q_U = states(7, 5), normal(5, 7)
    single, shared = once.dynamics(*q_v_u), twice.dynamics(*q_v_u)
    assert_close(shared.acceleration(Q_U), single.acceleration(Q_U), TOLERANCE)
    assert_close(shared.multiplier(Q_U), single.multiplier(Q_U).expand(5, 2) / 2.0, TOLERANCE)


# ---------------------------------------------------------------- batches


# ---------------------------------------------------------------- derivatives


def bodies_of(built: Model) -> torch.Tensor:
    """Standard parameters (bodies, 10) of the robot."""
    return standard_parameters(built.robot).reshape(-1, 10)


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("model", ["tree", "chain"])
def test_derivatives(model, kind):
    """With respect to q, v, u and the parameters of all bodies, also where contacts are redundant.

    Rotor inertia makes the light wrists heavier, so that finite differences keep their digits.
    """
    built = model_with(model, kind, baumgarte=Baumgarte(2.0, 0.7))
    built = built.with_robot(built.robot.with_armature([0.5] * built.robot.nv))
    Q_U = normal(built.robot.nv)

    def function(q, v, u, bodies):
        dynamics = built.dynamics(q, v, u, bodies)
        parts = dynamics.acceleration(Q_U), dynamics.multiplier(Q_U), dynamics.constrained_offset, dynamics.H.sum(-1)
        return torch.cat([part.flatten() for part in parts])

    assert_derivatives(function, *(x[0] for x in regular_states(built, 1)), bodies_of(built))


# ---------------------------------------------------------------- what it refuses


def test_states_that_are_not_finite():
    q, v, u = states(7, 3)
    q[1, 2] = torch.nan
    with pytest.raises(NumericalError, match="mass matrix is not positive definite"):
        model_with("iiwa", "one").dynamics(q, v, u)


def test_a_constraint_that_is_not_finite():
    """At the centre of a sphere there is no normal."""
    built = robot("iiwa")
    q, v, u = states(7)
    center = tuple(built.frame_pose(q, FRAMES["iiwa"])[:3, 3].tolist())
    held = Model(built, (Contact(FRAMES["iiwa"], (0.0, 0.0, 0.0), Sphere(center, 0.1)),))
    with pytest.raises(NumericalError, match="constraint matrix A is not finite"):
        held.dynamics(q, v, u)
