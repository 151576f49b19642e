"""Margins to slipping against Monte Carlo, closed forms and the forces of the model."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.stats import norm

from forcegp import JointFriction, fit
from forcegp.errors import ContactError, InvalidInput
from forcegp.forces import foot_friction
from forcegp.mechanics import Contact, Plane
from forcegp.model import Model
from forcegp.posterior import friction_margins
from forcegp.posterior.friction_margin import margin_moments
from forcegp.posterior.prediction import Gaussian
from forcegp.scores import friction_margins_figure, normal_force_figure, slip_scores
from forcegp.simulation import QuadrupedConfig, simulate_quadruped


def forces(mean, covariance) -> Gaussian:
    """One foot."""
    return Gaussian(*(torch.tensor(np.asarray(x, float))[None] for x in (mean, covariance)))


def moments(mean, covariance, mu):
    return [float(x) for x in margin_moments(forces(mean, covariance), float(mu))]


@pytest.mark.parametrize("seed", range(12))
def test_moments_and_probability_are_those_of_sampling(seed):
    """Means inside, outside and near the apex of the cone; covariances of rank one to three."""
    rng = np.random.default_rng(seed)
    mean, mu = rng.normal([0.0, 0.0, (0.0, 4.0, 10.0)[seed % 3]], 3.0), rng.uniform(0.2, 1.2)
    factor = rng.normal(0.0, 2.0, (3, 1 + seed % 4 % 3))
    F = mean + rng.normal(size=(400_000, factor.shape[1])) @ factor.T
    margin = mu * F[:, 2] - np.hypot(F[:, 0], F[:, 1])
    found = moments(mean, factor @ factor.T, mu)
    assert found[0] == pytest.approx(margin.mean(), abs=0.02 * margin.std())
    assert found[1] == pytest.approx(margin.std(), rel=0.02)
    assert found[2] == pytest.approx((margin < 0.0).mean(), abs=0.004)


def test_closed_forms():
    mean, std, slip = moments([3.0, 4.0, 12.0], np.diag([0.0, 0.0, 4.0]), 0.5)  # N alone is uncertain
    assert (mean, std) == pytest.approx((1.0, 1.0), abs=1e-3)
    assert slip == pytest.approx(norm.cdf(-1.0), abs=2e-3)
    mean, std, slip = moments([0.0, 0.0, 10.0], np.diag([4.0, 4.0, 0.0]), 0.3)  # T about zero: Rayleigh
    assert mean == pytest.approx(3.0 - 2.0 * np.sqrt(np.pi / 2.0), abs=2e-3)
    assert slip == pytest.approx(np.exp(-(3.0**2) / 8.0), abs=2e-3)
    assert moments([3.0, 4.0, 12.0], np.zeros((3, 3)), 0.5) == pytest.approx([1.0, 0.0, 0.0])
    assert moments([3.0, 4.0, -12.0], np.zeros((3, 3)), 0.5)[2] == pytest.approx(1.0)  # pulling at the ground


@pytest.fixture(scope="module")
def log():
    return simulate_quadruped(QuadrupedConfig(seconds=2.5, seed=2, payload=0.0))


@pytest.fixture(scope="module")
def dog(log):
    return fit(log.model.with_forces(JointFriction(tuple(log.joint_names[6:]))), log, points=25, restarts=1)


def test_margins_of_feet_are_those_of_the_true_forces(dog, log):
    rows = log.rows(slice(0, 600, 10))
    found = friction_margins(dog, rows.q, rows.v, rows.u, 0.6)
    true = rows.truth["lambda"].reshape(len(rows), 4, 3)
    stands = rows.u[:, -4:] > 0.5
    assert found.names == tuple(f"{leg}_foot" for leg in ("front_left", "front_right", "rear_left", "rear_right"))
    assert not stands.all()
    margin = 0.6 * true[..., 2] - np.linalg.norm(true[..., :2], axis=-1)
    errors = (found.mean.numpy() - margin)[stands] / found.std.numpy()[stands]
    assert (np.abs(errors) < 4.0).mean() > 0.9
    assert np.isnan(found.slip.numpy()[~stands]).all()
    forces = np.stack([found.force[name].mean.numpy() for name in found.names], axis=1)
    assert np.abs(forces - true)[stands].max() < 3.0


def test_scores_and_figures(dog, log):
    rows = log.rows(slice(0, 600, 20))
    scores = slip_scores(dog, rows, 0.6)
    found = friction_margins(dog, rows.q, rows.v, rows.u, 0.6)
    first = scores["front_left_foot"]
    assert first["least_margin"] == pytest.approx(float(np.nanmin(found.mean[:, 0])))
    assert found.mean[first["row"], 0] == pytest.approx(first["least_margin"])
    assert slip_scores(dog, rows, 0.01)["front_left_foot"]["slipping"] > 0.5
    figure = friction_margins_figure(dog, rows, 0.6)
    assert [axes.get_title(loc="left") for axes in figure.axes] == list(scores)
    held = normal_force_figure(dog, rows, seconds=0.2)
    assert held.axes[0].get_title(loc="left") == "Contact 0: front_left_foot along x"
    assert held.axes[0].get_ylabel() == "force [N]"
    assert held.get_suptitle().startswith("Contact force")


def test_friction_of_the_prior_counts_and_surfaces_have_their_normals(log):
    """A foot that slides on a slope: the force along it is that of the prior, the normal one lambda."""
    foot = log.model.robot.frame_pose(torch.tensor(log.q[0]), "front_left_foot")[:3, 3]
    plane = Plane((0.3, 0.0, 1.0), float(0.3 * foot[0] + foot[2]))
    slope = Contact("front_left_foot", (0.0, 0.0, 0.0), plane, "stands")
    model = Model(log.model.robot, (slope,), log.model.forces)
    u = np.concatenate([log.u[:, :12], np.ones((len(log), 1))], axis=1)
    v = log.v + 0.1 * np.random.default_rng(0).normal(size=log.v.shape)
    given = {"q": log.q, "v": v, "u": u, "a": log.a, "time": log.time, "noise_std": np.ones(18)}
    data = type(log)(**given, model=model).rows(slice(0, 600, 60))
    posterior = fit(model.with_forces(foot_friction((0,))), data, points=6, restarts=1)
    found = friction_margins(posterior, data.q, data.v, data.u, 0.5)
    parts = posterior.components(data.q, data.v, data.u)
    force = found.force["front_left_foot"].mean
    torch.testing.assert_close(force[:, 2], parts.multiplier.mean[:, 0], rtol=1e-9, atol=1e-9)
    friction = next(iter(parts.values())).point_force.mean
    across = force[:, :2].norm(dim=-1)
    torch.testing.assert_close(across, friction.norm(dim=-1), rtol=1e-6, atol=1e-9)
    assert float(across.max()) > 0.0


def test_two_feet_of_one_link_have_names_and_forces_of_their_own(dog, log):
    height = float(log.model.robot.frame_pose(torch.tensor(log.q[0]), "front_left_foot")[2, 3])
    places = {"heel": (0.0, 0.0, 0.0), "toe": (0.05, 0.0, 0.0)}
    ground = [Contact("front_left_foot", at, Plane((0.0, 0.0, 1.0), height), name) for name, at in places.items()]
    rows = log.rows(slice(0, 3))
    u = np.concatenate([rows.u[:, :12], np.ones((3, 2))], axis=1)
    posterior = dog.with_contacts(ground)
    found = friction_margins(posterior, rows.q, rows.v, u, 0.5)
    assert found.names == ("front_left_foot (heel)", "front_left_foot (toe)")
    each = posterior.predict(rows.q, rows.v, u).contact_force.mean.unflatten(-1, (2, 3))
    for k, name in enumerate(found.names):
        torch.testing.assert_close(found.force[name].mean[:, 2], each[:, k, 2], rtol=1e-9, atol=1e-9)


def test_what_margins_need_is_named(dog, log):
    row = (log.q[:1], log.v[:1], log.u[:1])
    for wrong in (-0.1, "ice", float("nan")):
        with pytest.raises(InvalidInput, match="give a number of at least 0"):
            friction_margins(dog, *row, wrong)
    lifted = dataclasses.replace(log.rows(slice(0, 3)), u=np.zeros((3, 16)), truth={})
    with pytest.raises(ContactError, match="no foot stands in any of the rows"):
        slip_scores(dog, lifted, 0.5)
    with pytest.raises(ContactError, match="nothing can slip"):
        friction_margins(dog.with_contacts([]), log.q[:1], log.v[:1], log.u[:1, :12], 0.5)
    zero = fit(log.model, log, points=5)
    found = friction_margins(zero, *row, 0.5)
    assert found.slip.tolist() == pytest.approx(np.zeros((1, 4)), abs=1e-12)  # nothing is unknown
