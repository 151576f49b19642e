"""Each known force against its formula, with its sign, through files, and from the numbers of the URDF."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from tests.mechanics.systems import assert_close, robot, states
from tests.robots.pinocchio_oracle import Oracle
from tests.robots.robot_models import CHAIN, MODELS

from forcegp import Coulomb, LoadFriction, Offset, RigidBodies
from forcegp.errors import InvalidInput, UnknownName
from forcegp.forces import Actuation, Body, DirectionalFriction, GearFriction, Law, Rotor, Spring, Stribeck, Viscous
from forcegp.forces.joint_law import JointLaw
from forcegp.forces.registry import FORCES, force_class
from forcegp.mechanics import State
from forcegp.model import Model

NUMBERS = [0.5, 1.5, 0.0, 2.0]
TENSOR = torch.tensor(NUMBERS, dtype=torch.float64)
TENTHS = torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)
ROOTS = torch.tensor([0.2, -0.1, 0.3, 0.0], dtype=torch.float64)
TRANSMISSION = ((6.0, 0.0, 0.0, 0.0), (-1.0, 6.0, 0.0, 0.0), (0.0, 0.0, 1.0, 1.0), (0.0, 0.0, 1.0, -1.0))
COUPLED = torch.tensor(TRANSMISSION, dtype=torch.float64)

FORMULAS = {
    "actuation": (lambda: Actuation(), lambda q, v, u: u),
    "bias": (lambda: RigidBodies(), lambda q, v, u: -pinocchio_bias(q, v)),
    "viscous": (lambda: Viscous(NUMBERS), lambda q, v, u: -TENSOR * v),
    "Coulomb": (lambda: Coulomb(NUMBERS, 0.02), lambda q, v, u: -TENSOR * (v / 0.02).tanh()),
    "Stribeck": (
        lambda: Stribeck(NUMBERS, 3.0, [0.1, 0.2, 0.3, 0.4], 0.02),
        lambda q, v, u: -(TENSOR + 3.0 * (-((v / TENTHS) ** 2)).exp()) * (v / 0.02).tanh(),
    ),
    "load": (
        lambda: LoadFriction(0.7, [0.5, 0.8, 0.0, 0.2], 0.02),
        lambda q, v, u: -(0.7 + torch.tensor([0.5, 0.8, 0.0, 0.2], dtype=torch.float64) * u.abs()) * (v / 0.02).tanh(),
    ),
    "gear": (
        lambda: GearFriction(0.7, 0.5, 0.02, [0.2, -0.1, 0.3, 0.0], 2.0, 0.3),
        lambda q, v, u: (
            -(0.7 + 0.5 * u.abs() + ROOTS * v.abs().sqrt() + 2.0 * (-((v / 0.3) ** 2)).exp()) * (v / 0.02).tanh()
        ),
    ),
    "spring": (lambda: Spring(NUMBERS, 0.3), lambda q, v, u: -TENSOR * (q - 0.3)),
    "constant": (lambda: Offset(-TENSOR), lambda q, v, u: -TENSOR.expand_as(v)),
    "direction": (lambda: DirectionalFriction(-TENSOR), lambda q, v, u: TENSOR * v.abs()),
    "armature": (lambda: Rotor(NUMBERS), lambda q, v, u: torch.zeros_like(u)),
    "rotors": (lambda: Rotor(NUMBERS, transmission=TRANSMISSION), lambda q, v, u: torch.zeros_like(u)),
    "damped motors": (
        lambda: Viscous(NUMBERS, transmission=TRANSMISSION),
        lambda q, v, u: -torch.einsum("kj,k,ki,ni->nj", COUPLED, TENSOR, COUPLED, v),
    ),
    "sprung motors": (
        lambda: Spring(NUMBERS, 0.3, transmission=TRANSMISSION),
        lambda q, v, u: -(TENSOR * (q @ COUPLED.mT - 0.3)) @ COUPLED,
    ),
    "gears of motors": (
        lambda: GearFriction(0.7, 0.5, 0.02, 0.2, transmission=TRANSMISSION),
        lambda q, v, u: (
            -(
                (0.7 + 0.5 * torch.linalg.solve(COUPLED.mT, u.mT).mT.abs() + 0.2 * (v @ COUPLED.mT).abs().sqrt())
                * ((v @ COUPLED.mT) / 0.02).tanh()
            )
            @ COUPLED
        ),
    ),
}


def at_motors(transmission):
    return partial(Rotor, transmission=transmission)


def chain():
    return robot("chain")


def pinocchio_bias(q, v):
    oracle = Oracle(CHAIN, chain())
    return torch.as_tensor(np.stack([oracle.bias_forces(*row) for row in zip(q.numpy(), v.numpy(), strict=True)]))


def known(*forces: Law, **options) -> Model:
    return Model(chain(), forces=forces, **options)


@pytest.mark.parametrize("make_and_formula", FORMULAS.values(), ids=FORMULAS)
def test_each_against_its_formula(make_and_formula):
    make, formula = make_and_formula
    q, v, u = states(4, 6)
    expected = formula(q, v, u)
    assert_close(known(make()).dynamics(q, v, u).Q_K, expected, 1e-10)
    assert_close(make().bound_to(chain()).force(State(q, v, u, chain())), expected, 1e-10)


def test_the_sum_is_what_is_listed_and_nothing_else():
    q, v, u = states(4, 6)
    parts = [make() for make, _ in FORMULAS.values()]
    assert_close(known(*parts).dynamics(q, v, u).Q_K, sum(formula(q, v, u) for _, formula in FORMULAS.values()), 1e-10)
    assert not known().dynamics(q, v, u).Q_K.any()
    listed = known(Actuation(), RigidBodies()).dynamics(q, v, u).Q_K
    assert_close(listed, u - pinocchio_bias(q, v), 1e-10)  # without the damping of the URDF


@pytest.mark.parametrize("model", MODELS)
def test_the_numbers_of_the_urdf(model):
    built = robot(model)
    q, v, u = states(built.nv, 3)
    damping = torch.tensor([joint.damping for joint in built.joints], dtype=torch.float64)
    friction = torch.tensor([joint.friction for joint in built.joints], dtype=torch.float64)
    assert damping.any() or model == "iiwa"
    single = torch.tensor([name in built.single_joint_names for name in built.joint_names])
    expected = torch.where(single, -damping * v - friction * (v / 0.01).tanh(), 0.0)
    laws = tuple(law for law in Model(built).forces if isinstance(law, Viscous | Coulomb))
    assert_close(Model(built, forces=laws).dynamics(q, v, u).Q_K, expected, 1e-14)


def test_bodies_that_are_learned_are_of_links_that_move():
    first, *_, moving = chain().link_names
    assert dict(RigidBodies((moving,)).bound_to(chain()).learn) == {moving: Body()}
    with pytest.raises(InvalidInput, match="does not move"):
        RigidBodies((first,)).bound_to(chain())


def test_armature_adds_to_the_diagonal_and_to_that_of_the_robot():
    q, v, u = states(4, 5)
    geared = Model(chain().with_armature([0.1, 0.2, 0.3, 0.4]), forces=(Actuation(), RigidBodies(), Rotor(NUMBERS)))
    plain = known(Actuation(), RigidBodies()).dynamics(q, v, u)
    added = torch.diag(TENSOR + torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64))
    dynamics = geared.dynamics(q, v, u)
    assert_close(dynamics.M, plain.M + added, 1e-13)
    assert_close(dynamics.acceleration(torch.zeros_like(u)), torch.linalg.solve(plain.M + added, plain.Q_K), 1e-10)


# ---------------------------------------------------------------- one number per joint


@pytest.mark.usefixtures("unchecked")  # forces check their numbers where they meet a robot
@pytest.mark.parametrize(
    ("kind", "arguments", "error", "message"),
    [
        (Viscous, ([1.0, 2.0],), InvalidInput, r"has \(2,\) values; chain has 4 joints: slide, spin"),
        (Viscous, ([1.0, -2.0, 0.0, 0.0],), InvalidInput, "every joint needs a finite number >= 0"),
        (Viscous, (math.nan,), InvalidInput, "every joint needs a finite number"),
        (Stribeck, (1.0, 2.0, 0.0), InvalidInput, "stribeck_velocity is .* a finite number > 0"),
        (Rotor, (-1.0,), InvalidInput, "Rotor inertia"),
        (at_motors([[1.0, 0.0]]), (1.0,), InvalidInput, r"has shape \(1, 2\); chain needs a finite regular matrix"),
        (at_motors([[1.0] * 4] * 4), (1.0,), InvalidInput, "needs a finite regular matrix"),
        (at_motors("gears"), (1.0,), InvalidInput, "Rotor transmission is 'gears'; write the joints that a motor"),
        (at_motors("spin+"), (1.0,), InvalidInput, "Rotor transmission is 'spin[+]'"),
        (Viscous, ({"elbow": 1.0},), UnknownName, "no joint 'elbow' in chain"),
        (Viscous, ({"tilt": None},), InvalidInput, "give a number, one per joint, or a mapping"),
        (Viscous, ("strong",), InvalidInput, "Viscous damping is 'strong'"),
        (Coulomb, (1.0, 0.0), InvalidInput, "velocity_scale is .* every joint needs a finite number > 0"),
    ],
    ids=str,
)
def test_wrong_numbers_are_named(kind, arguments, error, message):
    with pytest.raises(error, match=message):
        known(kind(*arguments))


def test_every_law_of_joints_is_tested_here():
    tested = {type(make()) for make, _ in FORMULAS.values()}
    own = {kind for kind in map(force_class, FORCES) if kind.__module__.startswith("forcegp.")}
    assert {kind for kind in own if issubclass(kind, JointLaw)} <= tested
