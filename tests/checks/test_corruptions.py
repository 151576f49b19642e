"""Every corruption of a two-joint log is named by `check`, and said in one line before a fit; clean logs are not."""

import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.checks import corruptions
from tests.checks.clean_logs import between_postures, clean_logs, one_rests, rests, with_motion
from tests.checks.corruptions import CORRUPTIONS, ROBOTS, at, clean, gripped, named, said_by, two_links
from tests.checks.logs import clean as filtered_log
from tests.goldens.compare import assert_unchanged
from tests.posterior.arm import arm_model
from tests.robots.robot_models import loaded, with_link

from forcegp.checks import check, quick_check
from forcegp.checks.causes import like_units
from forcegp.checks.check_input import CheckInput
from forcegp.checks.couplings import _needed, _rounded
from forcegp.checks.explanations import _units
from forcegp.checks.residuals import two_levels
from forcegp.checks.search import search
from forcegp.checks.torque_doubts import _remembered, held_points, without_stops
from forcegp.checks.torques import Comparison
from forcegp.data import Dataset
from forcegp.model import Model
from forcegp.robots import Robot
from forcegp.simulation.kuka_surface import kuka_file


def log_of(place: int):
    """Robots, rates and kinds of noise in turn."""
    name = ("planar", "heavy", "geared")[place % 3]
    return clean(ROBOTS[name](), place, rate=(100.0, 250.0)[place % 2], seconds=7.0, noise=("a", "qvu")[place // 3 % 2])


def every(count, first):
    """All corruptions, of which each so-manieth is fast."""
    marks = [[pytest.mark.nightly] * (k % count != first) for k in range(len(CORRUPTIONS))]
    return [pytest.param(name, marks=own) for name, own in zip(CORRUPTIONS, marks, strict=True)]


@pytest.mark.parametrize("name", every(2, 1))
def test_a_corruption_is_named_by_check(name):
    corrupt, words = CORRUPTIONS[name]
    report = check(corrupt(log_of(list(CORRUPTIONS).index(name))))
    assert named(said_by(report), words), said_by(report)
    found = {"joints": report.per_joint(), **corruptions.numbers(report.doubts)}
    assert_unchanged(f"checks/{name}", found, rtol=1e-3)


@pytest.mark.parametrize("name", every(4, 0))
def test_a_corruption_is_named_before_a_fit(name):
    corrupt, words = CORRUPTIONS[name]
    data = corrupt(log_of(list(CORRUPTIONS).index(name)))
    quick = quick_check(data)
    assert_unchanged(f"checks/{name} before a fit", corruptions.numbers(quick), rtol=1e-3)
    line = corruptions.said_by_fit(data, quick)
    assert "\n" not in line
    assert named(line, words), line
    assert words not in ("register", "targets") or len(quick.at("wrong")) == 1, line


def test_an_invented_contact_is_named_by_check_and_before_a_fit():
    data = corruptions.invented(clean(two_links(), 2))
    assert named(said_by(check(data)), "contact")
    assert named(corruptions.said_by_fit(data, quick_check(data)), "contact")


@pytest.mark.nightly
def test_a_contact_is_not_sought_where_velocities_are_wrong(monkeypatch):
    asked = []
    monkeypatch.setattr("forcegp.checks.report.held_points", lambda inputs: asked.append(inputs) or [])
    data = at(clean(two_links(), 0), "u", [1, -1])
    check(replace(data, v=np.rad2deg(data.v)))
    assert not asked
    check(data)
    assert asked


def test_noise_of_the_acceleration_is_no_cause():
    data, noise = clean(two_links(), 0, noise="none"), np.array([30.0, 30.0])
    noisy = replace(data, a=data.a + noise * np.random.default_rng(0).normal(size=data.a.shape))
    assert data.model is not None
    stated = CheckInput.quick(replace(noisy, noise_std=noise, time_ordered=False), data.model)
    assert search(stated)[1] == []
    assert search(replace(stated, compared_noise=np.zeros(2)))[1] != []


def said(data):
    return [each for each in check(data).doubts if each.level != "ok"]


@pytest.mark.filterwarnings("ignore:.*are lengths in metres")
@pytest.mark.parametrize("size", [3e-3, pytest.param(30.0, marks=pytest.mark.nightly)])
def test_units_of_mass_and_length_change_nothing(size):
    data = clean(two_links(size=size), 1, noise="qvu")
    assert said(data) == []
    found = said(replace(data, u=data.u * np.array([1.0, -1.0])))[0]
    assert (found.about, found.correction) == ("torque sign", {"sign": {"u": (1.0, -1.0)}})


def test_two_mistakes_are_both_named():
    data = clean(two_links(), 1, noise="qvu")
    found = check(replace(data, u=1e3 * data.u * np.array([-1.0, 1.0]))).doubts.at("wrong")
    assert {each.about for each in found} == {"torque sign", "torque unit"}
    assert found.of("torque sign")[0].joints == ("joint1",)
    assert found.of("torque unit")[0].correction == {"unit": {"u": ("mNm",)}}
    for each, size in {"Ncm": 100.0, "ozfin": 141.612, "kgfcm": 10.1972, "lbfin": 8.85075}.items():
        assert like_units(1.06 * size, ("Nm", "Nm"))[0] == (each,)
        assert like_units(size, ("Nm", "N"))[0] == like_units(109.0, ("Nm",))[0] == like_units(1.6e3, ("Nm",))[0] == ()
    [found] = quick_check(replace(data, u=1e3 * data.u))
    after, before = map(float, re.findall(r"([\d.]+) %", found.what))
    assert after < 0.1 * before  # of the log as it is, without any factor


@pytest.mark.parametrize(
    "x", ["1e3 -9.55 mm/s,rpm", "1e3 10 mm/s,rad/s", "1e2 1 cm/s,rad/s", "1 10 ", "2 9.5 mm/s,rpm"]
)
def test_units_of_velocities_are_found_joint_by_joint_and_before_those_of_torques(x):
    rail, gear, unit = x.split(" ")
    data = at(clean(ROBOTS["crane"](), 4, noise="qvu"), "v", [float(rail), float(gear)])
    told = {"import": {"units": {"v": ["mm/s", "rad/s"]}} if rail == "2" else "of others"}
    found = quick_check(replace(at(data, "u", [1e3, 1e3]), metadata=told))
    assert {each.command for each in found.of("velocity")} >= {f"forcegp import --unit v={unit}" if unit else ""}
    assert not found.of("torque unit")


def test_one_of_two_axes_in_millimetres_is_not_both():
    data = at(clean(two_links(kinds=("prismatic", "prismatic")), 4, noise="qvu"), "v", [1.0, 1e3])
    assert quick_check(data).of("velocity")[0].command == "forcegp import --unit v=m/s,mm/s"


@pytest.mark.parametrize(("limits", "told"), [((-3, 3), True), ((0, 0), True), ((40, 110), False), ((-99, 120), True)])
def test_positions_are_not_in_degrees_where_their_joint_could_not_be_there(limits, told):
    q = 1.3 + 0.5 * np.sin(np.arange(2000)[:, None] / 250.0 * [2.1, 3.3])
    data, new = (
        CORRUPTIONS["degrees"][0](with_motion(two_links(), q, 250.0, 0)),
        'lower="{}" upper="{}"'.format(*limits),
    )
    text = data.model.robot.urdf_text.replace("continuous", "revolute").replace('lower="-9" upper="9"', new)
    assert ("degrees" in said_by(check(replace(data, model=Model(Robot.from_urdf_text(text)))))) == told


def test_the_factor_of_a_torque_has_an_interval():
    data = clean(two_links(), 1, noise="qvu")
    [found] = said(replace(data, u=data.u * np.array([1.0, 1.6])))
    assert found.numbers["factor"]["joint2"] == pytest.approx(1.6, abs=found.numbers["error_95"][0])
    assert found.numbers["error_95"][0] < 0.03


@pytest.mark.nightly
def test_a_factor_of_a_thousand_is_a_unit_beside_a_load():
    data = clean(two_links(), 1, noise="qvu")
    for largest, told in ((4.5e-3, True), (8e-3, False)):  # a load makes more of kNm than masses do
        assert ("--unit u=kNm." in said(replace(data, u=data.u * np.array([1.2e-3, largest])))[0].do) == told


@pytest.mark.parametrize("degrees", [10.0, 40.0])
def test_the_gravity_of_a_tilted_base_is_right(degrees):
    angle = np.deg2rad(degrees)
    true = 9.81 * np.array([np.sin(angle) * 0.6, np.sin(angle) * 0.8, -np.cos(angle)])
    found = said(corruptions.recorded_under(clean(ROBOTS["spatial"](), 3, noise="qvu"), tuple(true)))[0]
    gravity = np.array(found.numbers["gravity"])
    stated = found.command.removeprefix("forcegp import --gravity=").split(",")
    np.testing.assert_allclose(np.array(stated, float), gravity, atol=1e-3)
    assert np.rad2deg(np.arccos(gravity @ true / np.linalg.norm(gravity) / 9.81)) < 2.0


def test_what_no_cause_explains_is_said_with_its_place_and_without_a_remedy():
    data = clean(two_links(), 4, noise="qvu")
    pushed = 3.0 * np.std(data.u[:, 1]) * np.sin(9.0 * data.time) * (np.abs(data.time - 4.0) < 0.7)
    found = check(replace(data, u=data.u + np.stack([0.0 * pushed, pushed], axis=1))).doubts
    assert [each.about for each in found if each.level != "ok"] == ["unknown cause"]
    assert found[0].joints == ("joint2",)
    left_out = found[0].do.partition("--without ")[2].split(",")[:2]
    np.testing.assert_allclose(np.array(left_out, float), [3.25, 4.75], atol=0.1)
    assert not found[0].correction
    late = check(replace(data, u=data.u + np.outer(np.roll(pushed, 650), [0.0, 1.0]))).doubts.of("unknown cause")
    assert late[0].numbers["seconds"][1] == pytest.approx(data.time[-1], abs=0.01)  # what is left is too short
    for joint in (0, 1):  # that of the first, which gravity pulls the other way, looks like another sign
        stiff = 2.0 * np.std(data.u[:, joint]) / np.std(data.q[:, joint])
        [spring] = said(replace(data, u=data.u + stiff * data.q * np.eye(2)[joint]))
        assert (spring.about, spring.numbers["value"]) == ("spring", pytest.approx(stiff, rel=0.05))


def three_joints(seed):
    time = np.arange(0.0, 12.0, 0.01)
    q = 0.7 * np.sin(time[:, None] * [1.7, 2.9, 4.1] + np.arange(3.0)) + 0.3 * np.sin(0.9 * time)[:, None]
    plain = arm_model(0).robot.urdf_text.replace('<dynamics damping="0.3" friction="0.1"/>', "")
    return with_motion(Robot.from_urdf_text(plain), q, 100.0, seed)


@pytest.mark.parametrize("told", [True, False])
def test_an_unknown_force_of_positions_alone_is_said_to_be_one(told):
    """Of two other joints, as a rope over pulleys; and one that was so at another time."""
    data = three_joints(4)
    q = data.q if told else np.roll(data.q, 300, axis=0)
    pulls = 1.5 * data.u[:, 1].std() * np.sin(1.3 * q[:, 0]) * np.cos(q[:, 2])
    found = check(replace(data, u=data.u + pulls[:, None] * np.eye(3)[1])).doubts.of("unknown cause")
    assert found
    assert ("a cable" in found[0].what) == told


def test_a_hose_that_pulls_with_a_constant_force_is_found_with_its_place():
    data, force, point = three_joints(4), np.array([2.0, -1.0, -4.0]), (0.05, 0.02, -0.1)  # 29 degrees
    link = data.model.robot.layout.bodies[-1].child
    J = data.model.robot.kinematics(torch.tensor(data.q)).frame_jacobian(link, point)[:, :3].numpy()
    (found,) = said(replace(data, u=data.u - np.einsum("nkj,k->nj", J, force)))
    assert (found.about, found.level) == ("pull", "look")
    np.testing.assert_allclose(found.numbers["force"], force, atol=0.5)
    np.testing.assert_allclose(found.numbers["point"], point, atol=0.02)


def test_a_tilt_beside_a_load_is_as_right_as_without():
    plain, true = clean(ROBOTS["spatial"](), 3, noise="qvu"), 9.81 * np.array([0.2, -0.1, -np.sqrt(0.95)])
    heavy = loaded(plain.model.robot, plain.model.robot.layout.bodies[-1].child, mass=0.5)
    motion = [torch.tensor(x) for x in (plain.q, plain.v, plain.a)]
    u = plain.u + (heavy.inverse_dynamics(*motion) - plain.model.robot.inverse_dynamics(*motion)).numpy()
    tilted = corruptions.recorded_under(replace(plain, u=u, model=Model(heavy)), tuple(true))
    gravity = np.array(said(replace(tilted, model=plain.model))[0].numbers["gravity"])
    assert np.rad2deg(np.arccos(gravity @ true / np.linalg.norm(gravity) / 9.81)) < 1.0


@pytest.mark.parametrize(
    ("range_", "subjects"),
    [(0.0, {"constant channel"}), (0.0008, set()), pytest.param(0.0015, {"unknown cause"}, marks=pytest.mark.nightly)],
)
def test_the_torque_of_a_joint_that_a_brake_holds_shows_no_constant(range_, subjects):
    still = one_rests(two_links(), 5)
    moved = 0.5 * range_ * np.sin(2.0 * still.time)[:, None] * [0.0, 1.0]
    held = with_motion(two_links(), still.q + moved, 250.0, 5)
    noise = 1e-3 * np.random.default_rng(0).normal(size=held.u.shape)
    found = check(replace(held, u=held.u * [1.0, 0.0] + noise)).doubts
    of_motion = {"acceleration", "excitation"}  # which hardly shows beside noise
    assert {each.about for each in found if each.level != "ok"} - of_motion == subjects
    lock = "Right for a joint that was held; then forcegp import --lock joint2=0.3."
    assert all(each.do.startswith(lock) for each in found.of("constant channel"))


@pytest.mark.parametrize(("times", "about"), [(1.0, "dry friction"), (5.0, "unknown cause")])
def test_gears_that_stick_are_no_unknown_cause_and_more_than_they_hold_is_one(times, about):
    """LuGre friction (Canudas de Wit et al. 1995) of a joint that waits while another moves; a brake holds more."""
    q = rests(two_links(), 3).q.copy()
    time = np.arange(len(q)) / 200.0
    q[:, 0] = 0.5 * np.sin(2.1 * time) + 0.3 * np.sin(3.7 * time)
    data, bristle, held = with_motion(two_links(), q, 200.0, 3, 0.0), 0.0, []
    for v in np.repeat(data.v[:, 1], 20):
        bristle += (v - abs(v) * bristle / 2e-3) / 4000.0
        held.append(bristle / 2e-3)
    force = np.std(data.u[:, 1]) * np.array(held)[19::20] * np.where(np.abs(data.v[:, 1]) < 1e-9, times, 1.0)
    data = replace(data, u=data.u + np.stack([0.0 * force, force], axis=1))
    assert [(each.about, each.joints) for each in check(data).doubts if each.level != "ok"] == [(about, ("joint2",))]
    assert len(check(gripped(data, 6.1)).doubts.of("load")) == (times == 1.0)  # which such gears do not hide


@pytest.mark.parametrize(("begin", "told"), [(12.0, True), (6.0, False)])
def test_a_joint_that_moves_once_is_judged_by_its_motion(begin, told):
    time = np.arange(2000) / 100.0
    moves = (time > begin) & (time < 15.0)
    once = np.where(moves, 0.7 - 0.4 * np.cos(4.0 * np.pi * (time - begin) / 3.0), 0.3)
    data = with_motion(two_links(), np.stack([0.5 * np.sin(2.1 * time), once], axis=1), 100.0, 3, 0.0)
    dry = np.where(moves, 3.0 * np.tanh(data.v[:, 1] / 0.05), np.cumsum(np.sin(0.7 * time)) / 300.0)  # less than slips
    found = [x for x in check(replace(data, u=data.u + np.c_[0.0 * dry, dry])).doubts if x.level != "ok"]
    seen = [("excitation", ("joint2",), pytest.approx([begin, 15.0], abs=0.2))] * told
    assert [(x.about, x.joints, x.numbers["seconds"]) for x in found] == seen


def test_joints_that_move_in_turn_stand_on_no_brakes():
    """While one moves, stiction holds the others: rows that show neither their friction nor what postures need."""
    rng, (held, q) = np.random.default_rng(0), np.zeros((2, 1500, 3))
    for k, begin in enumerate(range(0, 1500, 200)):  # moves of 1.2 s, rests of .8 s
        share = np.clip((np.arange(1500 - begin) / 120.0), 0.0, 1.0)
        q[begin:, k % 3] += rng.uniform(-0.6, 0.6, 3)[k % 3] * 0.5 * (1.0 - np.cos(np.pi * share))
        held[begin:, k % 3] = rng.uniform(-1.0, 1.0)
    data = with_motion(arm_model().robot, q, 100.0, 0, 0.0)
    dry = 40.0 * np.where(np.abs(data.v) > 1e-3, np.tanh(data.v / 0.02), held)
    assert not without_stops(replace(data, u=data.u + dry))[1]


@pytest.mark.parametrize(("seconds", "stops"), [(3.0, 1), (1.5, 0)])
def test_a_long_rest_before_a_motion_that_tells_nothing_of_it_is_left_out(seconds, stops):
    moves = np.array([1.2, -0.8]) + 0.2 * np.sin(np.arange(1600)[:, None] / 200.0 * [3.0, 5.0])
    count = int(200 * seconds)
    rows = np.setdiff1d(np.arange(count + 1600), np.arange(count - 4, count + 4))
    data = with_motion(two_links(), np.concatenate([np.zeros((count, 2)), moves]), 200.0, 0, 0.0).rows(rows)
    u = two_links().inverse_dynamics(*map(torch.tensor, (data.q, data.v, data.a))).numpy()
    before, noise = rows < count, 0.05 * np.random.default_rng(0).normal(size=u.shape)
    data = replace(data, episode=(~before).astype(int), u=u + noise + 0.5 * before[:, None])
    assert len(without_stops(data)[1]) == stops


@pytest.mark.parametrize(
    ("weights", "costs"),
    [
        ([[0.75, 0.25], [-0.25, 0.75]], [2.5, 4.5]),  # as gears have them
        ([[0.8, 0.3], [-0.3, 0.8]], [2.5, 4.5]),
        ([[1.0, 0.1], [-0.1, 1.0]], []),  # cross-talk of a sensor
        ([[1.0, 0.94], [0.94, 1.0]], []),  # which cannot be told apart again
    ],
)
def test_torques_of_shared_drives_are_those_of_simple_gears_first(weights, costs):
    data = clean(two_links(), 1, noise="none")
    tau = two_links().inverse_dynamics(*map(torch.tensor, (data.q, data.v, data.a))).numpy()
    rows = replace(data, u=tau @ np.array(weights).T)
    found = dict(_rounded(_needed(Comparison(robot=two_links(), laws=(), rows=rows, given=rows), [0, 1])))
    assert [*found] == costs
    for cost, step in zip(costs, (0.25, 0.01), strict=False):
        assert found[cost] == pytest.approx(step * np.round(np.array(weights) / step), abs=1e-9)


def test_friction_of_motors_that_turn_two_joints_is_told_and_not_corrected():
    data, turn = clean(two_links(), 1, noise="qvu"), np.array([[1.0, 1.0], [1.0, -1.0]])
    rubs = np.std(data.u[:, 0]) * np.tanh(data.v @ turn.T / 0.05)
    [found] = check(replace(data, u=data.u + rubs @ turn)).doubts.of("coupled joints")
    assert (found.level, found.joints, found.correction) == ("look", ("joint1", "joint2"), {})
    assert found.what.startswith("friction of joint1 and joint2")


@pytest.mark.parametrize(("share", "told"), [(0.8, True), (0.4, False)])
def test_what_carries_a_sliding_joint_is_told(share, told):
    data = clean(ROBOTS["crane"](), 1, noise="qvu")
    carried = share * data.u[:, 0].mean()
    found = check(replace(data, u=data.u - [carried, 0.0])).doubts.of("offset")
    assert [x.numbers["offset"] for x in found] == ([pytest.approx(-carried, rel=0.05)] if told else [])


@pytest.mark.nightly
def test_friction_that_remembers_is_no_push():
    """About a turn it is far from any that velocities make, for seconds here."""
    data = between_postures(arm_model().robot, 3, 24.0)
    assert not check(data).doubts.of("push")
    stuck = between_postures(arm_model().robot, 5, 24.0)  # from 8 to 10 s two joints rest, and gears hold up to .9 Nm
    bump = 0.9 * np.sqrt(np.sin(0.5 * np.pi * (stuck.time - 8.0)).clip(0.0)) * (abs(stuck.time - 9.0) < 1.0)
    assert not check(replace(stuck, u=stuck.u + np.outer(bump, [1.0, 0.0, -1.0]))).doubts.of("push")
    inputs = CheckInput.of(data, data.model)
    found = search(inputs)[0]
    again = _remembered(found, inputs.below(3.0))  # which has other rows
    assert np.corrcoef(again.ravel(), _remembered(found, inputs).ravel())[0, 1] > 0.9


def test_torques_in_steps_are_right_and_friction_that_is_another_later_is_named():
    data = clean(two_links(), 5, noise="qvu")
    step = np.ptp(data.u) / 100.0
    assert not check(replace(data, u=step * np.round(data.u / step))).doubts.at("wrong")
    assert not check(replace(data, u=data.u + _dry(data))).doubts.of("drift")
    later = check(replace(data, u=data.u + _dry(data) * (1.0 + np.outer(data.time > 5.0, [0.0, 1.0])))).doubts
    [since] = [each for each in later if each.level != "ok"]  # no unknown cause, either
    assert since.numbers == {
        "ratio": {"joint2": pytest.approx(1.9, abs=0.1)},
        "seconds": pytest.approx([5, 8], abs=0.3),
    }


def _dry(data):
    return np.std(data.u, axis=0) * np.tanh(data.v / 0.05)


@pytest.mark.nightly
def test_friction_that_fades_is_named():
    data = clean(two_links(), 5, noise="qvu")
    dry = _dry(data)
    for fade, ratio in ((0.1, 0.34), (0.02, 0.87)):  # beside .1 that stays
        drift = check(replace(data, u=data.u + dry * (1.0 - fade * data.time)[:, None])).doubts.of("drift")
        told = [each.numbers["ratio"] == pytest.approx({"joint1": ratio, "joint2": ratio}, abs=0.05) for each in drift]
        assert told == [True]
    alone = check(replace(data, u=data.u + dry * (1.0 - np.array([0.0, 0.05]) * data.time[:, None]))).doubts.of("drift")
    assert [(each.joints, "seconds" in each.numbers) for each in alone] == [(("joint2",), False)]
    cold = check(replace(data, u=data.u + dry * (1.0 + np.exp(-np.square(data.time / 2.0)))[:, None])).doubts
    assert [each.about for each in cold if each.level != "ok"] == ["drift"], "no push, either"


LOADS = [((7.0,), 4, (0.0, 7.0)), ((12.2,), 4, (12.2, 14.99)), ((11,), -1, (11, 14.99)), ((6.0, 5.0), -1, (6, 11)),
         ((2.0, 2.0), -1, (2, 4, 6, 8, 10, 12, 14, 14.99)), ((14.65,), -1, (14.65, 14.99))]  # fmt: skip


@pytest.mark.parametrize(("at", "rest", "out"), LOADS)
def test_the_times_of_a_load_are_told_also_behind_a_rest(at, rest, out):
    time = np.arange(0.0, 15.0, 0.01)
    way = np.stack([np.sin(2.1 * time), 0.8 * np.sin(3.3 * time)], axis=1) * np.clip(time - rest, 0, 1)[:, None] ** 3
    doubts = check(gripped(with_motion(two_links(), way, 100.0, 3, 0.0), *at)).doubts
    [found] = doubts.of("load")
    assert found.numbers["seconds"] == pytest.approx(out, abs=0.2)
    assert ("or something pulls like one" in found.what) == (out == (6, 11))
    assert not doubts.of("push", "drift")  # a load that is taken up is none


def test_rows_are_taken_where_they_and_the_changes_cost_least():
    each = np.array([*itertools.product([0, 1], repeat=9)])
    for seed in range(20):
        cost, change = np.random.default_rng(seed).normal(size=9), 0.2 * seed
        total = each @ cost + change * np.abs(np.diff(each, axis=1)).sum(axis=1)
        assert two_levels(cost, change).tolist() == each[np.argmin(total)].astype(bool).tolist()


def test_short_and_unordered_logs_are_looked_at_too():
    data = clean(two_links(), 0)
    few = data.rows(np.random.default_rng(0).choice(len(data), 60, replace=False))
    assert quick_check(few) == ()
    assert quick_check(replace(few, u=-few.u))[0].about == "torque sign"
    assert quick_check(data.rows(slice(0, 12))) == ()


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(1, 12))
def test_clean_logs_raise_no_alarm(seed):
    torch.manual_seed(seed)
    for name, data in clean_logs(seed):
        assert len(data) <= 300 or not check(data).doubts.at("wrong"), name
        assert quick_check(data) == (), name


def test_a_joint_that_is_held_throughout_is_at_no_end_of_its_motion_and_says_nothing_of_stops():
    torch.manual_seed(9)
    held = dict(clean_logs(9))["a joint is held"]
    assert not check(held).doubts.of("stop")
    check(replace(held, v=held.v + 1e-3 * np.random.default_rng(0).normal(size=held.v.shape) * [0.0, 1.0]))  # rows stay


ROUND = '<inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>'
LEG = f"""<robot name="leg"><link name="rail"/>
<joint name="z" type="prismatic"><parent link="rail"/><child link="body"/><axis xyz="0 0 1"/></joint>
<link name="body"><inertial><mass value="2"/>{ROUND}
<joint name="hip" type="continuous"><parent link="body"/><child link="thigh"/><axis xyz="0 1 0"/></joint>
<link name="thigh"><inertial><origin xyz="0 0 -0.1"/><mass value="0.3"/>{ROUND}
<joint name="knee" type="continuous"><parent link="thigh"/><child link="shank"/><axis xyz="0 1 0"/>
<origin xyz="0 0 -0.2"/></joint>
<link name="shank"><inertial><origin xyz="0 0 -0.1"/><mass value="0.2"/>{ROUND}
<joint name="ankle" type="fixed"><parent link="shank"/><child link="foot"/><origin xyz="0 0 -0.2"/></joint>
<link name="foot"/></robot>"""


@pytest.mark.parametrize("held", [True, False])
def test_a_foot_that_stays_is_no_wrong_sign_or_unit(held):
    robot, time = Robot.from_urdf_text(LEG), np.arange(0.0, 8.0, 0.005)
    hip = 0.6 + 0.2 * np.sin(2.0 * time) + 0.1 * np.sin(3.3 * time + 1.0)
    q = np.stack([0.4 * np.cos(hip), hip, -2.0 * hip], axis=1)  # the foot stays 0.4 m below the hip's lowest place
    v, a = (np.gradient(q, time, axis=0), np.gradient(np.gradient(q, time, axis=0), time, axis=0))
    kinematics = robot.kinematics(torch.tensor(q))
    assert float(kinematics.frame_pose("foot")[:, :3, 3].std(0).max()) < 1e-12
    u = robot.inverse_dynamics(*(torch.tensor(x) for x in (q, v, a)))
    push = torch.tensor(np.stack([2.0 * np.cos(time), 0.0 * time, 25.0 + 12.0 * np.sin(1.7 * time)], axis=1))
    u = u - float(held) * (kinematics.frame_jacobian("foot")[:, :3].mT @ push[..., None])[..., 0]
    noise = 1e-3 * np.random.default_rng(0).normal(size=q.shape)
    found = said(Dataset(q=q, v=v, u=u.numpy() + noise, a=a, time=time, model=Model(robot)))
    assert [each.about for each in found if each.level == "wrong"] == (["contact"] if held else [])
    if held:
        assert "--contact foot:held" in found[0].do
        assert found[0].joints == ("z", "hip", "knee")


def test_positions_in_degrees_are_no_link_that_stays():
    """As radians they turn levers by far more than a turn, which moves no link farther than the lever is long."""
    robot, time = Robot.from_urdf(kuka_file()), np.arange(0.0, 8.0, 0.01)
    q = np.rad2deg(0.8 * np.sin(time[:, None] * np.linspace(0.7, 1.9, 7) + np.arange(7.0)))
    rest = np.zeros_like(q)
    log = Dataset(q=q, v=rest, u=rest, a=rest, time=time, model=Model(robot))
    assert held_points(CheckInput.as_recorded(log, log.model, compared=log)) == []


@pytest.mark.parametrize(("slips", "held"), [(0.0, True), (0.02, True), (0.04, False)])
def test_a_foot_that_slips_by_more_than_a_twentieth_is_free(slips, held):
    robot, time = Robot.from_urdf_text(LEG), np.arange(0.0, 8.0, 0.005)
    hip = 0.6 + 0.2 * np.sin(2.0 * time)
    q = np.stack([0.4 * np.cos(hip), hip, -2.0 * hip + slips * np.sin(1.1 * time)], axis=1)
    v = np.gradient(q, time, axis=0)
    log = Dataset(q=q, v=v, u=0.0 * q + 1.0, a=np.gradient(v, time, axis=0), time=time, model=Model(robot))
    assert bool(held_points(CheckInput.quick(log, log.model))) == held


@pytest.mark.parametrize(("rate", "unit"), [(0.1, "ms"), (1.5, ""), (200.0, ""), (5000.0, ""), (8000.0, "min")])
def test_another_unit_of_time_is_asked_for_only_at_rates_that_no_log_has(rate, unit):
    data = clean(two_links(), 0)
    inputs = CheckInput.quick(replace(data, time=np.arange(len(data)) / rate), data.model)
    root = search(inputs)[0]
    found = [each.correction["unit"]["time"][0] for each, _ in _units(root.log, inputs, root.factors)
             if each.about == "time unit"]  # fmt: skip
    assert (unit in found) if unit else not found


@pytest.mark.nightly
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_turned_torques_are_named_though_all_masses_are_wrong(sign):
    data = filtered_log(5, arm_model(contacts=0))
    robot = data.model.robot
    for link, mass, along in (("upper", 3.0, -0.3), ("fore", 0.3, 0.4), ("hand", 4.0, -0.2)):
        robot = with_link(robot, link, mass, np.array((0.1, along, along)), 0.05 * np.eye(3))
    wrong_masses = replace(data, u=sign * data.u, model=Model(robot))
    found = [each for each in said(wrong_masses) if each.about == "torque sign"]
    assert len(found) == (sign < 0.0)
    assert all(each.correction == {"sign": {"u": (-1.0, -1.0, -1.0)}} for each in found)
