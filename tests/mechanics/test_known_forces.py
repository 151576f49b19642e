"""Each known force against its formula, with its sign, through files, and from the numbers of the URDF."""

import json
import math
from dataclasses import FrozenInstanceError, dataclass, fields

import numpy as np
import pytest
import torch
from tests.mechanics.systems import assert_close, normal, robot, states
from tests.robots.pinocchio_oracle import Oracle
from tests.robots.robot_models import CHAIN, MODELS

from forcegp.errors import FileFormatError, InvalidInput, UnknownJoint
from forcegp.mechanics import (
    Actuation,
    Armature,
    ConstantJointForce,
    CoulombJointFriction,
    DirectionalJointFriction,
    KnownForce,
    LoadJointFriction,
    MechanicalSystem,
    ObservedWind,
    ObservedWrench,
    RigidBodyBias,
    RotorInertia,
    State,
    StribeckJointFriction,
    Thrusters,
    ViscousJointFriction,
)
from forcegp.mechanics.known_forces import KNOWN_FORCES, known_force_to_dict
from forcegp.mechanics.surfaces import object_from_dict

JOINTS = ("slide", "spin", "skew", "tilt")
NUMBERS = [0.5, 1.5, 0.0, 2.0]
TENSOR = torch.tensor(NUMBERS, dtype=torch.float64)
TENTHS = torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)
TRANSMISSION = ((6.0, 0.0, 0.0, 0.0), (-1.0, 6.0, 0.0, 0.0), (0.0, 0.0, 1.0, 1.0), (0.0, 0.0, 1.0, -1.0))

FORMULAS = {
    "actuation": (lambda: Actuation(), lambda q, v, u: u),
    "bias": (lambda: RigidBodyBias(), lambda q, v, u: -pinocchio_bias(q, v)),
    "viscous": (lambda: ViscousJointFriction(NUMBERS), lambda q, v, u: -TENSOR * v),
    "Coulomb": (
        lambda: CoulombJointFriction(NUMBERS, 0.02),
        lambda q, v, u: -TENSOR * (v / 0.02).tanh(),
    ),
    "Stribeck": (
        lambda: StribeckJointFriction(NUMBERS, 3.0, [0.1, 0.2, 0.3, 0.4], 0.02),
        lambda q, v, u: -(TENSOR + (3.0 - TENSOR) * (-((v / TENTHS) ** 2)).exp()) * (v / 0.02).tanh(),
    ),
    "load": (
        lambda: LoadJointFriction(NUMBERS, 0.7, 0.02),
        lambda q, v, u: -(0.7 + TENSOR * u.abs()) * (v / 0.02).tanh(),
    ),
    "constant": (lambda: ConstantJointForce(-TENSOR), lambda q, v, u: -TENSOR.expand_as(v)),
    "direction": (lambda: DirectionalJointFriction(-TENSOR), lambda q, v, u: TENSOR * v.abs()),
    "armature": (lambda: Armature(NUMBERS), lambda q, v, u: torch.zeros_like(u)),
    "rotors": (lambda: RotorInertia(NUMBERS, TRANSMISSION), lambda q, v, u: torch.zeros_like(u)),
}


def chain():
    return robot("chain")


def pinocchio_bias(q, v):
    oracle = Oracle(CHAIN, chain())
    return torch.as_tensor(np.stack([oracle.bias_forces(*row) for row in zip(q.numpy(), v.numpy(), strict=True)]))


def known(*forces: KnownForce, **options) -> MechanicalSystem:
    return MechanicalSystem(chain(), known_forces=forces, **options)


@pytest.mark.parametrize("make_and_formula", FORMULAS.values(), ids=FORMULAS)
def test_each_against_its_formula(make_and_formula):
    make, formula = make_and_formula
    q, v, u = states(4, 6)
    expected = formula(q, v, u)
    assert_close(known(make()).dynamics(q, v, u).Q_K, expected, 1e-10)
    assert_close(make().bound_to(chain()).force(State.of(chain(), q, v, u)), expected, 1e-10)


