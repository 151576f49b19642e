"""Friction that drifts: what a log tells of it, what `update` follows, and what intervals of motions count."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from scipy.linalg import null_space
from scipy.signal import lfilter
from scipy.stats import multivariate_normal
from tests.fit.test_motion_fit import slide
from tests.forces.test_presliding import log_of, motion
from tests.posterior.arm import arm_data, arm_model

from forcegp import Coulomb, Dataset, Torques, Viscous, fit, load_posterior, save_posterior
from forcegp.data.views import recorded_motions
from forcegp.evidence import Accelerations
from forcegp.fit import calibrated
from forcegp.forces import GearFriction, JointFriction, Offset
from forcegp.noise import Noise
from forcegp.posterior.drift import BETWEEN, Drift, in_its_record, random_walk, restricted_likelihood, scaled
from forcegp.scores.held_out import held_out_motions

DT, NOISE = 0.01, 0.3


def recording(seed: int, rate: float = 0.0, seconds: float = 60.0, level: float = 0.0, still: float = 0.0) -> Dataset:
    """A cart of 5 kg by Euler steps of 1 ms; the level of its dry friction makes a random walk from 1 + `level` on."""
    generator, rows = np.random.default_rng(seed), round(seconds / DT)
    time, phase = DT * np.arange(rows), generator.uniform(0.0, 6.0, 3)
    force = sum(k * np.sin(w * time + p) for k, w, p in zip((12.0, 9.0, 5.0), (1.3, 4.1, 0.4), phase, strict=True))
    force = np.where(time < still, 0.0, force)
    dry = 4.0 * (1.0 + level + rate * DT**0.5 * np.cumsum(generator.standard_normal(rows)))
    q, v, a = np.zeros((3, rows, 1))
    x, w = 0.0, 0.0
    for k in range(rows):
        a[k] = (force[k] - 3.0 * w - dry[k] * np.tanh(w / 0.02)) / 5.0
        q[k], v[k] = x, w
        for _ in range(10):
            w += DT / 10 * (force[k] - 3.0 * w - dry[k] * np.tanh(w / 0.02)) / 5.0
            x += DT / 10 * w
    a, truth = a + NOISE * generator.standard_normal(a.shape), {"Q_U": (dry[:, None] / 4.0)}
    return Dataset(q=q, v=v, u=force[:, None], a=a, time=time, model=slide(3.0, 4.0), truth=truth)


def fitted(log: Dataset):
    return fit(log.model.with_forces(Viscous(), Coulomb(None, 0.02), Offset()), replace(log, truth={}), Accelerations())


def drift_of(posterior) -> Drift:
    return Drift(**posterior.settings["drift"])


@pytest.fixture(scope="module")
def steady():
    log = recording(1)
    return log, fitted(log)


def test_a_random_walk_is_found():
    """Relative to the mean level of the log, which is what the fit finds."""
    rate, found = 0.02, []
    for seed in range(5):
        log = recording(seed, rate, 100.0)
        found.append(drift_of(fitted(log)).rate[0] * float(log.truth["Q_U"].mean()))
    assert rate / 1.5 < np.median(found) < 1.5 * rate
    assert sum(rate / 1.5 < each < 1.5 * rate for each in found) >= 4, found


def test_where_nothing_drifts_none_is_found(steady):
    _, posterior = steady
    drift = drift_of(posterior)
    assert (drift.rate, drift.records) == ([0.0], 1)
    assert drift.between == drift.std == pytest.approx([0.03]), "what is assumed of another record"
    assert "5.9% between records (assumed)" in str(posterior)


@pytest.mark.nightly
def test_what_is_no_random_walk_is_hardly_ever_told_as_one():
    generator, found = np.random.default_rng(0), 0
    for _ in range(200):
        y, information = generator.standard_normal(40), np.ones(40)
        found += random_walk(y, information, np.arange(40.0), np.zeros(40, dtype=int), 1.0)[0] > 0.0
    assert found <= 0.05 * 200
    lasting = 0
    for _ in range(40):  # errors that last for two blocks
        y = np.convolve(generator.standard_normal(41), [1.0, 1.0], "valid")
        lasting += random_walk(y, 10.0 * np.ones(40), np.arange(40.0), np.zeros(40, dtype=int), 1.0)[0] > 0.0
    assert lasting <= 2
    for _ in range(20):  # what lasts for six is no error of a posture
        y = lfilter([0.53], [1.0, -np.exp(-1.0 / 6.0)], generator.standard_normal(80))
        lasting += random_walk(y, 100.0 * np.ones(80), np.arange(80.0), np.zeros(80, dtype=int), 1.0)[0] > 0.0
    assert lasting >= 7
    drifting = 0
    for _ in range(40):  # a threshold twice as high would miss most
        y = generator.standard_normal(40) + 0.7 * np.cumsum(generator.standard_normal(40))
        drifting += random_walk(y, np.ones(40), np.arange(40.0), np.zeros(40, dtype=int), 1.0)[0] > 0.0
    assert drifting >= 18


def test_the_likelihood_is_that_of_contrasts():
    """REML is the likelihood of all combinations of the levels that do not hold their mean (Harville 1974)."""
    generator, n = np.random.default_rng(3), 12
    y, contrasts, differences = generator.standard_normal(n), null_space(np.ones((1, n))).T, []
    for seed in range(3):
        root = np.random.default_rng(seed).standard_normal((n, n))
        covariance = root @ root.T + np.eye(n)
        nats, c = restricted_likelihood(y, covariance)
        there = contrasts @ covariance @ contrasts.T
        density = [float(multivariate_normal(cov=k * c * there).logpdf(contrasts @ y)) for k in (0.97, 1.0, 1.03)]
        assert density[1] == max(density)
        differences.append(density[1] - nats)
    np.testing.assert_allclose(differences, differences[0])


def test_records_that_differ_are_learned_from_them():
    parts = [recording(seed, level=level, seconds=12.0) for seed, level in ((1, -0.2), (2, 0.0), (3, 0.2), (4, 0.0))]
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ("q", "v", "u", "a", "time")}
    drift = drift_of(fitted(Dataset(**arrays, episode=np.repeat(np.arange(4), len(parts[0])), model=parts[0].model)))
    assert (drift.rate, drift.records) == ([0.0], 4)
    assert 0.08 < drift.between[0] < 0.3


def test_update_is_conditioning_on_all_rows(steady):
    """Against a Gaussian process of the level, with its dense covariance over all rows."""
    _, posterior = steady
    rows, given = recording(9, level=0.05, seconds=4.0), replace(drift_of(posterior), rate=[0.02])
    updated = posterior.with_settings(drift=asdict(given)).update(rows)
    q, v, u = (torch.tensor(x) for x in (rows.q, rows.v, rows.u))
    coulomb = next(law for law in posterior.model.laws if isinstance(law, Coulomb))
    f = coulomb.force(posterior.model.state(q, v, u))[:, 0].numpy()
    M = float(posterior.model.mass_matrix_at(posterior.model.robot.kinematics(q[:1])))
    missed = M * (rows.a - posterior.predict(q, v, u).mean.numpy())[:, 0] - given.bias[0] * f
    walk = BETWEEN**2 + 0.02**2 * np.minimum.outer(rows.time, rows.time)
    joint = f[:, None] * walk * f + given.noise[0][0] / DT * np.eye(len(f))
    gain, found = np.linalg.solve(joint, f[:, None] * walk[:, -1:])[:, 0], drift_of(updated)
    np.testing.assert_allclose(found.level, [gain @ missed], rtol=1e-6)
    np.testing.assert_allclose(found.std, [np.sqrt(walk[-1, -1] - gain @ (f * walk[-1]))], rtol=1e-6)
    assert found.level[0] == pytest.approx(0.05, abs=0.03)
    before, after = posterior.parameters["coulomb.level.x"], updated.parameters["coulomb.level.x"]
    assert after.value == pytest.approx((1.0 + found.level[0]) * before.value)
    assert updated.parameters["viscous.x"] == posterior.parameters["viscous.x"]


def test_the_level_is_that_of_motors():
    time, q, v, a = motion(3000, 1)
    T, level = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 1.0]]), np.array([0.8, 0.5, 0.3])
    rigid = arm_model(0).robot.inverse_dynamics(*map(torch.tensor, (q, v, a))).numpy()
    noise = 0.01 * np.random.default_rng(0).standard_normal((2, *q.shape))
    first, second = (
        log_of(q, v, a, rigid + (by * level * np.tanh(v @ T.T / 0.05)) @ T + each, time)
        for by, each in zip((1.0, [1.0, 1.0, 1.1]), noise, strict=True)
    )
    posterior = fit(arm_model(0).with_forces(Coulomb(transmission="bend+lift")), first, Torques(), rows=1500)
    moved = posterior.update(replace(second, time=time + 1e4)).settings["drift"]["level"]
    np.testing.assert_allclose(moved, [0.0, 0.0, 0.1], atol=0.01)


def test_another_record_is_predicted_better(steady, tmp_path):
    _, posterior = steady
    other = recording(5, level=0.15, seconds=24.0)
    rest, updated = other.rows(other.time >= 8.0), posterior.update(other.rows(other.time < 8.0))
    again = updated.update(rest.rows(rest.time < 16.0))
    assert abs(drift_of(again).level[0] - 0.15) < 0.03
    assert drift_of(again).std[0] < drift_of(updated).std[0]
    back = again.update(recording(6, seconds=12.0))
    assert abs(drift_of(back).level[0]) < 0.03, "a record that begins anew is about as the fit was"

    def error(model) -> float:
        motions = recorded_motions(rest, 12, 1.0)
        moved = model.rollout(motions.q[:, 0], motions.v[:, 0], motions.u, motions.dt, integrator="rk4")
        return float(np.sqrt(np.square(moved.q.numpy() - motions.q)[:, -1].mean()))

    assert error(updated) < 0.4 * error(posterior)
    save_posterior(updated, tmp_path / "run")
    assert error(load_posterior(tmp_path / "run")) == pytest.approx(error(updated))


def test_where_the_same_record_goes_on_nothing_changes(steady):
    log, posterior = steady
    later = recording(1, seconds=64.0)
    updated = posterior.update(later.rows(later.time >= 60.0))
    assert drift_of(updated).here == "fit"
    assert drift_of(updated).level == [0.0]
    state = log.q[:5], log.v[:5], log.u[:5]
    assert torch.equal(updated.predict(*state).mean, posterior.predict(*state).mean)


def test_motions_that_go_on_in_the_record_have_its_level(steady):
    _, posterior = steady
    drift = posterior.settings["drift"]
    until, seconds = drift["until"], drift["seconds"]
    soon = in_its_record(posterior, [until + 0.5, until + 0.9 * seconds]).settings["drift"]
    assert soon == {**drift, "here": "fit", "std": [0.0]}
    for begins in ([until + 1.1 * seconds], [0.5 * until], [until + 0.5, 0.0]):
        assert in_its_record(posterior, begins) is posterior
    walking = posterior.with_settings(drift={**drift, "rate": [0.02]})
    assert in_its_record(walking, [until + 4.0]).settings["drift"]["std"] == [pytest.approx(0.04)]
    rows = recording(7, seconds=20.0)
    motions = held_out_motions(replace(rows, time=rows.time + until + 0.1), np.ones(len(rows), dtype=bool), (0.5,), 5)
    assert motions.of(posterior)[0].settings["drift"]["here"] == "fit"


def test_intervals_count_another_level_until_it_is_seen(steady):
    log, posterior = steady
    posterior = calibrated(posterior, log, (0.1, 0.5))
    fresh, motions = posterior.motion_intervals, recorded_motions(log, 40, 0.5)
    start = motions.q[:, 0], motions.v[:, 0], motions.u, motions.dt
    for place, kind in enumerate((Coulomb, Viscous)):
        louder = replace(posterior, target=scaled(posterior.model, torch.tensor([1.0 + BETWEEN]), kind))
        away = louder.rollout(*start, integrator="rk4").q - posterior.rollout(*start, integrator="rk4").q
        assert fresh.drift[place, -1, 0, 0] == pytest.approx(float(away[:, -1].square().mean().sqrt()), rel=0.25)
    same = posterior.update(recording(1, seconds=61.0).rows(slice(-100, None))).motion_intervals
    other = posterior.update(recording(7, seconds=20.0)).motion_intervals
    assert not same.drift.any()
    assert 0.0 < other.drift[0, -1, 0, 0] < 0.5 * fresh.drift[0, -1, 0, 0]
    np.testing.assert_allclose(other.drift[1] ** 2, 0.5 * fresh.drift[1] ** 2)
    time = torch.tensor([0.5], dtype=torch.float64)
    widths = [float(each.half_width("q", time, None)) for each in (same, other, fresh)]
    assert widths == sorted(widths)
    assert widths[0] < widths[2]
    squares = (1.959963984540054**2) * float(np.square(fresh.drift[:, -1, 0, 0]).sum())
    assert widths[2] ** 2 == pytest.approx(widths[0] ** 2 + squares)


def test_scaled_friction_is_a_multiple():
    model = slide(3.0, 4.0).with_forces(GearFriction(1.0, 0.2, 0.3, 0.5, 0.1, 0.05, memory=False))
    q, v, u = torch.zeros(4, 1), torch.tensor([[-1.0], [0.01], [0.1], [2.0]]), torch.ones(4, 1)
    state = model.state(*(x.double() for x in (q, v, u)))
    once, twice = (
        next(law for law in each.laws if isinstance(law, GearFriction)).force(state)
        for each in (model, scaled(model, torch.tensor([2.0])))
    )
    torch.testing.assert_close(twice, 2.0 * once)


def test_a_joint_that_hardly_moves_has_no_level():
    seconds = 20.0
    few = drift_of(fitted(recording(3, seconds=seconds, still=0.95 * seconds)))
    enough = drift_of(fitted(recording(3, seconds=seconds, still=0.85 * seconds)))
    assert (few.between, enough.between) == ([0.0], [BETWEEN])


def test_many_rows_are_thinned():
    noise = drift_of(fitted(recording(2, seconds=150.0))).noise[0][0]
    assert noise == pytest.approx((5.0 * NOISE) ** 2 * 2.0 * DT, rel=0.3), "white noise of every second row"


def test_what_it_is_not_learned_for():
    data = arm_data(30, seed=1)
    assert "drift" not in fit(data.model.with_forces(noise=Noise(0.1)), data, restarts=1).settings
    log = recording(1, seconds=5.0)
    functions = fit(log.model.with_forces(JointFriction(), noise=Noise(NOISE)), log.rows(slice(0, 60)), restarts=1)
    assert "drift" in functions.settings
    updated = functions.update(log.rows(slice(60, 70)))
    assert updated.settings["drift"] == functions.settings["drift"], "functions learn rows themselves"
