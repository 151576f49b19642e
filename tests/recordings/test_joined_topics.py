"""Topics with different clocks on that of the pose, against sampling the motion by hand."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.data import samples
from tests.recordings.log_files import EPOCH, write_text
from tests.recordings.test_moving_bases import flight

from forcegp import Model, Robot
from forcegp.errors import DatasetError
from forcegp.recordings import ColumnMapping, ImportOptions, import_recordings, open_source

typesys = pytest.importorskip("rosbags.typesys")
ROS2 = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
LATE = 2_000_000  # ns until the recorder has a message

__all__ = ["flight"]  # a fixture


def message(kind, **values):
    return ROS2.types[kind](**values)


def vector(values, kind="Vector3"):
    return message(f"geometry_msgs/msg/{kind}", **dict(zip("xyzw", map(float, values), strict=False)))


def header(stamp):
    time = message("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    return message("std_msgs/msg/Header", stamp=time, frame_id="")


def odometry(stamp, q, v):
    pose = message("geometry_msgs/msg/Pose", position=vector(q[:3], "Point"), orientation=vector(q[3:], "Quaternion"))
    twist, none = message("geometry_msgs/msg/Twist", linear=vector(v[:3]), angular=vector(v[3:])), np.zeros(36)
    own = {
        "pose": message("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=none),
        "twist": message("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=none),
    }
    return message("nav_msgs/msg/Odometry", header=header(stamp), child_frame_id="body", **own)


def commands(u):
    layout = message("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    return message("std_msgs/msg/Float64MultiArray", layout=layout, data=np.array(u))


def imu(stamp, force):
    own = {f"{name}_covariance": np.zeros(9) for name in ("orientation", "angular_velocity", "linear_acceleration")}
    turn = vector([0, 0, 0, 1], "Quaternion")
    values = {"orientation": turn, "angular_velocity": vector([0, 0, 0]), "linear_acceleration": vector(force)}
    return message("sensor_msgs/msg/Imu", header=header(stamp), **values, **own)


def joint_state(stamp, angle):
    own = {"position": np.array([angle]), "velocity": np.zeros(0), "effort": np.zeros(0)}
    return message("sensor_msgs/msg/JointState", header=header(stamp), name=["knee"], **own)


def written(folder: Path, messages) -> Path:
    """(topic, stamp of the recorder, message) in any order; one that is late in the list is late in the bag."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topics = {}
        for topic, stamp, own in sorted(messages, key=lambda item: item[1]):
            if topic not in topics:
                topics[topic] = bag.add_connection(topic, own.__msgtype__, typestore=ROS2)
            bag.write(topics[topic], stamp, ROS2.serialize_cdr(own, own.__msgtype__))
    return folder / "bag"


def nanoseconds(time):
    return EPOCH + np.round(np.asarray(time) * 1e9).astype(np.int64)


def bag_of(folder, flight, command_times, force_times=None):
    """Odometry of every row, rotor speeds 1000 t + k at the times of commands, forces that grow evenly."""
    stamps = nanoseconds(flight.time)
    messages = [
        ("/odom", s + LATE, odometry(s, q, v)) for s, q, v in zip(stamps.tolist(), flight.q, flight.v, strict=True)
    ]
    for t in command_times:
        messages.append(("/rotors", int(nanoseconds(t)), commands(1000 * t + np.arange(4.0))))
    for t in () if force_times is None else force_times:
        stamp = int(nanoseconds(t))
        messages.append(("/imu", stamp + 3 * LATE, imu(stamp, [t, 2 * t, 9.81 - t])))
    return written(folder, messages)


POSE = ColumnMapping(q=("/odom:pose",), v=("/odom:twist",), u=("/rotors:data",), time="/odom:header.stamp")


def imported(path, flight, mapping=POSE, **options):
    found = import_recordings([path], mapping, model=flight.model, options=ImportOptions(**options))
    return found, found.metadata["import"]


@pytest.mark.nightly
def test_poses_and_twists_are_named_by_their_topic(tmp_path, flight):
    source = open_source(bag_of(tmp_path, flight, [0.0, 0.1], [0.0, 0.1]))
    place, turn = "/odom:pose.pose.position.", "/odom:pose.pose.orientation."
    expected = (*(place + axis for axis in "xyz"), *(turn + axis for axis in "xyzw"))
    assert source.vectors["/odom:pose"] == source.vectors["/odom:pose.pose"] == expected
    part = "/odom:twist.twist."
    expected = tuple(f"{part}{kind}.{axis}" for kind in ("linear", "angular") for axis in "xyz")
    assert source.vectors["/odom:twist"] == expected
    assert source.vectors["/imu:linear_acceleration"] == tuple(f"/imu:linear_acceleration.{axis}" for axis in "xyz")


