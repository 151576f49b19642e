from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from forcegp import Robot
from forcegp.errors import InvalidInput, SimulationError
from forcegp.forces.force import Coefficient
from forcegp.forces.joint_law import JointLaw
from forcegp.forces.registry import FORCES
from forcegp.simulation import KukaSurfaceConfig
from forcegp.simulation.kuka_surface import PointFriction, joint_friction_of, multiplier_with_friction
from forcegp.simulation.trajectory import laws_of_joints

STRIBECK = PointFriction(coulomb=0.3, static=0.5, breakaway_velocity=0.1, smoothing=1e-6)
ROBOT = Robot.from_urdf_text(
    "<robot name='seven'><link name='l0'/>"
    + "".join(
        f"<link name='l{k}'><inertial><mass value='1'/><inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' "
        f"iyz='0'/></inertial></link><joint name='j{k}' type='continuous'><parent link='l{k - 1}'/>"
        f"<child link='l{k}'/></joint>"
        for k in range(1, 8)
    )
    + "</robot>"
)
UP = np.array([0.0, 0.0, 1.0])
numbers = st.floats(-3.0, 3.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)


def test_dry_friction_at_speeds_known_by_hand():
    expected = [0.0, 0.5, 0.3 + 0.2 / np.e, 0.3]
    np.testing.assert_allclose(STRIBECK.coefficient(np.array([0.0, 1e-3, 0.1, 5.0])), expected, atol=3e-5)
    coulomb = PointFriction(coulomb=0.3, static=0.3, breakaway_velocity=0.1, smoothing=0.04)
    assert coulomb.coefficient(np.array(0.03)) == pytest.approx(0.3 * 0.6)  # 3-4-5
    np.testing.assert_allclose(coulomb.forces(np.array([0.03, 0.0, 7.0]), UP)[1], [-0.18, 0.0, 0.0], atol=1e-15)


def test_joint_friction_at_values_known_by_hand():
    law = joint_law("stribeck", joint_smoothing=1e-6)
    np.testing.assert_allclose(law(v := np.full(7, 0.2)), -(C + (S - C) / np.e + D * v), atol=1e-12)
    np.testing.assert_allclose(law(np.full((1, 7), -10.0)), [C + 10.0 * D], atol=1e-12)


@given(velocity=vectors, normal=vectors, smoothing=st.floats(1e-3, 1.0))
def test_friction_takes_energy_and_dry_friction_is_tangential_with_its_coefficient(velocity, normal, smoothing):
    length = np.linalg.norm(normal)
    normal = normal / length if length > 1e-3 else UP
    dry = PointFriction(2.0, 0.3, 0.5, 0.1, smoothing)
    viscous, force = dry.forces(velocity, normal)
    assert force @ velocity <= 1e-11  # rounding of the tangential part, over the least smoothing
    np.testing.assert_allclose(viscous, -2.0 * velocity)
    assert abs(force @ normal) < 1e-11
    speed = np.linalg.norm(velocity - (velocity @ normal) * normal)
    assert np.linalg.norm(force) == pytest.approx(float(dry.coefficient(np.array(speed))), abs=1e-11)
    v = np.resize(velocity, 7)
    for name in ("coulomb", "stribeck"):
        assert (joint_law(name, joint_smoothing=smoothing)(v) * v <= 0.0).all()


def joint_law(name: str, **changes):
    return joint_friction_of(KukaSurfaceConfig(joint_friction=name, **changes), ROBOT)


C, S, D = (np.array(getattr(KukaSurfaceConfig(), f"joint_{name}")) for name in ("coulomb", "static", "viscous"))


@dataclass(frozen=True, eq=False)
class Quadratic(JointLaw):
    """A law of somebody else: -k |v| v."""

    drag: float | None = None
    coefficients: ClassVar = {"drag": Coefficient("force/velocity^2", 0.3)}

    def amplitude(self, features, parameters):
        return -parameters["drag"] * features[0].abs() * features[0]


def test_a_law_of_ones_own_acts_in_plants(monkeypatch):
    monkeypatch.setitem(FORCES, "quadratic", Quadratic)
    v = np.linspace(-1.0, 1.0, 7)
    np.testing.assert_allclose(joint_law("quadratic")(v), -0.3 * np.abs(v) * v - D * v)
    np.testing.assert_allclose(joint_law("quadratic:drag=0.6,viscous:0")(v), -0.6 * np.abs(v) * v, atol=1e-14)
    with pytest.raises(InvalidInput, match="joint_friction is 'payload:l7'; give laws of joints"):
        joint_law("payload:l7")
    robot = Robot.from_urdf_text(ROBOT.urdf_text, base="floating")
    law, q = laws_of_joints("spring:2,viscous:0", robot, {"velocity": 0.1}), robot.neutral().numpy() + np.arange(14.0)
    np.testing.assert_array_equal(law(np.ones(13), q=q), np.r_[np.zeros(6), -2.0 * q[7:]])


def problem(seed: int):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(7, 7))
    return root @ root.T + np.eye(7), rng.normal(size=7), rng.normal(size=7), rng.normal(size=7), rng.normal()


@pytest.mark.parametrize("seed", range(8))
def test_multiplier_and_acceleration_solve_the_equations_that_hold_together(seed):
    mass, force, row, direction, b = problem(seed)
    inverse = np.linalg.inv(mass)
    per_load = direction * 0.9 * (row @ inverse @ row) / abs(row @ inverse @ direction)  # nine tenths of Painleve
    found = multiplier_with_friction(mass, force, row, per_load, b)

    def residual(multiplier: float) -> float:
        return float(row @ inverse @ (force + abs(multiplier) * per_load + multiplier * row) - b)

    assert found == pytest.approx(brentq(residual, -1e4, 1e4, xtol=1e-12), rel=1e-9)
    # the saddle-point system in one piece, with the sign that was found
    model = np.block([[mass, -(row + np.sign(found) * per_load)[:, None]], [row[None], np.zeros((1, 1))]])
    assert np.linalg.solve(model, np.append(force, b))[7] == pytest.approx(found, rel=1e-9)


def test_a_normal_force_that_is_not_determined_is_refused():
    mass, force, row, direction, b = problem(0)
    inverse = np.linalg.inv(mass)
    per_load = direction * 1.01 * (row @ inverse @ row) / abs(row @ inverse @ direction)
    with pytest.raises(SimulationError, match="not determined"):
        multiplier_with_friction(mass, force, row, per_load, b)
