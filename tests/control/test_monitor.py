"""The monitor of contacts: against the momentum observer, a dense formula, and forces that are known."""

import math
from importlib.resources import files

import numpy as np
import pinocchio
import pytest
import torch
from scipy.stats import norm
from tests.control.test_tracking import ROBOT, TRUE, URDF, URDF_ALONE, VISCOUS
from tests.goldens.compare import assert_unchanged
from tests.posterior.arm import arm_model

from forcegp import ContactMonitor, Dataset, JointFriction, Model, Robot, Rotor, fit
from forcegp.control.monitor import _touches, errors_near_rest, link_ends
from forcegp.errors import DatasetError, InvalidInput
from forcegp.evidence.least_squares import NoiseLevels
from forcegp.forces import Coulomb

DT = 0.01


def motion(seconds, seed, push=None, noise=0.003, dt=DT):
    """q, v, u (T, 2) of sines, exact but for noise; `push` (T, 2) are joint torques that u lacks."""
    time, rng = np.arange(round(seconds / dt)) * dt, np.random.default_rng(seed)
    rate, size, phase = rng.uniform(0.7, 3.0, (3, 2)), rng.uniform(0.2, 0.5, (3, 2)), rng.uniform(0, 6, (3, 2))
    angle, size = rate[:, None] * time[None, :, None] + phase[:, None], size[:, None]
    q, v = (size * np.sin(angle)).sum(0), (size * rate[:, None] * np.cos(angle)).sum(0)
    a = -(size * rate[:, None] ** 2 * np.sin(angle)).sum(0)
    at = [torch.from_numpy(0.5 * (x + np.roll(x, -1, 0))) for x in (q, v)]  # in the middle of the steps
    step = torch.from_numpy((np.roll(v, -1, 0) - v) / dt)
    u = ROBOT.inverse_dynamics(*at, step).numpy() + at[1].numpy() * VISCOUS - (0.0 if push is None else push)
    assert a.shape == u.shape
    return q, v + noise * rng.standard_normal(v.shape), u


@pytest.fixture(scope="module")
def monitor():
    return ContactMonitor(TRUE, dt=DT).calibrate([motion(120.0, 1)])


def test_it_is_the_momentum_observer():
    """r = K (p - int (u - friction + C^T v - g + r) dt) of De Luca and Mattone, integrated in small steps."""
    dt, bandwidth, push = 1e-3, 3.0, np.zeros((1000, 2))
    push[300:] = 2.0, -1.0
    q, v, u = motion(1.0, 2, push, noise=0.0, dt=dt)
    observer = ContactMonitor(TRUE, dt=dt, bandwidth=bandwidth).calibrate([motion(55.0, 1, dt=dt)])
    found, model = observer.run(q, v, u).torque.numpy(), pinocchio.buildModelFromXML(URDF)
    data, K = model.createData(), 2.0 * math.pi * bandwidth
    r, total, first = np.zeros(2), np.zeros(2), None
    for k in range(len(q) - 1):
        momentum = pinocchio.crba(model, data, q[k]) @ v[k]
        first = momentum if first is None else first
        r = K * (momentum - first - total)
        if k > 5:
            np.testing.assert_allclose(found[k], r, atol=0.05)
        C = pinocchio.computeCoriolisMatrix(model, data, q[k], v[k])
        gravity = pinocchio.computeGeneralizedGravity(model, data, q[k])
        total = total + dt * (u[k] - VISCOUS * v[k] + C.T @ v[k] - gravity + r)
    np.testing.assert_allclose(found[-1], push[-1], atol=0.02)


def test_calls_are_the_run(monitor):
    q, v, u = motion(1.0, 3)
    whole = monitor.run(q, v, u)
    monitor.restart()
    calls = [monitor(*sample) for sample in zip(q, v, u, strict=True)]
    for name in ("torque", "distance", "probability", "alarm"):
        torch.testing.assert_close(torch.stack([getattr(call, name) for call in calls]), getattr(whole, name))


