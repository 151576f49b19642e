"""Errors of predicted motions against closed forms, and with what observers saw before each of them."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.data.test_wind import flight

from forcegp import AerodynamicForce
from forcegp.data import Dataset
from forcegp.errors import InvalidInput, NumericalWarning
from forcegp.fit import fit
from forcegp.model import Model
from forcegp.posterior import observing
from forcegp.robots import Robot
from forcegp.scores.experiment import OBSERVED, scored
from forcegp.scores.held_out import held_out_motions, motion_scores

SLEDGE = """<robot name="sledge"><link name="base"/><link name="sledge"><inertial><mass value="{mass}"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="rail" type="prismatic"><parent link="base"/><child link="sledge"/><axis xyz="1 0 0"/>
<limit lower="-9" upper="9" effort="9" velocity="9"/></joint></robot>"""
FORCE, TRUE_MASS, STEP = 3.0, 2.0, 0.01


def sledge(mass: float) -> Model:
    return Model(Robot.from_urdf_text(SLEDGE.format(mass=mass)))


def recording(rows: int = 101, episodes: int = 2, force: float = FORCE) -> Dataset:
    time, a = STEP * np.arange(rows), np.full((rows, 1), force / TRUE_MASS)
    v, q = 0.1 + a * time[:, None], 0.1 * time[:, None] + 0.5 * a * time[:, None] ** 2
    arrays = {"q": q, "v": v, "u": np.full((rows, 1), force), "a": a}
    return Dataset(
        **{name: np.tile(values, (episodes, 1)) for name, values in arrays.items()}, time=np.tile(time, episodes),
        episode=np.repeat(np.arange(episodes), rows), model=sledge(TRUE_MASS),
    )  # fmt: skip


def posterior(mass: float, data: Dataset):
    return fit(sledge(mass).with_forces(noise=1.0), data.select_episodes([0]), points=5)


@pytest.mark.parametrize("mass", [1.0, 2.5])
def test_a_wrong_mass_is_off_by_half_of_its_acceleration_times_the_time_squared(mass):
    data = recording()
    motions = held_out_motions(data, data.episode == 1, (0.1, 0.5), starts=4)
    assert motions.notes == ()
    table, facts = motion_scores(posterior(mass, data), motions)
    assert (facts["motions"], facts["diverged"]) == (4, [0, 0])
    expected = [0.5 * FORCE * abs(1.0 / mass - 1.0 / TRUE_MASS) * horizon**2 for horizon in (0.1, 0.5)]
    assert np.allclose([table[f"position after {h} s"]["rmse"] for h in ("0.1", "0.5")], np.c_[expected], rtol=1e-9)
    speed = [2.0 * error / horizon for error, horizon in zip(expected, (0.1, 0.5), strict=True)]
    assert np.allclose([table[f"velocity after {h} s"]["rmse"] for h in ("0.1", "0.5")], np.c_[speed], rtol=1e-9)
    assert np.allclose(np.mean(facts["squared"], axis=1), np.square(expected))


def test_motions_begin_in_held_out_stretches_and_cross_no_gap():
    data = recording()
    held_out = (data.episode == 0) & (data.time > 0.3) | (data.episode == 1) & (data.time < 0.45)
    model = posterior(1.0, data)
    _, motions = held_out_motions(data, held_out, (0.4,), starts=3).of(model)
    first, rows = np.c_[motions.q[:, 0, 0], motions.v[:, 0, 0]], np.c_[data.q[held_out, 0], data.v[held_out, 0]]
    assert {*map(tuple, first.round(9).tolist())} <= {*map(tuple, rows.round(9).tolist())}
    assert len(motions.q) == 6
    gap = data.rows(np.flatnonzero((data.time < 0.5) | (data.time > 0.7)))
    _, motions = held_out_motions(gap, np.ones(len(gap), dtype=bool), (0.25, 0.4), starts=5).of(model)
    assert np.allclose(np.diff(motions.q[..., 0], n=2, axis=1), FORCE / TRUE_MASS * STEP**2)
    usual = held_out_motions(gap, np.ones(len(gap), dtype=bool))
    assert usual.horizons == (0.1, 0.2)
    assert "not predicted: 0.5 s, 1 s" in usual.notes[0]
    with pytest.raises(InvalidInput, match=r"not predicted: 0.6 s; held-out stretches last 0.49 s.*Give shorter ones"):
        held_out_motions(gap, np.ones(len(gap), dtype=bool), (0.25, 0.6))


def test_what_cannot_be_predicted_is_said():
    data = recording()
    for none in (held_out_motions(data, data.time < 0.02), held_out_motions(data, data.time >= 0.0, ())):
        assert len(none) == 0
        assert motion_scores(posterior(1.0, data), none) == ({}, None)
    times = data.time.copy()
    times[1::2] += 0.002
    uneven = Dataset(q=data.q, v=data.v, u=data.u, a=data.a, time=times, episode=data.episode, model=data.model)
    found = held_out_motions(uneven, data.episode == 0, (0.5,))
    assert len(found) == 0
    assert "uneven" in found.notes[0]
    assert len(held_out_motions(replace(uneven, time=0.02 * times + 0.98 * data.time), data.episode == 0, (0.5,)))
    mixed = data.rows(np.random.default_rng(0).permutation(len(data)))
    assert "not in the order of time" in held_out_motions(mixed, np.ones(len(data), bool), (0.5,)).notes[0]


def test_diverged_motions_are_counted_and_not_averaged():
    data = recording(force=30.0)  # 3000 m/s^2: beyond 1000 m/s after a third of a second
    motions = held_out_motions(data, data.episode == 0, (0.1, 0.9), starts=2)
    with pytest.warns(NumericalWarning, match="2 of 2 rollouts diverged"):
        table, facts = motion_scores(posterior(0.01, data), motions)
    assert facts["diverged"] == [0, 2]
    assert table["position after 0.1 s"]["rmse"] == [pytest.approx(0.5 * 0.1**2 * (3000.0 - 15.0))]
    assert table["position after 0.9 s"]["rmse"] == [None]


def test_a_base_that_turns_is_off_by_the_angle_whatever_the_sign_of_its_quaternion():
    """A body thrown in space turns at a constant rate: a recording that began 0.2 rad ahead stays that far ahead."""
    text = SLEDGE.split("<joint")[0].format(mass=2.0).replace('<link name="base"/>', "") + "</robot>"
    model, time = Model(Robot.from_urdf_text(text, base="floating", gravity=(0.0, 0.0, 0.0))), STEP * np.arange(51)
    half, q = 0.5 * (3.0 * time + 0.4), np.zeros((51, 7))
    q[:, 0], q[:, 5], q[:, 6] = 1.0, np.sin(half), np.cos(half)
    v = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 3.0], (51, 1))
    data = Dataset(q=q, v=v, u=np.zeros((51, 0)), a=0.0 * v, time=time, model=model)
    model = fit(model.with_forces(noise=1.0), data, points=5)
    motions = held_out_motions(data, np.ones(51, dtype=bool), (0.2,), starts=1)
    right = motion_scores(model, motions)[0]["position after 0.2 s"]["rmse"]
    assert len(right) == 6
    assert max(right) < 1e-9
    ahead = q.copy()
    ahead[1:, 5], ahead[1:, 6] = -np.sin(half[1:] + 0.1), -np.cos(half[1:] + 0.1)
    off = motion_scores(model, held_out_motions(replace(data, q=ahead), np.ones(51, dtype=bool), (0.2,), starts=1))[0]
    np.testing.assert_allclose(off["position after 0.2 s"]["rmse"][5], 0.2, atol=1e-9)


# ---------------------------------------------------------------- observers


def pushed(forces, rows, seed=4, noise=0.0):
    """Flights in still air, each with a constant force of the world."""
    dataset = flight([(0.0, 0.0, 0.0)] * len(forces), episodes=len(forces), rows=rows, seed=seed, noise=noise)
    state = dataset.model.dynamics(*map(torch.tensor, (dataset.q, dataset.v, dataset.u))).state
    rotation, a = state.kinematics.frame_pose("body")[:, :3, :3].numpy(), dataset.a.copy()
    a[:, :3] += np.einsum("nji,nj->ni", rotation, np.array(forces)[dataset.episode]) / 1.2
    return replace(dataset, a=a)


@pytest.fixture(scope="module")
def airborne():
    train = pushed([(0.0, 0.0, 0.0)], rows=200, noise=0.02)
    with warnings.catch_warnings(action="ignore"):
        return fit(train.model.with_forces(AerodynamicForce(kernel="linear"), noise=0.02), train, points=60, restarts=1)


@pytest.fixture(scope="module")
def log():
    """Two stretches, each pushed another way."""
    return pushed([(0.0, 5.0, 0.0), (4.0, 0.0, 0.0)], rows=150, seed=5, noise=0.02)


def unobserved(airborne):
    blind = AerodynamicForce(kernel="linear", observe=0.0)
    return replace(airborne, trained=replace(airborne.trained, forces=(*airborne.trained.laws, blind)))


def test_rows_are_predicted_with_what_was_observed_before_them(airborne, log):
    none = held_out_motions(log, np.ones(len(log), dtype=bool), ())
    seen, blind = (scored(each, log, none) for each in (airborne, unobserved(airborne)))
    assert OBSERVED in seen["warnings"]
    assert OBSERVED not in blind["warnings"]
    errors = [max(found["table"]["acceleration"]["nrmse"][:2]) for found in (seen, blind)]
    assert errors[0] < 0.3 * errors[1]
    assert len(seen["stretches"]) == len(blind["stretches"])  # no row is left out


def test_motions_begin_with_what_was_observed_before_them(airborne, log):
    held_out = held_out_motions(log, np.ones(len(log), dtype=bool), (0.1, 0.3), starts=4)
    seeing, motions = held_out.of(airborne)
    assert len(motions.q) == 8
    _, seen = observing(airborne, log.select_episodes([1]), whole=True)
    np.testing.assert_allclose(motions.u[4:, 0], seen.u[list(motions.rows[4:])], rtol=1e-12, atol=1e-12)
    assert seeing.model.inputs == seen.model.inputs
    assert held_out.of(unobserved(airborne))[1].u.shape[-1] == log.u.shape[-1]
    rollout = seeing.rollout(motions.q[:, 0], motions.v[:, 0], motions.u, motions.dt, integrator="rk4")
    away = log.model.robot.difference(torch.tensor(motions.q[:, -1]), rollout.q[:, -1]).square().mean(-1)
    np.testing.assert_allclose(motion_scores(airborne, held_out)[1]["squared"][1], away, rtol=1e-9)