def test_none_can_be_changed():
    numbers = [(force, field.name) for force in (make() for make, _ in FORMULAS.values()) for field in fields(force)]
    assert len({type(force) for force, _ in numbers}) == len(FORMULAS) - 1  # the bias has no numbers
    for force, name in numbers:
        with pytest.raises(FrozenInstanceError):
            setattr(force, name, 0.0)


def test_the_sum_is_what_is_listed_and_nothing_else():
    q, v, u = states(4, 6)
    parts = [make() for make, _ in FORMULAS.values()]
    together = known(*parts).dynamics(q, v, u).Q_K
    assert_close(together, sum(formula(q, v, u) for _, formula in FORMULAS.values()), 1e-10)
    assert not known().dynamics(q, v, u).Q_K.any()
    default = MechanicalSystem(chain()).dynamics(q, v, u).Q_K
    assert_close(default, u - pinocchio_bias(q, v), 1e-10)  # damping of the URDF enters only where it is listed


@pytest.mark.parametrize("model", MODELS)
def test_the_numbers_of_the_urdf(model):
    built = robot(model)
    q, v, u = states(built.nv, 3)
    damping = torch.tensor([joint.damping for joint in built.joints], dtype=torch.float64)
    friction = torch.tensor([joint.friction for joint in built.joints], dtype=torch.float64)
    assert damping.any() or model == "iiwa"
    system = MechanicalSystem(
        built, known_forces=(ViscousJointFriction.from_robot(built), CoulombJointFriction.from_robot(built, 0.05))
    )
    assert_close(system.dynamics(q, v, u).Q_K, -damping * v - friction * (v / 0.05).tanh(), 1e-14)


def test_friction_never_drives():
    q, v, u = states(4, 50)
    for force in (ViscousJointFriction(NUMBERS), CoulombJointFriction(NUMBERS)):
        assert float((known(force).dynamics(q, v, u).Q_K * v).max()) <= 0.0


def test_friction_by_load_alone_is_none_without_load():
    q, v, u = states(4, 5)
    friction = known(LoadJointFriction(NUMBERS))  # c = 0 and w = 0.01, if nothing else is said
    assert_close(friction.dynamics(q, v, u).Q_K, -TENSOR * u.abs() * (v / 0.01).tanh(), 1e-12)


def test_dry_friction_saturates_at_its_coefficient():
    q, v, u = states(4, 50)
    friction = known(CoulombJointFriction(NUMBERS, 1e-9)).dynamics(q, v, u).Q_K
    assert_close(friction, -TENSOR * v.sign(), 1e-12)


# ---------------------------------------------------------------- armature


def test_armature_adds_to_the_diagonal_and_to_that_of_the_robot():
    q, v, u = states(4, 5)
    geared = MechanicalSystem(
        chain().with_armature([0.1, 0.2, 0.3, 0.4]), known_forces=(Actuation(), RigidBodyBias(), Armature(NUMBERS))
    )
    plain = MechanicalSystem(chain()).dynamics(q, v, u)
    added = torch.diag(TENSOR + torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64))
    dynamics = geared.dynamics(q, v, u)
    assert_close(dynamics.M, plain.M + added, 1e-13)
    nothing = torch.zeros_like(u)
    assert_close(dynamics.acceleration(nothing), torch.linalg.solve(plain.M + added, plain.Q_K), 1e-10)


def test_armature_as_a_known_force_equals_armature_of_the_robot():
    q, v, u = states(4, 5)
    nothing = torch.zeros_like(u)
    one = MechanicalSystem(chain().with_armature(NUMBERS)).dynamics(q, v, u)
    other = known(Actuation(), RigidBodyBias(), Armature(NUMBERS)).dynamics(q, v, u)
    assert_close(one.acceleration(nothing), other.acceleration(nothing), 1e-10)


def test_rotors_that_a_moving_link_carries():
    """The kinetic energy of two rotors: the first sits in the base, the second turns with the first link, too."""
    ratio, rotor = 6.0, [1e-3, 2e-3, 0.0, 0.0]
    M = RotorInertia(rotor, TRANSMISSION).bound_to(chain()).added_inertia()
    v = normal(4)
    energy = 0.5 * rotor[0] * (ratio * v[0]) ** 2 + 0.5 * rotor[1] * (ratio * v[1] - v[0]) ** 2
    assert_close(0.5 * v @ M @ v, energy, 1e-14)
    q, v, u = states(4, 5)
    added = known(Actuation(), RigidBodyBias(), RotorInertia(rotor, TRANSMISSION)).dynamics(q, v, u).M
    assert_close(added, MechanicalSystem(chain()).dynamics(q, v, u).M + M, 1e-13)
    one_each = RotorInertia(NUMBERS).bound_to(chain()).added_inertia()
    assert_close(one_each, Armature(NUMBERS).bound_to(chain()).added_inertia(), 1e-14)


