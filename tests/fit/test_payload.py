"""A `Payload` that is estimated, against payloads that Pinocchio's inverse dynamics carries."""

import re
from dataclasses import replace
from importlib import import_module
from importlib.resources import files
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
import torch
from scipy.stats import t as student
from tests.robots.pinocchio_oracle import Oracle

from forcegp.cli.payload import AT_REST
from forcegp.data import Dataset, Preparation
from forcegp.data.views import at_rest
from forcegp.data.views import postures as posture_numbers
from forcegp.errors import DatasetError, DataWarning, ForceGPError
from forcegp.evidence import Torques, body_names, motion_residuals
from forcegp.evidence.least_squares import Fit
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.evidence.recorded_rows import RecordedRows
from forcegp.fit import fit
from forcegp.fit.equations import weights_of_rests
from forcegp.fit.payloads import CAUSES, misfit
from forcegp.fit.physical import typical_sizes
from forcegp.forces import Actuation, Body, Offset, Payload, RigidBodies, Rotor, Stribeck, Viscous, parse_forces
from forcegp.model import Model
from forcegp.posterior import Estimates
from forcegp.robots import Robot
from forcegp.robots.urdf_file import replace_inertial

TEXT = files("forcegp.simulation").joinpath("ur5.urdf").read_text()
MIDDLE = np.array([0.0, -1.2, 1.4, -0.8, -1.5, 0.0])
ROBOT = Robot.from_urdf_text(TEXT)
MASS, CENTER, INERTIA = 1.3, np.array([0.03, -0.02, 0.06]), np.diag([2e-3, 3e-3, 1e-3])
ROTORS = 0.01 * np.array([joint.effort_limit for joint in ROBOT.joints])


def log(text, seed, *, seconds=30.0, noise=0.0, friction=1.0):
    """A smooth motion of a UR5 with this URDF, and the torques that it needs."""
    rng, time = np.random.default_rng(seed), np.arange(0.0, seconds, 0.02)
    size, w, phase = rng.uniform(0.2, 0.5, (3, 6)), rng.uniform(0.5, 3.0, (3, 6)), rng.uniform(0, 6.3, (3, 6))
    at = w * time[:, None, None] + phase
    q = MIDDLE + (size * np.sin(at)).sum(1)
    v, a = (size * w * np.cos(at)).sum(1), -(size * w**2 * np.sin(at)).sum(1)
    oracle, dry = Oracle(text, ROBOT), 2.0 * ROTORS * (1.0 + 0.5 * np.exp(-((v / 0.1) ** 2))) * np.tanh(v / 0.02)
    u = np.array([oracle.inverse_dynamics(*row) for row in zip(q, v, a, strict=True)])
    u += ROTORS * a + friction * (dry + ROTORS * v) + noise * rng.standard_normal(u.shape)
    return Dataset(q=q, v=v, u=u, a=a, time=time, model=Model(ROBOT))


def loaded(mass=MASS, text=TEXT):
    return replace_inertial(text, "tool0", mass, CENTER, INERTIA, source="a test")


LAWS = Viscous(), Stribeck(), Rotor()
ONE = np.where(np.arange(6) == 2, 0.9, 1.0)


class Found:
    """What people ask of a payload."""

    def __init__(self, data, link=None, laws=LAWS, **options):
        self.posterior = fit(data.model.with_forces(*laws, Payload(link)), data, Torques(mean=0.4), **options)
        self.estimates = self.posterior.parameters
        (payload,) = (law for law in self.posterior.model.laws if isinstance(law, Payload))
        self.link, self.mass, self.center_of_mass = payload.link, payload.mass, np.array(payload.center_of_mass)

    @property
    def intervals(self):
        names = ["mass", *(f"center_of_mass.{axis}" for axis in "xyz")]
        return [self.estimates[f"payload.{name}"].interval for name in names]


@pytest.fixture(scope="module")
def found() -> Found:
    return Found(log(loaded(), 1, noise=0.05))


