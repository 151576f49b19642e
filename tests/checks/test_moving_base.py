"""Logs of bases that move: what a state estimator may have meant by its columns."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.checks.corruptions import numbers
from tests.goldens.compare import assert_unchanged

from forcegp import Dataset, Model, Robot, check, import_recordings
from forcegp.checks import quick_check
from forcegp.checks.moving_base import _explained, base_doubts, carried_doubts, stance_doubts, unmeasured_base_doubts
from forcegp.data.configurations import rates
from forcegp.data.dataset import IMU
from forcegp.data.imu import expected
from forcegp.forces import Actuation, RigidBodies, Thrusters
from forcegp.recordings import ColumnMapping
from forcegp.simulation import QuadrupedConfig, simulate_quadruped

BODY = """<robot name="drone"><link name="body"><inertial><mass value="2"/>
<inertia ixx="0.03" iyy="0.03" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


@pytest.fixture(scope="module")
def log():
    return simulate_quadruped(QuadrupedConfig(seconds=4.0, seed=5, noise=0.05))


def test_a_clean_log_has_no_doubt(log):
    assert not quick_check(log)


def turned_about_z(log, turn):
    """The same with its base turned about its own z axis, and its rotation to the world."""
    spin = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, turn, *[0.0] * 12], dtype=torch.float64)
    q = log.model.robot.integrate(torch.tensor(log.q), spin).numpy()
    q[:, :3] = log.q[:, :3]
    back, v, a = Rotation.from_euler("z", -turn), log.v.copy(), log.a.copy()
    for x in (v, a):
        x[:, :3], x[:, 3:6] = back.apply(x[:, :3]), back.apply(x[:, 3:6])
    return replace(log, q=q, v=v, a=a), Rotation.from_quat(q[:, 3:7])


def test_velocities_in_the_axes_of_the_world_are_named(log):
    turned, rotation = turned_about_z(log, 1.2)  # far from upright, where body and world differ

    def found(q=turned.q, **v):
        return quick_check(replace(turned, q=q, v=np.hstack([v["linear"], v["angular"], turned.v[:, 6:]]))).of("base")

    linear, angular = turned.v[:, :3].copy(), turned.v[:, 3:6].copy()
    assert not found(linear=linear, angular=angular)
    doubt = found(linear=rotation.apply(linear), angular=rotation.apply(angular))[0]
    assert doubt.what.startswith("positions of 'base' change as if it had velocities in the axes of the world")
    assert "--axes v=world" in doubt.command
    doubt = found(linear=rotation.apply(linear), angular=angular)[0]
    assert "linear velocities in the axes of the world" in doubt.what
    assert "--axes v=world,body" in doubt.command
    q = np.hstack([turned.q[:, :3], np.roll(turned.q[:, 3:7], 1, axis=1), turned.q[:, 7:]])
    doubt = found(q, linear=rotation.apply(linear), angular=angular)[0]
    assert "--orientation wxyz --axes v=world,body" in doubt.command


def test_an_accelerometer_is_no_acceleration(log):
    a, rotation = log.a.copy(), log.model.robot.frame_pose(torch.tensor(log.q), "trunk")[:, :3, :3].numpy()
    a[:, :3] += np.cross(log.v[:, 3:6], log.v[:, :3]) + 9.81 * rotation[:, 2, :]
    (doubt,) = quick_check(replace(log, a=a))
    assert (doubt.about, doubt.level) == ("base acceleration", "wrong")
    assert "--axes a=imu" in doubt.command
    a[:, :3] *= -1.0
    (doubt,) = quick_check(replace(log, a=a))
    assert (doubt.about, doubt.level) == ("base acceleration", "look")


def test_accelerations_in_world_axes_are_named_also_where_they_are_no_larger_than_the_true_ones(log):
    turned, rotation = turned_about_z(log, 0.9)
    assert not quick_check(turned).of("base acceleration")
    v, world = turned.v, turned.a.copy()
    world[:, :3] = rotation.apply(world[:, :3] + np.cross(v[:, 3:6], v[:, :3]))
    world[:, 3:6] = rotation.apply(world[:, 3:6])
    (doubt,) = quick_check(replace(turned, a=world)).of("base acceleration")
    assert doubt.level == "wrong"
    assert doubt.numbers["error"] < 2.0 * doubt.numbers["size"]
    assert "--axes a=world" in doubt.command