def test_stribeck_friction_falls_from_static_to_coulomb():
    slow, fast = torch.full((1, 4), 1e-4, dtype=torch.float64), torch.full((1, 4), 5.0, dtype=torch.float64)
    nothing = torch.zeros_like(slow)
    friction = known(StribeckJointFriction(1.0, 3.0, 0.1, 1e-6))
    assert_close(friction.dynamics(nothing, slow, nothing).Q_K, torch.full((1, 4), -3.0).double(), 1e-4)
    assert_close(friction.dynamics(nothing, fast, nothing).Q_K, torch.full((1, 4), -1.0).double(), 1e-12)


# ---------------------------------------------------------------- one number per joint


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (0.7, [0.7] * 4),
        (NUMBERS, NUMBERS),
        (tuple(NUMBERS), NUMBERS),
        (TENSOR, NUMBERS),
        (dict(zip(reversed(JOINTS), reversed(NUMBERS), strict=True)), NUMBERS),
        ({"skew": 3.0}, [0.0, 0.0, 3.0, 0.0]),
        ({}, [0.0] * 4),
    ],
    ids=str,
)
def test_numbers_may_come_in_any_form(given, expected):
    v = normal(3, 4)
    for force in (ViscousJointFriction(given), CoulombJointFriction(given), Armature(given)):
        (name,) = (name for name in force.per_joint if name != "velocity_scale")
        bound = getattr(force.bound_to(chain()), name)
        assert bound.dtype == torch.float64
        assert bound.tolist() == expected
        assert getattr(force, name) is given  # binding makes another one
    system = known(ViscousJointFriction(given))
    assert_close(system.dynamics(v, v, v).Q_K, -torch.tensor(expected, dtype=torch.float64) * v, 1e-14)


def test_a_coefficient_may_be_learned():
    damping = TENSOR.clone().requires_grad_()
    q, v, u = states(4, 3)
    known(ViscousJointFriction(damping)).dynamics(q, v, u).Q_K.sum().backward()
    assert_close(damping.grad, -v.sum(0), 1e-14)
    assert known(ViscousJointFriction(damping)).to_json() == known(ViscousJointFriction(NUMBERS)).to_json()


