"""Flags of feet from motion and forces, against those of the simulation that made the rows."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from forcegp import Accelerations, Dataset, Model, Robot, Torques, fit, score
from forcegp.data import Preparation, estimate_stance, motion_spectrum
from forcegp.data.stance import _bearing, _between
from forcegp.data.views import decided
from forcegp.errors import ContactError, DatasetError, InvalidInput
from forcegp.evidence import motion_residuals
from forcegp.forces import Viscous
from forcegp.mechanics import fixed_point
from forcegp.scores import learn, named_model
from forcegp.simulation import QuadrupedConfig, simulate_quadruped

SWITCHES = slice(-4, None)


def walk(seed: int, noise: float = 0.0, **config):
    """Rows without their flags, with white noise on all velocities, and the flags."""
    log = simulate_quadruped(QuadrupedConfig(**{"seconds": 6.0, "seed": seed, "noise": 0.1, **config}))
    v, u = log.v + noise * np.random.default_rng(seed).normal(size=log.v.shape), log.u.copy()
    u[:, SWITCHES] = 0.0
    return replace(log, v=v, u=u, truth={}), log.u[:, SWITCHES]


@pytest.mark.parametrize(("seed", "noise"), [(0, 0.0), (1, 0.0), (2, 0.02), (3, 0.02)])
def test_flags_are_those_of_the_simulation(seed, noise):
    log, flags = walk(seed, noise)
    found = estimate_stance(log)
    decided = np.isfinite(found.flags)
    assert found.names == log.model.inputs[SWITCHES]
    assert (found.flags == flags)[decided].mean() > 0.998  # the others are within a hundredth of a second of a change
    assert decided.all(axis=1).mean() > 0.85
    swing = flags == 0.0
    assert (found.flags[swing] == 0.0).mean() > 0.8


def hopping(v, a, height, time):
    """Rows of one body on a point foot, from its velocity, acceleration and height."""
    body = '<inertial><mass value="2"/><inertia ixx=".02" iyy=".02" izz=".02" ixy="0" ixz="0" iyz="0"/></inertial>'
    robot = Robot.from_urdf_text(f'<robot name="hopper"><link name="foot">{body}</link></robot>', base="floating")
    model, q = Model(robot, fixed_point("foot", switch="stands")), np.tile(robot.neutral().numpy(), (len(time), 1))
    q[:, 2] += height
    return Dataset(q=q, v=v, u=np.zeros((len(time), 1)), a=a, time=time, model=model)


def test_a_foot_that_swings_most_of_the_time():
    """A hopper whose flight is as fast as the noise of its velocity: what it seldom carries is stance, not the rest."""
    time = np.arange(2000) / 200
    flags = (time % 0.8 < 0.25).astype(float)
    v, a = np.zeros((2, len(time), 6))
    v[:, 2] = (1.0 - flags) * np.random.default_rng(0).normal(size=len(time))
    a[:, 2] = -9.75 * (1.0 - flags)
    found = estimate_stance(hopping(v, a, 0.1 * (1.0 - flags), time))
    decided = np.isfinite(found.flags[:, 0])
    assert (found.flags[:, 0] == flags)[decided].all()
    assert decided.mean() > 0.75


def test_a_foot_that_drags_before_it_is_lifted_may_bear_a_little():
    time = np.arange(2000) / 200
    phase = time % 0.8
    height = 0.03 * np.clip(phase - 0.5, 0.0, None)
    drags, lifted = (phase > 0.3) & (height == 0.0), height > 0.0
    v, a = np.zeros((2, len(time), 6))
    v[drags | lifted, 0], a[drags, 2], a[lifted, 2] = 0.2, -9.2, -9.75
    found = estimate_stance(hopping(v, a, height, time)).flags[:, 0]
    assert not (found[drags] == 0.0).any()
    assert (found[(height > 0.0052) & (height < 0.0078)] == 0.0).all()


LEG = """<joint name="leg" type="prismatic"><parent link="trunk"/><child link="foot"/><axis xyz="{}"/>
<limit lower="0" upper="1" effort="500" velocity="20"/></joint>"""
BODY = '<inertial><mass value="{}"/><inertia ixx=".05" iyy=".05" izz=".05" ixy="0" ixz="0" iyz="0"/></inertial>'


def hop(base: str, rate: float, stands: float, gravity=(0.0, 0.0, -9.81)):
    """A trunk of 5 kg on a leg: half a second in the air, then so many seconds on the ground, in closed form."""
    up = 2 if base == "floating" else 1
    links = "".join(f'<link name="{name}">{BODY.format(m)}</link>' for name, m in (("trunk", 5.0), ("foot", 0.5)))
    leg = LEG.format("0 0 -1" if base == "floating" else "0 -1 0")
    robot = Robot.from_urdf_text(f'<robot name="hopper">{links}{leg}</robot>', base=base, gravity=gravity)
    time, flies, speed = np.arange(0.0, 8.0, 1.0 / rate), 0.5, 0.25 * 9.81
    t = time % (flies + stands)
    flags, w = (t >= flies).astype(float), np.pi / stands
    in_air, on_ground = t, t - flies
    z = np.where(flags, -speed / w * np.sin(w * on_ground), speed * in_air - 0.5 * 9.81 * in_air**2)
    dz = np.where(flags, -speed * np.cos(w * on_ground), speed - 9.81 * in_air)
    ddz = np.where(flags, speed * w * np.sin(w * on_ground), -9.81)
    q = np.tile(robot.neutral().numpy(), (len(time), 1))
    v, a = np.zeros((2, len(time), robot.nv))
    q[:, up], v[:, up], a[:, up] = 0.5 + z, dz, ddz
    q[:, -1], v[:, -1], a[:, -1] = 0.5 + flags * z, flags * dz, flags * ddz
    u = np.stack([5.0 * (ddz + 9.81), 0.0 * flags], 1)
    return Dataset(q=q, v=v, u=u, a=a, time=time, model=Model(robot, fixed_point("foot", switch="stands"))), flags


@pytest.mark.parametrize(("rate", "stands", "cutoff"), [(50.0, 0.1, 8.0), (50.0, 0.14, 10.0), (50.0, 0.12, 15.0)])
def test_stance_as_short_as_what_a_filter_smears_is_never_called_swing(rate, stands, cutoff):
    log, _ = hop("floating", rate, stands, (0.0, 0.0, -9.81))
    rows = Preparation(cutoff=cutoff).apply(log)
    found = estimate_stance(rows).flags[:, 0]
    decided, t = np.isfinite(found), rows.time % (0.5 + stands)
    assert (found == (t >= 0.5))[decided].all()
    assert decided.mean() > 0.5


def test_prepared_rows_carry_the_flags_and_open_ones_half():
    log, flags = walk(9)
    prepared, found = Preparation(stance="auto", every=2).apply(log), estimate_stance(log).flags[::2]
    np.testing.assert_array_equal(prepared.u[:, SWITCHES], np.where(np.isnan(found), 0.5, found))
    np.testing.assert_array_equal(prepared.time, log.time[::2])
    known, report = np.isfinite(found).all(axis=1), prepared.metadata["preparation"]["stance"]
    assert report["open_rows"] == (~known).sum() > 10
    assert report["standing"]["front_left_stands"] == pytest.approx(flags[:, 0].mean(), abs=0.03)
    np.testing.assert_array_equal(decided(prepared).time, prepared.time[known])


@pytest.mark.nightly
def test_open_rows_show_torques_beside_what_feet_may_bear_and_nothing_else():
    """Forces of feet that stand or may stand are taken out by least squares; accelerations learn from decided rows."""
    rows = Preparation(stance="auto", every=5).apply(walk(9, seconds=3.0)[0])
    model, there = rows.model, decided(rows)
    q, v, u = (torch.tensor(x) for x in (rows.q, rows.v, rows.u))
    dynamics = model.dynamics(q, v, u)
    left = (dynamics.Q_K - (dynamics.M @ torch.tensor(rows.a)[..., None])[..., 0]).numpy()
    feet = [dynamics.state.kinematics.frame_jacobian(name[: -len("stands")] + "foot", (0.0, 0.0, 0.0))[:, :3]
            for name in model.switches]  # fmt: skip
    for k in range(len(rows)):
        arms = torch.cat([torch.zeros(0, 18), *(x[k] for x, flag in zip(feet, u[k, SWITCHES], strict=True) if flag)]).T
        left[k] -= arms.numpy() @ np.linalg.lstsq(arms.numpy(), left[k], rcond=None)[0]
    np.testing.assert_allclose(motion_residuals(rows, model)[0], left, atol=1e-9)
    for evidence, used in ((Torques(), rows), (Accelerations(), there)):
        posterior = fit(model.with_forces(Viscous()), rows, evidence)
        assert len(posterior.training) == len(used)
    assert score(posterior, rows).runs["model"][0]["test_rows"] == len(there) < len(rows)
    few = rows.rows(slice(None, None, 3))
    learned, _ = learn(named_model(model, ["gp:joint-friction"]), few, iterations=1)
    assert len(learned.training) == len(decided(few)) < len(few)


def test_open_rows_are_filled_by_the_nearest_decided_one():
    log, flags = walk(1)
    found = estimate_stance(log)
    filled = found.filled(log)
    assert (filled.u[:, SWITCHES] == flags).mean() > 0.98
    decided = np.isfinite(found.flags)
    assert (filled.u[:, SWITCHES] == found.flags)[decided].all()
    own, known = found.flags[:, 0], np.flatnonzero(decided[:, 0])
    for row in np.flatnonzero(~decided[:, 0]):
        distance = np.abs(known - row)
        assert filled.u[row, SWITCHES.start] in own[known[distance == distance.min()]]
    with pytest.raises(DatasetError, match="open in all 1440 rows"):
        replace(found, flags=np.full_like(found.flags, np.nan)).filled(log)


def test_the_cutoff_of_a_robot_on_feet_is_not_far_beyond_that_of_its_base():
    log, _ = walk(2, lift=False)
    noise = np.random.default_rng(0).normal(size=log.v.shape) * np.array([1e-3] * 6 + [1e-4] * 12)
    noise[:, 8] += 0.02 * np.sin(2.0 * np.pi * 30.0 * log.time)  # a knee shakes
    noisy = replace(log, q=log.model.robot.integrate(torch.tensor(log.q), torch.tensor(noise)).numpy(), noise_std=None)
    each, found = motion_spectrum(noisy).cutoff, Preparation(cutoff="auto").apply(noisy)
    assert found.metadata["preparation"]["cutoff"] == pytest.approx(1.5 * np.nanmax(each[:6]), rel=0.01)
    assert "joints do up to" in found.metadata["preparation"]["why"]["cutoff"]
    free = replace(noisy, u=noisy.u[:, :12], model=log.model.with_contacts([]))
    assert Preparation(cutoff="auto").resolved(free).cutoff == pytest.approx(np.nanmax(each), rel=0.01)
    assert np.nanmax(each) > 25.0 > 3.0 * np.nanmax(each[:6])


def test_what_stance_needs_is_named():
    log, _ = walk(0)
    with pytest.raises(ContactError, match="no contact of the model has a switch"):
        estimate_stance(log, log.model.with_contacts(()))
    with pytest.raises(InvalidInput, match="stance is 'yes'; allowed: 'log' or 'auto'"):
        Preparation(stance="yes")
    wild = replace(log, v=np.random.default_rng(0).normal(size=log.v.shape) * 5.0, u=0.0 * log.u, a=0.0 * log.a)
    sliding = replace(estimate_stance(wild), flags=np.full((len(log), 4), np.nan))
    with pytest.raises(DatasetError, match="leave the stance open in all"):
        sliding.written(wild)


@pytest.mark.parametrize(("low", "high"), [(1.0, 3.5), (1.0, 2.6)])  # logarithms of newtons
def test_forces_fall_into_their_two_classes(low, high):
    """Of normal logarithms a foot stands from where that is 20 times likelier; the rest of the cut tails is a tenth."""
    rng, width, share = np.random.default_rng(0), 0.4, 0.2
    force = np.exp(np.concatenate([rng.normal(low, width, 4000), rng.normal(high, width, 16000)]))[:, None]
    free, bears = _bearing(force, np.arange(20000)[:, None] < 4000)

    def odds(x: float) -> float:
        return np.log((1.0 - share) / share) + (np.square(x - low) - np.square(x - high)) / (2.0 * width**2)

    bounds = [np.exp(brentq(lambda x, s=s: odds(x) - s * np.log(20.0), low, high)) for s in (-1.0, 1.0)]
    assert free <= bounds[0]
    assert 0.9 * bounds[1] < bears < 0.97 * bounds[1]


@pytest.mark.parametrize(("noise", "decides"), [(0.1, True), (0.3, False)])
def test_velocities_that_are_as_loud_as_steps_decide_nothing(noise, decides):
    log, _ = walk(5, noise)
    found = estimate_stance(replace(log, u=0.0 * log.u, a=np.random.default_rng(0).normal(0.0, 100.0, log.a.shape)))
    assert (found.flags == 1.0).any() == decides


def test_rows_within_fifteen_milliseconds_of_a_change_are_open():
    time = 0.001 * np.arange(1000)
    assert 0.029 <= 0.001 * np.isnan(_between((time >= 0.5).astype(float)[:, None], time)).sum() <= 0.032
