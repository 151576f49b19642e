"""The forces that priors stand for against Pinocchio, dense equations of motion, and laws of friction."""

import math

import numpy as np
import pinocchio as pin
import pytest
import torch
from tests.mechanics.systems import POINT, contacts, solve_kkt, states
from tests.mechanics.systems import model_with as model_of
from tests.robots.pinocchio_oracle import Oracle
from tests.robots.robot_models import FRAMES, MODELS

from forcegp import ContactFriction, Coulomb
from forcegp.forces import Actuation, JointFriction, LoadFriction, Payload, RigidBodies, Stribeck, ToolForces, Viscous
from forcegp.mechanics import Contact, ImplicitSurface, Plane
from forcegp.model import Model
from forcegp.robots import Robot

MODEL = "chain"  # prismatic, continuous and revolute joints
FRAME = FRAMES[MODEL]
ROWS = 5
GRAVITY = (1.0, -2.0, -9.0)
CENTER = (0.03, -0.05, 0.11)
MASS = 1.7


@pytest.fixture(scope="module")
def model():
    return model_of(MODEL)


@pytest.fixture(scope="module")
def oracle(model):
    return Oracle(MODELS[MODEL](), model.robot)


@pytest.fixture(scope="module")
def rows(model):
    return states(model.robot.nv, ROWS)


@pytest.fixture(scope="module")
def dynamics(model, rows):
    return model.dynamics(*rows)


def jacobians(oracle, q, v, point=POINT):
    """Poses and Jacobians of a point of FRAME in every row, by Pinocchio."""
    index = oracle.with_point(FRAME, np.array(point))
    found = [oracle.frame(a, b, index) for a, b in zip(q.numpy(), v.numpy(), strict=True)]
    return tuple(torch.tensor(np.stack(part)) for part in list(zip(*found, strict=True))[:2])


class TestPayload:
    @pytest.fixture(scope="class")
    @classmethod
    def robot(cls):
        return Robot.from_urdf_text(MODELS[MODEL](), gravity=GRAVITY)

    def test_it_is_the_gravity_that_a_mass_adds(self, robot, rows):
        """Pinocchio, with a point mass put into the body that carries the link."""
        bare, loaded = (Oracle(MODELS[MODEL](), robot) for _ in range(2))
        joint, placement = loaded.carrier(FRAME)
        at = pin.SE3(placement).act(np.array(CENTER))
        loaded.model.inertias[joint] = loaded.model.inertias[joint] + pin.Inertia(MASS, at, np.zeros((3, 3)))
        loaded.data = loaded.model.createData()
        q, *_ = rows
        expected = [bare.gravity_forces(row) - loaded.gravity_forces(row) for row in q.numpy()]
        without, with_load = Model(robot), Model(robot).with_forces(Payload(FRAME, MASS, CENTER))
        still = rows[0], 0.0 * rows[1], 0.0 * rows[2]
        given = with_load.dynamics(*still).Q_K - without.dynamics(*still).Q_K
        torch.testing.assert_close(given, torch.tensor(np.stack(expected)), rtol=1e-10, atol=1e-10)


class TestToolForces:
    def test_along_a_surface_the_force_is_tangential_to_it(self, oracle, rows, dynamics):
        """For a point that stays on it; for one that drifts off, the force is tilted to resist all of its motion."""
        q, v, u = rows
        _, J = jacobians(oracle, q, v)
        normal = torch.tensor([0.2, -0.1, 1.0], dtype=torch.float64)
        normal = normal / normal.norm()
        on_the_plane = v - (torch.linalg.pinv(dynamics.A) @ (dynamics.A @ v[..., None]))[..., 0]
        held = Model(dynamics.state.robot, contacts("one", FRAME)).dynamics(q, on_the_plane, u)
        force = ToolForces().point_force(held)
        torch.testing.assert_close(force.mT @ force, torch.eye(2).double().expand(ROWS, 2, 2), rtol=0.0, atol=1e-12)
        assert float((normal @ force).abs().max()) < 1e-12
        torch.testing.assert_close(ToolForces().direction(held), J[:, :3].mT @ force, rtol=1e-10, atol=1e-10)
        drifted = v - 0.99 * (v - on_the_plane)
        moving = Model(dynamics.state.robot, contacts("one", FRAME)).dynamics(q, drifted, u)
        velocity = (J[:, :3] @ drifted[..., None])[..., 0]
        (z, _), tangents = ToolForces().features(moving), ToolForces().point_force(moving)
        off = float((velocity @ normal).abs().max())
        assert off > 1e-4
        assert float(((tangents @ z[..., None])[..., 0] - velocity).abs().max()) < 0.1 * off

    def test_without_its_contact_it_is_zero(self, model, rows):
        free = model.with_contacts([]).dynamics(*rows)
        for prior in (ToolForces(), ToolForces(inputs=("velocity", "position")), ContactFriction()):
            count = len(prior.latent_names(model.robot))
            assert torch.equal(prior.direction(free), torch.zeros(ROWS, model.robot.nv, count).double())
            assert torch.equal(prior.point_force(free), torch.zeros(ROWS, 3, count).double())
            assert [z.shape for z in prior.features(free)] == [z.shape for z in prior.features(model.dynamics(*rows))]