@pytest.mark.usefixtures("unchecked")  # forces check their numbers where they meet a robot
@pytest.mark.parametrize(
    ("kind", "arguments", "error", "message"),
    [
        (ViscousJointFriction, ([1.0, 2.0],), InvalidInput, r"has \(2,\) values; chain has 4 joints: slide, spin"),
        (ViscousJointFriction, ([[1.0] * 4],), InvalidInput, r"has \(1, 4\) values"),
        (ViscousJointFriction, ([1.0, -2.0, 0.0, 0.0],), InvalidInput, "every joint needs a finite number >= 0"),
        (ViscousJointFriction, (math.nan,), InvalidInput, "every joint needs a finite number"),
        (ViscousJointFriction, (math.inf,), InvalidInput, "every joint needs a finite number"),
        (ConstantJointForce, (math.nan,), InvalidInput, "every joint needs a finite number"),
        (StribeckJointFriction, (1.0, 2.0, 0.0), InvalidInput, "stribeck_velocity is .* must be positive"),
        (StribeckJointFriction, (1.0, -2.0, 1.0), InvalidInput, "StribeckJointFriction static"),
        (RotorInertia, (-1.0,), InvalidInput, "RotorInertia inertia"),
        (RotorInertia, (1.0, [[1.0, 0.0]]), InvalidInput, r"has shape \(1, 2\); chain needs a finite matrix \(4, 4\)"),
        (RotorInertia, (1.0, "gears"), InvalidInput, "RotorInertia transmission is 'gears'"),
        (ViscousJointFriction, ({"elbow": 1.0},), UnknownJoint, "no joint 'elbow' in chain"),
        (ViscousJointFriction, ({"tlit": 1.0},), UnknownJoint, "did you mean 'tilt'"),
        (ViscousJointFriction, ({"tilt": None},), InvalidInput, "give a number, one per joint, or a mapping"),
        (ViscousJointFriction, ("strong",), InvalidInput, "ViscousJointFriction coefficients is 'strong'"),
        (ViscousJointFriction, (None,), InvalidInput, "coefficients is None"),
        (
            CoulombJointFriction,
            (
                1.0,
                0.0,
            ),
            InvalidInput,
            "velocity_scale is .* it must be positive for every joint",
        ),
        (
            CoulombJointFriction,
            (
                1.0,
                [1.0, 1.0, 0.0, 1.0],
            ),
            InvalidInput,
            "velocity_scale is .* must be positive",
        ),
        (
            CoulombJointFriction,
            (
                1.0,
                {"tilt": 0.1},
            ),
            InvalidInput,
            "velocity_scale is .* must be positive",
        ),
        (CoulombJointFriction, (-1.0,), InvalidInput, "CoulombJointFriction coefficients"),
        (Armature, (-1e-3,), InvalidInput, "Armature inertia"),
        (Armature, ({"elbow": 1.0},), UnknownJoint, "elbow"),
    ],
    ids=str,
)
def test_wrong_numbers_are_named(kind, arguments, error, message):
    with pytest.raises(error, match=message):
        known(kind(*arguments))


# ---------------------------------------------------------------- files


@pytest.mark.parametrize("make_and_formula", FORMULAS.values(), ids=FORMULAS)
def test_they_survive_a_file_exactly(make_and_formula):
    force = make_and_formula[0]().bound_to(chain())
    stored = json.loads(json.dumps(known_force_to_dict(force)))
    again = object_from_dict("known force", KNOWN_FORCES, stored).bound_to(chain())
    assert type(again) is type(force)
    for name in force.per_joint:
        assert torch.equal(getattr(again, name), getattr(force, name))


def test_every_known_force_of_files_is_tested_here():
    elsewhere = {Thrusters, ObservedWrench, ObservedWind}  # test_thrusters.py, tests/data/test_wind.py
    assert {type(make()) for make, _ in FORMULAS.values()} | elsewhere == set(KNOWN_FORCES.values())


@pytest.mark.parametrize(
    "stored",
    [
        {"type": "gravity"},
        {"type": ["actuation"]},
        {},
        {"type": "actuation", "coefficients": 1.0},
        {"type": "viscous-joint-friction"},
        "actuation",
        None,
    ],
    ids=str,
)
def test_damaged_forces_are_refused(stored):
    with pytest.raises(FileFormatError, match="known force"):
        object_from_dict("known force", KNOWN_FORCES, stored)


# ---------------------------------------------------------------- a force of the user


class Spring(KnownForce):
    """As the documentation promises: one subclass with a `force`."""

    def __init__(self, stiffness: float) -> None:
        self.stiffness = stiffness

    def force(self, state: State) -> torch.Tensor:
        return -self.stiffness * state.q


@dataclass(frozen=True, eq=False)
class SpringPerJoint(KnownForce):
    stiffness: float | list[float]
    per_joint = ("stiffness",)

    def force(self, state: State) -> torch.Tensor:
        return -self.stiffness * state.q


def test_a_force_of_the_user():
    q, v, u = states(4, 3)
    assert_close(known(Spring(2.0)).dynamics(q, v, u).Q_K, -2.0 * q, 1e-14)
    assert_close(known(SpringPerJoint(NUMBERS)).dynamics(q, v, u).Q_K, -TENSOR * q, 1e-14)
    with pytest.raises(InvalidInput, match="a Spring cannot be stored; files carry actuation"):
        known(Spring(2.0)).to_json()


def test_numbers_are_copied():
    numbers = np.array(NUMBERS)
    bound = ViscousJointFriction(torch.from_numpy(numbers)).bound_to(chain())
    numbers[:] = -1.0
    assert bound.coefficients.tolist() == NUMBERS
