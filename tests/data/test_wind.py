"""The wind of a recording: found exactly where the law of air is exact, and observed from the past only."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from forcegp import Dataset, Model, Robot
from forcegp.data import find_wind
from forcegp.forces import Actuation, RigidBodies, Thrusters
from forcegp.mechanics import fixed_point

BODY = (
    '<robot name="drone"><link name="body"><inertial><mass value="1.2"/>'
    '<inertia ixx="0.01" iyy="0.012" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
)
PLACES = [(0.1, -0.1, 0.0), (-0.1, 0.1, 0.0), (0.1, 0.1, 0.0), (-0.1, -0.1, 0.0)]
DRAG, SQUARED = np.array([0.2, 0.3, 0.4]), np.array([0.05, 0.04, 0.06])


def flight(wind, *, drag=1.0, episodes=1, rows=800, seed=0, noise=0.0):
    """Random smooth motions of a body on which drag is the only unmodelled force, a law that `AirLaw` holds exactly."""
    robot = Robot.from_urdf_text(BODY, base="floating")
    model = Model(robot, (), (Actuation(), Thrusters("body", PLACES, 1.0, [0.02, 0.02, -0.02, -0.02]), RigidBodies()))
    rng, parts, time = np.random.default_rng(seed), [], np.arange(rows) / 100
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
    air = v[:, :3] - np.einsum("nji,nj->ni", state.state.kinematics.frame_pose("body")[:, :3, :3].numpy(), blowing)
    force = -drag * (DRAG * air + SQUARED * np.linalg.norm(air, axis=1, keepdims=True) * air)
    a = state.acceleration(torch.tensor(np.concatenate([force, -drag * 0.01 * air[:, [1, 0, 2]]], axis=1))).numpy()
    a = a + noise * rng.standard_normal(a.shape)
    return Dataset(q=q, v=v, u=u, a=a, time=np.tile(time, episodes) + 100.0 * episode, episode=episode, model=model)


@pytest.mark.parametrize("wind", [(0.0, 0.0, 0.0), (3.0, -2.0, 0.0), (-9.0, 7.0, 0.0)])
def test_the_wind_of_an_exact_law_is_found(wind):
    law, found = find_wind(flight([wind]))
    np.testing.assert_allclose(law.wind, wind, atol=1e-5)
    np.testing.assert_allclose(found, np.broadcast_to(wind, found.shape), atol=1e-5)
    assert max(law.deviations) < 1e-5


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
