"""Force sensors beside torques and motion: MuJoCo's arm with gears that stick, pushed at the hand; a real leg."""

import re
from dataclasses import replace
from functools import cache

import mujoco as untyped
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.evidence.arm_in_mujoco import followed
from tests.posterior.arm import URDF, arm_model

from forcegp import Accelerations, ContactForces, Dataset, Model, Robot, Torques, check, fit
from forcegp.data import Preparation
from forcegp.errors import InvalidInput
from forcegp.fit import held_out_noise
from forcegp.fit.force_sensors import force_sensor_doubts, with_touches
from forcegp.forces import Actuation, Viscous
from forcegp.mechanics import fixed_frame, fixed_point
from forcegp.scores.models import identified_model, identify

mujoco = untyped
DRY, RATE = np.array([0.3, 0.4, 0.2]), 250


def pushes(q):
    return np.array([6.0 * np.sin(5.0 * q[0]), -8.0 * np.sin(4.0 * q[1] + 1.0), 7.0 * np.cos(3.0 * q[2])])


@cache
def recorded(pushed=True, seed=0):
    """The log, the force on the hand, the axes of the hand, and what a sensor at the wrist measures of the hand."""
    plant = []

    def prepare(spec):
        spec.body("hand").add_site(name="hand")
        for kind in (mujoco.mjtSensor.mjSENS_FORCE, mujoco.mjtSensor.mjSENS_FRAMEQUAT):
            spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="hand")
        model = spec.compile()
        model.dof_armature[:] = [0.1, 0.15, 0.04]
        plant[:] = model, mujoco.MjData(model)
        return model

    def taken(q, v):
        model, data = plant
        data.qpos[:], J = q, np.zeros((3, 3))
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacBody(model, data, J, None, model.body("hand").id)
        return DRY * np.tanh(v / 0.01) - pushed * J.T @ pushes(q)

    (q, v, u, a, sensed), rng = followed(prepare, 12, RATE, 4, taken, seed)
    force = pushed * np.array([*map(pushes, q)]) + 0.02 * rng.standard_normal(q.shape)
    R, model = Rotation.from_quat(sensed[:, [4, 5, 6, 3]]).as_matrix(), replace(arm_model(0), contacts=())
    log = Dataset(q=q, v=v, u=u + 0.01 * rng.standard_normal(u.shape), a=a, time=np.arange(len(q)) / RATE, model=model)
    return log, force, R, (R @ sensed[:, :3, None])[..., 0]


def told(force, log=None):
    log = replace(recorded()[0] if log is None else log, measured={"force.hand": force})
    return list(force_sensor_doubts(log, log.model))


def in_hand(R, values):
    return (R @ np.broadcast_to(values, (len(R), 3))[..., None])[..., 0]


TIME = np.linspace(-0.5, 0.5, 12 * RATE)[:, None]
MISTAKES = {
    "none": (lambda F, R: F, "ok", r"leaves 0\.03\d* %"),
    "sign": (lambda F, R: -F, "wrong", r"as \(-x, -y, -z\); (.|\n)*or turn all torques"),
    "order": (lambda F, R: F[:, [1, 2, 0]], "wrong", r"as \(z, x, y\); (.|\n)*hand=X,Y,Z\."),
    "mirrored": (lambda F, R: F * [1.0, -1.0, 1.0], "wrong", r"as \(x, -y, z\)"),
    "of the hand": (lambda F, R: in_hand(R.mT, F), "wrong", "along the axes of the frame; (.|\n)*--axes force=body"),
    "turned twice": (lambda F, R: in_hand(R, F), "wrong", "along the axes of the world; (.|\n)*--axes force=world"),
    "kN": (lambda F, R: F / 1000.0, "look", "in kN, or torques are off"),
    "kgf": (lambda F, R: F / 9.80665, "look", "--unit force=kgf"),
    "a gain of 12": (lambda F, R: F / 12.0, "ok", "leaves"),
    "not tared": (lambda F, R: F + in_hand(R, [1.2, 0.0, -0.6]), "look", r"off by \(1.18, -0.08\d*, -0.57\d*\) N"),
    "drift": (
        lambda F, R: F + in_hand(R, TIME * [4.0, 0.0, 3.0]), "look", r"drifts by \((4.0|3.9)\d, .*, (2.9|3.0)\d*\) N",
    ),
    "a step": (lambda F, R: F + in_hand(R, (TIME > 0.34) * [3.0, 0.0, -2.0]), "ok", "leaves 3"),
    "a faint signal": (lambda F, R: 2.0 * np.random.default_rng(0).normal(size=F.shape), "look", "does not follow"),
    "a fainter one": (lambda F, R: 0.8 * np.random.default_rng(0).normal(size=F.shape), "ok", "hardly notice"),
    "another signal": (lambda F, R: 5.0 * np.random.default_rng(0).normal(size=F.shape), "look", "does not follow"),
}  # fmt: skip


