"""Predictions, motions and what they show of themselves, as they were: of small posteriors of every kind."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.evidence.test_contact_forces import held, measured
from tests.goldens.compare import assert_unchanged
from tests.posterior.arm import arm_data, arm_model, arm_that_remembers, quick_fit
from tests.posterior.test_drift import fitted, recording

from forcegp import Accelerations, Viscous, fit
from forcegp.errors import DataWarning, ForceGPError
from forcegp.forces import ContactFriction, JointAccelerations, JointForces, JointFriction
from forcegp.posterior.fitted import Estimate, MotionIntervals

POSTERIORS = {
    "friction": lambda: quick_fit(arm_model().with_forces(JointFriction(), ContactFriction(load=True, expected=0.2))),
    "two contacts": lambda: quick_fit(arm_model().with_forces(JointForces())).with_contacts(arm_model(2).contacts),
    "air": lambda: quick_fit(arm_model().with_forces(JointForces(("v",)), Viscous())).with_contacts([]),
    "accelerations": lambda: quick_fit(arm_model().with_forces(JointAccelerations()).without_mean()),
    "hidden": lambda: quick_fit(
        held(JointForces(("v",))),
        replace(measured(held(Viscous(0.7)), held(), rows=30), measured={}, noise_std=[0.05] * 3),
    ),
    "memory": lambda: arm_that_remembers()[0],
    "laws": lambda: fit(arm_model(0).with_forces(Viscous()), arm_data(30, 0, arm_model(0)), Accelerations()),
    "drift": lambda: fitted(recording(1, 0.02, seconds=8.0)),
}
INTEGRATORS = {"friction": "symplectic-euler", "drift": "rk4", "laws": "implicit-midpoint"}


def moved(posterior, start, integrator) -> list:
    motion = posterior.rollout(*start, 0.01, integrator=integrator, samples=2, seed=1)
    return [motion.q, motion.v, motion.std("q"), motion.constraint, *motion.interval("v")]


@pytest.mark.parametrize("case", POSTERIORS)
def test_predictions_and_motions(case):
    with warnings.catch_warnings(action="ignore", category=DataWarning):  # of a past that is not known
        posterior = POSTERIORS[case]().with_settings(widening=1.0)
        rows = posterior.training
        q, v, u = (x[3:9] + 0.01 for x in (rows.q, rows.v, rows.u))
        plain = u[:, :3] if posterior.model.memory.names else u
        predictions = {"all": posterior.predict(q, v, u), "given": posterior.predict(q, v, plain, a=torch.ones_like(v))}
        predictions["mean"] = posterior.predict(q, v, u, covariance=False)
        predictor = posterior.predictor(compile=False)
        found = {
            "components": posterior.components(q, v, u),
            "curves": [posterior.curve(name, points=7) for name in posterior.latent_names if case == "friction"],
            "motions": moved(posterior, (q[0], v[0], u), INTEGRATORS[case]) if case in INTEGRATORS else None,
            "predictor": [predictor.mean(q, v, u), predictor.joint_forces(q[0], v[0], u[0])],
            "slopes": [predictor.linearize(q[0], v[0], u[0]), predictor.linearize_step(q[0], v[0], u[0], 0.01)],
            "facts": [*map(str, (posterior, *predictions.values(), posterior.parameters))],
        }
    with pytest.raises(ForceGPError, match="call predict"):
        print(predictions["mean"].std)
    assert_unchanged(f"posterior/{case}", found | predictions, rtol=1e-4)


@pytest.mark.parametrize("spread", [None, 0.3])
def test_widths_of_motions_grow_with_the_last_horizon(spread):
    numbers = np.random.default_rng(0).uniform(0.5, 2.0, (4, 2, 3, 2, 2))
    widths = MotionIntervals(np.array([0.1, 0.4, 1.0]), numbers[0, 0], numbers[1], (), numbers[2])
    time, given = torch.linspace(0.0, 2.0, 9).double(), None if spread is None else torch.full((9, 2), spread).double()
    assert_unchanged(f"posterior/widths {spread}", {name: widths.half_width(name, time, given) for name in ("q", "v")})


def test_the_interval_is_that_of_student_with_19_degrees_of_freedom():
    mass = Estimate("payload.mass", "kg", 2.0, 0.5, 1.0, 1.0, "log", "")
    assert mass.interval == pytest.approx((2.0 - 0.5 * 2.09302, 2.0 + 0.5 * 2.09302), abs=1e-5)  # of tables
