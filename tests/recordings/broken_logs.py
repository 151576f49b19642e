"""Logs that cannot be imported: each is a file or folder, the flags it is given with, and the words of the refusal."""

import gzip
import io
import os
import pickle
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import scipy.io
from numpy.lib import format as npy
from pyarrow import parquet
from tests.recordings.log_files import motion, table, write_bag2, write_hdf5, write_text

FLAGS = "--time time --q q_{joints} --v v_{joints} --u u_{joints} --robot arm.urdf"
ARRAYS = "--time time --q q --v v --u u --robot arm.urdf"

URDF = """<robot name="pendulum"><link name="base"/>
{links}
</robot>"""
LINK = """<link name="{name}_link"><inertial><origin xyz="0 0 -0.1"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{name}_link"/><axis xyz="0 1 0"/>
<limit lower="-1.5" upper="1.5" effort="100" velocity="20"/></joint>"""


def urdf(*joints: str) -> str:
    parents = ["base", *(f"{joint}_link" for joint in joints)]
    links = [LINK.format(name=joint, parent=parent) for joint, parent in zip(joints, parents, strict=False)]
    return URDF.format(links="\n".join(links))


@dataclass(frozen=True)
class Broken:
    """`make` writes the log below a folder; `words` follow `forcegp import`; `told` stands in the refusal."""

    make: Callable[[Path], Path]
    told: str
    words: str = FLAGS


def csv(change: Callable[[dict[str, np.ndarray]], None], name: str = "log.csv") -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        columns = {key: values.copy() for key, values in table(motion()).items()}
        change(columns)
        return write_text(folder / name, columns)

    return make


def text(edit: Callable[[str], str], name: str = "log.csv") -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = csv(lambda columns: None, name)(folder)
        path.write_text(edit(path.read_text()))
        return path

    return make


def cut(write: Callable[[Path], Path], share: float = 0.6) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = write(folder)
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])
        return path

    return make


def setting(name: str, row: int, value: float) -> Callable[[Path], Path]:
    def change(columns: dict[str, np.ndarray]) -> None:
        columns[name][row] = value

    return csv(change)


def scaled(factor: float, *names: str) -> Callable[[Path], Path]:
    def change(columns: dict[str, np.ndarray]) -> None:
        for name in names:
            columns[name] *= factor

    return csv(change)


def wrapping(columns: dict[str, np.ndarray]) -> None:
    columns["q_elbow"] = (np.linspace(0, 9, len(columns["time"])) + np.pi) % (2 * np.pi) - np.pi


def archive(folder: Path, **arrays: object) -> Path:
    np.savez_compressed(folder / "log.npz", **{**motion(), **arrays})
    return folder / "log.npz"


def member(folder: Path, content: bytes, mode: int = zipfile.ZIP_DEFLATED) -> Path:
    """The usual archive, with other bytes for q."""
    with zipfile.ZipFile(folder / "log.npz", "w", mode) as file:
        for name, values in motion().items():
            buffer = io.BytesIO()
            np.save(buffer, values)
            file.writestr(f"{name}.npy", content if name == "q" else buffer.getvalue())
    return folder / "log.npz"