@pytest.mark.parametrize("what", ["deg/s", "sign"])
def test_velocities_of_the_joints_are_compared_beside_a_base(log, what, tmp_path):
    """The mistake is named, flags of feet are not blamed for it, and its correction leaves the base as it was."""
    mistaken = np.ones(log.nv)
    mistaken[6:] = 180.0 / np.pi if what == "deg/s" else 1.0
    mistaken[8] *= 1.0 if what == "deg/s" else -1.0
    columns = {"t": log.time} | {
        f"{name}{k}": x[:, k]
        for name, x in (("q", log.q), ("v", log.v * mistaken), ("u", log.u))
        for k in range(x.shape[1])
    }
    table = np.column_stack(list(columns.values()))
    np.savetxt(tmp_path / "log.csv", table, "%.12g", ",", header=",".join(columns), comments="")
    signals = {name: (f"{name}{{0..{getattr(log, name).shape[1] - 1}}}",) for name in "qvu"}
    mapping = ColumnMapping(time="t", **signals)
    wrong = import_recordings([tmp_path / "log.csv"], mapping, model=log.model)
    (doubt,) = quick_check(wrong)
    assert (doubt.level, doubt.about) == ("wrong", "velocity")
    assert [each.about for each in check(wrong).doubts if each.level == "wrong"] == ["velocity"]
    units = ["m/s"] * 3 + ["rad/s"] * 3 + ["deg/s"] * 12
    assert (f"--unit v={','.join(units)};" if what == "deg/s" else "--sign v=1,1,1,1,1,1,1,1,-1,1,") in doubt.advice
    corrected = mapping.corrected_by(doubt.correction, log.joint_names, {})
    right = import_recordings([tmp_path / "log.csv"], corrected, model=log.model)
    np.testing.assert_allclose(right.v, log.v, atol=1e-9)
    assert not [each for each in quick_check(right) if each.level == "wrong"]


def test_a_base_that_does_not_fall_although_nothing_acts_on_it(log):
    names = [name for name in log.model.inputs if not name.endswith("_stands")]
    bare = replace(log, u=log.u[:, : len(names)], model=log.model.with_contacts([]), truth={})
    (doubt,) = [each for each in check(bare).doubts if each.level == "wrong"]
    assert doubt.about == "base force"
    assert doubt.numbers["force"] == pytest.approx(17.2 * 9.81, rel=0.05)  # the robot without its load
    q, v, u = (torch.tensor(x) for x in (bare.q, bare.v, bare.u))
    falls = bare.model.dynamics(q, v, 0.0 * u).acceleration_map().offset.numpy()
    assert not [each for each in check(replace(bare, a=falls)).doubts if each.about == "base force"]
    lifted = replace(log, u=np.hstack([bare.u, np.zeros((len(log), 4))]), truth={})
    (carried,) = [each for each in check(lifted).doubts if each.about == "base force"]
    assert (carried.level, carried.numbers) == ("wrong", pytest.approx(doubt.numbers, rel=1e-9))
    assert "--feet" in carried.advice


@pytest.mark.nightly
@pytest.mark.parametrize(("order", "shift"), [("wxyz", -1), ("xyzw", 1)])
def test_the_order_of_quaternions_of_a_robot_that_stays_upright(order, shift):
    """Its rates are a small part of its speed, and either order of the log may have been stated."""
    time, robot = np.arange(2000) / 200, Robot.from_urdf_text(BODY, base="floating")
    v, q = np.zeros((2000, 6)), [robot.neutral()]
    for k in range(6):
        v[:, k] = (1.0 if k < 3 else 0.1) * np.sin((k + 2) * time)
    for step in torch.tensor(v[:-1] + np.diff(v, axis=0) / 2) / 200:
        q.append(robot.integrate(q[-1], step))
    q = torch.stack(q).numpy()
    actual = "xyzw" if order == "wxyz" else "wxyz"
    true = Dataset(q=q, v=v, u=np.zeros((2000, 0)), a=np.gradient(v, time, axis=0), time=time,
                   model=Model(robot, (), (RigidBodies(),)))  # fmt: skip
    assert not [each for each in quick_check(true) if each.about == "base"]
    turn = Rotation.from_quat(q[:, 3:])
    q[:, 3:] = np.roll(q[:, 3:], shift, axis=1)  # as read in the wrong order, with linear velocities in world axes
    v = np.hstack([Rotation.from_quat(q[:, 3:]).inv().apply(turn.apply(v[:, :3])), v[:, 3:]])
    stated = {"import": {"mapping": {"orientation": order, "axes": {"v": ["world", "body"]}}}}
    (doubt,) = [each for each in quick_check(replace(true, q=q, v=v, metadata=stated)) if each.about == "base"]
    assert (doubt.level, doubt.correction) == ("wrong", {"orientation": {"q": (actual,)}})