def postures(seed, count, rows=100, last_move=False):
    """Rests of two seconds, in which gears bear up to their breakaway, any way or that of the last move."""
    rng, text = np.random.default_rng(seed), loaded()
    oracle, rest, time = Oracle(text, ROBOT), np.repeat(np.arange(count), rows), 0.02 * np.arange(count * rows)
    at = MIDDLE + rng.uniform(-1.0, 1.0, (count, 6))
    stuck, none = 2.0 * ROTORS * rng.choice([-1.0, 1.0], (count, 6)) * rng.uniform(0.7, 1.0, (count, 6)), np.zeros(6)
    stuck = np.sign(np.diff(at, axis=0, prepend=at[:1])) * np.abs(stuck) if last_move else stuck
    u = np.array([oracle.inverse_dynamics(q, none, none) for q in at]) + stuck
    q, v = at[rest] + 1e-5 * rng.standard_normal((len(rest), 6)), 1e-3 * rng.standard_normal((len(rest), 6))
    u = u[rest] + 0.05 * rng.standard_normal((len(rest), 6))
    return Dataset(q=q, v=v, u=u, a=np.gradient(v, 0.02, axis=0), time=time, episode=rest, model=Model(ROBOT))


def held_of_postures(count, seeds):
    """Intervals of mass and centre, of so many logs each, that hold."""
    held = np.zeros(4, dtype=int)
    for seed in seeds:
        prepared = Preparation(cutoff="auto", delay="auto").apply(postures(seed, count, rows=40))
        assert prepared.metadata["preparation"]["cutoff"] is None
        ends = Found(prepared, laws=(Offset(),)).intervals
        held += [low <= true <= high for (low, high), true in zip(ends, [MASS, *CENTER], strict=True)]
    return held


def stopped(data, every=150, rows=40):
    """The log with rests, in which gears hold what a controller that integrates leaves them."""
    rng, none, parts = np.random.default_rng(0), np.zeros(6), np.split(np.arange(len(data)), range(every, 1500, every))
    rest = np.concatenate([np.arange(len(part) + rows) >= len(part) for part in parts])
    q, v, a, u = (
        np.array(x)[np.r_[*(np.r_[p, [p[-1]] * rows] for p in parts)]] for x in (data.q, data.v, data.a, data.u)
    )
    v[rest], a[rest], oracle = 0.0, 0.0, Oracle(TEXT, ROBOT)
    for at in np.split(np.flatnonzero(rest), len(parts)):
        u[at] = oracle.inverse_dynamics(q[at[0]], none, none) + 4.0 * ROTORS * rng.uniform(-1.0, 1.0, 6)
    u += 0.05 * rng.standard_normal(u.shape)
    return Dataset(q=q, v=v, a=a, u=u, time=0.02 * np.arange(len(q)), model=Model(ROBOT))


@pytest.mark.filterwarnings("ignore::forcegp.errors.DataWarning")
def test_rests_count_by_what_they_leave(monkeypatch):
    """Friction is that of the motion, not of the loads that gears hold at rest; by a half, unless they count less."""
    data, module = log(TEXT, 0, noise=0.05), import_module("forcegp.fit.equations")
    laws = parse_forces("viscous,coulomb:memory=true,offset,rotor")
    found = []
    for each, less in ((data, 0.7), (stopped(data), 0.7), (stopped(data), 0.0)):
        monkeypatch.setattr(module, "LESS", less)
        values = fit(data.model.with_forces(*laws), each, Torques()).parameters
        found.append(np.array([values[f"coulomb.level.{name}"].value for name in ROBOT.joint_names]))
    assert found[1] == pytest.approx(found[0], rel=0.06)
    assert np.median(found[2] / found[0]) < 0.7


@pytest.mark.parametrize(
    ("rows", "speed", "leaves", "counts"),
    [(20, 0.025, 2.0, 0.5), (20, 0.035, 2, 1), (14, 0.025, 2, 1), (20, 0.025, 1.4, 1)],
)
def test_joints_that_stand_long_enough_and_leave_more_count_less(rows, speed, leaves, counts):
    time, stands = 0.02 * np.arange(400), np.arange(400) % 100 < rows
    part = SimpleNamespace(v=np.where(stands, speed, 1.0)[:, None], time=time)
    weights = weights_of_rests([part], np.where(stands, leaves, 1.0)[:, None])
    np.testing.assert_allclose(weights[:, 0], np.where(stands, counts, 1.0))


