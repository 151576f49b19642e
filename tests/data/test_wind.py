"""The wind of a recording: found exactly where the law of air is exact, and observed from the past only."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from forcegp import AerodynamicForce, Dataset, Model, Robot, fit
from forcegp.data import find_wind
from forcegp.data.wind import steady_forces
from forcegp.forces import Actuation, RigidBodies, Thrusters
from forcegp.mechanics import fixed_point
from forcegp.posterior import load_posterior, observing, save_posterior

BODY = (
    '<robot name="drone"><link name="body"><inertial><mass value="1.2"/>'
    '<inertia ixx="0.01" iyy="0.012" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
)
PLACES = [(0.1, -0.1, 0.0), (-0.1, 0.1, 0.0), (0.1, 0.1, 0.0), (-0.1, -0.1, 0.0)]
DRAG, SQUARED = np.array([0.2, 0.3, 0.4]), np.array([0.05, 0.04, 0.06])


def flight(wind, *, drag=1.0, episodes=1, rows=800, seed=0, noise=0.0):
    """Random smooth motions of a body on which drag is the only unmodelled force, a law that `AirLaw` holds exactly."""
    robot = Robot.from_urdf_text(BODY, base="floating")
    rotors = Thrusters("body", PLACES, 1.0, [0.02, 0.02, -0.02, -0.02])
    model = Model(robot, (), (Actuation(), rotors, RigidBodies()))
    rng, parts = np.random.default_rng(seed), []
    time = np.arange(rows) / 100
    for episode in range(episodes):

        def waves(columns, size, rng=rng):
            rate, phase = rng.uniform(0.5, 6.0, (2, columns)), rng.uniform(0, 6, (2, columns))
            return size * np.sin(rate[:, None] * time[:, None] + phase[:, None]).sum(0)

        turn = np.concatenate([waves(3, 0.2), np.ones((rows, 1))], axis=1)
        q = np.concatenate([waves(3, 1.0), turn / np.linalg.norm(turn, axis=1, keepdims=True)], axis=1)
        parts.append(
            (q, waves(6, 1.5), 3.0 + waves(4, 0.5), np.full(rows, episode), np.broadcast_to(wind[episode], (rows, 3)))
        )
    q, v, u, episode, blowing = map(np.concatenate, zip(*parts, strict=True))
    state = model.dynamics(*map(torch.tensor, (q, v, u)))
    rotation = state.state.kinematics.frame_pose("body")[:, :3, :3].numpy()
    air = v[:, :3] - np.einsum("nji,nj->ni", rotation, blowing)
    force = -drag * (DRAG * air + SQUARED * np.linalg.norm(air, axis=1, keepdims=True) * air)
    torque = -drag * 0.01 * air[:, [1, 0, 2]]
    a = state.acceleration(torch.tensor(np.concatenate([force, torque], axis=1))).numpy()
    a = a + noise * rng.standard_normal(a.shape)
    return Dataset(q=q, v=v, u=u, a=a, time=np.tile(time, episodes) + 100.0 * episode, episode=episode, model=model)


@pytest.mark.parametrize("wind", [(0.0, 0.0, 0.0), (3.0, -2.0, 0.0), (-9.0, 7.0, 0.0)])
def test_the_wind_of_an_exact_law_is_found(wind):
    dataset = flight([wind])
    law, found = find_wind(dataset)
    np.testing.assert_allclose(law.wind, wind, atol=1e-5)
    np.testing.assert_allclose(found, np.broadcast_to(wind, found.shape), atol=1e-5)
    assert max(law.deviations) < 1e-5


def test_every_episode_has_its_wind():
    winds = [(4.0, 1.0, 0.0), (-2.0, 5.0, 0.0), (0.0, 0.0, 0.0)]
    dataset = flight(winds, episodes=3, noise=0.05)
    _, found = find_wind(dataset)
    for episode, wind in enumerate(winds):
        np.testing.assert_allclose(found[dataset.episode == episode].mean(0), wind, atol=0.1)


def test_another_wind_is_observed_from_the_rows_before():
    law, _ = find_wind(flight([(3.0, -2.0, 0.0)]))
    other = flight([(-5.0, 4.0, 0.0)], seed=1)
    observed = law.wind_before(other)
    np.testing.assert_allclose(observed[0], law.wind)
    np.testing.assert_allclose(observed[60:], np.broadcast_to((-5.0, 4.0, 0.0), observed[60:].shape), atol=0.1)
    first = other.rows(np.arange(200))
    np.testing.assert_allclose(law.wind_before(first), observed[:200], atol=1e-12)  # nor does the length count
    changed = other.a.copy()
    changed[300:] += 3.0
    after = law.wind_before(replace(other, a=changed))
    np.testing.assert_array_equal(after[:301], observed[:301])
    assert np.abs(after[301] - observed[301]).max() > 1e-3


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("case", ["no drag", "few rows", "out of order", "contact"])
def test_nothing_is_found_where_rows_do_not_show_it(case, seed):
    dataset = flight([(3.0, 0.0, 0.0)], drag=0.0 if case == "no drag" else 1.0, noise=0.3, seed=seed)
    if case == "few rows":
        dataset = dataset.rows(np.arange(300))
    if case == "out of order":
        dataset = dataset.rows(np.random.default_rng(0).permutation(len(dataset)))
    if case == "contact":
        dataset = replace(dataset, model=dataset.model.with_contacts(fixed_point("body", (0.0, 0.0, 0.0))))
    assert find_wind(dataset) is None


def pushed(forces, rows=120, seed=4, noise=0.0):
    """Flights in still air, each with a constant force of the world."""
    dataset = flight([(0.0, 0.0, 0.0)] * len(forces), episodes=len(forces), rows=rows, seed=seed, noise=noise)
    state = dataset.model.dynamics(*map(torch.tensor, (dataset.q, dataset.v, dataset.u))).state
    rotation = state.kinematics.frame_pose("body")[:, :3, :3].numpy()
    a = dataset.a.copy()
    a[:, :3] += np.einsum("nji,nj->ni", rotation, np.array(forces)[dataset.episode]) / 1.2
    return replace(dataset, a=a)


def test_the_force_of_each_episode_is_found():
    forces = np.array([(2.0, -1.0, 0.5), (-3.0, 0.0, 1.0), (0.0, 4.0, -1.0)])
    found = steady_forces(pushed(forces))
    expected = forces - forces.mean(0)
    np.testing.assert_allclose(found, expected[np.repeat(range(3), 120)], atol=1e-6)
    assert steady_forces(pushed(forces[:1])) is None


def test_a_fit_leaves_the_force_of_each_episode_to_its_observer(tmp_path):
    """So no function has to explain it; later flights, stored models and rows that are added have one of their own."""
    from forcegp.cli.fit import fit_summary

    train = pushed([(6.0, 0.0, 0.0), (-6.0, 0.0, 0.0)], noise=0.02)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        posterior = fit(train.model.with_forces(AerodynamicForce(kernel="linear"), noise=0.02), train, restarts=1)
    assert posterior.model.inputs == train.model.inputs
    np.testing.assert_allclose(posterior.settings["steady_forces"]["0"], (6.0, 0.0, 0.0), atol=1.0)
    assert fit_summary(posterior, 1.0)["wind_not_found"]
    there = pushed([(0.0, 9.0, 0.0)], seed=5, noise=0.02)
    seeing, seen = observing(posterior, there)
    a = seeing.predict(seen.q, seen.v, seen.u, covariance=False).mean.numpy()
    assert np.abs(a - seen.a)[:, :3].mean() < 0.1  # of 7.5 m/s^2
    save_posterior(posterior, tmp_path / "drone")
    loaded = load_posterior(tmp_path / "drone")
    more = [each.update(there.rows(np.arange(60))) for each in (posterior, loaded)]
    means = [each.predict(there.q, there.v, there.u, covariance=False).mean for each in more]
    torch.testing.assert_close(*means, rtol=1e-9, atol=1e-9)
    assert len(more[0].training) > len(posterior.training)
