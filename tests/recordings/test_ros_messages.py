"""Numbers taken out of ROS messages, against those that were put in, and messages in the order of time."""

import sqlite3
from contextlib import closing

import numpy as np
import pytest
from tests.data.samples import model
from tests.recordings.log_files import EPOCH, joint_states, motion, write_bag2

from forcegp.errors import DataWarning, FileFormatError
from forcegp.recordings import ColumnMapping, import_recordings, open_source, ros_bag
from forcegp.recordings.ros_bag import numbers

COSTLY = {
    "or needed more than 1 s": "DROP TABLE schema; CREATE VIEW schema AS WITH RECURSIVE c(schema_version) AS "
    "(SELECT 1 UNION ALL SELECT 2 FROM c) SELECT count(*) AS schema_version FROM c",
    "memory": "ALTER TABLE messages RENAME TO old; CREATE TABLE messages (id, topic_id, timestamp, data AS "
    "(zeroblob(900000000))); INSERT INTO messages SELECT id, topic_id, timestamp FROM old",
}

typesys = pytest.importorskip("rosbags.typesys")
ROS2 = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


def joint_state(names, positions, efforts=()):
    header, stamp = ROS2.types["std_msgs/msg/Header"], ROS2.types["builtin_interfaces/msg/Time"](sec=5, nanosec=7)
    position, effort = (np.array(values, dtype=np.float64) for values in (positions, efforts))
    return ROS2.types["sensor_msgs/msg/JointState"](
        header=header(stamp=stamp, frame_id="base"), name=list(names), position=position, velocity=np.zeros(0),
        effort=effort,
    )  # fmt: skip


def test_joint_states_go_by_the_names_of_joints():
    message = joint_state(("elbow", "é/_"), (0.5, -0.5), (2.0, 3.0))
    expected = {"position.elbow": 0.5, "position.é/_": -0.5, "effort.elbow": 2.0, "effort.é/_": 3.0}
    assert numbers(message) == {"header.stamp": 5_000_000_007, **expected}
    assert numbers(message, ("effort",)) == {"effort.elbow": 2.0, "effort.é/_": 3.0}
    with pytest.raises(FileFormatError, match="2 names but 1 values of 'position'"):
        numbers(joint_state(("a", "b"), (1.0,)))


CONTROLLER = """std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint[] points
trajectory_msgs/JointTrajectoryPoint feedback"""
ROS2.register(typesys.get_types_from_msg(CONTROLLER, "any_msgs/msg/Controller"))


def controller(names, positions):
    own = {name: np.zeros(0) for name in ("velocities", "accelerations", "effort")}
    past = ROS2.types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
    point = ROS2.types["trajectory_msgs/msg/JointTrajectoryPoint"](positions=positions, time_from_start=past, **own)
    header, kind = joint_state((), ()).header, ROS2.types["any_msgs/msg/Controller"]
    return kind(header=header, joint_names=list(names), points=[point], feedback=point)


def test_names_of_joints_hold_for_the_messages_inside():
    vectors = {}
    found = numbers(controller(("elbow", "base"), np.array([1.0, 2.0])), None, vectors)
    inside = {f"{at}.positions.{name}" for at in ("points[0]", "feedback") for name in ("elbow", "base")}
    assert inside < found.keys()
    assert found["feedback.positions.base"] == 2.0
    assert [*vectors["feedback.positions"]] == ["feedback.positions.elbow", "feedback.positions.base"]


def test_a_vector_whose_messages_name_the_joints_is_put_into_their_order(tmp_path):
    from rosbags.rosbag2 import StoragePlugin, Writer

    q = motion()["q"]
    with Writer(tmp_path / "log", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection("/state", "any_msgs/msg/Controller", typestore=ROS2)
        for row, values in enumerate(q):
            message = controller(("elbow", "shoulder"), values[::-1].copy())
            bag.write(connection, EPOCH + 10**7 * row, ROS2.serialize_cdr(message, connection.msgtype))
    mapping = ColumnMapping(time="/state:log_time", q=("/state:feedback.positions",), u=("0",))
    np.testing.assert_array_equal(import_recordings([tmp_path / "log"], mapping, model=model("continuous")).q, q)


@pytest.mark.parametrize(
    "order", [np.r_[0:200:2, 1:200:2], np.r_[1:40, 0, 40:200]], ids=["chunks that overlap", "one chunk out of order"]
)
def test_messages_come_in_the_order_of_time(tmp_path, order):
    """Several chunks of 1 MiB: every message carries 20 kB of frame name."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    messages = list(joint_states(motion(), ROS2, ros1=False))
    with Writer(tmp_path / "log", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=ROS2)
        for row in order:
            stamp, message = messages[row]
            message.header.frame_id = "f" * 20_000
            bag.write(connection, stamp, ROS2.serialize_cdr(message, connection.msgtype))
    names = ["/joint_states:log_time", "/joint_states:position.elbow"]
    times, positions = open_source(tmp_path / "log").read(names).values()
    np.testing.assert_array_equal(times, EPOCH + np.round(motion()["time"] * 1e9).astype(np.int64))
    np.testing.assert_array_equal(positions, motion()["q"][:, 1])


@pytest.mark.parametrize("packed", [pytest.param(False, marks=pytest.mark.nightly), True])
@pytest.mark.parametrize("share", [pytest.param(0.1, marks=pytest.mark.nightly), 0.6])
def test_whole_messages_before_a_cut_are_read_with_a_warning(tmp_path, packed, share):
    """Several chunks of 1 MiB; which messages are whole is seen in the bytes, or of packed ones estimated."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    bag = Writer(tmp_path / "log", version=9, storage_plugin=StoragePlugin.MCAP)
    if packed:
        bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    sent = []
    with bag:
        connection = bag.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=ROS2)
        for stamp, message in joint_states(motion(), ROS2, ros1=False):
            message.header.frame_id = np.random.default_rng(stamp).bytes(10_000).hex()
            sent.append(ROS2.serialize_cdr(message, connection.msgtype))
            bag.write(connection, stamp, sent[-1])
    file = tmp_path / "log" / "log.mcap"
    content = file.read_bytes()[: int(share * file.stat().st_size)]
    file.write_bytes(content)
    expected = range(int(200 * share) - 15, 200) if packed else [sum(bytes(each) in content for each in sent)]
    for place in (tmp_path / "log", file):
        with pytest.warns(DataWarning, match=r"record: the \d+ whole messages before are read"):
            read = open_source(place).read(["/joint_states:position.elbow"])["/joint_states:position.elbow"]
        assert len(read) in expected
        np.testing.assert_array_equal(read, motion()["q"][: len(read), 1])
        (tmp_path / "log" / "metadata.yaml").unlink(missing_ok=True)  # as a recorder leaves it that was killed


@pytest.mark.parametrize("told", COSTLY)
def test_a_bag_costs_no_more_than_its_limits(tmp_path, monkeypatch, told):
    monkeypatch.setattr(ros_bag, "SECONDS", 1 if " s" in told else 30)
    bag = write_bag2(tmp_path / "log", motion(), "sqlite3")
    with closing(sqlite3.connect(bag / "log.db3")) as file:
        file.executescript(COSTLY[told])
    with pytest.raises(FileFormatError, match=f"^[^\n]*{told}[^\n]*$"):
        open_source(bag)
