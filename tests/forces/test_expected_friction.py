"""Tables of expected friction, and the normal force under it against dense equations with the friction in them."""

import json

import numpy as np
import pytest
import torch
from scipy.interpolate import interp1d
from scipy.optimize import brentq
from tests.mechanics.systems import POINT, regular_states, solve_kkt
from tests.mechanics.systems import model_with as model_of
from tests.robots.robot_models import FRAMES

from forcegp.errors import FileFormatError, InvalidInput, NumericalWarning, UnknownName
from forcegp.forces import ContactFriction, JointFriction, UnknownForces, force_from_dict, force_to_dict
from forcegp.forces.contact_friction import SMALLEST_SHARE, ExpectedFriction, TabulatedCurve, refined_loads
from forcegp.mechanics import Contact, ImplicitSurface, Plane, Sphere

MODEL = "chain"
FRAME = FRAMES[MODEL]
PLANE, SPHERE = Plane((0.2, -0.1, 1.0), 0.055), Sphere((0.1, 0.3, -0.2), 0.4)
SURFACES = {
    "plane": PLANE, "sphere": SPHERE, "any-plane": ImplicitSurface(lambda p: 3.0 * PLANE.value(p)),
    "any-sphere": ImplicitSurface(lambda p: -2.0 * SPHERE.value(p) * (1.0 + 0.5 * p[0])),
}  # fmt: skip
COEFFICIENT = TabulatedCurve((0.0, 0.2, 0.5, 3.0), (0.0, 0.12, 0.08, 0.11))
JOINTS = (
    ("tilt", TabulatedCurve((-1.0, -0.1, 0.1, 1.0), (-2.0, -1.5, 1.5, 2.0))),
    ("slide", TabulatedCurve((-1.0, 1.0), (-4.0, 4.0))),
)
EXPECTED = ExpectedFriction(COEFFICIENT, JOINTS)


class TestTabulatedCurve:
    at, values = (-1.0, -0.5, 0.25, 2.0), (3.0, -1.0, 0.5, 0.0)

    def test_it_is_linear_in_between_and_beyond(self):
        x = torch.cat([torch.tensor(self.at), torch.linspace(-3.0, 4.0, 41)]).double()[:, None]
        line, found = interp1d(self.at, self.values, fill_value="extrapolate"), TabulatedCurve(self.at, self.values)(x)
        torch.testing.assert_close(found, torch.tensor(line(x.numpy())), rtol=1e-13, atol=1e-13)

    def test_gradients(self):
        x = torch.tensor([-2.0, -0.7, 0.1, 1.0, 5.0], dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(TabulatedCurve(self.at, self.values), x)

    @pytest.mark.parametrize(
        ("at", "values", "message"),
        [
            ((0.0,), (1.0,), "two or more"), ((0.0, 1.0), (1.0,), "2 places and 1 values"),
            ((0.0, 0.0), (1.0, 1.0), "increasing"), ((1.0, 0.0), (1.0, 1.0), "increasing"),
            ((0.0, float("nan")), (1.0, 1.0), "at of a tabulated curve .* finite numbers"),
            ((0.0, 1.0), (1.0, float("inf")), "values of a tabulated curve .* finite numbers"),
            ((0.0, 1.0), ("a", 1.0), "finite numbers"), (0.0, (1.0, 1.0), "0 places and 2 values"),
        ],
    )  # fmt: skip
    def test_refusals(self, at, values, message):
        with pytest.raises(InvalidInput, match=message):
            TabulatedCurve(at, values)


def rows_of(surface: str):
    """Dynamics at rows whose multipliers have both signs."""
    model = model_of(MODEL).with_contacts([Contact(FRAME, POINT, SURFACES[surface])])
    q, v, u = regular_states(model, 12)
    pressed = model.dynamics(q, v, 0.0 * u)
    push = pressed.A[:, 0] / pressed.A[:, 0].norm(dim=-1, keepdim=True)
    u = 40.0 * torch.where(torch.arange(12) % 2 == 0, 1.0, -1.0)[:, None] * push  # towards the surface, and away
    dynamics = model.dynamics(q, v, u)
    signs = dynamics.multiplier_map().offset[:, 0].sign()
    assert bool((signs > 0).any())
    assert bool((signs < 0).any())
    return dynamics


def friction_direction(dynamics):
    """J_t^T v_t / |v_t| (rows, nv) and |v_t|, by projection onto the tangential plane."""
    J = dynamics.state.kinematics.frame_jacobian(FRAME, POINT)[:, :3]
    velocity = (J @ dynamics.state.v[..., None])[..., 0]
    normal = dynamics.normals[:, 0] / dynamics.normals[:, 0].norm(dim=-1, keepdim=True)
    sliding = velocity - (velocity * normal).sum(-1, keepdim=True) * normal
    speed = sliding.norm(dim=-1)
    return (J.mT @ (sliding / speed[:, None])[..., None])[..., 0], speed


def coupled_multiplier(dynamics, coefficients, joint_force, row):
    """lambda that solves M a = Q_K + joint_force - mu |s_p lambda| J^T d + A^T lambda, A a = b, by a search for it."""
    direction, _ = friction_direction(dynamics)
    size = float(dynamics.normals[row, 0].norm())
    M, A, b = dynamics.M[row], dynamics.A[row], dynamics.b[row]

    def too_much(multiplier: float) -> float:
        friction = -coefficients[row] * size * abs(multiplier) * direction[row]
        return float(solve_kkt(M, dynamics.Q_K[row] + joint_force[row] + friction, A, b)[1]) - multiplier

    return brentq(too_much, -1e5, 1e5, xtol=1e-12, rtol=1e-14)


@pytest.mark.parametrize("surface", SURFACES)
def test_the_normal_force_solves_the_equations_with_friction_in_them(surface):
    dynamics = rows_of(surface)
    _, speed = friction_direction(dynamics)
    coefficients = torch.tensor(np.interp(speed.numpy(), COEFFICIENT.at, COEFFICIENT.values))
    names, joint_force = dynamics.state.robot.joint_names, torch.zeros_like(dynamics.state.v)
    for name, curve in JOINTS:
        k, line = names.index(name), interp1d(curve.at, curve.values, fill_value="extrapolate")
        joint_force[:, k] = -torch.tensor(line(dynamics.state.v[:, k].numpy()))
    solved = [coupled_multiplier(dynamics, coefficients, joint_force, row) for row in range(len(speed))]
    expected = torch.tensor(solved, dtype=torch.float64).abs() * dynamics.normals[:, 0].norm(dim=-1)
    found = ContactFriction(load=True, expected=EXPECTED).point_force(dynamics)[..., 0].norm(dim=-1)
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-8)
    nominal = ContactFriction(load=True).point_force(dynamics)[..., 0].norm(dim=-1)
    assert float((nominal - expected).abs().max()) > 0.02 * float(expected.max())


