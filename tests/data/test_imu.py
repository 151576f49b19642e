"""IMUs against MuJoCo's accelerometers, and what is said of logs with a mistake planted."""

from dataclasses import replace
from functools import cache

import mujoco as untyped
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.evidence.arm_in_mujoco import followed
from tests.posterior.arm import arm_model
from tests.robots.mjcf_models import QUADRUPED
from tests.robots.mujoco_oracle import MujocoOracle, states
from tests.robots.test_mjcf import read

from forcegp import check
from forcegp.data import Dataset, Preparation
from forcegp.data.dataset import IMU
from forcegp.data.imu import expected, imu_doubts, specific_force
from forcegp.doubts import Doubts

mujoco = untyped
POINT, TURN = (0.03, -0.02, 0.1), (0.3, -0.5, 1.0)
NAME = f"{IMU}hand@{','.join(map(str, (*POINT, *TURN)))}"
RATE = 500


def with_accelerometer(spec, body):
    spec.body(body).add_site(name="at", pos=POINT, quat=Rotation.from_euler("xyz", TURN).as_quat(scalar_first=True))
    spec.add_sensor(type=mujoco.mjtSensor.mjSENS_ACCELEROMETER, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="at")
    return spec.compile()


def test_specific_forces_of_a_moving_base_are_those_of_mujoco():
    robot, body = read(QUADRUPED), "fl_shank"
    oracle = MujocoOracle(with_accelerometer(mujoco.MjSpec.from_string(QUADRUPED), body))
    for q, v, push in zip(*states(robot), strict=True):
        oracle.data.qfrc_applied[:] = 20.0 * push.numpy()
        oracle.at(q.numpy(), v.numpy())
        a = torch.tensor(np.linalg.solve(oracle.T, oracle.data.qacc - oracle.drift))
        found = specific_force(robot.kinematics(q, v), NAME.replace("hand", body))(a)
        np.testing.assert_allclose(found, oracle.data.sensordata, atol=1e-9 * abs(oracle.data.sensordata).max())


@cache
def recorded():
    """An arm with viscous friction that follows sines: as it was, and with an encoder and derived v and a."""
    (q, v, u, a, f), rng = followed(lambda spec: with_accelerometer(spec, "hand"), 8, RATE, 2)
    time = np.arange(len(q)) / RATE
    true = Dataset(q=q, v=v, u=u, a=a, time=time, model=arm_model(0), measured={NAME: f})
    q, (u, f) = np.round(q / 5e-4) * 5e-4, (x + 0.05 * rng.standard_normal(x.shape) for x in (u, f))
    v = np.gradient(q, time, axis=0)
    return replace(true, q=q, v=v, u=u, a=np.gradient(v, time, axis=0), measured={NAME: f}), true


def changed(change, cutoff=10.0):
    raw, _ = recorded()
    f = change(raw.measured[NAME], expected(replace(raw, v=0.0 * raw.v, a=0.0 * raw.a), raw.model, NAME), raw.time)
    return Preparation(cutoff=cutoff).apply(replace(raw, measured={NAME: f}))


def turned(y, bias=0.0):
    return lambda f, *_: f @ Rotation.from_rotvec([0.0, y, 0.0]).as_matrix() + [0.0, bias, 0.0]


def late(f, _, time):
    return np.stack([np.interp(time - 0.012, time, x) for x in f.T], 1)


@pytest.mark.parametrize(
    ("change", "level", "words"),
    [
        (lambda f, *_: f, "ok", "differs by 0.0"), (lambda f, *_: -f, "wrong", "1.0=-x,-y,-z"),
        (lambda f, *_: f[:, [1, 0, 2]] * [1, -1, 1], "wrong", "it is -y,x,z of its frame's x,y,z"),
        (lambda f, *_: f / 9.80665, "wrong", "it is in g. forcegp import --unit imu=g"),
        (lambda f, at_rest, _: f - at_rest, "wrong", "it is without gravity"),
        (lambda f, *_: 2.0 * f, "wrong", "Compare its frame, point, axes and unit"),
        (turned(0.034), "look", "turned by 1.9 degrees"), (turned(0.08), "wrong", "turned by 4.6 degrees"),
        (turned(0.1, bias=0.6), "look", "Compare its frame"),
        (turned(1.2), "wrong", "turned by 69 degrees. State it"), (late, "look", "11.4 ms later than the motion"),
    ],
)  # fmt: skip
def test_check_names_what_is_wrong(change, level, words):
    rows = changed(change)
    found = Doubts(imu_doubts(rows, rows.model))
    assert (found.level, words in str(found)) == (level, True), str(found)
    assert check(rows).doubts.of("imu").level == found.of("imu").level


def test_differences_are_those_of_means_over_a_tenth_of_a_second():
    rows = changed(late, cutoff=60.0)
    difference = rows.measured[NAME] - expected(rows, rows.model, NAME)
    means = np.stack([np.convolve(x, np.full(50, 0.02), "valid") for x in difference.T])
    first, *others = imu_doubts(rows, rows.model)
    assert first.numbers["error"] == pytest.approx(np.sqrt((means**2).sum(0).mean()))
    assert not others  # noise hides the delay