def test_a_broken_sample_is_an_error_and_no_alarm_later(monitor):
    q, v, u = motion(1.0, 3)
    monitor.restart()
    for k in range(50):
        monitor(q[k], v[k], u[k])
    with pytest.raises(InvalidInput, match="give finite numbers"):
        monitor(np.full(2, np.nan), v[50], u[50])
    assert not any([bool(monitor(q[k], v[k], u[k]).alarm) for k in range(51, 90)])


def test_distances_are_mahalanobis_of_a_covariance_that_moves_with_the_inertia(monitor):
    q, v, u = motion(1.0, 4)
    state, row = monitor.run(q, v, u), 50
    M = ROBOT.mass_matrix(torch.from_numpy(0.5 * (q[row] + q[row - 1]))).numpy()
    slow, speed = np.zeros(2), 0.5 * np.abs(v[1 : row + 1] + v[:row])
    for each in speed:
        slow = monitor.keep * slow + (1.0 - monitor.keep) * np.exp(-each / monitor.near_rest[1])
    S = M @ np.diag(monitor.noise.acceleration**2) @ M + np.diag(monitor.noise.force**2)
    S += np.diag((monitor.near_rest[0] * slow) ** 2)
    tau = state.torque[row].numpy()
    assert float(state.distance[row]) == pytest.approx(tau @ np.linalg.solve(S, tau), rel=1e-9)


def test_errors_near_rest_are_found_by_their_likelihood():
    rng, rows = np.random.default_rng(0), 4000
    known, slow = rng.uniform(0.01, 0.02, rows), rng.uniform(size=rows) ** 4
    tau = rng.standard_normal(rows) * np.sqrt(known + 0.2**2 + (0.7 * slow) ** 2)
    cost, force, at_rest = errors_near_rest(tau, known, slow)
    assert (force, at_rest) == (pytest.approx(0.2, rel=0.05), pytest.approx(0.7, rel=0.1))
    S = known + force**2 + (at_rest * slow) ** 2
    assert cost + 0.5 * math.log(2.0 * math.pi) == pytest.approx(-norm.logpdf(tau, 0.0, np.sqrt(S)).mean(), rel=1e-6)


def test_a_joint_that_creeps_is_no_contact_where_its_reversals_showed_how_wrong_friction_is():
    def missed(v):
        return 1.5 * np.tanh(v / 0.002) * np.exp(-np.abs(v) / 0.05)

    free = motion(120.0, 1)
    observer = ContactMonitor(TRUE, dt=DT).calibrate([(*free[:2], free[2] + missed(free[1]))])
    assert observer.near_rest[0].min() > 0.5
    v = np.full((600, 2), 0.01)  # rad/s for six seconds
    q = np.cumsum(v * DT, axis=0)
    held = ROBOT.inverse_dynamics(*(torch.from_numpy(x) for x in (q, v, 0.0 * v))).numpy() + VISCOUS * v
    assert not observer.run(q, v, held + missed(v)).alarm[200:].any()
    assert observer.run(q, v, held + missed(v) - 8.0).alarm[200:].all()


def test_what_one_joint_shows_of_friction_near_rest_counts_for_the_others():
    free, v = motion(120.0, 1), np.full((600, 2), 0.01)
    q = np.cumsum(v * DT, axis=0)
    held = ROBOT.inverse_dynamics(*(torch.from_numpy(x) for x in (q, v, 0.0 * v))).numpy() + VISCOUS * v
    for shown in (0.0, 1.5):  # Nm of the first joint
        missed = shown * np.tanh(free[1] / 0.002) * np.exp(-np.abs(free[1]) / 0.05) * [1.0, 0.0]
        model = TRUE.with_forces(Coulomb(1e-3, sigma=1000.0, memory=True))
        observer = ContactMonitor(model, dt=DT).calibrate([(*free[:2], free[2] + missed)])
        assert bool(observer.run(q, v, held + np.array([0.0, 1.0])).alarm[200:].all()) == (shown == 0.0)