def test_a_late_sensor_and_a_weight_that_counts_twice():
    found = told(np.roll(recorded()[1], 5, axis=0))
    assert found[1].about == "sensor delay"
    assert found[1].numbers["delay"] == pytest.approx(0.02, abs=0.001)
    log, force, _, held = recorded(pushed=False)
    for sign, words in ((-1.0, "counts twice"), (1.0, "give the columns with a minus")):
        [doubt] = told(sign * held + force, log)
        assert doubt.numbers["mass"] == pytest.approx(-0.6 * sign, rel=0.02)  # of the hand
        assert words in doubt.do
    assert "hardly notice" in told(force, log)[0].what


def carrying(seed=0):
    """A log whose file has no hand: a light tool under gears that stick; the sensor there, and its axes."""
    log, noise, R, held = recorded(False, seed)
    bare = Robot.from_urdf_text(URDF.replace('mass value="0.6"', 'mass value="0.01"'))
    return replace(log, model=log.model.with_robot(bare)), noise - held, R


HANGS = r"0\.6 kg at \(20, -10, 50\) mm need there as "
TURNED = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
OF_TOOLS = {
    "none": (lambda F, R: F, "ok", r"carries 0\.6 kg at \(20, -10, 50\) mm, and torques need 0\.9[78]\d* times"),
    "sign": (lambda F, R: -F, "wrong", HANGS + r"\(-x, -y, -z\);(.|\n)*give the columns with a minus"),
    "turned": (lambda F, R: in_hand(R, in_hand(R.mT, F) @ TURNED), "wrong", r"as \(y, -x, z\) along the axes of the"),
    "of the hand": (lambda F, R: in_hand(R.mT, F), "wrong", HANGS + r"\(x, y, z\) (.|\n)*--axes force=body --force"),
    "turned twice": (lambda F, R: in_hand(R, F), "wrong", HANGS + r"\(x, y, z\) (.|\n)*--axes force=world --force"),
    "kgf": (lambda F, R: F / 9.80665, "look", r"0\.6 kg at \(20, -10, 50\) mm if it (.|\n)*--unit force=kgf\."),
    "not tared": (lambda F, R: F + in_hand(R, [0.7, 0.0, -0.4]), "look", r"off by \(0\.7\d*, -?\S+, -0\.4\d*\) N"),
    "dead": (lambda F, R: in_hand(R, [0.0, 0.0, 3.0]), "ok", "hardly notice"),
    "it touches": (lambda F, R: F + 0.2 * recorded()[1], "look", "does not follow"),
}


@pytest.mark.parametrize(
    ("log", "mistake"), [*((recorded, each) for each in MISTAKES), *((carrying, each) for each in OF_TOOLS)]
)
def test_what_is_wrong_with_a_sensor_is_told_also_by_the_motion_of_a_tool(log, mistake):
    change, level, words = (OF_TOOLS if log is carrying else MISTAKES)[mistake]
    own, force, R, *_ = log()
    doubt, *others = told(change(force, R), own)
    assert (doubt.level, others) == (level, [])
    assert re.search(words, str(doubt)), str(doubt)


def test_a_tool_shows_a_delay_and_columns_keep_their_names(monkeypatch):
    log, force, R = carrying()
    _, late = told(in_hand(R, np.roll(in_hand(R.mT, force), 5, axis=0)), log)
    assert late.numbers["delay"] == pytest.approx(0.02, abs=0.002)
    monkeypatch.setitem(force_sensor_doubts.__globals__, "MOST_ROWS", 2000)
    [doubt] = told(-force, replace(log, metadata={"import": {"columns": {"force.hand": ["F[0]", "F[1]", "F[2]"]}}}))
    assert "hand=-F[0],-F[1],-F[2]," in doubt.do


