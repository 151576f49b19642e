"""How long does it take to import a log of 1 GB, and how much memory?

A CSV file and an MCAP file of 1 GB each, with positions, velocities and torques of seven joints, are written once and
kept in runs/benchmarks. Stamps jitter by a tenth of a step, so that every row is interpolated; accelerations are
differentiated. `forcegp import` runs in a process of its own with the threads that it takes by itself; its wall-clock
time and its largest resident memory are measured from outside.

    python -m benchmarks importing
    python -m benchmarks.importing mcap 1e8        one of the files, smaller
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from forcegp.atomic_files import atomic_file, atomic_folder

KEPT = Path(__file__).resolve().parent.parent / "runs" / "benchmarks"
BYTES = 10**9
JOINTS = tuple(f"joint{index + 1}" for index in range(7))
STEP, JITTER = 1e-3, 0.1
ROWS = 50_000
EPOCH = 1_700_000_000 * 10**9  # ns


def rows(seed: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Without end: time (rows,) [s] and q, v, u side by side (rows, 21), rounded as a driver rounds them."""
    random = np.random.default_rng(seed)
    frequency = 2 * np.pi * random.uniform(0.2, 1.5, 7)
    start = 0
    while True:
        step = np.arange(start, start + ROWS)
        time_s = STEP * (step + JITTER * random.uniform(-0.5, 0.5, ROWS))
        angle = frequency * time_s[:, None]
        signals = np.hstack([np.sin(angle), frequency * np.cos(angle), 20 * np.sin(angle + 0.7)])
        yield np.round(time_s, 9), np.round(signals + random.normal(0, 1e-4, signals.shape), 9)
        start += ROWS


def write_csv(path: Path, size: int) -> None:
    """About `size` bytes of time and 21 columns."""
    import pyarrow as pa
    from pyarrow import csv

    names = ["time", *(f"{signal}_{joint}" for signal in ("q", "v", "tau") for joint in JOINTS)]
    with path.open("wb") as file:
        for block, (stamps, signals) in enumerate(rows(1)):
            columns = [stamps, *signals.T]
            table = pa.table([pa.array(np.ascontiguousarray(column)) for column in columns], names=names)
            csv.write_csv(table, file, csv.WriteOptions(include_header=block == 0))
            if file.tell() >= size:
                return


def write_mcap(path: Path, size: int) -> None:
    """About `size` bytes of sensor_msgs/JointState, written by `rosbags` message by message."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    header, stamp = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    kind = "sensor_msgs/msg/JointState"
    marks = np.arange(1.0, 22.0)  # numbers that are found again in the bytes of the one message that is serialised
    example = store.types[kind](
        header=header(stamp=stamp(sec=7, nanosec=9), frame_id="base"),
        name=list(JOINTS),
        position=marks[:7],
        velocity=marks[7:14],
        effort=marks[14:],
    )
    template = np.frombuffer(bytes(store.serialize_cdr(example, kind)), np.uint8)
    places = [template.tobytes().index(mark.tobytes()) for mark in marks]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection("/joint_states", kind, typestore=store)
        written = 0
        for stamps, signals in rows(2):
            nanoseconds = EPOCH + np.round(stamps * 1e9).astype(np.int64)
            messages = np.tile(template, (len(stamps), 1))
            seconds = np.stack(np.divmod(nanoseconds, 10**9), axis=1).astype("<u4")
            messages[:, 4:12] = seconds.view(np.uint8)
            for place, column in zip(places, signals.T, strict=True):
                messages[:, place : place + 8] = np.ascontiguousarray(column)[:, None].view(np.uint8)
            for own, message in zip(nanoseconds.tolist(), messages, strict=True):
                bag.write(connection, own, message.tobytes())
            written += len(stamps) * (template.size + 47)  # what MCAP adds to a message, with its index
            if written >= size:
                return


def csv_log(size: int) -> tuple[Path, list[str]]:
    """The file, and the flags that import it."""
    path = KEPT / f"log-{size:.0e}.csv"
    if not path.exists():
        with atomic_file(path) as temporary:
            write_csv(temporary, size)
    return path, ["--time", "time", "--q", "q_{joints}", "--v", "v_{joints}", "--u", "tau_{joints}"]


def mcap_log(size: int) -> tuple[Path, list[str]]:
    """The same for the bag."""
    folder = KEPT / f"log-{size:.0e}"
    if not folder.exists():
        with atomic_folder(folder) as temporary:
            write_mcap(temporary, size)
    (path,) = folder.glob("*.mcap")
    topic = "/joint_states:"
    return path, ["--q", f"{topic}position", "--v", f"{topic}velocity", "--u", f"{topic}effort"]


LOGS = {"csv": csv_log, "mcap": mcap_log}


def imported(kind: str, size: int) -> dict[str, float]:
    """Seconds, MiB and rows of one import."""
    KEPT.mkdir(parents=True, exist_ok=True)
    path, flags = LOGS[kind](size)
    out = KEPT / "imported.h5"
    command = [sys.executable, "-m", "forcegp", "import", path, *flags, "--joints", ",".join(JOINTS), "--json"]
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    with path.open("rb") as file:  # into the cache of the disk, whose speed is not what is asked
        while file.read(2**20):
            pass
    start = time.perf_counter()
    process = subprocess.Popen(
        [*map(str, command), "--out", str(out), "--overwrite"], env=environment, stdout=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{command} ended with {process.returncode}")
    import h5py

    with h5py.File(out) as file:
        count = len(file["time"])  # type: ignore[arg-type]  # a dataset
    result = {"seconds": seconds, "cpu_s": usage.ru_utime + usage.ru_stime, "memory_mib": usage.ru_maxrss / 1024}
    result |= {"rows": count, "bytes": path.stat().st_size, "written_bytes": out.stat().st_size}
    out.unlink()
    print(f"{kind}: {result}", flush=True)
    return result


def run() -> dict[str, float]:
    """Answer the question `importing`."""
    results: dict[str, float] = {}
    for kind in LOGS:
        measured = imported(kind, BYTES)
        results |= {
            f"import_{kind}_1gb_s": measured["seconds"],
            f"import_{kind}_1gb_cpu_s": measured["cpu_s"],
            f"import_{kind}_1gb_memory_mib": measured["memory_mib"],
            f"import_{kind}_1gb_rows": measured["rows"],
        }
    return results


if __name__ == "__main__":
    imported(sys.argv[1], int(float(sys.argv[2])))