def test_a_torque_that_friction_may_hold_at_first_is_no_contact():
    level, start = 6.0, np.array([0.75, -0.75])
    model = TRUE.with_forces(Coulomb(level, sigma=1000.0, memory=True))

    def with_friction(q, v, u, z):
        """Dahl's friction from z on, in the middle of the steps."""
        middle, torque = 0.5 * (q[1:] + q[:-1]), u.copy()
        for k, step in enumerate(np.diff(middle, axis=0, prepend=middle[:1])):
            z = np.sign(step) + (z - np.sign(step)) * np.exp(-1000.0 * np.abs(step))
            torque[k] = u[k] + level * z
        return q, v, torque

    observer = ContactMonitor(model, dt=DT).calibrate([with_friction(*motion(120.0, 1), np.zeros(2))])
    np.testing.assert_allclose(observer.level, level * np.eye(2))
    q, v, u = motion(6.0, 3)
    still = ROBOT.inverse_dynamics(*(torch.from_numpy(x) for x in (q[0], 0.0 * q[0], 0.0 * q[0]))).numpy()
    rest = np.tile(q[0], (200, 1)), np.zeros((200, 2)), np.tile(still, (200, 1))
    log = with_friction(*(np.concatenate(each) for each in zip(rest, (q, v, u), strict=True)), start)
    log[1][:200] += 0.003 * np.random.default_rng(0).standard_normal((200, 2))
    assert not observer.run(*log).alarm.any()
    held = np.arange(800)[:, None] >= 500
    assert observer.run(*log[:2], log[2] - 3.0 * held).alarm[520:].all()  # as soon as it has moved, half of it is one
    observer.level = 0.0 * observer.level
    assert observer.run(*log).alarm[:200].any()


