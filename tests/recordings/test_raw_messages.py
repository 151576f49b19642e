"""MCAP files chunk by chunk, and message by message where chunks overlap in time: the same messages."""

import importlib
import sys

import numpy as np
import pytest
from tests.recordings.log_files import EPOCH, joint_states, motion, write_bag2

from forcegp.recordings import open_source, ros_bag
from forcegp.recordings.ros_bag import _ordered_chunks, mcap_chunks, topic_messages

pytest.importorskip("rosbags")


def write_chunks(path, order):
    """A bag of several chunks (of 1 MiB each): every message carries 20 kB of frame name."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    messages = list(joint_states(motion(), store, ros1=False))
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=store)
        for row in order:
            stamp, message = messages[row]
            message.header.frame_id = "f" * 20_000
            bag.write(connection, stamp, store.serialize_cdr(message, connection.msgtype))
    return path


@pytest.mark.parametrize(
    ("order", "fast"),
    [(np.arange(200), True), (np.r_[0:200:2, 1:200:2], False), (np.r_[1:40, 0, 40:200], True)],
    ids=["in order", "chunks that overlap", "out of order in one chunk"],
)
def test_messages_come_in_the_order_of_time(tmp_path, order, fast):
    source = open_source(write_chunks(tmp_path / "log", order))
    pieces = list(source.chunks(["/joint_states:log_time", "/joint_states:position.elbow"], 64))
    times = np.concatenate([piece["/joint_states:log_time"] for piece in pieces])
    np.testing.assert_array_equal(times, EPOCH + np.round(motion()["time"] * 1e9).astype(np.int64))
    positions = np.concatenate([piece["/joint_states:position.elbow"] for piece in pieces])
    np.testing.assert_array_equal(positions, motion()["q"][:, 1])
    with source._open() as reader:
        assert (_ordered_chunks(reader) is not None) == fast


def test_both_ways_give_the_same_bytes(tmp_path, monkeypatch):
    source = open_source(write_bag2(tmp_path / "log", motion(), gripper=True, compressed="STORAGE"))

    def messages():
        with source._open() as reader:
            connections = [item for item in reader.connections if item.topic == "/joint_states"]
            for batch in topic_messages(reader, connections, 50):
                for begin, length, stamp in zip(batch.begins, batch.lengths, batch.stamps, strict=True):
                    yield int(stamp), batch.buffer[begin : begin + length].tobytes()

    fast = list(messages())
    monkeypatch.setattr("forcegp.recordings.ros_bag._ordered_chunks", lambda reader: None)
    assert fast == list(messages())
    assert len(fast) == 267


def hidden(place: str, name: str):
    """An attribute that rosbags itself has, but not for us: it may rename what it does not document."""

    def hide(monkeypatch):
        module, _, kind = place.rpartition(".")
        kind = getattr(importlib.import_module(module), kind)
        own = kind.__getattribute__

        def get(self, wanted):
            if wanted == name and sys._getframe(1).f_globals["__name__"].startswith("forcegp"):
                raise AttributeError(name)
            return own(self, wanted)

        monkeypatch.setattr(kind, "__getattribute__", get)

    return hide


def other_offsets(monkeypatch):
    """Offsets that mean something else."""
    own = ros_bag._begins_at
    monkeypatch.setattr(
        ros_bag,
        "_begins_at",
        lambda info, file: own(info._replace(chunk_start_offset=info.chunk_start_offset + 9), file),
    )


CHANGES = [
    hidden("rosbags.highlevel.AnyReader", "readers"),
    hidden("rosbags.rosbag2.Reader", "storage"),
    hidden("rosbags.rosbag2.reader.DirectoryReader", "storages"),
    hidden("rosbags.rosbag2.storage_mcap.McapReader", "chunks"),
    hidden("rosbags.rosbag2.storage_mcap.McapReader", "bio"),
    other_offsets,
]


@pytest.mark.parametrize("compressed", [None, "STORAGE"])
@pytest.mark.parametrize("change", CHANGES, ids=["readers", "storage", "storages", "chunks", "file", "offsets"])
def test_where_rosbags_has_changed_inside_the_rows_are_the_same(tmp_path, monkeypatch, change, compressed):
    write_bag2(tmp_path / "log", motion(), gripper=True, compressed=compressed)

    def imported():
        source = open_source(tmp_path / "log")
        names = [f"/joint_states:{name}" for name in ("log_time", "header.stamp", "position.elbow", "effort.elbow")]
        with source._open() as reader:
            fast = mcap_chunks(reader) is not None
        pieces = list(source.chunks(names, 64))
        return fast, {name: np.concatenate([piece[name] for piece in pieces]) for name in names}

    fast, before = imported()
    change(monkeypatch)
    still_fast, now = imported()
    assert (fast, still_fast) == (True, False)
    assert before.keys() == now.keys()
    for name, values in before.items():
        np.testing.assert_array_equal(now[name], values, err_msg=name)
