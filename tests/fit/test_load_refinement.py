"""Friction under load on the small arm: fits that find the normal force which friction itself changes."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from tests.posterior.arm import NOISE, arm_data

from forcegp.data import Dataset
from forcegp.errors import NumericalWarning
from forcegp.fit import fit
from forcegp.fit.fit import _Functions
from forcegp.fit.refinement import SETTLED, fit_with_refined_loads
from forcegp.fit.search import Search
from forcegp.forces import ContactFriction, JointFriction
from forcegp.inference import OptimizerOptions
from forcegp.model import Model

COULOMB, SLOWLY = 0.35, 0.1  # coefficient, and the speed (m/s) below which it falls to zero
OPTIONS = OptimizerOptions(iterations=60)
LOAD = ContactFriction(load=True)


def coefficient(speed: torch.Tensor) -> torch.Tensor:
    return COULOMB * torch.tanh(speed / SLOWLY)


@cache
def sliding_data(rows: int, seed: int, joint_friction: float = 0.0) -> Dataset:
    """Coulomb friction of the tool, solved together with acceleration and multiplier: one dense system per row."""
    # M a - A^T lambda + mu(|v_t|) sign |s_p| lambda J^T d = Q_K - c v with the sign of lambda that comes out of it
    data = arm_data(rows, seed)
    model = data.model
    J = model.robot.kinematics(torch.tensor(data.q)).frame_jacobian("hand", model.contacts[0].point)[:, :3]
    A, v = model.dynamics(*(torch.tensor(x) for x in (data.q, data.v, data.u))).A, torch.tensor(data.v)
    v = v - (torch.linalg.pinv(A) @ (A @ v[..., None]))[..., 0]  # along the plane
    states = torch.tensor(data.q), v, torch.tensor(data.u)
    dynamics, velocity = model.dynamics(*states), (J @ v[..., None])[..., 0]
    speed = velocity.norm(dim=-1)
    resisting = coefficient(speed)[:, None] * (J.mT @ (velocity / speed[:, None])[..., None])[..., 0]
    joints, solved = -joint_friction * v, []
    for sign in (1.0, -1.0):
        top = torch.cat([dynamics.M, (sign * resisting)[..., None] - A.mT], -1)
        matrix = torch.cat([top, torch.cat([A, A.new_zeros(rows, 1, 1)], -1)], -2)
        solved.append(torch.linalg.solve(matrix, torch.cat([dynamics.Q_K + joints, dynamics.b], -1)))
    positive = solved[0][:, 3] > 0.0
    assert bool((positive ^ (solved[1][:, 3] < 0.0)).all())  # exactly one sign is consistent
    found = torch.where(positive[:, None], solved[0], solved[1])
    a, multiplier = found[:, :3].numpy(), found[:, 3:]
    noise = NOISE * np.random.default_rng(seed + 100).standard_normal(a.shape)
    truth = {"a": a, "lambda": multiplier.numpy(), "Q_U": (joints - multiplier.abs() * resisting).numpy()}
    return replace(data, v=v.numpy(), a=a + noise, truth=truth)


def first_fit(model: Model, data: Dataset):
    """The fit under the nominal normal force, which `fit` does not stop at."""
    search = Search(1, restarts=1, seed=0, options=OPTIONS, start=None)
    return _Functions(model, search, "exact", None)._search(data, data)


def errors(posterior, test: Dataset) -> dict[str, float]:
    """Root-mean-square errors: acceleration without noise, lambda relative to itself, and the coefficient."""
    predicted, name = posterior.predict(test.q, test.v, test.u, covariance=False), posterior.latent_names[-1]
    speeds = torch.linspace(0.05, float(posterior.curve(name).visited[1, 0]), 50, dtype=torch.float64)

    def size(values: torch.Tensor) -> float:
        return float(values.square().mean().sqrt())

    normal_force = torch.tensor(test.truth["lambda"])
    return {
        "acceleration": size(predicted.mean - torch.tensor(test.truth["a"])),
        "normal force": size(predicted.multiplier.mean - normal_force) / size(normal_force),
        "coefficient": size(posterior.curve(name, speeds).mean - coefficient(speeds)),
    }


@pytest.fixture(scope="module")
def fits():
    """The same prior under the nominal and under the refined normal force."""
    data = sliding_data(60, 0)
    model = data.model.with_forces(LOAD)
    return first_fit(model, data), fit(model, data, restarts=1, options=OPTIONS)


def test_the_refined_fit_is_nearer_to_the_truth(fits):
    nominal, refined = (errors(posterior, sliding_data(80, 7)) for posterior in fits)
    assert refined["acceleration"] < 0.1 * nominal["acceleration"]
    assert refined["normal force"] < 0.1 * nominal["normal force"]
    assert refined["coefficient"] < 0.1 * nominal["coefficient"]


def test_it_ends_where_nothing_changes_any_more(fits):
    nominal, refined = fits
    assert 1 <= refined.settings["load_refinements"] <= 8
    assert "load_refinements" not in nominal.settings
    assert nominal.model.unknown_forces == (LOAD,)
    (found,) = refined.model.unknown_forces
    assert found.expected is not None
    expected = found.expected.sliding
    found = refined.curve("sliding", np.array(expected.at)).mean
    assert float((found - torch.tensor(expected.values)).abs().max()) < 5 * SETTLED
    assert refined.negative_log_likelihood < nominal.negative_log_likelihood


def test_beyond_the_visited_speeds_it_expects_what_the_curve_says():
    """Where accelerations are noisy, the ends of a curve are rough, and their slopes mean nothing."""
    clean = sliding_data(60, 1)
    a = clean.truth["a"] + 20 * NOISE * np.random.default_rng(3).standard_normal(clean.a.shape)
    data = replace(clean, a=a, noise_std=np.full(3, 20 * NOISE))
    first = first_fit(data.model.with_forces(LOAD), data)
    fastest = float(first.curve("sliding").visited[1, 0])
    expected: list[ContactFriction] = []

    def again(forces, last):
        expected.extend(forces.terms)
        return first

    with pytest.warns(NumericalWarning, match="still change"):
        fit_with_refined_loads(first, again, rounds=1)
    speeds = fastest * torch.linspace(0.0, 5.0, 80, dtype=torch.float64)
    curve = first.curve("sliding", speeds).mean
    assert expected[0].expected is not None
    assert float((expected[0].expected.sliding(speeds) - curve)[speeds > fastest].abs().max()) < 0.02
    assert float(curve.std()) > 1e-3  # it is no constant, which any continuation would meet


@pytest.mark.nightly
def test_joint_friction_beside_it_counts_for_the_normal_force():
    data, test = sliding_data(60, 0, 1.5), sliding_data(80, 7, 1.5)
    model = data.model.with_forces(JointFriction(kernel="linear"), LOAD)
    refined = fit(model, data, restarts=1, options=OPTIONS)
    nominal, friction = errors(first_fit(model, data), test), refined.model.unknown_forces[1]
    assert [name for name, _ in friction.expected.joints] == list(data.model.robot.joint_names)
    for _, curve in friction.expected.joints:
        at, values = (torch.tensor(part, dtype=torch.float64) for part in (curve.at, curve.values))
        assert float((values - 1.5 * at).abs().max()) < 0.01 * float(at.abs().max())
    assert errors(refined, test)["acceleration"] < 0.1 * nominal["acceleration"]


def test_an_expectation_that_was_given_stays():
    data, given = sliding_data(20, 0), ContactFriction(load=True, expected=0.1)
    posterior = fit(data.model.with_forces(given), data, restarts=1, options=OPTIONS)
    assert posterior.model.unknown_forces == (given,)
    assert "load_refinements" not in posterior.settings
    alone = first_fit(data.model.with_forces(given), data)
    assert all(torch.equal(posterior.hyperparameters[name], value) for name, value in alone.hyperparameters.items())