def test_intervals_hold_what_gears_bear_in_postures():
    """Each posture counts once, however many rows it has; the default filter leaves such logs as they are."""
    assert held_of_postures(4, range(6)).min() >= 5


def test_rests_bear_friction_as_the_last_move_left_it():
    """Friction that the last move left is no share of the load, in one episode or several; without an order none is."""
    for one_piece in (False, True):
        data = postures(2, 8, rows=30, last_move=True)
        data = replace(data, episode=np.zeros_like(data.episode)) if one_piece else data
        bare, found = (Found(data, laws=tuple(parse_forces(x))) for x in ("offset", ",".join(AT_REST)))
        assert abs(found.mass / MASS - 1.0) < 0.4 * abs(bare.mass / MASS - 1.0)
        levels = [found.estimates[f"coulomb.level.{name}"].value for name in ROBOT.joint_names]
        assert levels == pytest.approx(2.0 * 0.85 * ROTORS, rel=0.3)
    started = replace(data, time=data.time % 0.6, episode=np.arange(len(data)) // 30)  # whose order nobody knows
    assert Found(started, laws=tuple(parse_forces(",".join(AT_REST)))).mass == pytest.approx(bare.mass, rel=0.05)


def test_rests_in_one_piece_are_read_as_episodes_are():
    """Rows of rests one after the other, without the moves, and few of them."""
    data = postures(0, 6, rows=30)
    joined = replace(data, episode=np.zeros(len(data), dtype=int))
    assert at_rest(joined)
    one, other = (Found(each, laws=(Offset(),)) for each in (data, joined))
    assert other.estimates.rows == one.estimates.rows == 6
    assert other.mass == pytest.approx(one.mass, rel=0.01)
    moving = np.arange(len(data)) % 30 < 2
    assert not at_rest(replace(joined, q=joined.q + 0.1 * moving[:, None]))


def test_what_rests_is_a_matter_of_the_whole_range():
    data = postures(0, 3, rows=20)
    sway = np.linspace(-1.0, 1.0, 20)[np.arange(60) % 20][:, None] * np.ptp(data.q, axis=0)
    assert at_rest(replace(data, q=data.q + 0.004 * sway))
    assert not at_rest(replace(data, q=data.q + 0.0075 * sway))
    ramp = np.ptp(data.q, axis=0).max() * (np.arange(60) % 20) / 19.0
    idle = [replace(data, q=np.column_stack([data.q[:, :5], share * ramp])) for share in (8e-4, 1.5e-3)]
    assert list(map(at_rest, idle)) == [True, False]
    assert not at_rest(data.select_episodes([0, 1]))
    assert not at_rest(log(TEXT, 0, seconds=2.0))


def test_what_a_log_rests_in_is_one_piece():
    """Moves of a second between rests of another, in one episode: each rest and the move before it stay together."""
    time = 0.02 * np.arange(400)
    s = np.clip(time % 2.0, 0.0, 1.0)
    way = (time // 2.0 + s**3 * (10.0 - 15.0 * s + 6.0 * s**2))[:, None] * np.array([0.4, -0.3, 0.2, 0.5, 0.1, 0.3])
    data = replace(log(TEXT, 0, seconds=8.0), q=way)
    numbers = posture_numbers(data)
    assert numbers is not None
    assert [len(set(numbers[40 + 100 * k : 100 * k + 95])) for k in range(4)] == [1] * 4
    assert np.unique(numbers).tolist() == [0, 1, 2, 3]
    assert posture_numbers(log(TEXT, 0, seconds=8.0)) is None  # no rests
    assert posture_numbers(data.rows(slice(0, 200))) is None  # too few
    assert posture_numbers(replace(data, time=0.2 * time)) is None  # of rests below .3 s there may be many
    assert posture_numbers(replace(data, time=0.5 * time)) is not None
    s = np.clip((time % 2.0) / 1.5, 0.0, 1.0)[:, None]
    seldom = np.floor(time / 2.0)[:, None] + s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    assert posture_numbers(replace(data, q=seldom * way[-1])) is not None  # a third of the rows rest
    creep = 5e-3 * time[:, None] * np.ptp(way, axis=0)
    assert posture_numbers(replace(data, q=way + creep)) is None


def test_few_postures_have_the_interval_of_student():
    """The mean of three numbers, against the interval of a t distribution with two degrees of freedom."""
    values, one = np.array([1.0, 1.5, 3.0]), np.ones((1, 1))
    name = SimpleNamespace(name="mean", unit="1", start=0.0)
    white = np.column_stack([np.ones(3), values.mean() - values])
    found = Estimates.of_search([name], np.array([values.mean()]), one, white, list(np.arange(3)[:, None]), 1e-6 * one)
    expected = student.interval(0.95, 2, values.mean(), values.std(ddof=1) / 3**0.5)
    assert found["mean"].interval == pytest.approx(expected, rel=1e-6)


def with_longer_forearm(text):
    """The forearm is 10 % longer than the text states."""
    joint = text[text.index('<joint name="wrist_1_joint"') :]
    x, y, z = map(float, re.search(r'<origin[^>]*xyz="([^"]*)"', joint)[1].split())
    longer = re.sub(r'(<origin[^>]*xyz=")[^"]*"', rf'\g<1>{1.1 * x} {1.1 * y} {1.1 * z}"', joint, count=1)
    return text.replace(joint, longer)


def with_another_center(text):
    """The centre of the forearm lies .1 m further from its joint than the text states."""
    link = text[text.index('<link name="elbow_link"') :]
    x, y, z = map(float, re.search(r'<inertial>\s*<origin[^>]*xyz="([^"]*)"', link)[1].split())
    other = re.sub(r'(<inertial>\s*<origin[^>]*xyz=")[^"]*"', rf'\g<1>{x - 0.1} {y} {z}"', link, count=1)
    return text.replace(link, other)


CHANGED = {"gains": str, "gravity": str, "lengths": with_longer_forearm, "centres of mass": with_another_center}
OFF = [
    ("gains", np.full(6, 1.05)),
    ("gains", ONE),
    *((name, np.ones(6)) for name in ("lengths", "centres of mass", "gravity")),
]


@pytest.mark.parametrize(("cause", "off"), OFF)
def test_causes_that_explain_more_are_named_and_in_the_interval(cause, off):
    """All torques 5 % off, those of one joint, a forearm that the URDF has too short, one heavy elsewhere, a tilt."""
    data = log(CHANGED[cause](loaded()), 1, noise=0.05)
    data = replace(data, u=data.u * off)
    if cause == "gravity":  # the base is turned by ten degrees about y
        data = replace(data, model=Model(Robot.from_urdf_text(TEXT, gravity=(1.703, 0.0, -9.661))))
    with pytest.warns(DataWarning, match=CAUSES[cause][1]):
        estimate = Found(data, rows=800)
    [doubt] = [each for each in estimate.posterior.settings["doubts"] if each["numbers"]]
    gains = {name: 1.0 / x for name, x in zip(ROBOT.joint_names, off, strict=True) if x != 1.0}
    found = doubt["numbers"][cause]
    if cause == "centres of mass":
        found = {name: x for name, x in found.items() if abs(x) > 0.02}
    other = {"lengths": {"wrist_1_joint": 1.1}, "centres of mass": {"elbow_link along x": -0.1}}
    other["gravity"] = {"x": -0.174, "y": 0.0, "z": -0.015}
    assert found == pytest.approx(gains or other[cause], abs=0.02)
    ends = estimate.intervals
    assert all(low <= true <= high for (low, high), true in zip(ends, [MASS, *CENTER], strict=True))


@pytest.mark.filterwarnings("ignore::forcegp.errors.DataWarning")
@pytest.mark.parametrize("times", [5.0, 2.0])
def test_a_gain_stands_for_a_payload_where_no_other_number_explains_a_third(times, monkeypatch):
    nats, module = iter([1.0, times, *9 * [1.0]]), import_module("forcegp.fit.payloads")
    monkeypatch.setattr(module, "_instead", lambda _, f, C, *__: (next(nats), (0.2 * np.eye(C.shape[1])[0], 0 * f.x)))
    doubts = Found(log(TEXT, 1, noise=0.05), rows=800).posterior.settings["doubts"]
    assert any("as well as any payload" in each["what"] for each in doubts) == (times > 3.0)


@pytest.mark.filterwarnings("ignore::forcegp.errors.DataWarning")
def test_gravity_that_is_larger_is_not_a_base_that_is_tilted():
    """A fifth more than there is."""
    data = log(loaded(), 1, noise=0.05)
    more = 0.2 * Robot.from_urdf_text(loaded()).gravity_forces(torch.tensor(data.q)).numpy()
    doubts = Found(replace(data, u=data.u + more), rows=800).posterior.settings["doubts"]
    assert not any("gravity" in each["numbers"] for each in doubts)


ENCODERS = ("gear ratio", 1.2, 0.5), ("gear ratio", 1.08, 0.05), ("joint zero", 0.1, 0.5), ("joint zero", 0.04, 0.05)
ENCODERS += (("joint zero", 0.025, 0.05),)


@pytest.mark.parametrize(("cause", "true", "noise"), ENCODERS)
@pytest.mark.filterwarnings("ignore::forcegp.errors.DataWarning")
def test_a_wrong_encoder_is_named(cause, true, noise):
    """Positions of one joint, and what follows from them; from sizes on that are no error of a fit."""
    data, one = log(loaded(), 1, noise=noise), np.arange(6) == 2
    wrong = {x: getattr(data, x) / np.where(one, true, 1.0) for x in "qva"}
    data = replace(data, **(wrong if cause == "gear ratio" else {"q": data.q - true * one}))
    doubts = [x for x in Found(data, rows=800).posterior.settings["doubts"] if cause in x["numbers"]]
    assert len(doubts) == (true > 1.1 or 0.03 < true < 1.0)
    for doubt in doubts:
        assert doubt["numbers"][cause] == pytest.approx({"elbow_joint": true}, rel=0.1)
        assert float(doubt["what"].partition(" leave ")[2].partition("%")[0]) > 30.0


@pytest.mark.parametrize(("times", "way"), [(1.3, 1.0), (1.3, 0.7), (-1.0, 1.0)])
def test_a_cause_is_what_ridge_regression_finds(times, way, monkeypatch):
    """Of dense equations in numbers and factors, with the priors as rows: few rows, so that these count."""
    # Also on the way to the best numbers, as where a bound keeps them from it
    monkeypatch.setattr(import_module("forcegp.fit.payloads"), "NAMED", 0.0)
    data = log(loaded(), 1, seconds=2.0, noise=0.5)
    model = data.model.with_forces(Payload("tool0", MASS, CENTER, INERTIA.tolist()))
    space = ParameterSpace(model.with_forces(Viscous()), typical_sizes(model, [data]))
    rows = RecordedRows(space, data.q, data.v, times * data.u)
    r, _, jacobian, _ = rows.in_torque(space.start, rows.moving(data.a))
    noise, one = np.sqrt((r**2).mean(0)), np.eye(space.size)
    J = (jacobian / noise[:, None]).reshape(r.size, -1)
    best = -way * np.linalg.lstsq(np.vstack([J, one]), np.append((r / noise).ravel(), np.zeros(space.size)))[0]
    left = r + (J @ best).reshape(r.shape) * noise
    found = Fit(space.start, left, jacobian, noise, one, best, 1, True)
    cause = misfit(space.model_at(space.start), [rows], [data.a], [left], lambda each: each[0] / noise[:, None], found)
    C = (-(rows.delivered + left)[:, :, None] * np.eye(6) / noise[:, None]).reshape(r.size, -1)
    both = np.block([[C, J], [np.eye(6) / 0.2, np.zeros((6, space.size))], [np.zeros((space.size, 6)), one]])
    expected = -np.linalg.lstsq(both, np.concatenate([(r / noise).ravel(), np.zeros(6 + space.size)]))[0]
    if times < 0.0:  # turned torques are no gains, though a linear step explains much by them
        assert 0.8 < abs(expected[:6]).max() < 1.6
        assert cause is None or cause[0] is None or "gains" not in cause[0].numbers
        return
    doubt, move, _ = cause
    assert 1.0 - 1.0 / np.array(list(doubt.numbers["gains"].values())) == pytest.approx(expected[:6], rel=1e-6)
    assert way < 1.0 or move == pytest.approx(expected[6:] - best, rel=1e-6)


CAUSED = [(15, 0, 1, 2), (7, 0, 1, 0), (70, 1000, 1, 1), (20, 1000, 1, 0), (45, 300, 4, 2), (25, 300, 4, 1)]
CAUSED += [(45, 300, 2, 1)]


@pytest.mark.parametrize(("nats", "rest", "joint", "told"), CAUSED)
def test_causes_are_named_from_ten_nats_on_and_from_a_twentieth_of_what_is_left(nats, rest, joint, told):
    """A torque a twentieth too small, and noise of u that no gain explains: in the interval alone, or named as well."""
    data, one = log(loaded(), 1, seconds=6.7), np.arange(6) == joint
    model = data.model.with_forces(Payload("tool0", MASS, CENTER, INERTIA.tolist()))
    space = ParameterSpace(model.with_forces(Viscous()), typical_sizes(model, [data]))
    rows = RecordedRows(space, data.q, data.v, data.u)
    noise = data.u.std(axis=0) * (len(data) / (nats * 800)) ** 0.5  # with which that are about so many
    jacobian = rows.in_torque(space.start, rows.moving(data.a))[2]

    def white(torques):
        return torques[0] / noise[:, None]

    def cause(left):
        noisy = RecordedRows(space, data.q, data.v, data.u - left)
        slope = -np.einsum("ri,rik->k", left / noise**2, jacobian)  # of the prior, at the best numbers
        found = Fit(space.start, left, jacobian, noise, np.eye(space.size), slope, 1, True)
        return misfit(space.model_at(space.start), [noisy], [data.a], [left], white, found)

    basis = np.linalg.qr(white([np.concatenate([jacobian, data.u[:, :, None] * np.eye(6)], axis=-1)]).reshape(2010, -1))
    other = np.random.default_rng(0).standard_normal(2010)
    other, wrong = (other - basis[0] @ (basis[0].T @ other)).reshape(-1, 6), 0.05 * data.u * one
    left = wrong * (nats / cause(wrong)[2]) ** 0.5 + noise * other * (2.0 * rest / np.square(other).sum()) ** 0.5
    found = cause(left)
    assert (found is not None) + (found is not None and found[0] is not None) == told


def test_constants_of_currents_are_found_with_the_payload():
    """Beside the masses of the URDF, whatever the unit; friction and rotors are unknown, too."""
    constants, data = np.array([12.0, 3.0, 0.4, 0.05, 1.7, 0.2]), log(loaded(), 1, noise=0.05)
    estimate = Found(replace(data, u=data.u / constants), laws=(*LAWS, Actuation(gain=None)), rows=800)
    found = [estimate.estimates[f"gain.{joint}"].value for joint in ROBOT.joint_names]
    assert np.array(found) / constants == pytest.approx(np.ones(6), rel=0.02)
    assert estimate.mass == pytest.approx(MASS, rel=0.01)


def test_a_load_that_was_weighed_shows_gains_without_the_masses_of_the_file():
    """All links 15 % heavier than the file: with a log of the empty arm, the load alone tells the scale."""
    heavier = TEXT
    for name in ("shoulder_lift_link", "elbow_link", "wrist_1_link"):
        link = ROBOT.link(name)
        body = 1.15 * link.mass, np.array(link.center_of_mass), 1.15 * np.array(link.inertia)
        heavier = replace_inertial(heavier, name, *body, source="x")
    known, empty = (log(text, seed, noise=0.05) for text, seed in ((loaded(text=heavier), 3), (heavier, 4)))
    known, empty = (replace(each, u=each.u / 1.1) for each in (known, empty))
    laws = (*LAWS, RigidBodies("all"), Actuation(gain=None), Payload("tool0", MASS, None))
    found = fit(known.model.with_forces(*laws), known, Torques(mean=0.4), baseline=empty, rows=800).parameters
    gains = [found[f"gain.{joint}"] for joint in ROBOT.joint_names]
    assert [each.value for each in gains[1:5]] == pytest.approx([1.1] * 4, rel=0.03)
    mass = found["payload.mass"]
    assert (mass.value, mass.std / mass.value) == (pytest.approx(MASS, rel=0.001), pytest.approx(0.0002, rel=0.3))


FINGER = """<joint name="{0}" type="revolute"><parent link="tool0"/><child link="{0}_link"/><axis xyz="0 0 1"/>{1}
<limit lower="-1" upper="1" effort="9" velocity="9"/></joint><link name="{0}_link"><inertial><origin xyz=".04 0 0"/>
<mass value=".05"/><inertia ixx="5e-5" iyy="5e-5" izz="4e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


def test_the_hand_carries_the_payload_of_fingers_that_follow_each_other():
    """On a finger, it would be inertia of the joint that drives both, and the rotor would have none."""
    fingers = FINGER.format("left", "") + FINGER.format("right", '<mimic joint="left" multiplier="-1"/>')
    robot = Robot.from_urdf_text(TEXT.replace("</robot>", f"{fingers}</robot>"))
    holding = robot.with_text(loaded(text=robot.urdf_text)).with_armature([0.1] * 6 + [0.0055])
    q, v, a = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 400, 7))
    u = holding.inverse_dynamics(*map(torch.tensor, (q, v, a))).numpy()
    rows = Dataset(q=q, v=v, u=u, a=a, time=0.02 * np.arange(400), model=Model(robot))
    estimate = Found(rows, laws=(Viscous(), Rotor()))
    assert estimate.link == "tool0"
    assert estimate.mass == pytest.approx(MASS, rel=0.01)
    assert estimate.estimates["rotor.left"].value == pytest.approx(0.0055, rel=0.05)


def test_the_payload_is_found_with_friction_and_rotors(found):
    assert found.link == "tool0"
    assert found.mass == pytest.approx(MASS, rel=0.005)
    np.testing.assert_allclose(found.center_of_mass, CENTER, atol=1e-3)
    assert found.estimates.settled
    for joint, rotor in zip(ROBOT.joint_names, ROTORS, strict=True):
        assert found.estimates[f"rotor.{joint}"].value == pytest.approx(rotor, rel=0.03)
        assert found.estimates[f"stribeck.level.{joint}"].value == pytest.approx(2.0 * rotor, rel=0.05)


def test_the_system_moves_as_the_loaded_robot(found):
    rows = log(loaded(), 2, friction=0.0)
    q, v, a = (torch.tensor(x[::50]) for x in (rows.q, rows.v, rows.a))
    robot = found.posterior.model.loaded_robot
    np.testing.assert_allclose(robot.inverse_dynamics(q, v, a).numpy() + a.numpy() * ROTORS, rows.u[::50], atol=0.1)
    assert pin.computeTotalMass(pin.buildModelFromXML(robot.to_urdf())) == pytest.approx(16.9939 + MASS, rel=1e-3)


def test_intervals_hold():
    """95 % intervals of mass and place over payloads and noise that no test has seen: 20 numbers, 17 at least."""
    held = 0
    for seed in range(5):
        rng = np.random.default_rng(seed)
        mass, center = rng.uniform(0.3, 3.0), rng.uniform(-0.08, 0.08, 3)
        text = replace_inertial(TEXT, "tool0", mass, center, INERTIA, source="a test")
        ends = Found(log(text, seed, noise=0.3), rows=800).intervals
        held += sum(low <= true <= high for (low, high), true in zip(ends, [mass, *center], strict=True))
    assert held >= 17


def test_a_baseline_takes_errors_of_the_urdf_away():
    """A forearm that is 20 % heavier than its URDF is no payload."""
    link = ROBOT.link("elbow_link")
    heavier = replace_inertial(
        TEXT, "elbow_link", 1.2 * link.mass, np.array(link.center_of_mass), 1.2 * np.array(link.inertia), source="x"
    )
    with_payload, without = log(loaded(text=heavier), 3, noise=0.05), log(heavier, 4, noise=0.05)
    with pytest.warns(DataWarning, match="masses of the links times 1.2"):
        alone = Found(with_payload, rows=800)
    together = Found(with_payload, laws=(*LAWS, RigidBodies("all")), baseline=without, rows=800)
    assert abs(alone.mass - MASS) > 0.05
    assert together.mass == pytest.approx(MASS, rel=0.01)
    np.testing.assert_allclose(together.center_of_mass, CENTER, atol=3e-3)


def test_no_payload_is_none():
    nothing = Found(log(TEXT, 5, noise=0.05), rows=800)
    assert nothing.mass < 0.02
    low, high = nothing.intervals[0]
    assert low < 0.01
    assert high < 0.1


def test_the_frame_is_that_of_the_link(found):
    """The same payload in the frame of the wrist, 82.3 mm before the tool."""
    wrist = Found(log(loaded(), 1, noise=0.05), link="wrist_3_link")
    assert wrist.mass == pytest.approx(found.mass, rel=1e-3)
    np.testing.assert_allclose(wrist.center_of_mass, found.center_of_mass + np.array([0.0, 0.0, 0.0823]), atol=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [({"link": "base"}, "does not move"), ({"link": "tool9"}, "tool9"), ({"baseline": "empty.h5"}, "baseline|dataset")],
)
def test_what_makes_no_sense_is_refused(change, message):
    with pytest.raises(ForceGPError, match=message):
        Found(log(TEXT, 0, seconds=10.0), **change)
    with pytest.raises(DatasetError, match="100 rows; a payload needs 200"):
        Found(log(TEXT, 0, seconds=2.0))


UNIVERSAL = """<mujoco><compiler angle="radian"/><worldbody><body name="upper"><joint name="x" axis="1 0 0"/>
<joint name="y" axis="0 1 0"/><inertial pos="0 0 .2" mass="2" diaginertia=".03 .03 .01"/><body name="fore" pos="0 0 .4">
<joint name="elbow" axis="0 1 0"/><inertial pos="{0} 0 .15" mass="{1}" diaginertia=".02 .02 .01"/>
</body></body></worldbody></mujoco>"""


def test_two_joints_in_one_body_have_no_mass_between_them():
    """MuJoCo's inverse dynamics of a forearm with a payload of 0.5 kg, under a joint with two axes."""
    mujoco, file = pytest.importorskip("mujoco"), UNIVERSAL.format(0, 1)
    model = mujoco.MjModel.from_xml_string(UNIVERSAL.format(0.05 * 0.5 / 1.5, 1.5))
    state, time = mujoco.MjData(model), np.arange(0.0, 10.0, 0.01)
    at = np.array([0.9, 1.3, 1.7]) * time[:, None] + np.arange(3)
    rows = np.sin(at), np.array([0.9, 1.3, 1.7]) * np.cos(at), -(np.array([0.9, 1.3, 1.7]) ** 2) * np.sin(at)
    u = np.empty_like(at)
    for row, (q, v, a) in enumerate(zip(*rows, strict=True)):
        state.qpos, state.qvel, state.qacc = q, v, a
        mujoco.mj_inverse(model, state)
        u[row] = state.qfrc_inverse
    model = Model(Robot.from_mjcf_text(file))
    data = Dataset(q=rows[0], v=rows[1], u=u, a=rows[2], time=time, model=model)
    held = Found(data, link="fore")
    assert held.mass == pytest.approx(0.5, rel=1e-3)
    assert held.center_of_mass[:2] == pytest.approx([0.05, 0.0], abs=1e-3)
    identified = fit(model.with_forces(RigidBodies(dict.fromkeys(("upper", "fore"), Body(1e-6)))), data, Torques())
    assert body_names(model.robot) == ("upper", "fore")
    np.testing.assert_allclose(motion_residuals(data, identified.model)[0], 0.0, atol=1e-3)
