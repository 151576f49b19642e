"""Logs of bases that move, written in every convention, are one dataset; SciPy and Pinocchio are the oracles."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from tests.recordings.log_files import write_text

from forcegp import Model, Robot
from forcegp.data import Dataset, differentiate
from forcegp.errors import DatasetError, InvalidInput
from forcegp.recordings import ColumnMapping, ImportOptions, import_recordings
from forcegp.simulation import QuadrotorConfig, QuadrupedConfig, simulate_quadrotor, simulate_quadruped

FLIP = np.array([1.0, -1.0, -1.0])  # north, east, down -> north, west, up: half a turn about x
PLAIN = ColumnMapping(time="time", q=("q{0..6}",), v=("v{0..5}",), u=("u{0..3}",), a=("a{0..5}",))


def model_of(dataset: Dataset) -> Model:
    assert dataset.model is not None
    return dataset.model


@pytest.fixture(scope="module")
def flight() -> Dataset:
    return simulate_quadrotor(QuadrotorConfig(seconds=1.0, seed=3, wind=4.0))


def columns(flight: Dataset, **changes: np.ndarray) -> dict[str, np.ndarray]:
    """One column for each entry of q, v, u and a, or of what replaces them."""
    arrays = {name: getattr(flight, name) for name in "qvua"} | changes
    return {"time": changes.get("time", flight.time)} | {
        f"{name}{k}": array[:, k] for name, array in arrays.items() if name != "time" for k in range(array.shape[1])
    }


def turn(flight: Dataset) -> Rotation:
    return Rotation.from_quat(flight.q[:, 3:])


def classical(flight: Dataset, frame: pin.ReferenceFrame) -> np.ndarray:
    """The acceleration of the base's origin, as a point of the world sees it."""
    model = pin.buildModelFromXML(model_of(flight).robot.urdf_text, pin.JointModelFreeFlyer())
    data, found = model.createData(), []
    for q, v, a in zip(flight.q, flight.v, flight.a, strict=True):
        pin.forwardKinematics(model, data, q, v, a)
        found.append(pin.getClassicalAcceleration(model, data, 1, frame).linear)
    return np.array(found)


def quaternion_first(flight):
    return {"q": np.hstack([flight.q[:, :3], np.roll(flight.q[:, 3:], 1, axis=1)])}, {"orientation": "wxyz"}


def either_sign(flight):
    signs = np.where(np.random.default_rng(1).random(len(flight)) < 0.5, -1.0, 1.0)
    return {"q": np.hstack([flight.q[:, :3], signs[:, None] * flight.q[:, 3:]])}, {}


def angles_in_degrees(flight):
    R = turn(flight).as_matrix()
    yaw, roll = np.arctan2(R[:, 1, 0], R[:, 0, 0]), np.arctan2(R[:, 2, 1], R[:, 2, 2])
    q = np.hstack([1000.0 * flight.q[:, :3], np.rad2deg(np.stack([roll, -np.arcsin(R[:, 2, 0]), yaw], axis=1))])
    return {"q": q}, {"q": ("q{0..5}",), "orientation": "angles", "unit": {"q": ("mm", "deg")}}


def world_velocities(flight):
    v = np.hstack([turn(flight).apply(flight.v[:, :3].copy()), turn(flight).apply(flight.v[:, 3:].copy())])
    return {"v": v}, {"axes": {"v": ("world",)}}


def world_linear_velocity(flight):
    v = np.hstack([turn(flight).apply(flight.v[:, :3].copy()), np.rad2deg(flight.v[:, 3:])])
    return {"v": v}, {"axes": {"v": ("world", "body")}, "unit": {"v": ("deg/s",)}}


def accelerometer(flight):
    force = classical(flight, pin.LOCAL) - turn(flight).inv().apply([0.0, 0.0, -9.81])
    return {"a": np.hstack([force, flight.a[:, 3:]])}, {"axes": {"a": ("imu",)}}


def world_accelerations(flight):
    angular = turn(flight).apply(flight.a[:, 3:].copy())
    return {"a": np.hstack([classical(flight, pin.LOCAL_WORLD_ALIGNED), angular])}, {"axes": {"a": ("world",)}}


def north_east_down(flight):
    """As PX4 has it; R' = S R S with the half turn S about x."""
    S = np.diag(FLIP)
    R = Rotation.from_matrix(S @ turn(flight).as_matrix() @ S).as_quat()
    q = np.hstack([flight.q[:, :3] * FLIP, np.roll(R, 1, axis=1)])
    v, a = np.tile(FLIP, 2) * flight.v, accelerometer(flight)[0]["a"] * np.tile(FLIP, 2)
    v[:, :3] = Rotation.from_matrix(S @ turn(flight).as_matrix() @ S).apply(v[:, :3])
    axes = {"v": ("world", "body"), "a": ("imu",)}
    return {"q": q, "v": v, "a": a}, {"orientation": "wxyz", "ned": True, "axes": axes}


def rotors_per_minute(flight):
    return {"u": 30.0 / np.pi * flight.u}, {"unit": {"u": ("rpm",)}}


