"""Plays joint states of a ROS bag in real time to a node on this machine: python examples/play_bag.py BAG [SPEED]."""

import json
import socket
import sys
import time
from pathlib import Path

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

ADDRESS = "127.0.0.1", 7400
FIELDS = "position", "velocity", "effort"


def play(bag, speed=1.0, address=ADDRESS):
    """A line of JSON for each message, when it is due: the time of its header in s, and the fields by joint."""
    known = get_typestore(Stores.LATEST)
    with socket.create_connection(address) as node, AnyReader([Path(bag)], default_typestore=known) as reader:
        topics = [each for each in reader.connections if each.msgtype == "sensor_msgs/msg/JointState"]
        begun = time.monotonic()
        for topic, recorded, raw in reader.messages(topics):
            time.sleep(max(0.0, begun + 1e-9 * (recorded - reader.start_time) / speed - time.monotonic()))
            message = reader.deserialize(raw, topic.msgtype)
            stamp = message.header.stamp
            row = {name: dict(zip(message.name, getattr(message, name).tolist(), strict=False)) for name in FIELDS}
            node.sendall(json.dumps({"time": stamp.sec + 1e-9 * stamp.nanosec, **row}).encode() + b"\n")


if __name__ == "__main__":
    play(sys.argv[1], *map(float, sys.argv[2:]))