def claiming(shape: tuple[int, ...]) -> bytes:
    """An array of that shape, of which nothing but the header is there."""
    buffer = io.BytesIO()
    npy.write_array_header_1_0(buffer, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return buffer.getvalue()


def bomb_of_gzip(folder: Path) -> Path:
    parts = b"time,q\n" + b"0,0\n" * (40 * 2**20), b"0,0\n"  # the size that a file states is that of its last part
    return written("log.csv.gz", b"".join(gzip.compress(part, 9) for part in parts))(folder)


def bomb_of_parquet(folder: Path) -> Path:
    parquet.write_table(pa.table({"q": np.zeros(2**24)}), folder / "log.parquet")
    return folder / "log.parquet"


def crashing_matlab(folder: Path) -> Path:
    """One byte at which scipy's reader ends with the signal SIGSEGV."""
    scipy.io.savemat(file := io.BytesIO(), {"time": np.arange(8.0)})
    return written("log.mat", file.getvalue()[:176] + b"\0" + file.getvalue()[177:])(folder)


def pipe(folder: Path) -> Path:
    os.mkfifo(folder / "log.csv")
    return folder / "log.csv"


def elsewhere(spoil: Callable[[Path, Path], object]) -> Callable[[Path], Path]:
    """A bag whose only file lies above it, and what stands in its place."""

    def make(folder: Path) -> Path:
        bag = write_bag2(folder / "log", motion(), "sqlite3")
        spoil(bag / "log.db3", (bag / "log.db3").rename(folder / "secret.db3"))
        return bag

    return make


def integers(folder: Path) -> Path:
    with h5py.File(folder / "log.h5", "w") as file:
        file.create_dataset("q", data=np.zeros((100 * 2**17, 2), np.int8), compression="gzip")
    return folder / "log.h5"


def twins(path: Path) -> Path:
    with zipfile.ZipFile(path, "a") as file:
        file.writestr("q", b"")
    return path


def linked(folder: Path) -> Path:
    write_hdf5(folder / "other.h5", motion())
    with h5py.File(folder / "log.h5", "w") as file:
        file["time"] = motion()["time"]
        file["q"] = h5py.ExternalLink("other.h5", "/log/q")
    return folder / "log.h5"


def hollow(folder: Path) -> Path:
    with h5py.File(folder / "log.h5", "w") as file:
        file.create_dataset("q", shape=(10**10, 2), chunks=(1000, 2), dtype="f8")
    return folder / "log.h5"


def mcap(folder: Path) -> Path:
    return next(write_bag2(folder / "log", motion()).glob("*.mcap"))


def with_urdf(make: Callable[[Path], Path], *joints: str) -> Callable[[Path], Path]:
    def both(folder: Path) -> Path:
        (folder / "arm.urdf").write_text(urdf(*joints))
        return make(folder)

    return both


def written(name: str, content: bytes) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(content)
        return folder / name

    return make


ONE = "--time time --q q_a,q_a --u u_a,u_a --robot arm.urdf"
LATE = b"".join(b"%.2f,0,0\n" % (1e6 * (k // 150) + k % 150 / 100) for k in range(300))
GOOD = csv(lambda columns: None)

BROKEN = {
    "no such file": Broken(lambda folder: folder / "log.csv", "log.csv does not exist"),
    "missing column": Broken(GOOD, "no column 'p_shoulder'", FLAGS.replace("q_{", "p_{")),
    "nothing mapped": Broken(
        with_urdf(GOOD, "hip", "knee"), "no columns for q (positions)", "--time time --robot arm.urdf"),
    "no robot": Broken(GOOD, "give --robot ARM.urdf", "--time time --q q_shoulder,q_elbow --u 0"),
    "NaN": Broken(setting("v_elbow", 7, np.nan), "'v_elbow' (v of joint 'elbow') is missing (empty or NaN) at row 7"),
    "text": Broken(
        text(lambda t: t.replace(t.splitlines()[5].split(",")[2], "stop", 1)), "'q_elbow' holds 'stop' at row 4"),
    "ragged": Broken(text(lambda t: t + "1.0,2.0\n"), "row 200 (line 202) has 2 fields instead of 7"),
    "duplicate names": Broken(text(lambda t: t.replace("v_elbow", "q_elbow")), "'q_elbow' stands over columns 3, 5"),
    "no header": Broken(
        text(lambda t: t[t.index("\n") + 1 :]), "no column 'q_shoulder' in log.csv. Valid columns: c1, c2"),
    "binary": Broken(written("log.csv", bytes(range(256)) * 9), "holds binary data"),
    "pickle": Broken(written("log.pkl", pickle.dumps([1])), "reading those runs code"),
    "folder": Broken(lambda folder: (folder / "logs").mkdir() or folder / "logs", "no ROS 2 bag (metadata.yaml)"),
    "folder without a name": Broken(lambda folder: folder, ". is a folder, but no ROS 2 bag (metadata.yaml)"),
    "gzip bomb": Broken(bomb_of_gzip, "no log of sensors shrinks so far"),
    "bomb of zeros": Broken(bomb_of_parquet, "no log of sensors shrinks so far", ARRAYS),
    "pipe": Broken(pipe, "log.csv is not a regular file"),
    "crash of scipy": Broken(crashing_matlab, "log.mat: matlab crashed at it", ARRAYS),
    "bag of links": Broken(elsewhere(Path.symlink_to), "'log.db3' is a pipe, a device, a link to elsewhere"),
    "bag of pipes": Broken(elsewhere(lambda bag, _: os.mkfifo(bag)), "'log.db3' is a pipe, a device, a link"),
    "bag of addresses": Broken(elsewhere(lambda bag, _: bag.with_name("%2e%2e%2fsecret.db3").touch()), "%, ? or #"),
    "small integers": Broken(integers, "the file claims 200 MiB", ARRAYS),
    "short rows": Broken(
        lambda folder: written("log.csv.gz", gzip.compress(b"a,b\n" + b"0,0\n" * 2**23))(folder), "shrinks so far"),
    "two of one name": Broken(lambda folder: twins(archive(folder)), "holds two arrays of one name", ARRAYS),
    "rows of any length": Broken(
        written("log.json", b"[" + b"[1],[1,2]," * 9999 + b"[1]]"), "lists of different", ARRAYS),
    "own names": Broken(written("log.jsonl", b"\n".join(b'{"k%d": 1}' % k for k in range(2000))), "2000 names", ARRAYS),
    "month 13": Broken(
        written("log.csv", b"time,q_a,u_a\n" + b"2024-13-45 1:00:00,0,0\n" * 9), "'time', the time, is missing", ONE),
    "a long gap": Broken(
        written("log.csv", b"time,q_a,u_a\n" + LATE), "300 rows would become 1e+08", f"{ONE} --gap 1e7"),
    "a high rate": Broken(GOOD, "--rate", f"{FLAGS} --rate 1e8"),
    "long integer": Broken(written("log.json", b"[1%b]" % (b"0" * 400)), "no array of numbers", ARRAYS),
    "huge number": Broken(setting("u_elbow", 7, 1e100), "'u_elbow' (u of joint 'elbow') is 1e+100 at row 7"),
    "huge time": Broken(scaled(1e300, "time"), "the median step is"),
    "time backwards": Broken(
        csv(lambda x: x["time"].put([50, 51], x["time"][[51, 50]])),
        "runs backwards by 0.00195312 s at row 51 (line 53)"),
    "time stands still": Broken(csv(lambda columns: columns["time"].fill(3.0)), "all rows have the same time stamp"),
    "ms given as s": Broken(scaled(1e3, "time"), "add --unit time=ms"),
    "unknown unit": Broken(GOOD, "no unit 'degrees' in the units of q; did you mean", f"{FLAGS} --unit q=degrees"),
    "angle wraps": Broken(csv(wrapping), "jumps by more than half a turn", FLAGS),
    "no motor": Broken(
        with_urdf(csv(lambda x: x.pop("u_elbow")), "shoulder", "elbow"), "--u u_shoulder,0 (0", "--robot arm.urdf"),
    "degrees": Broken(scaled(57.3, "q_shoulder", "q_elbow"), "Give --unit q=deg if it is in deg"),
    "beyond limits": Broken(
        with_urdf(scaled(3.0, "q_elbow"), "shoulder", "elbow"), "beyond its limits -1.5 to 1.5 in the URDF"),
    "another robot": Broken(
        with_urdf(GOOD, "shoulder", "wrist"), "'pendulum' has shoulder, wrist", f"{FLAGS} --joints shoulder,elbow"),
    "too few columns": Broken(GOOD, "u has 1 columns for 2 joints", FLAGS.replace("u_{joints}", "u_elbow")),
    "no combination": Broken(
        GOOD, "is no combination", FLAGS.replace("--q q_{joints}", "--q q_shoulder**q_elbow,q_elbow")),
    "cut member": Broken(lambda f: member(f, claiming((200, 2))), "claims the shape (200, 2)", ARRAYS),
    "bad header": Broken(lambda f: member(f, npy.magic(1, 0) + b"\xff\x10" + b"{" * 5000), "a NumPy archive", ARRAYS),
    "npz bomb": Broken(lambda f: member(f, claiming((10**8, 2)) + bytes(2 * 10**8)), "shrinks so far", ARRAYS),
    "Python objects": Broken(lambda f: archive(f, q=np.array([{}], object)), "reading them runs code", ARRAYS),
    "other lengths": Broken(lambda f: archive(f, u=np.ones((7, 2))), "different numbers of rows", ARRAYS),
    "no such group": Broken(archive, "no array or group", f"{ARRAYS} --episodes run*"),
    "external link": Broken(linked, "links to other files are not followed", ARRAYS),
    "hollow HDF5": Broken(hollow, "shrinks so far", ARRAYS),
    "two topics": Broken(mcap, "several topics are joined by their stamps",
        "--step 0.002 --q /joint_states:position --u /wrench:wrench.force.x,0 --robot arm.urdf"),
    "episode again": Broken(
        csv(lambda columns: columns.update(episode=np.repeat([0.0, 1.0, 0.0, 0.0], 50))),
        "episode 0 begins again at row 100", f"{FLAGS} --episode episode"),
}  # fmt: skip
