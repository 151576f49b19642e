"""One motion of two joints, written in every format that can be imported."""

import gzip
from pathlib import Path

import h5py
import numpy as np
import scipy.io

JOINTS = ("shoulder", "elbow")
STEP = 1 / 512  # s; 1953125 ns, so that stamps in ns and in s are the same numbers
EPOCH = 1_700_000_000 * 10**9  # ns
ROWS = 200


def motion(rows: int = ROWS) -> dict[str, np.ndarray]:
    """time (rows,) and q, v, u (rows, 2), in SI."""
    time = STEP * np.arange(rows)
    frequency, phase = 2 * np.pi * np.array([1.1, 1.7]), np.array([0.2, 1.0])
    angle = frequency * time[:, None] + phase
    return {
        "time": time, "q": 0.7 * np.sin(angle), "v": 0.7 * frequency * np.cos(angle),
        "u": 3.0 * np.cos(2.0 * angle + 0.3),
    }  # fmt: skip


def table(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """One column per name, as a table has them: time, q_shoulder, q_elbow, v_shoulder, ..."""
    columns = {"time": data["time"]}
    for signal in "qvu":
        columns |= {f"{signal}_{joint}": data[signal][:, index] for index, joint in enumerate(JOINTS)}
    return columns


def write_text(path: Path, columns: dict[str, np.ndarray], *, delimiter: str = ",", before: str = "") -> Path:
    """Every digit of every number, so that nothing is lost."""
    lines = [delimiter.join(columns)]
    lines += [delimiter.join(repr(float(value)) for value in row) for row in zip(*columns.values(), strict=True)]
    text = before + "\n".join(lines) + "\n"
    if path.suffix == ".gz":
        path.write_bytes(gzip.compress(text.encode(), 6, mtime=0))
    else:
        path.write_text(text)
    return path


def write_parquet(path: Path, columns: dict[str, np.ndarray]) -> Path:
    """Arrays (rows,) as columns, (rows, k) as columns of lists; several row groups."""
    import pyarrow as pa
    from pyarrow import parquet

    made = {
        name: pa.array(values)
        if values.ndim == 1
        else pa.FixedSizeListArray.from_arrays(values.ravel(), values.shape[1])
        for name, values in columns.items()
    }
    parquet.write_table(pa.table(made), path, row_group_size=70)
    return path


def write_hdf5(path: Path, data: dict[str, np.ndarray]) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in data.items():
            file.create_dataset(f"log/{name}", data=values, compression="gzip")
        file["log/again"] = file["log"]  # a second name, and by it names without end
    return path


def write_matlab5(path: Path, data: dict[str, np.ndarray]) -> Path:
    scipy.io.savemat(path, {"log": dict(data)}, do_compression=True, oned_as="row")
    return path


def write_matlab73(path: Path, data: dict[str, np.ndarray]) -> Path:
    """As MATLAB writes it: HDF5 after a block of 512 bytes, arrays column by column, vectors as matrices."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in data.items():
            stored = file.create_dataset(name, data=np.ascontiguousarray(values.reshape(len(values), -1).T))
            stored.attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return path


def joint_states(data: dict[str, np.ndarray], store, *, ros1: bool):
    """(stamp in ns, JointState) for every row."""
    header, time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    state = store.types["sensor_msgs/msg/JointState"]
    for row in range(len(data["time"])):
        stamp = EPOCH + round(data["time"][row] * 10**9)
        own = {"stamp": time(sec=stamp // 10**9, nanosec=stamp % 10**9), "frame_id": "base"}
        made = header(seq=row, **own) if ros1 else header(**own)
        values = {"position": data["q"][row], "velocity": data["v"][row], "effort": data["u"][row]}
        yield stamp, state(header=made, name=list(JOINTS), **values)


def write_bag1(path: Path, data: dict[str, np.ndarray], compression: str | None = None) -> Path:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store, bag = get_typestore(Stores.ROS1_NOETIC), Writer(path)
    if compression is not None:
        bag.set_compression(Writer.CompressionFormat[compression])
    with bag:
        connection = bag.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=store)
        for stamp, message in joint_states(data, store, ros1=True):
            bag.write(connection, stamp + 1000, store.serialize_ros1(message, connection.msgtype))
    return path


def write_bag2(
    path: Path, data: dict[str, np.ndarray], storage: str = "mcap", gripper: bool = False, compressed: str | None = None
) -> Path:
    """A folder; with `gripper`, another publisher on the same topic now and then."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    bag = Writer(path, version=9, storage_plugin=plugin)
    if compressed is not None:
        bag.set_compression(CompressionMode[compressed], CompressionFormat.ZSTD)
    with bag:
        connection = bag.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=store)
        wrench = bag.add_connection("/wrench", "geometry_msgs/msg/WrenchStamped", typestore=store)
        for row, (stamp, message) in enumerate(joint_states(data, store, ros1=False)):
            bag.write(connection, stamp + 1000, store.serialize_cdr(message, connection.msgtype))
            if gripper and row % 3 == 0:
                one = np.array([0.01])
                other = type(message)(header=message.header, name=["finger"], position=one, velocity=one, effort=one)
                bag.write(connection, stamp + 1000, store.serialize_cdr(other, connection.msgtype))
            vector = store.types["geometry_msgs/msg/Vector3"]
            force, torque = vector(x=float(row), y=0.5, z=-1.0), vector(x=0.0, y=0.0, z=float(row) ** 2)
            both = store.types["geometry_msgs/msg/Wrench"](force=force, torque=torque)
            own = store.types[wrench.msgtype](header=message.header, wrench=both)
            bag.write(wrench, stamp + 1000, store.serialize_cdr(own, wrench.msgtype))
    return path