@pytest.mark.parametrize("seed", [1, *(pytest.param(k, marks=pytest.mark.nightly) for k in range(2, 5))])
def test_a_right_sensor_gets_no_false_word(seed):
    log, force, R = carrying(seed)
    noise = np.random.default_rng(seed).normal(size=force.shape)
    for F in (force, force + 0.5 * noise):
        assert [doubt.level for doubt in told(F, log)] == ["ok"]
    [doubt] = told(force - in_hand(R, force[0]), log)
    assert (doubt.level, "is off by" in doubt.what) == ("look", True)


def test_what_an_arm_feels_is_added_to_its_torques():
    """Its power is that of the force on the way of the hand."""
    log, force, *_ = recorded()
    log, doubts = replace(log, measured={"force.hand": force, "imu.hand": force}), told(force)
    places, (rows, [felt]) = log.model.robot.frame_pose(torch.tensor(log.q), "hand"), with_touches(log, doubts)
    power = (force * np.gradient(places[:, :3, 3].numpy(), 1.0 / RATE, axis=0)).sum(1)
    np.testing.assert_allclose(((rows.u - log.u) * log.v).sum(1)[1:-1], power[1:-1], atol=1e-3 * np.abs(power).max())
    assert ([*rows.measured], "is added to u" in felt.what) == (["imu.hand"], True)
    for each, said in (replace(log, model=arm_model(0).with_contacts(fixed_point("hand"))), doubts), (log, []):
        assert with_touches(each, said) == (each, [])


@pytest.mark.nightly
def test_a_sensor_that_does_not_teach_is_no_force():
    log, force, _ = carrying()
    rows, words = replace(log, measured={"force.hand": force}).rows(np.arange(0, 3000, 6)), "bodies+viscous+gear"
    with_sensor, without = (
        identified_model(f"{words}@accelerations", log.model, each).noise for each in (rows, replace(rows, measured={}))
    )
    assert with_sensor == without
    assert identify(rows, f"{words}@torques")[0] == f"{words}@torques"  # no spring explains it
    with pytest.raises(InvalidInput, match="where the model has no contact"):
        held_out_noise(log.model.with_forces(Viscous()), rows, Accelerations())


def test_short_logs_and_two_points_tell_nothing_and_known_gains_count():
    log, force, _, _ = recorded()
    held = log.model.with_contacts(fixed_frame("hand"))
    assert "too short" in told(-force[:500], log.rows(slice(0, 500)))[0].what
    assert list(force_sensor_doubts(replace(log, measured={"force.hand": -force}), held)) == []
    weak = replace(log, u=2.0 * log.u, model=log.model.with_forces(Actuation(gain=0.5)))
    assert told(force, weak)[0].numbers["factor"] == pytest.approx(1.0, abs=0.01)


def test_a_fit_refuses_what_is_wrong():
    log, force, _, _ = recorded()
    wrong = replace(log, measured={"force.hand": -force})
    assert check(wrong).doubts.of("force sensor").level == "wrong"
    with pytest.raises(InvalidInput, match="or turn all torques"):
        fit(log.model.with_forces(Actuation(gain=None), Viscous()), wrong, [Torques(), ContactForces("hand")])


@pytest.mark.parametrize(("sign", "level"), [(1.0, "ok"), (-1.0, "wrong")])
def test_a_real_leg(shared, sign, level):
    realdata = shared("realdata")
    time, *columns = np.loadtxt(realdata / "hopper" / "hopper_A.csv.gz", delimiter=",", skiprows=1).T
    q, u, force = (np.array(columns[k : k + 3]).T for k in (0, 3, 6))
    model = Model(Robot.from_urdf(realdata / "hopper" / "teststand.urdf"), fixed_point("contact"))
    raw = Dataset(q=q, v=0.0 * q, u=u, a=0.0 * q, time=time, model=model, measured={"force.contact": sign * force})
    log = Preparation(cutoff=20.0, every=5, trim=0.2).apply(raw)
    assert [each.level for each in force_sensor_doubts(log, model)] == [level]