CONVENTIONS = (
    *(quaternion_first, either_sign, angles_in_degrees, world_velocities, world_linear_velocity, accelerometer),
    *(world_accelerations, north_east_down, rotors_per_minute),
)


def imported(folder, flight, changes=None, mapping=PLAIN, model=None, **options) -> Dataset:
    path = write_text(folder / "log.csv", columns(flight, **(changes or {})))
    return import_recordings([path], mapping, model=model or flight.model, options=ImportOptions(**options))


@pytest.mark.parametrize("convention", [lambda _: ({}, {}), *CONVENTIONS])
def test_every_convention_is_the_same_dataset(tmp_path, flight, convention):
    changes, stated = convention(flight)
    found = imported(tmp_path, flight, changes, replace(PLAIN, **stated))
    for name in "vua":
        expected = getattr(flight, name)
        assert_allclose(getattr(found, name), expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert_allclose(found.q[:, :3], flight.q[:, :3], rtol=0, atol=1e-14)
    same = np.sign((found.q[:, 3:] * flight.q[:, 3:]).sum(axis=1))
    assert_allclose(found.q[:, 3:], same[:, None] * flight.q[:, 3:], rtol=0, atol=1e-14)
    assert (same == same[0]).all()
    assert model_of(found).inputs == ("rotor_1", "rotor_2", "rotor_3", "rotor_4")


def test_what_lacks_is_differentiated_on_the_manifold(tmp_path, flight):
    """Poses alone; then with a gyroscope, whose values stay as they are."""
    space, found = model_of(flight).robot.space, imported(tmp_path, flight, mapping=replace(PLAIN, v=None, a=None))
    expected = differentiate(flight.q, flight.time, space)
    assert_allclose(found.v, expected, rtol=0, atol=1e-10)
    assert_allclose(found.a, differentiate(expected, flight.time), rtol=0, atol=1e-8)
    partly = imported(tmp_path, flight, mapping=replace(PLAIN, v=("derive{1..3}", "v{3..5}"), a=None))
    assert_allclose(partly.v[:, :3], expected[:, :3], rtol=0, atol=1e-10)
    np.testing.assert_array_equal(partly.v[:, 3:], flight.v[:, 3:])
    assert partly.metadata["import"]["columns"]["v"] == ["derive", "derive", "derive", "v3", "v4", "v5"]


def test_a_spline_passes_signs_that_flip(tmp_path):
    """A tumbling base at uneven times: even rows are on the motion, whatever the signs in the log."""
    random = np.random.default_rng(2)
    rows, rate = 2000, 200.0
    time = (np.arange(rows) + random.uniform(-0.2, 0.2, rows)) / rate
    model = Model(Robot.from_urdf_text(BODY, base="floating"))

    def motion(t):
        spin = Rotation.from_rotvec(np.outer(t, [3.0, -1.0, 2.0])) * Rotation.from_euler("x", 0.3)
        return np.hstack([np.stack([np.sin(t), np.cos(2 * t), 0.1 * t**2], axis=1), spin.as_quat()])

    q = motion(time)
    q[:, 3:] *= random.choice([-1.0, 1.0], rows)[:, None]
    table = {"time": time} | dict(zip(("body_x", "body_y", "body_z", "qx", "qy", "qz", "qw"), q.T, strict=True))
    found = import_recordings([write_text(tmp_path / "log.csv", table)], ColumnMapping(), model=model)
    assert found.u.shape == (len(found), 0)
    expected = motion(found.time + time[0])
    same, inner = np.sign((found.q[:, 3:] * expected[:, 3:]).sum(axis=1)), slice(5, -5)
    assert_allclose(found.q[inner, :3], expected[inner, :3], rtol=0, atol=1e-8)
    assert_allclose(found.q[inner, 3:], (same[:, None] * expected[:, 3:])[inner], rtol=0, atol=1e-8)
    spin = (Rotation.from_euler("x", -0.3)).apply([3.0, -1.0, 2.0])
    assert_allclose(found.v[inner, 3:], np.tile(spin, (len(found) - 10, 1)), rtol=0, atol=1e-5)


BODY = """<robot name="box"><link name="body"><inertial><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


def test_lengths_are_mended_or_refused(tmp_path, flight):
    found = imported(tmp_path, flight, {"q": np.round(flight.q, 4)})
    assert_allclose(np.linalg.norm(found.q[:, 3:], axis=1), 1.0, rtol=0, atol=1e-15)
    (note,) = found.metadata["import"]["recordings"][0]["notes"]
    assert note.startswith("orientations divided by their length")
    long = flight.q.copy()
    long[7, 3:] *= 1.02
    with pytest.raises(DatasetError, match=r"length 1\.02 at row 7|length 1\.02 at line"):
        imported(tmp_path, flight, {"q": long})


@pytest.mark.parametrize(
    ("changes", "stated", "message"),
    [
        ({}, {"q": ("q{0..5}",)}, "q has 6 columns for 7 positions"),
        ({}, {"u": ("u0",)}, "u has 1 columns for 4 inputs"),
        ({}, {"v": ("v{0..1}", "derive", "v{3..5}"), "axes": {"v": ("world",)}}, "needs all of its linear part"),
        ({}, {"a": None, "axes": {"a": ("imu",)}}, "the log has no a"),
        ({}, {"unit": {"q": ("mm", "cm")}}, "at most one of each kind"),
        ({}, {"unit": {"v": ("deg/s", "rpm")}}, "at most one of each kind"),
        ({"q": "turned"}, {}, "turns by more than a quarter of a turn at"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, flight, changes, stated, message):
    if changes:
        q = flight.q.copy()
        q[40:, 3:] = (turn(flight)[40:] * Rotation.from_euler("z", 170, degrees=True)).as_quat()
        changes = {"q": q}
    with pytest.raises((InvalidInput, DatasetError), match=message):
        imported(tmp_path, flight, changes, replace(PLAIN, **stated))


def test_motors_of_an_mjcf_file_are_the_inputs(tmp_path, flight):
    sites = "".join(f'<site name="s{k}" pos="{0.1 * (-1) ** k} {0.1 * (k // 2) - 0.05} 0"/>' for k in range(4))
    motors = "".join(f'<motor name="m{k}" site="s{k}" gear="0 0 1 0 0 {0.02 * (-1) ** k}"/>' for k in range(4))
    (tmp_path / "drone.xml").write_text(
        f'<mujoco model="d"><worldbody><body name="body"><freejoint name="free"/><geom size=".1" mass="1"/>{sites}'
        f"</body></worldbody><actuator>{motors}</actuator></mujoco>"
    )
    model = Model.from_file(tmp_path / "drone.xml", base="floating")
    found = imported(tmp_path, flight, mapping=replace(PLAIN, unit={"u": ("1",)}), model=model)
    assert model_of(found).inputs == ("m0", "m1", "m2", "m3")
    np.testing.assert_array_equal(found.u, flight.u)


def test_qpos_qvel_and_qacc_of_mujoco(tmp_path):
    """A body that tumbles in free fall: the dynamics of the robot give the accelerations that were imported."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    text = """<mujoco model="box"><option timestep="0.001" integrator="RK4"/><worldbody><body name="body">
    <freejoint name="base"/><inertial pos="0.05 -0.02 0.03" mass="2" diaginertia="0.01 0.02 0.025"/></body>
    </worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qvel[:] = [1.0, -0.5, 2.0, 3.0, -2.0, 4.0]
    rows = []
    for _ in range(200):
        mujoco.mj_forward(model, data)
        rows.append(np.concatenate([[data.time], data.qpos, data.qvel, data.qacc]))
        mujoco.mj_step(model, data)
    names = ["time", *(f"q{k}" for k in range(7)), *(f"v{k}" for k in range(6)), *(f"a{k}" for k in range(6))]
    path = write_text(tmp_path / "log.csv", dict(zip(names, np.array(rows).T, strict=True)))
    (tmp_path / "box.xml").write_text(text)
    model = Model.from_file(tmp_path / "box.xml", base="floating")
    axes = {"v": ("world", "body"), "a": ("world", "body")}
    found = import_recordings([path], replace(PLAIN, u=None, orientation="wxyz", axes=axes), model=model)
    assert_allclose(found.v[1:-1], differentiate(found.q, found.time, model.robot.space)[1:-1], rtol=0, atol=1e-4)
    q, v, u = (torch.tensor(x) for x in (found.q, found.v, found.u))
    assert_allclose(found.a, model.dynamics(q, v, u).acceleration(torch.zeros_like(v)).numpy(), rtol=0, atol=1e-9)


def walking_log(tmp_path, u: np.ndarray):
    """A log of a walker that has these columns of u, its dataset, and the mapping."""
    walk = simulate_quadruped(QuadrupedConfig(seconds=1.0, seed=2))
    write_text(tmp_path / "walk.csv", columns(walk, u=u(walk)))
    return walk, ColumnMapping(time="time", q=("q{0..18}",), v=("v{0..17}",), u=(f"u{{0..{u(walk).shape[1] - 1}}}",))


def test_flags_that_a_log_lacks_are_open(tmp_path):
    walk, mapping = walking_log(tmp_path, lambda walk: 1e3 * walk.u[:, :12])
    mapping = replace(mapping, unit={"u": ("mNm",)}, sign={"u": (-1.0,)})
    given = {"paths": [tmp_path / "walk.csv"], "model": walk.model}
    with pytest.raises(InvalidInput, match=r"u has 12 columns for 16 inputs .* 0 for a joint that nothing drives"):
        import_recordings(mapping=mapping, **given)
    found = import_recordings(mapping=mapping, options=ImportOptions(stance="auto"), **given)
    done = found.metadata["import"]
    assert tuple(done["open_switches"]) == walk.model.inputs[12:]
    assert done["columns"]["u"] == [f"u{k}" for k in range(12)]
    u = found.u
    assert_allclose(u[:, :12], -walk.u[:, :12], rtol=1e-6)
    assert (u[:, 12:] == 0.0).all()
