"""The laws that a simulation followed, as curves: closed forms with the numbers of its configuration."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
import torch

from forcegp.fit import fit
from forcegp.forces import ContactFriction, JointFriction, ToolForces
from forcegp.inference import OptimizerOptions
from forcegp.posterior.prediction import Curve
from forcegp.simulation import KukaSurfaceConfig

V = np.linspace(-1.5, 1.5, 40)  # rad/s, without 0
SPEED = np.linspace(0.01, 1.2, 40)  # m/s


@pytest.fixture
def curves(motion):
    """The true curves of a prior, fitted to rows that say to come from a simulation with these changes."""
    from benchmarks.force_priors.jobs import true_curves

    def of(prior, **changes):
        config = dataclasses.asdict(KukaSurfaceConfig(seconds=2, seed=1, **changes))
        stated = {name: list(value) if isinstance(value, tuple) else value for name, value in config.items()}
        data = replace(motion.rows(slice(0, None, 60)), metadata={"config": stated})
        model = data.model.with_forces(prior)
        return true_curves(fit(model, data, restarts=1, options=OptimizerOptions(iterations=0)))

    return of


def test_friction_that_grows_with_the_load_is_a_coefficient(curves):
    prior = ContactFriction(load=True, expected=0.2)
    smooth = SPEED / np.sqrt(SPEED**2 + 0.04**2)
    given = {"friction_smoothing": 0.04, "coulomb_coefficient": 0.25}
    law = curves(prior, friction="coulomb", **given)["sliding"]
    np.testing.assert_allclose(law(SPEED), 0.25 * smooth, rtol=1e-12)
    law = curves(prior, friction="stribeck", static_coefficient=0.6, breakaway_velocity=0.2, **given)["sliding"]
    np.testing.assert_allclose(law(SPEED), (0.25 + 0.35 * np.exp(-((SPEED / 0.2) ** 2))) * smooth, rtol=1e-12)


def test_viscous_friction_is_a_force_and_per_speed_a_constant(curves):
    law = curves(ContactFriction(), viscous_coefficient=1.7)["sliding"]
    np.testing.assert_allclose(law(SPEED), 1.7 * SPEED, rtol=1e-12)
    law = curves(ContactFriction(viscous=True), viscous_coefficient=1.7)["sliding"]
    np.testing.assert_allclose(law(SPEED), 1.7 * np.ones(40), rtol=1e-12)


def test_joints_resist_by_the_law_of_each(curves):
    changes = {"joint_friction": "stribeck", "joint_smoothing": 0.08, "joint_breakaway_velocity": 0.3}
    found = curves((JointFriction(), ContactFriction()), **changes)
    assert len(found) == 8
    config = KukaSurfaceConfig()
    for k in range(7):
        coulomb, static, viscous = config.joint_coulomb[k], config.joint_static[k], config.joint_viscous[k]
        level = coulomb + (static - coulomb) * np.exp(-((V / 0.3) ** 2))
        expected = np.tanh(V / 0.08) * level + viscous * V
        np.testing.assert_allclose(found[f"joint-friction lbr_iiwa_joint_{k + 1}"](V), expected, rtol=1e-12)
        assert bool((expected * V > 0.0).all())


def test_one_joint_alone_has_its_own_law(curves):
    whole = curves(JointFriction(), joint_friction="stribeck")
    (alone,) = curves(JointFriction(("lbr_iiwa_joint_3",)), joint_friction="stribeck").values()
    assert np.array_equal(alone(V), whole["lbr_iiwa_joint_3"](V))
    assert not np.array_equal(alone(V), whole["lbr_iiwa_joint_5"](V))


def test_joints_without_friction_resist_nothing(curves):
    found = curves(JointFriction(("lbr_iiwa_joint_2",)))
    assert np.array_equal(found["lbr_iiwa_joint_2"](V), np.zeros(40))


@pytest.mark.parametrize(
    ("prior", "changes"),
    [
        (ContactFriction(), {"friction": "stribeck"}),  # not proportional to the load
        (ContactFriction(load=True, expected=0.2), {}),  # viscous friction does not grow with it
        (ContactFriction(axes="two-axis"), {}),
        (ContactFriction(viscous=True, inputs=("position",)), {}),
        (ToolForces(), {}),
    ],
)
def test_what_the_simulation_did_not_follow_has_no_law(curves, prior, changes):
    assert curves(prior, **changes) == {}


def test_models_without_forces_have_no_law(motion):
    from benchmarks.force_priors.jobs import true_curves

    data = motion.rows(slice(0, None, 60))
    assert true_curves(fit(data.model.black_box(), data, options=OptimizerOptions(iterations=0))) == {}


def test_coverage_of_a_curve_counts_the_points_in_the_visited_range():
    from benchmarks.force_priors.jobs import curve_coverage

    def curve(mean, std, high):
        at, column = torch.linspace(0.0, 1.0, 5, dtype=torch.float64)[:, None], torch.tensor([[0.0], [high]])
        return Curve(
            "f", "N", ("v [m/s]",), at, *(torch.tensor(each).double() for each in (mean, std)), column.double()
        )

    given = curve([0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 0.1, 0.1, 0.1, 0.1], 1.0)
    assert curve_coverage(given, lambda v: 4.0 * v) == 1.0  # exact at rest, where there is no width
    assert curve_coverage(given, lambda v: 4.0 * v + 0.15) == pytest.approx(0.8)
    assert curve_coverage(given, lambda v: 4.0 * v + 0.3) == 0.0
    assert curve_coverage(curve([0.0, 1.0, 2.0, 9.0, 9.0], [0.1] * 5, 0.5), lambda v: 4.0 * v) == 1.0