def test_free_motion_raises_as_many_alarms_as_asked_for():
    often = ContactMonitor(TRUE, dt=DT).calibrate([motion(200.0, 5)], false_alarms_per_hour=60.0)
    alarms = often.run(*motion(600.0, 6)).alarm.numpy()
    blocks = alarms[: len(alarms) // 200 * 200].reshape(-1, 200).any(axis=1)  # expected: 10 of 300
    assert 2 <= blocks.sum() <= 28


def test_pushes_are_found(monitor):
    q, v, u = motion(4.0, 7)
    where, point, force = "fore", torch.tensor([0.0, 0.0, 0.0], dtype=torch.float64), np.array([4.0, 3.0, 2.0])
    J, push = ROBOT.kinematics(torch.from_numpy(q)).frame_jacobian(where, point)[:, :3].numpy(), np.zeros_like(u)
    push[200:] = np.einsum("tij,i->tj", J, force)[200:]
    state = monitor.run(q, v, u - push)
    assert not state.alarm[:200].any()
    assert state.alarm[206:].all()
    assert float(state.probability[-1]) > 0.999
    torch.testing.assert_close(state.torque[-1], torch.from_numpy(push[-1]), atol=0.1, rtol=0.1)


def test_a_place_explains_the_torque_by_the_least_force():
    """Against all points of all links one by one, with rotors in the metric; of links that meet it is the first."""
    robot = Robot.from_urdf_text(files("forcegp.simulation").joinpath("ur5.urdf").read_text())
    observer = ContactMonitor(Model(robot, forces=(*Model(robot).forces, Rotor(0.2))), dt=DT)
    rng = np.random.default_rng(3)
    observer.noise = noise = NoiseLevels(rng.uniform(0.1, 0.3, 6), rng.uniform(0.1, 0.5, 6))
    places = [(link, k / 4 * end.numpy()) for link, end in link_ends(robot).items() for k in range(5)]
    chosen = []
    for _ in range(50):
        q = torch.from_numpy(rng.uniform(-3.0, 3.0, 6))
        kinematics, M = robot.kinematics(q), robot.mass_matrix(q).numpy() + 0.2 * np.eye(6)
        L = np.linalg.cholesky(M @ np.diag(noise.acceleration**2) @ M + np.diag(noise.force**2))
        levers = [np.linalg.solve(L, kinematics.frame_jacobian(link, x)[:3].mT.numpy()) for link, x in places]
        tau = levers[rng.integers(len(places))] @ rng.normal(0.0, 30.0, 3) + rng.standard_normal(6)
        inverse = [np.linalg.pinv(J, rcond=1e-9) * (np.abs(J).max() > 1e-9) for J in levers]
        force = [B @ tau for B in inverse]
        misfit = np.array([np.sum((tau - J @ f) ** 2) for J, f in zip(levers, force, strict=True)])
        felt = np.array([np.abs(J).max() > 1e-9 for J in levers])
        alike = np.flatnonzero(felt & (misfit <= misfit.min() + 3.8414588))  # as 95 in 100 that are right
        best, found = min(alike, key=lambda k: round(float(np.linalg.norm(force[k])), 7)), observer.place(q, L @ tau)
        assert found.link == places[best][0]
        assert set(found.also) == {places[k][0] for k in alike} - {found.link}
        wanted = [places[best][1], force[best], np.sqrt((inverse[best] ** 2).sum(1))]
        np.testing.assert_allclose([found.point, found.force, found.force_std], wanted, rtol=1e-6, atol=1e-9)
        chosen.append(best % 5)
    assert {*chosen} == {1, 2, 3, 4}, "the end of a link is the beginning of the next one"


def test_smallest_forces_are_those_of_all_directions_at_the_ends_of_links():
    robot = Robot.from_urdf_text(files("forcegp.simulation").joinpath("ur5.urdf").read_text())
    observer, rng = ContactMonitor(Model(robot), dt=DT), np.random.default_rng(4)
    observer.noise, observer.threshold = NoiseLevels(rng.uniform(0.1, 0.3, 6), rng.uniform(0.1, 0.5, 6)), 25.0
    q, sides = torch.from_numpy(rng.uniform(-3.0, 3.0, 6)), rng.standard_normal((100_000, 3))
    M = robot.mass_matrix(q).numpy()
    S = M @ np.diag(observer.noise.acceleration**2) @ M + np.diag(observer.noise.force**2)
    unit = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    for link, found in observer.smallest_forces(np.stack([q, q])).items():
        tau = unit @ robot.kinematics(q).frame_jacobian(link, link_ends(robot)[link])[:3].numpy()
        newton = 5.0 / np.sqrt(np.einsum("ki,ij,kj->k", tau, np.linalg.inv(S), tau).clip(1e-12))
        for each, limit in zip((newton.min(), newton.max()), found, strict=True):
            assert each == pytest.approx(limit, rel=0.02) or (limit == math.inf and each > 1e3)


def test_free_motion_is_tested_itself():
    spread = torch.linspace(1.0, 1.2, 21, dtype=torch.float64)  # median 1.1, quartiles .1 apart
    found = [[*_touches(torch.cat([spread, spread.new_tensor([x])]), [spread.new_ones(22, 2)])] for x in (1.8, 2.0)]
    assert [len(each) for each in found] == [0, 1], "over 1.75 medians, and over 5.6 quartiles more"
    assert "from 42 to 44 s" in found[1][0].what
    wide, strong = torch.linspace(1.0, 3.0, 21, dtype=torch.float64), torch.ones(21, 2, dtype=torch.float64)
    assert not [*_touches(torch.cat([wide, wide.new_tensor([7.5])]), [spread.new_ones(22, 2)])]
    strong[3], strong[4], strong[6] = 15.0, 5.0, 15.0  # the last one as usual where others were at rest
    wide[3] = wide[4] = 4.0
    assert ["from 6 to 8 s" in each.what for each in _touches(wide, [strong])] == [True]
    push = np.zeros((6000, 2))
    push[2000:2400] = 0.3, 0.1
    q, v, u = motion(60.0, 3)
    doubts = [ContactMonitor(TRUE, dt=DT).calibrate([(q, v, u - x)]).doubts for x in (0.0, push, [0.0, 0.05])]
    assert [[each.about for each in own] for own in doubts] == [[], ["touched"], ["offset"]]
    assert doubts[2][0].joints == ("elbow",)


def test_links_reach_from_their_joint_to_the_next_one():
    ends = link_ends(ROBOT)
    assert list(ends) == ["upper", "fore"]
    np.testing.assert_allclose(ends["upper"], [0.0, 0.0, -0.4])  # the elbow


@pytest.fixture(scope="module")
def posterior():
    q, v, u = motion(6.0, 8, noise=0.0)
    middle = [0.5 * (x[1:] + x[:-1]) for x in (q, v)]
    a = np.diff(v, axis=0) / DT + 0.02 * np.random.default_rng(9).standard_normal((len(q) - 1, 2))
    rows = Dataset(
        q=middle[0], v=middle[1], u=u[:-1], a=a, time=DT * np.arange(len(a)), model=URDF_ALONE,
        noise_std=np.full(2, 0.02),
    )  # fmt: skip
    return fit(URDF_ALONE.with_forces(JointFriction()), rows, points=40, restarts=1)


def test_learned_friction_sees_what_the_urdf_does_not(posterior):
    free, limits, push = motion(120.0, 1), {}, np.zeros((400, 2))
    push[200:] = 0.25, 0.1
    models = {"learned": posterior.predictor(covariance="none"), "urdf": URDF_ALONE, "both": posterior.predictor()}
    for name, model in models.items():
        found = ContactMonitor(model, dt=DT).calibrate([free])
        limits[name] = found.run(*motion(4.0, 7, push)).alarm[250:].double().mean()
    assert limits["learned"] > 0.95
    assert limits["both"] > 0.95
    assert limits["urdf"] < 0.05


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ContactMonitor(TRUE, dt=DT)([0.0, 0.0], [0.0, 0.0], [0.0, 0.0]), None),
        (lambda: ContactMonitor(TRUE, dt=DT).run(*motion(1.0, 1)), "not calibrated: call calibrate"),
        (lambda: ContactMonitor(TRUE, dt=DT).place([0.0, 0.0], [0.0, 0.0]), "not calibrated"),
        (lambda: ContactMonitor(TRUE, dt=0.0), "time step"),
        (lambda: ContactMonitor(TRUE, dt=DT, bandwidth=60.0), "bandwidth is 60.0; give Hz above 0 and below 50"),
        (lambda: ContactMonitor(arm_model(), dt=DT), r"posterior\.with_contacts\(\[\]\)"),
        (lambda: ContactMonitor(TRUE, dt=DT).calibrate([motion(20.0, 1)]), "too short for a threshold"),
        (lambda: ContactMonitor(TRUE, dt=DT).calibrate([]), "too short"),
        (lambda: ContactMonitor(TRUE, dt=DT).calibrate([motion(60.0, 1)], false_alarms_per_hour=0.0), "above 0"),
        (lambda: ContactMonitor(TRUE, dt=DT).calibrate([(*motion(60.0, 1)[:2], np.zeros((3, 2)))]), "have shapes"),
        (lambda: ContactMonitor(TRUE, dt=DT).calibrate([tuple(np.nan * x for x in motion(60.0, 1))]), "finite"),
    ],
)
def test_what_makes_no_monitor(make, message):
    if message is None:  # nothing to judge at the first sample
        assert not make().alarm
        return
    with pytest.raises((InvalidInput, DatasetError), match=message):
        make()


def test_alarms_and_places_are_what_they_were(monitor):
    push = np.zeros((400, 2))
    push[200:] = 3.0, -1.0
    q, v, u = motion(4.0, 6, push)
    state = monitor.run(q, v, u)
    place = monitor.place(q[300], state.torque[300])
    ends = {name: end.numpy() for name, end in link_ends(ROBOT).items()}
    found = {"numbers": monitor.numbers, "state": state, "place": place, "ends": ends}
    found["levers"] = [each.numpy() for each in monitor.levers(torch.from_numpy(q[300].copy()))]
    assert_unchanged("control/monitor", found, rtol=1e-3)
