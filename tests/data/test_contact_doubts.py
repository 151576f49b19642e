"""Contacts that the rows contradict: off their surface, invented; and none where they are right."""

from dataclasses import replace

import numpy as np
import pytest
from tests.checks.corruptions import clean, invented, moved, on_a_line, two_links

from forcegp.data import Dataset, contact_doubts, differentiate
from forcegp.mechanics import Plane
from forcegp.model import Model
from forcegp.simulation import QuadrupedConfig, simulate_quadruped


def simulated(seed: int, surface: str = "plane", noise: float = 0.1, seconds: float = 4.0) -> Dataset:
    from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface

    return simulate_kuka_surface(KukaSurfaceConfig(seconds=seconds, seed=seed, surface=surface, noise=noise))


def wrong(data: Dataset, model: Model | None = None) -> list[int]:
    return [doubt.numbers["contact"] for doubt in contact_doubts(data, model)]


@pytest.fixture(scope="module")
def sliding() -> Dataset:
    return simulated(7)


def test_a_model_without_physics_has_nothing_to_compare(sliding):
    assert wrong(sliding) == wrong(sliding, sliding.model.without_mean()) == []


def test_few_rows_are_enough_and_never_too_many(sliding):
    few = sliding.rows(np.random.default_rng(0).choice(len(sliding), 20, replace=False))
    assert wrong(few) == wrong(few.rows(slice(0, 6))) == []
    below = sliding.model.with_contacts([replace(sliding.model.contacts[0], surface=Plane((0.0, 0.0, 1.0), 0.03))])
    assert (wrong(few, below), wrong(few.rows(slice(0, 6)), below)) == ([0], [])


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_an_arm_on_a_line(noise):
    data = on_a_line(4, noise=noise)
    assert (wrong(data), wrong(moved(data, (0.02, 0.0, 0.0)))) == ([], [0])
    assert wrong(invented(clean(two_links(), 4))) == [0]


def test_noise_of_positions_is_no_motion_of_feet_that_stand():
    """At .03 mm and .1 mrad a standing foot is differentiated to .02 m/s, and swings in some rows."""
    clean_walk = simulate_quadruped(QuadrupedConfig(seconds=4.0, seed=1))
    space, noise, q = clean_walk.model.robot.space, np.random.default_rng(0), clean_walk.q.copy()
    q[:, :3] += 3e-5 * noise.standard_normal((len(q), 3))
    q[:, 7:] += 1e-4 * noise.standard_normal(q[:, 7:].shape)
    v = differentiate(q, clean_walk.time, space)
    assert wrong(replace(clean_walk, q=q, v=v, a=differentiate(v, clean_walk.time), noise_std=None, truth={})) == []
    lifted = 1.0 - clean_walk.u[:, -4:]
    assert wrong(replace(clean_walk, u=np.hstack([clean_walk.u[:, :-4], lifted]), truth={})) == [1]
