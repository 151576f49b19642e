"""Every planted defect is found and named, and a clean log stays clean."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from tests.checks.logs import PENDULUM, RATE, arm, clean, column, pendulum
from tests.robots.robot_models import with_link

from forcegp.checks import CheckReport, check, quick_check, without_pushes, without_stops
from forcegp.checks.check_input import CheckInput
from forcegp.checks.fits import Explanation
from forcegp.checks.residuals import pushed_where_they_are
from forcegp.checks.search import UNKNOWN, _stop, moving, search
from forcegp.checks.torque_doubts import push
from forcegp.checks.torques import Comparison
from forcegp.data import Dataset, Preparation
from forcegp.doubts import look
from forcegp.errors import InvalidInput
from forcegp.fit.payloads import with_gravity
from forcegp.forces import Coulomb, Viscous
from forcegp.mechanics import fixed_point
from forcegp.model import Model
from forcegp.robots import Robot

SYSTEMS = {"arm": arm, "pendulum": pendulum}


def told(report: CheckReport) -> str:
    return "\n".join([f"[{item.level}] {item.about}: {item.what}" for item in report.doubts if item.level != "ok"])


@pytest.mark.parametrize("model", SYSTEMS)
@pytest.mark.parametrize(("seed", "noise"), [(0, 0.0), (1, 1.0)])
def test_a_clean_log_raises_no_alarm(model, seed, noise):
    report = check(clean(seed, SYSTEMS[model](), noise=noise))
    assert report.doubts.level == "ok", told(report)
    assert {item.about for item in report.doubts} >= {"sampling", "velocity"}


@pytest.mark.parametrize(("share", "level"), [(0.005, "ok"), (0.012, "wrong")])
def test_velocities_are_compared_of_joints_that_move(share, level):
    data = clean(4, noise=0.0)
    pace = data.v[:, 0] * share * np.std(data.v, axis=0).max() / np.std(data.v[:, 0])
    data = column(data, "v", 0, lambda _: 1.5 * pace)
    data = column(data, "q", 0, lambda q: q.mean() + np.cumsum(pace) / RATE)
    assert check(data).doubts.of("velocity").level == level


def stopped(torque, at=700):
    """A motion that rests in the middle, on torques that lack so much [Nm] of what the posture needs."""
    data, rows = clean(4, arm()), np.r_[:at, np.repeat(at, 200), at:1400]
    still, time = slice(at, at + 200), np.arange(len(rows)) / RATE
    moved = {name: getattr(data, name)[rows] for name in "qvua"}
    moved["v"][still], moved["a"][still] = 0.0, 0.0
    hold = data.model.robot.gravity_forces(torch.tensor(data.q[at])).numpy()
    moved["u"][still] = hold - torque + 0.03 * np.random.default_rng(0).normal(size=(200, 3))
    return Dataset(**moved, time=time, model=data.model)


@pytest.mark.parametrize("lacking", [0.4, 1.1])
def test_a_rest_on_brakes_is_left_out(lacking):
    data = stopped(np.array([0.0, lacking, 0.0]))
    found = check(data).doubts.of("stop")
    assert len(found) == (lacking > 1.0)
    if found:
        [[begin, end]] = found[0].numbers["seconds"]
        assert (begin, end) == pytest.approx((3.5, 4.495), abs=0.03)
        kept, _ = without_stops(data)
        assert len(kept.episodes) == 2 == 1 + len(without_stops(replace(data, u=np.roll(data.u, 4, axis=0)))[1])  # late
        assert np.abs(kept.v).max(axis=1).min() > 0.0
        assert len(without_stops(data.rows(slice(680, None)))[0].episodes) == 1  # 20 rows before it teach nothing


def test_a_rest_at_an_end_of_its_motion_presses_on_a_stop_unless_its_drive_is_off():
    data = stopped(np.array([0.0, 6.0, 0.0]), end := int(np.argmax(clean(4, arm()).q[:, 1])))
    kept, [doubt] = without_stops(data)
    assert "lift is held at an end of its motion" in doubt.what
    assert data.q[:, 1].max() - kept.q[:, 1].max() == pytest.approx(0.1 * np.ptp(data.q[:, 1]), rel=0.2)
    for share, told in ((0.0, "brakes"), (0.08, "at an end of its motion")):
        (u := data.u.copy())[end : end + 200, 1] = share * np.std(data.u[:, 1])
        assert told in without_stops(replace(data, u=u))[1][0].what


def test_a_prepared_log_is_not_filtered_twice():
    noisy = clean(3)
    noisy = replace(noisy, q=noisy.q + 1e-4 * np.random.default_rng(0).normal(size=noisy.q.shape))
    report = check(Preparation(cutoff=8.0, every=4, trim=0.2).apply(noisy))
    assert report.doubts.level == "ok", told(report)
    assert report.inputs.prepared is not None
    assert report.inputs.prepared.metadata["preparation"]["cutoff"] is None


def test_switches_of_a_foot_that_lifts_are_no_lost_rows():
    log = clean(5)
    flags = np.ones((len(log), 1))
    for row in range(50, len(log), 100):
        flags[row : row + 3] = 0.0
    model = log.model.with_contacts(fixed_point("hand", switch="hand_stands")[:1])
    lifted = replace(log, u=np.hstack([log.u, flags]), model=model, noise_std=None)
    assert not check(lifted).doubts.of("drop-outs")
    lost = np.array(lifted.u)
    lost[25::100, 1] = 0.0
    (found,) = check(replace(lifted, u=lost)).doubts.of("drop-outs")
    assert found.joints == ("lift",)


@pytest.mark.parametrize(("share", "level"), [(0.07, "look"), (0.14, "wrong")])
def test_a_dead_torque_is_wrong_where_the_motion_needs_a_share_of_the_others(share, level):
    data = clean(4, pendulum(), noise=0.0)
    q, v, a = (torch.tensor(x) for x in (data.q, data.v, data.a))
    lower = pendulum().robot.link("lower")

    def lighter(scale):
        robot = with_link(pendulum().robot, "lower", scale * lower.mass, lower.center_of_mass, scale * lower.inertia)
        return robot, robot.inverse_dynamics(q, v, a).numpy()

    def above(scale):
        needed = lighter(scale)[1].std(axis=0)
        return needed[1] / needed[0] - share

    robot, u = lighter(brentq(above, 1e-3, 10.0))
    dead = column(replace(data, u=u, model=Model(robot)), "u", 1, np.zeros_like)
    (found,) = check(dead).doubts.of("constant channel")
    assert (found.level, found.joints) == (level, ("elbow",))


def test_an_angle_that_wraps_is_told():
    data = clean(3, pendulum())
    wrapped = column(data, "q", 0, lambda x: (x + 2 * np.pi * data.time / 3 + np.pi) % (2 * np.pi) - np.pi)
    (found,) = check(replace(wrapped, v=data.v + np.array([2 * np.pi / 3, 0.0]))).doubts.of("jumps")
    assert found.level == "wrong"
    assert "np.unwrap" in found.do


def test_the_report_is_json_and_sorted_by_severity():
    content = json.loads(json.dumps(check(column(clean(2), "u", 1, np.negative)).to_dict(), allow_nan=False))
    assert content["level"] == "wrong"
    assert content["doubts"][0]["about"] == "torque sign"
    assert sum(content["counts"].values()) == len(content["doubts"])


def test_what_cannot_be_checked_is_refused():
    data = clean(1)
    with pytest.raises(InvalidInput, match="no stretch of 64 rows without a gap"):
        check(data.rows(slice(0, 40)))
    with pytest.raises(InvalidInput, match="not in order of time"):
        check(data.rows([5, 3, 1]))
    with pytest.raises(InvalidInput, match=r"pan, lift, bend, those of pendulum shoulder, elbow"):
        check(data, pendulum())


def test_a_model_whose_friction_remembers_is_compared_as_if_its_joints_had_slid_on():
    log = clean(4)
    steady, remembering = (Coulomb(0.4, 0.05, sigma=1e3, memory=memory) for memory in (False, True))
    reports = [quick_check(log, log.model.with_forces(*log.model.forces, law)) for law in (steady, remembering)]
    assert reports[0] == reports[1]


@pytest.mark.parametrize(
    ("stiffness", "at_motor", "shake"),
    [
        (300.0, False, 0.0),
        (4e4, False, 0.0),
        pytest.param(300.0, True, 0.0, marks=pytest.mark.nightly),
        (4e4, True, 1e-4),
    ],
)
def test_a_chirp_across_the_resonance_of_a_gear_is_named(stiffness, at_motor, shake):
    """Two masses, friction at the motor, by small steps; a stiff one is as good as rigid, also if an encoder shakes."""
    robot = Robot.from_urdf_text(PENDULUM, locked={"elbow": 0.0})
    link = float(robot.mass_matrix(torch.zeros(1).double()))
    weight = float(robot.gravity_forces(torch.full((1,), np.pi / 2).double()))
    rng, dt, rotor, seconds, sweep = np.random.default_rng(0), 2.5e-4, 0.08, 16.0, 1.0 if shake else 10.0
    places, phases = np.linspace(100.0, 400.0, 14), np.arange(14) ** 2
    rows, (q, v, motor, speed) = [], (0.0, 0.0, 0.0, 0.0)
    for k in range(int(seconds / dt)):
        t = k * dt
        u = 4.0 * np.sin(2.0 * np.pi * (0.3 + sweep * t / seconds) * t) + 1.5 * np.sin(1.3 * t) - 0.4 * speed
        if k % 10 == 0:
            seen = (motor if at_motor else q) + shake * np.sin(places * t + phases).sum()
            rows.append((t, seen + 2e-5 * rng.standard_normal(), u + 0.02 * rng.standard_normal()))
        spring = stiffness * (motor - q) + 0.3 * (speed - v)
        v += dt * (spring - weight * np.sin(q) - 0.05 * v) / link
        speed += dt * (u - spring - 0.3 * np.tanh(speed / 0.01)) / rotor
        q, motor = q + dt * v, motor + dt * speed
    time, q, u = np.array(rows).T
    v = np.gradient(q, time)
    columns = {"q": q, "v": v, "a": np.gradient(v, time), "u": u}
    found = check(Dataset(**{name: x[:, None] for name, x in columns.items()}, time=time, model=Model(robot))).doubts
    resonance = np.sqrt(stiffness / link if at_motor else stiffness * (1.0 / rotor + 1.0 / link)) / (2.0 * np.pi)
    if stiffness > 1e4:
        assert not found.of("elastic joint")
    else:  # below it, since a rotor nobody states is taken for friction
        numbers = found.of("elastic joint")[0].numbers
        assert 0.7 * resonance < numbers["resonance"]["shoulder"] < 1.1 * resonance
        assert 0.2 * resonance < numbers["cutoff"] < 0.4 * resonance
        assert not found.of(UNKNOWN)


def touched_by(log, force):
    """The log of an arm whose hand bears this force [N] from 4 to 6 s."""
    J = log.model.robot.kinematics(torch.tensor(log.q)).frame_jacobian("hand")[:, :3].numpy()
    there = np.clip(10.0 * np.minimum(log.time - 4.0, 6.0 - log.time), 0.0, 1.0)
    return replace(log, u=log.u - there[:, None] * np.einsum("rij,i->rj", J, force))


def test_of_few_rows_a_push_explains_a_nat_of_each(monkeypatch):
    monkeypatch.setattr("forcegp.checks.torque_doubts.SURE", np.inf)
    touched = touched_by(clean(4, seconds=12.0), [-4.0, 8.0, 2.0])
    inputs = replace(CheckInput.of(touched, touched.model), most_rows=200)
    [found] = push(search(inputs)[0], inputs, -np.inf, np.inf)
    assert found.numbers["seconds"] == pytest.approx([4.0, 6.0], abs=0.3)


def test_the_seconds_of_a_push_are_named_and_left_out():
    log = clean(4, seconds=12.0)
    touched = touched_by(log, [-2.0, 4.0, 1.0])
    assert not check(log).doubts.of("push")
    doubts = check(touched).doubts
    [found] = doubts.of("push")
    assert found.joints == ("pan", "lift")
    begin, end = found.numbers["seconds"]
    assert 3.8 < begin < 4.0
    assert 6.0 < end < 6.2
    beside = 0.35 * np.std(log.u, axis=0) * np.sin(7.0 * log.time)[:, None] * [0.0, 1.0, 0.0]  # what has no cause
    [found] = check(replace(hard := touched_by(log, [-4.0, 8.0, 2.0]), u=hard.u + beside)).doubts.of("push")
    assert found.numbers["seconds"] == pytest.approx([4.0, 6.0], abs=0.1)
    kept = without_pushes(touched, doubts)
    assert (len(kept.episodes), len(kept)) == (2, pytest.approx(1950, abs=10))
    cut = replace(touched, episode=(touched.time > 1.0).astype(int))  # of whose episodes no time comes twice
    for end, episodes in ((9.0, 2), (10.5, 1)):  # with 3 s and 1.5 s of the log behind it
        found = [look(about="push", what="", numbers={"seconds": [4.0, end]})]
        assert len(without_pushes(cut, found).episodes) == episodes


@pytest.mark.parametrize(
    ("at", "left_out"), [pytest.param(8.0, (8.0, 12.0), marks=pytest.mark.nightly), (3.0, (0.0, 3.0))]
)
def test_a_torque_that_is_zeroed_anew_is_named_and_the_shorter_part_left_out(at, left_out):
    log = clean(4, seconds=12.0)
    doubts = check(column(log, "u", 1, lambda u: u + 0.5 * (log.time > at))).doubts
    [found] = doubts.of("offset")
    assert (found.joints, found.numbers["offset"]) == (("lift",), pytest.approx(0.5, rel=0.05))
    assert found.numbers["seconds"] == pytest.approx(left_out, abs=0.2)
    assert len(without_pushes(log, doubts)) == pytest.approx(len(log) * (1.0 - np.ptp(left_out) / 12.0), abs=40)


@pytest.mark.nightly
def test_an_offset_of_all_or_of_the_first_rows_is_no_torque_that_is_zeroed_anew():
    log, at = clean(4, seconds=12.0), 3.0
    begins = column(log, "u", 1, lambda u: u + 5.0 * (log.time < 0.1))  # friction from another place
    for quiet in (replace(log, u=log.u + 0.5 * (log.time > at)[:, None]), begins):
        assert not check(quiet).doubts.of("offset")


def test_a_joint_that_stands_still_while_its_torque_goes_on_has_a_dead_encoder():
    log = clean(4, seconds=12.0)
    q, v, a = (x.copy() for x in (log.q, log.v, log.a))
    q[1600:, 1], v[1600:, 1], a[1600:, 1] = q[1600, 1], 0.0, 0.0
    [found] = check(replace(log, q=q, v=v, a=a)).doubts.of("unknown cause")
    assert "dead encoder" in found.what
    assert found.numbers["stands"] == ("lift",)


@pytest.mark.parametrize(
    ("wide", "stops", "rows"), [(0.009, 0.01, 1200), (0.045, 0.05, 1200), (0.06, None, 1200), (0.045, 0.05, 160)]
)
def test_a_stop_is_a_twentieth_of_the_motion_at_most(wide, stops, rows):
    rng, log = np.random.default_rng(0), clean(4, seconds=12.0).rows(slice(rows))
    q, tau = rng.uniform(size=log.q.shape), rng.normal(size=log.u.shape)
    pushed = replace(log, q=q, u=tau + 50.0 * rng.uniform(0.5, 1.0, tau.shape) * (q > 1.0 - wide))
    held = Comparison(robot=log.model.robot, laws=(), rows=pushed, given=pushed)
    vars(held).update(tau=tau, friction=np.zeros((*tau.shape, 1)))
    found = _stop(Explanation(held, np.zeros(log.nv)), 0) or (0.0, None)
    assert found[1] == (stops and pytest.approx(stops, rel=0.05))


@pytest.mark.parametrize("stops", [True, False])
def test_an_end_stop_is_told_by_where_it_holds_a_joint(stops):
    """Its motor pushes on as the joint would have moved; the same torques without a stop are something else."""
    log = clean(4, seconds=12.0)
    end = log.q[:, 1].max() - 0.2 * np.ptp(log.q[:, 1])
    over, one = np.maximum(log.q[:, [1]] - end, 0.0), np.eye(log.nv)[1]
    held = (over > 0.0) * one * stops
    moves, u = 1.0 - held, log.u + 400.0 * over * one
    log = replace(log, q=log.q - over * held, v=log.v * moves, a=log.a * moves, u=u)
    [doubt] = check(log).doubts.of(UNKNOWN)
    assert doubt.numbers.get("stops", {}) == ({log.joint_names[1]: pytest.approx(end, abs=1e-2)} if stops else {})
    if stops:
        once = log.time < doubt.numbers["seconds"][1] + 0.5
        pushed = replace(log, u=log.u + 300.0 * over * (np.eye(log.nv)[0] + np.eye(log.nv)[2])).rows(once)
        assert not [x for x in check(pushed).doubts.of(UNKNOWN) if "stops" in x.numbers], "several joints feel a push"
        assert len(doubt.numbers["seconds"]) > 2
        assert without_pushes(log, [doubt]).q[:, 1].max() < end


def test_currents_are_in_a_wrong_unit_although_rotors_and_friction_explain_them():
    limits = '<limit lower="-9" upper="9" effort="9" velocity="9"/><axis xyz="'
    slides = PENDULUM.replace("continuous", "prismatic").replace('<axis xyz="', limits)
    log = clean(0, Model(Robot.from_urdf_text(slides.replace('0 1 0"/>\n', '1 0 0"/>\n'))))
    factors = check(replace(log, u=log.u / 40.0)).doubts.of("torque unit")[0].numbers["factor"]
    assert 0.0 < max(factors.values()) <= 1.0 / 40.0


def test_nothing_is_differentiated_across_postures():
    data = clean(0)
    apart = replace(data, u=data.u + np.sin(9.0 * data.q), episode=np.arange(len(data)))
    assert not quick_check(apart.rows(slice(None, None, 7))).of("elastic joint")


def test_torques_that_repeat_over_equal_ways_are_named():
    data = clean(0, noise=0.0)
    size = 0.5 * np.std(data.u, axis=0)
    [found] = check(replace(data, u=data.u + size * np.sin(60.0 * data.q))).doubts.of("cogging")
    np.testing.assert_allclose(found.numbers["way"], 2.0 * np.pi / 60.0, rtol=0.01)
    np.testing.assert_allclose(found.numbers["size"], size, rtol=0.05)
    of_one = 0.6 * size[1] * np.sin(60.0 * data.q[:, 1])  # beside something else that no cause explains
    rest = 0.36 * size[1] * np.sin(7.0 * data.time)
    [found] = check(column(data, "u", 1, lambda u: u + of_one + rest)).doubts.of("cogging")
    assert found.joints == ("lift",)
    assert found.numbers["size"] == pytest.approx([0.6 * size[1]], rel=0.1)


@pytest.mark.parametrize(
    ("size", "still", "about"),
    [*(pytest.param(0.1, k, "jumps", marks=pytest.mark.nightly) for k in (0, 4)), (4e-4, 0, ""), (0.1, 6, "frozen")],
)
def test_an_encoder_that_slips_or_stops_is_named(size, still, about):
    data, row = clean(0), np.arange(1400)
    q = data.q + np.outer(row > 902, [0.0, size, 0.0])
    q[902 - still : 903, 1] = q[902 - still, 1]
    for v in (data.v, np.gradient(q, data.time, axis=0)):  # of a channel of its own, or derived
        found = [x for x in check(replace(data, q=q, v=v)).doubts.at("wrong") if "jump" in x.numbers]
        assert [x.about.startswith(about) for x in found] == [True] * bool(about)
        assert [x.numbers["jump"] for x in found] == pytest.approx([q[903, 1] - q[902, 1]] * len(found))
        assert all("still" not in x.numbers for x in found)  # which are names of joints, to forcegp auto


def test_rows_at_rest_show_no_torque():
    """Stiction holds any torque there: a tilt of 25 degrees was no cause that was tried, beside rests of teaching."""
    model, path = arm(), clean(0, noise=0.0)
    pace = np.maximum(np.sin(2.0 * np.pi * path.time / 1.4), 0.0) ** 2
    way, s = CubicSpline(path.time, path.q), np.cumsum(pace) / RATE
    q, v = way(s), way(s, 1) * pace[:, None]
    a = way(s, 2) * pace[:, None] ** 2 + way(s, 1) * np.gradient(pace, path.time)[:, None]
    held = np.random.default_rng(0).uniform(-2.0, 2.0, (20, 3))[(path.time / 1.4).astype(int)]
    there = with_gravity(model.robot, np.array([4.146, 0.0, -8.891]))
    u = there.inverse_dynamics(*map(torch.tensor, (q, v, a))).numpy() + np.where(v, 2.0 * np.tanh(v / 0.02), held)
    [doubt] = (each for each in check(replace(path, q=q, v=v, a=a, u=u)).doubts if each.level != "ok")
    assert doubt.about == "gravity"
    off = np.cross(doubt.numbers["gravity"], there.gravity.numpy()) / 9.81**2
    assert np.linalg.norm(off) < np.sin(np.deg2rad(2.0))
    speed = np.zeros((100, 2))
    speed[::2], speed[1::4, 0], speed[3::4, 0] = 1.0, 0.08, 0.06  # of .71
    rows = replace(clean(0, pendulum()).rows(slice(0, 100)), v=speed)
    assert [len(moving(each)) for each in (rows, replace(rows, v=0.0 * speed))] == [75, 100]


def test_springs_are_asked_for_where_torques_are_missed_by_position():
    log, rng = clean(0, noise=0.0), np.random.default_rng(0)
    model = log.model.with_forces(Viscous(0.1), Coulomb(0.2, 0.05))

    def asked(spring: float, share: float = 0.0) -> tuple[str, ...]:
        """With a spring at the second joint of this power of its torque, and noise of this share of what is missed."""
        pull = spring**0.5 * log.u[:, 1].std() / log.q[:, 1].std() * (log.q[:, 1] - log.q[:, 1].mean())
        noise = rng.standard_normal(len(log)) * pull.std() * (share / (1.0 - share)) ** 0.5
        return pushed_where_they_are(column(log, "u", 1, lambda u: u + pull + noise), model)

    assert asked(0.0) == asked(7e-4) == asked(0.1, 0.75) == ()
    assert asked(1.6e-3) == asked(0.1) == asked(0.1, 0.5) == ("lift",)
    assert "lift" not in pushed_where_they_are(column(log, "u", 1, lambda u: 0.0 * u), model)  # passive
