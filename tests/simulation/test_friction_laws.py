import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from forcegp.errors import SimulationError
from forcegp.simulation.contact_forces import (
    DryFriction,
    JointStribeckFriction,
    RoughPatch,
    ViscousFriction,
    multiplier_with_friction,
)

STRIBECK = DryFriction(coulomb=0.3, static=0.5, stribeck_velocity=0.1, smoothing=1e-6)
UP = np.array([0.0, 0.0, 1.0])
numbers = st.floats(-3.0, 3.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)


def test_dry_friction_at_speeds_known_by_hand():
    expected = [0.0, 0.5, 0.3 + 0.2 / np.e, 0.3]
    np.testing.assert_allclose(STRIBECK.coefficient(np.array([0.0, 1e-3, 0.1, 5.0])), expected, atol=3e-5)
    coulomb = DryFriction(coulomb=0.3, static=0.3, stribeck_velocity=0.1, smoothing=0.04)
    assert coulomb.coefficient(np.array(0.03)) == pytest.approx(0.3 * 0.6)  # 3-4-5
    np.testing.assert_allclose(coulomb.force(np.array([0.03, 0.0, 7.0]), UP), [-0.18, 0.0, 0.0], atol=1e-15)


def test_joint_friction_and_the_patch_at_values_known_by_hand():
    law = JointStribeckFriction(np.array([2.0, 1.0]), np.array([3.0, 1.0]), np.array([0.5, 0.0]), 0.2, 1e-6)
    np.testing.assert_allclose(law.force(np.array([0.2, -10.0])), [-(2.0 + 1.0 / np.e + 0.1), 1.0], atol=1e-12)
    np.testing.assert_allclose(law.force(np.array([[-10.0, 0.0]])), [[7.0, 0.0]], atol=1e-12)
    patch = RoughPatch(0.0, 0.25, factor=4.0)
    np.testing.assert_allclose([patch.scale(x) for x in (-0.1, 0.0, 0.1, 0.25, 0.4)], [1, 2.5, 4, 2.5, 1], atol=1e-12)


@given(velocity=vectors, normal=vectors, smoothing=st.floats(1e-3, 1.0))
def test_friction_takes_energy_and_dry_friction_is_tangential_with_its_coefficient(velocity, normal, smoothing):
    length = np.linalg.norm(normal)
    normal = normal / length if length > 1e-3 else UP
    dry = DryFriction(0.3, 0.5, 0.1, smoothing)
    force = dry.force(velocity, normal)
    assert force @ velocity <= 1e-11  # rounding of the tangential part, over the least smoothing
    assert ViscousFriction(2.0).force(velocity, normal) @ velocity <= 0.0
    assert abs(force @ normal) < 1e-11
    speed = np.linalg.norm(velocity - (velocity @ normal) * normal)
    assert np.linalg.norm(force) == pytest.approx(float(dry.coefficient(np.array(speed))), abs=1e-11)
    joints = JointStribeckFriction(np.full(3, 1.0), np.full(3, 2.0), np.full(3, 0.1), 0.2, smoothing)
    assert (joints.force(velocity) * velocity <= 0.0).all()


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
    system = np.block([[mass, -(row + np.sign(found) * per_load)[:, None]], [row[None], np.zeros((1, 1))]])
    assert np.linalg.solve(system, np.append(force, b))[7] == pytest.approx(found, rel=1e-9)


def test_a_normal_force_that_is_not_determined_is_refused():
    mass, force, row, direction, b = problem(0)
    inverse = np.linalg.inv(mass)
    per_load = direction * 1.01 * (row @ inverse @ row) / abs(row @ inverse @ direction)
    with pytest.raises(SimulationError, match="not determined"):
        multiplier_with_friction(mass, force, row, per_load, b)