def test_commands_hold_and_forces_are_interpolated(tmp_path, flight):
    at = np.arange(0.011, 1.2, 0.0097)
    path = bag_of(tmp_path, flight, at, np.arange(-0.003, 0.9, 0.0013))
    mapping = ColumnMapping(
        q=POSE.q, v=POSE.v, u=POSE.u, a=("/imu:linear_acceleration", "derive{1..3}"), axes={"a": ("imu",)}
    )
    found, done = imported(path, flight, mapping)
    times = flight.time[(flight.time >= at[0]) & (flight.time < 0.8985)]
    rows = np.flatnonzero((flight.time >= at[0]) & (flight.time < 0.8985))
    np.testing.assert_allclose(found.time, times - times[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.q, flight.q[rows], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(found.v, flight.v[rows])
    last = at[np.searchsorted(at, times + 1e-12, side="right") - 1]
    np.testing.assert_allclose(found.u, 1000 * last[:, None] + np.arange(4), rtol=0, atol=1e-9)
    force = np.stack([times, 2 * times, 9.81 - times], axis=1)
    gravity = Rotation.from_quat(found.q[:, 3:]).inv().apply([0.0, 0.0, -9.81])
    expected = force + gravity - np.cross(found.v[:, 3:], found.v[:, :3])
    np.testing.assert_allclose(found.a[:, :3], expected, rtol=0, atol=1e-6)
    (note,) = [note for note in done["recordings"][0]["notes"] if "rows are those of" in note]
    assert "/rotors held (by log_time)" in note
    assert "/imu interpolated" in note
    assert f"; {len(flight) - len(rows)} rows before" in note


HOPPER = """<robot name="hopper"><link name="trunk"><inertial><mass value="5"/>
<inertia ixx="0.05" iyy="0.06" izz="0.04" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="knee" type="revolute"><parent link="trunk"/><child link="foot"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="50" velocity="20"/></joint><link name="foot"><inertial><mass value="0.5"/>
<inertia ixx="0.002" iyy="0.002" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


def test_joints_of_another_topic_are_interpolated_and_their_torques_held(tmp_path):
    """The base of a legged robot and its joints; stamps of JointState at its own rate."""
    base, joint = np.arange(60) / 100, np.arange(-0.01, 0.7, 0.003)
    rows, forwards = zip(base, nanoseconds(base).tolist(), strict=True), [1.0, 0, 0, 0, 0, 0]
    messages = [("/odom", stamp, odometry(stamp, [t, 0, 1, 0, 0, 0, 1], forwards)) for t, stamp in rows]
    for t, stamp in zip(joint, nanoseconds(joint).tolist(), strict=True):
        values = {"position": np.array([0.3 * t]), "velocity": np.array([0.3]), "effort": np.array([5.0 + t])}
        own = message("sensor_msgs/msg/JointState", header=header(stamp), name=["knee"], **values)
        messages.append(("/joints", stamp + LATE, own))
    mapping = ColumnMapping(
        q=("/odom:pose", "/joints:position.{joints}"),
        v=("/odom:twist", "/joints:velocity.{joints}"),
        u=("/joints:effort.{joints}",),
    )
    model = Model(Robot.from_urdf_text(HOPPER, base="floating"))
    found = import_recordings([written(tmp_path, messages)], mapping, model=model)
    np.testing.assert_allclose(found.time, base, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.q[:, 7], 0.3 * base, rtol=0, atol=1e-8)
    last = joint[np.searchsorted(joint, base + 1e-9, side="right") - 1]
    np.testing.assert_allclose(found.u[:, 0], 5.0 + last, rtol=0, atol=1e-12)
    done = found.metadata["import"]
    assert done["guessed"] == ["time = /odom:header.stamp"]
    assert "/joints interpolated, u held" in done["recordings"][0]["notes"][-1]


def test_angles_that_wrap_are_not_interpolated_across(tmp_path):
    """Joints at 70 Hz turn once; as `unwrap` continues them they are on the motion to one of their steps."""
    base, joint = np.arange(200) / 100, np.arange(-0.1, 2.2, 1 / 70)
    rows = zip(base, nanoseconds(base).tolist(), strict=True)
    messages = [("/odom", s, odometry(s, [t, 0, 1, 0, 0, 0, 1], [1.0, 0, 0, 0, 0, 0])) for t, s in rows]
    for t, stamp in zip(joint, nanoseconds(joint).tolist(), strict=True):
        messages.append(("/joints", stamp, joint_state(stamp, (np.rad2deg(3.0 * t) + 180.0) % 360.0 - 180.0)))
    path = written(tmp_path, messages)
    mapping = ColumnMapping(q=("/odom:pose", "/joints:position.knee"), u=("0",), unit={"q": ("deg",)})
    model = Model(Robot.from_urdf_text(HOPPER.replace("revolute", "continuous"), base="floating"))
    with pytest.raises(DatasetError, match="jumps by more than half a turn"):
        import_recordings([path], mapping, model=model)
    found = import_recordings([path], mapping, model=model, options=ImportOptions(unwrap=True))
    off = np.abs(found.q[:, 7] - 3.0 * base)
    assert np.sort(off)[-4] < 1e-6
    assert off.max() < 3.0 / 70


@pytest.mark.nightly
def test_a_pause_of_a_topic_is_a_gap(tmp_path, flight):
    at = np.concatenate([np.arange(0, 0.4, 0.01), np.arange(0.7, 1.0, 0.01)])
    found, done = imported(bag_of(tmp_path, flight, at), flight, gap=0.05)
    begin = found.time[found.episode == 1][0]
    assert found.episodes == (0, 1)
    assert 0.7 <= begin < 0.7 + 1.5 / 240
    assert found.time[found.episode == 0][-1] <= 0.44 + 1e-9
    assert len(done["recordings"][0]["gaps"]) == 1


def test_topics_that_cannot_be_joined_are_refused(tmp_path, flight):
    path = bag_of(tmp_path, flight, 100.0 + np.arange(0, 1, 0.01))
    with pytest.raises(DatasetError, match="do not overlap"):
        imported(path, flight)


@pytest.mark.nightly
def test_stamps_that_run_backwards_are_refused(tmp_path, flight):
    stamps = nanoseconds(flight.time).tolist()
    order = [*stamps[:50], stamps[20], *stamps[51:]]
    messages = [("/odom", s, odometry(o, q, v)) for s, o, q, v in zip(stamps, order, flight.q, flight.v, strict=True)]
    messages += [("/rotors", int(nanoseconds(t)), commands([0.0] * 4)) for t in np.arange(0, 1, 0.01)]
    with pytest.raises(DatasetError, match="time runs backwards"):
        imported(written(tmp_path, messages), flight)


def test_a_table_of_several_topics_is_joined_by_its_time(tmp_path):
    """As plotting programs export them: cells of the other topics are empty. Straight lines are joined exactly."""
    rows = np.arange(40)
    time = 0.01 * rows + 0.004 * (rows % 2)
    cells = {"__time": time, "/q[0]": 2 * time, "/q[1]": -time, "/v[0]": 2 + time, "/v[1]": 3 * time}
    cells |= {"/u[0]": 5 * time, "/u[1]": time}
    for name in cells:
        if name != "__time":
            cells[name] = np.where(rows % 2 == (name[1] != "q"), cells[name], np.nan)
    cells["/v[1]"][1] = np.nan  # one value that was lost
    mapping = ColumnMapping(time="__time", q=("/q",), v=("/v",), u=("/u",))
    found = import_recordings([write_text(tmp_path / "log.csv", cells)], mapping, model=samples.model("continuous"))
    own = time[4:-1:2]
    np.testing.assert_allclose(found.time, own - own[0], atol=1e-15)
    np.testing.assert_allclose(found.q, np.stack([2 * own, -own], axis=1), rtol=1e-13)
    np.testing.assert_allclose(found.v, np.stack([2 + own, 3 * own], axis=1), rtol=1e-13)
    np.testing.assert_allclose(found.u[:, 0], 5 * time[3:-2:2], rtol=1e-13)  # held
    [note] = found.metadata["import"]["recordings"][0]["notes"]
    assert note.startswith("rows are those of /q[0]: /v[0] interpolated, u held, /v[1] interpolated; 2 rows")