class TestContactFriction:
    def friction(self, dynamics, prior, *coefficients):
        latents = torch.tensor(coefficients, dtype=torch.float64)
        return [(part(dynamics) @ latents) for part in (prior.direction, prior.point_force)]

    def test_it_takes_power_and_has_the_size_of_the_latent(self, oracle, rows, dynamics):
        q, v, _ = rows
        joint_force, force = self.friction(dynamics, ContactFriction(), 2.5)
        power = (v * joint_force).sum(-1)
        assert bool((power < -1e-3).all())
        torch.testing.assert_close(force.norm(dim=-1), 2.5 * torch.ones(ROWS).double(), rtol=1e-9, atol=0.0)
        _, J = jacobians(oracle, q, v)
        velocity = (J[:, :3] @ v[..., None])[..., 0]
        normal = dynamics.normals[:, 0] / dynamics.normals[:, 0].norm(dim=-1, keepdim=True)
        along = velocity - (velocity * normal).sum(-1, keepdim=True) * normal
        torch.testing.assert_close(force, -2.5 * along / along.norm(dim=-1, keepdim=True), rtol=1e-8, atol=1e-8)
        torch.testing.assert_close(power, -2.5 * along.norm(dim=-1), rtol=1e-8, atol=0.0)
        (speed,) = ContactFriction().features(dynamics)
        torch.testing.assert_close(speed[:, 0], along.norm(dim=-1), rtol=1e-9, atol=0.0)

    @pytest.mark.parametrize("scale", [1.0, 3.0], ids=["distance", "any-surface"])
    def test_load_is_the_normal_force_of_the_dense_equations(self, model, rows, scale):
        """A surface function that is no distance has another multiplier and the same force."""
        plane = model.contacts[0].surface
        surface = ImplicitSurface(lambda p: scale * plane.value(p))
        dynamics = model.with_contacts([Contact(FRAME, POINT, surface)]).dynamics(*rows)
        _, multiplier = solve_kkt(dynamics.M, dynamics.Q_K, dynamics.A, dynamics.b)
        force_of_contact = multiplier[:, 0].abs() * scale
        _, force = self.friction(dynamics, ContactFriction(load=True), 0.3)
        torch.testing.assert_close(force.norm(dim=-1), 0.3 * force_of_contact, rtol=1e-8, atol=0.0)
        plain, loaded = ContactFriction().direction(dynamics), ContactFriction(load=True).direction(dynamics)
        torch.testing.assert_close(loaded, force_of_contact[:, None, None] * plain, rtol=1e-8, atol=1e-12)

    def test_isotropic_friction_knows_no_direction(self, model, rows):
        """The robot and its plane turned about the vertical by any angle feel the same joint forces."""
        text = MODELS[MODEL]()
        first, second = (Contact(FRAME, POINT, Plane(normal, 0.05)) for normal in ((0.2, -0.1, 1.0), (0.1, 0.2, 1.0)))
        quarter = f'<link name="ground"/><joint name="turn" type="fixed"><origin xyz="0 0 0" rpy="0 0 {math.pi / 2}"/>'
        quarter += '<parent link="ground"/><child link="rail"/></joint><link name="rail"/>'
        assert '<link name="rail"/>' in text
        turned = Robot.from_urdf_text(text.replace('<link name="rail"/>', quarter))
        here, there = Model(model.robot, (first,)).dynamics(*rows), Model(turned, (second,)).dynamics(*rows)
        for prior in (ContactFriction(), ContactFriction(load=True)):
            torch.testing.assert_close(prior.direction(there), prior.direction(here), rtol=1e-9, atol=1e-9)
            torch.testing.assert_close(prior.features(there)[0], prior.features(here)[0], rtol=1e-9, atol=1e-9)


def test_joint_friction_is_positive_against_positive_velocity(dynamics, rows):
    prior = JointFriction(("tilt", "slide"))
    order = [dynamics.state.robot.joint_names.index(name) for name in ("tilt", "slide")]
    force = prior.direction(dynamics) @ torch.tensor([2.0, 3.0], dtype=torch.float64)
    expected = torch.zeros_like(rows[1])
    expected[:, order] = torch.tensor([-2.0, -3.0], dtype=torch.float64)
    assert torch.equal(force, expected)
    assert torch.equal(torch.cat(prior.features(dynamics), -1), rows[1][:, order])


def test_dry_friction_of_a_file_goes_where_another_law_of_it_is_added():
    """A robot's file states Coulomb's; Stribeck's beside it would push twice."""
    model = Model(model_of(MODEL).robot, forces=(Actuation(), RigidBodies(), Coulomb(0.4), Viscous(0.1)))
    for law in (Stribeck(), LoadFriction(0.2, 0.1), Coulomb()):
        found = [type(each).__name__ for each in model.with_forces(law).laws]
        assert found == ["Actuation", "RigidBodies", "Viscous", type(law).__name__]
    both = model.with_forces(Coulomb(), LoadFriction(0.0, 0.1))
    assert sum(each.part == "dry friction" for each in both.laws) == 2