def test_no_friction_leaves_the_nominal_force():
    dynamics = rows_of("any-sphere")
    nominal = ContactFriction(load=True).direction(dynamics)
    none = ContactFriction(load=True, expected=0.0).direction(dynamics)
    torch.testing.assert_close(none, nominal, rtol=1e-12, atol=1e-12)


def test_jamming_stays_finite():
    """Where friction and normal force would lift each other without end, the force grows tenfold and no further."""
    dynamics = rows_of("plane")
    with pytest.warns(NumericalWarning) as caught:
        jammed = ContactFriction(load=True, expected=1e6).point_force(dynamics)[..., 0].norm(dim=-1)
    nominal = ContactFriction(load=True).point_force(dynamics)[..., 0].norm(dim=-1)
    assert bool(torch.isfinite(jammed).all())
    torch.testing.assert_close((jammed / nominal).max().item(), 1.0 / SMALLEST_SHARE, rtol=1e-9, atol=0.0)
    tenfold = int(torch.isclose(jammed / nominal, torch.tensor(1.0 / SMALLEST_SHARE).double(), rtol=1e-9).sum())
    (message,) = [str(warning.message) for warning in caught]
    assert message.startswith(f"the expected friction nearly jams contact 0 in {tenfold} of 12 states: ")
    assert "taken as 10 times that without sliding friction" in message
    assert "give a smaller coefficient, expected=COEFFICIENT" in message


def test_jamming_is_not_asked_for_where_no_value_is_known():
    """Derivatives of the mixing by torch.func: a branch on a value would be an error there."""
    model = model_of(MODEL).with_contacts([Contact(FRAME, POINT, PLANE)])
    q, v, u = regular_states(model, 3)
    prior = ContactFriction(load=True, expected=1e6)

    def direction(one):
        return prior.direction(model.dynamics(one[None], v[:1], u[:1]))

    assert bool(torch.isfinite(torch.func.vmap(torch.func.jacrev(direction))(q)).all())


def test_it_survives_a_file():
    prior = ContactFriction(load=True, expected=EXPECTED)
    again = force_from_dict(json.loads(json.dumps(force_to_dict(prior))))
    assert (again, hash(again)) == (prior, hash(prior))
    dynamics = rows_of("plane")
    assert torch.equal(again.direction(dynamics), prior.direction(dynamics))
    damaged = force_to_dict(prior)
    damaged["expected"] = {"sliding": {"at": [0.0, 1.0]}, "joints": []}
    with pytest.raises((FileFormatError, InvalidInput), match="expected is"):
        force_from_dict(damaged)


@pytest.mark.parametrize("expected", [-0.1, float("nan"), float("inf"), "much", [0.1], {"sliding": 0.3}])
def test_expectations_that_are_none(expected):
    with pytest.raises(InvalidInput, match="give a friction coefficient of at least 0"):
        ContactFriction(load=True, expected=expected)


def test_expectations_without_a_load_and_of_joints_that_are_not_there():
    with pytest.raises(InvalidInput, match="no load; give load=True"):
        ContactFriction(expected=0.3)
    line = TabulatedCurve((0.0, 1.0), (0.1, 0.1))
    prior = ContactFriction(load=True, expected=ExpectedFriction(line, (("elbow", line),)))
    with pytest.raises(UnknownName, match="elbow"):
        prior.check(model_of(MODEL).robot, rows_of("plane").contacts)


class TestRefinedLoads:
    @staticmethod
    def table(name):
        return TabulatedCurve((0.0, 1.0), (float(len(name)), 0.0))

    def test_it_expects_the_friction_of_joints_and_tool(self):
        robot, prior = model_of(MODEL).robot, UnknownForces((JointFriction(("tilt",)), ContactFriction(load=True)))
        refined = refined_loads(prior, robot, self.table)
        assert refined.terms[0] == prior.terms[0]
        first, second = prior.latent_names(robot)
        assert refined.terms[1].expected == ExpectedFriction(self.table(second), (("tilt", self.table(first)),))
        (alone,) = refined_loads(UnknownForces((ContactFriction(load=True),)), robot, self.table).terms
        assert alone == ContactFriction(load=True, expected=ExpectedFriction(self.table("sliding")))

    @pytest.mark.parametrize(
        "prior",
        [
            ContactFriction(),
            ContactFriction(load=True, expected=0.3),
            UnknownForces((JointFriction(), ContactFriction(load=True, expected=0.0))),
        ],
    )
    def test_there_is_nothing_to_refine(self, prior):
        forces = prior if isinstance(prior, UnknownForces) else UnknownForces((prior,))
        assert refined_loads(forces, model_of(MODEL).robot, self.table) is None