def test_a_base_in_millimetres(log):
    q, v, a = log.q.copy(), log.v.copy(), log.a.copy()
    for values in (q, v, a):
        values[:, :3] *= 1000.0
    bare = replace(log, q=q, v=v, a=a, u=log.u[:, :12], model=log.model.with_contacts([]), truth={})
    (doubt,) = [each for each in check(bare).doubts if each.about == "base force"]
    assert doubt.level == "wrong"
    assert "--unit q=mm" in doubt.advice


FLYING = 400.0  # Hz


def flight(seed: int = 0, noise: bool = True) -> tuple[Dataset, np.ndarray]:
    """A drone that flies to and fro, as motion capture sees it (1 mm, 0.2 degrees), and its velocities in the world."""
    time, draw = np.arange(2400) / FLYING, np.random.default_rng(seed).normal
    size, turns = np.array([1.5, 1.2, 0.4]), np.array([1.3, 1.9, 1.1])
    position, velocity = (size * np.sin(turns * time[:, None])), size * turns * np.cos(turns * time[:, None])
    up = (-size * turns**2 * np.sin(turns * time[:, None])) + np.array([0.0, 0.0, 9.81])
    length = np.linalg.norm(up, axis=1, keepdims=True)
    side = np.cross(up / length, [1.0, 0.3, 0.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    turned = Rotation.from_matrix(np.stack([np.cross(side, up / length), side, up / length], axis=2))
    turning = np.zeros((2400, 3))
    turning[1:-1] = (turned[:-2].inv() * turned[2:]).as_rotvec() * FLYING / 2.0
    speeds = np.sqrt(2.0 * length / 4.0 / 1e-5) * np.ones(4)  # of rotors whose thrusts are equal, rad/s
    rotors = Thrusters("body", [(0.1, 0.1, 0), (-0.1, 0.1, 0), (0.1, -0.1, 0), (-0.1, -0.1, 0)], thrust=1e-5, power=2)
    model = Model(Robot.from_urdf_text(BODY, base="floating"), (), (Actuation(), rotors, RigidBodies()))
    jitter = Rotation.from_rotvec(np.deg2rad(0.2) * noise * draw(size=(2400, 3)))
    q = np.hstack([position + 0.001 * noise * draw(size=(2400, 3)), (turned * jitter).as_quat()])
    world = velocity + 0.02 * noise * draw(size=(2400, 3))
    v = np.hstack([(turned * jitter).inv().apply(world), turning])
    log = {"q": q, "v": v, "u": speeds, "a": np.gradient(v, time, axis=0), "time": time}
    return Dataset(**log, model=model).rows(slice(2, -2)), world[2:-2]


def test_an_imu_of_a_robot_with_legs_is_checked():
    log = simulate_quadruped(QuadrupedConfig(seconds=2.0, seed=0))
    name = f"{IMU}{log.model.robot.layout.bodies[5].child}"
    sensed = replace(log, measured={name: expected(log, log.model, name)})
    assert [each.level for each in check(sensed).doubts.of("imu")] == ["ok"]


def with_w_first(log: Dataset, world: np.ndarray) -> Dataset:
    """The log as an import reads it that was given linear velocities of the world, and not the order of quaternions."""
    q, v = log.q.copy(), log.v.copy()
    q[:, 3:7] = np.roll(q[:, 3:7], 1, axis=1)
    v[:, :3] = Rotation.from_quat(q[:, 3:7]).inv().apply(world)
    stated = {"import": {"mapping": {"axes": {"v": ["world", "body"]}}}}
    return replace(log, q=q, v=v, a=np.gradient(v, log.time, axis=0), metadata=stated)


def test_what_a_log_at_a_high_rate_means_is_named():
    log, world = flight()
    (doubt,) = quick_check(with_w_first(log, world))
    assert (doubt.level, doubt.correction) == ("wrong", {"orientation": {"q": ("wxyz",)}})
    v = np.hstack([world, log.v[:, 3:]])
    (doubt,) = quick_check(replace(log, v=v, a=np.gradient(v, log.time, axis=0)))
    assert (doubt.level, doubt.correction) == ("wrong", {"axes": {"v": ("world", "body")}})
    stated = {"import": {"mapping": {"axes": {"v": ["world"]}}}}  # rates of the body, turned as those of the world
    v = np.hstack([log.v[:, :3], Rotation.from_quat(log.q[:, 3:7]).inv().apply(log.v[:, 3:].copy())])
    (doubt,) = quick_check(replace(log, v=v, a=np.gradient(v, log.time, axis=0), metadata=stated))
    assert (doubt.level, doubt.correction) == ("wrong", {"axes": {"v": ("world", "body")}})
    assert "angular velocities in the axes of the base" in doubt.what


@pytest.mark.parametrize("speeds", [1.0, 60.0 / (2.0 * np.pi)])
@pytest.mark.parametrize("w_first", [False, True])
def test_thrust_shows_the_unit_of_rotors_and_the_order_of_quaternions(w_first, speeds):
    """Velocities that were derived from such quaternions agree with them."""
    log, _ = flight(noise=False)
    q, stated = log.q.copy(), {}
    if w_first:
        q[:, 3:7] = np.roll(q[:, 3:7], 1, axis=1)
        stated["orientation"] = {"q": ("wxyz",)}
    if speeds != 1.0:
        stated["unit"] = {"u": ("rpm",)}
    v = rates(log.model.robot.space, q, log.time)
    read = replace(log, q=q, v=v, u=speeds * log.u, a=np.gradient(v, log.time, axis=0)).rows(slice(3, -3))
    assert [each.correction for each in quick_check(read)] == ([stated] if stated else [])


def test_rows_that_were_left_out_are_no_jumps():
    log, _ = flight(noise=False)
    (doubt, *_) = check(log.rows(np.flatnonzero(np.arange(len(log)) % 800 < 50))).doubts.of("base")
    assert doubt.numbers["as recorded"] < 1e-4 * doubt.numbers["speed"]  # across gaps a quarter


def test_what_is_said_of_growing_mistakes(log):
    found = {}
    drone, world = (x[:800] if isinstance(x, np.ndarray) else x.rows(slice(0, 800)) for x in flight(seed=1))
    wrong_v, wrong_a = np.zeros((2, 800, 6))
    wrong_v[:, :3] = world - drone.v[:, :3]
    wrong_a[:, :3] = Rotation.from_quat(drone.q[:, 3:7]).inv().apply([0.0, 0.0, 9.81])
    wrong_a[:, :3] += np.cross(drone.v[:, 3:], drone.v[:, :3])
    for size in (0.3, 0.8, 1.5):
        found[f"v {size}"] = numbers(base_doubts(replace(drone, v=drone.v + size * wrong_v), drone.model))
        found[f"a {size}"] = numbers(base_doubts(replace(drone, a=drone.a + size * wrong_a), drone.model))
        found[f"u {size}"] = numbers(carried_doubts(replace(drone, u=size * drone.u), drone.model))
    few = log.rows(slice(240, 480))
    for share in (0.004, 0.03, 0.07):
        flips, some = few.u.copy(), np.random.default_rng(0).random(len(few)) < share
        flips[some, 12:] = 1.0 - flips[some, 12:]
        found[f"flags {share}"] = numbers(list(stance_doubts(replace(few, u=flips, truth={}), few.model))[2:])
    lifted = np.where(np.arange(few.u.shape[1]) < 12, few.u, 0.0)
    noise, other = torch.randn(2, 300, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for size in (0.1, 0.4, 0.8, 1.3, 2.0):
        mixed = [_explained(noise + share * size * other, size * other) for share in (0.4, 0.6, 0.75, 1.0, 1.25, 1.4)]
        found[f"explained {size}"] = mixed
    still = replace(few, q=few.q[:1] + 0.0 * few.q, v=0.0 * few.v, a=0.0 * few.a, truth={})
    turning, gliding, moving = still.v.copy(), still.v.copy(), few.v * (np.arange(few.nv) > 5)
    turning[7, 4] = gliding[:, 0] = 1e-3
    for name, v in (("still", still.v), ("moving", moving), ("turning", moving + turning), ("gliding", gliding)):
        found[name] = [each.what for each in unmeasured_base_doubts(replace(still, v=v), few.model)]
    found["row"] = list(unmeasured_base_doubts(replace(still, v=moving).rows([0]), few.model))
    found["no feet"] = numbers(carried_doubts(replace(few, u=lifted, truth={}), few.model))
    assert_unchanged("checks/bases", found, rtol=1e-5)
