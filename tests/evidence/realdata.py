"""The recordings of real robots in the optional folder ../shared/realdata, prepared by the protocols of its README."""

import gzip
import re
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import scipy.io

from forcegp.data import Dataset, Preparation, resample, with_strokes
from forcegp.errors import DataWarning
from forcegp.forces import Actuation, Law, RigidBodies, Rotor
from forcegp.model import Model
from forcegp.robots import Robot

PENDULUM_LINK = """<link name="{name}"><inertial><origin xyz="0 0 {com}"/><mass value="{mass}"/>
<inertia ixx="{inertia}" iyy="{inertia}" izz="{thin}" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{name}_joint" type="continuous"><parent link="{parent}"/><child link="{name}"/><origin xyz="0 0 {length}"/>
<axis xyz="0 1 0"/></joint>"""


def dataset(model: Model, time, q, u, episode) -> Dataset:
    """A raw log: q and u as recorded; v and a are for `Preparation` to compute."""
    nothing = np.zeros_like(q)
    return Dataset(
        q=q, v=nothing, u=u, a=nothing, time=time, model=model, episode=episode
    )  # fmt: skip


def multiarm_system(*more: Law) -> Model:
    """The passive double pendulum with its published numbers, standing upright at q = 0."""
    names = ("name", "parent", "mass", "com", "length", "inertia")
    first = ("first", "base", 0.0938439748, 0.108565215, 0.0, 4.37529430e-4)
    second = ("second", "first", 0.137595970, 0.116779018, 0.172719204, 1.26882939e-3)
    links = [dict(zip(names, values, strict=True)) for values in (first, second)]
    parts = [PENDULUM_LINK.format(thin=0.1 * float(link["inertia"]), **link) for link in links]
    text = f'<robot name="multiarm"><link name="base"/>{"".join(parts)}</robot>'
    return Model(Robot.from_urdf_text(text, gravity=(0.0, 0.0, -9.80858023)), (), (RigidBodies(), *more))


def multiarm(folder: Path, model: Model) -> Dataset:
    """All pieces: 25 Hz, 0.1 s trimmed at both ends; the angles there are absolute."""
    with np.load(folder / "multiarm_pendulum/double_id.npz") as data:
        step = float(data["dt"])
        pieces = [data[name] for name in sorted(data.files) if name.startswith("piece")]
    q = np.concatenate([np.stack([p[:, 0], p[:, 1] - p[:, 0]], axis=1) for p in pieces])
    time = np.concatenate([step * np.arange(len(p)) for p in pieces])
    episode = np.repeat(np.arange(len(pieces)), [len(p) for p in pieces])
    return Preparation(cutoff=25.0, trim=100 * step).apply(dataset(model, time, q, np.zeros_like(q), episode))


def dfki_system(folder: Path) -> Model:
    """The double pendulum of DFKI with rotors at a ratio of 6 on the first link."""
    robot = Robot.from_urdf(folder / "dfki_double_pendulum/model/double_pendulum_C1.urdf")
    return Model(robot, (), (Actuation(), RigidBodies(), Rotor(1e-5, transmission=[[6.0, 0.0], [-1.0, 6.0]])))


def dfki(folder: Path, model: Model, *runs: int) -> Dataset:
    """Runs at 500 Hz, 20 Hz, 60 samples trimmed at both ends."""
    parts = []
    for run in runs:
        with gzip.open(folder / f"dfki_double_pendulum/raw/20230629-{run}.csv.gz", "rt") as file:
            log = np.genfromtxt(file, delimiter=",", names=True)
        log = log[np.concatenate([[True], np.diff(log["time"]) > 0.0])]
        q, u = (np.stack([log[f"{name}1"], log[f"{name}2"]], axis=1) for name in ("pos_meas", "tau_meas"))
        parts.append((log["time"] - log["time"][0], q, u, np.full(len(log), run)))
    raw = dataset(model, *(np.concatenate(x) for x in zip(*parts, strict=True)))
    return Preparation(cutoff=20.0, trim=0.12).apply(resample(raw, 0.002))


def panda_system(folder: Path) -> Model:
    """The manufacturer's Panda, one link of which breaks the triangle inequality."""
    with warnings.catch_warnings(action="ignore", category=DataWarning):
        robot = Robot.from_urdf(folder / "panda_gaz2019/model/fer_franka_description.urdf", inertias="nearest")
    return Model(robot)


def panda(folder: Path, model: Model) -> tuple[Dataset, Dataset]:
    """5 Hz, every 20th sample; five blocks of time, the third and fifth held out, 0.25 s guard."""
    names = ("time", "positions", "torques")
    time, q, u = (np.loadtxt(folder / f"panda_gaz2019/raw/exciting_traj_{name}.txt.gz") for name in names)
    q, u = q.reshape(-1, 7), u.reshape(-1, 7)
    fresh = np.concatenate([[True], (np.diff(time) > 0.0) & (np.diff(q, axis=0) != 0.0).any(1)])
    raw = dataset(model, time[fresh] - time[0], q[fresh], u[fresh], np.zeros(fresh.sum(), int))
    rows = Preparation(cutoff=5.0, every=20).apply(resample(raw, 0.001))
    block = rows.time[-1] / 5.0
    test = np.isin(np.minimum((rows.time / block).astype(int), 4), (2, 4))
    return rows.rows(~test & ~(abs(rows.time[:, None] - block * np.array([2, 3, 4])) <= 0.25).any(1)), rows.rows(test)


def emps(folder: Path) -> tuple[Dataset, Dataset]:
    """One prismatic axis at 1 kHz behind 20 Hz: both halves of the record, .25 s apart."""
    record = scipy.io.loadmat(folder / "emps/DATA_EMPS.mat")
    one = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    robot = Robot.from_urdf_text(
        f"""<robot name="emps"><link name="base"/><link name="carriage"><inertial><mass value="100"/>{one}</inertial>
        </link><joint name="x" type="prismatic"><parent link="base"/><child link="carriage"/><axis xyz="1 0 0"/>
        <limit lower="-0.1" upper="0.4" effort="1000" velocity="2"/></joint></robot>"""
    )
    time, q, u = record["t"][:, 0], record["qm"], record["gtau"] * record["vir"]
    log = Preparation(cutoff=20.0, trim=0.1).apply(dataset(Model(robot), time, q, u, np.zeros(len(time), dtype=int)))
    middle = 0.5 * float(log.time[-1])
    return log.rows(log.time < middle - 0.25), log.rows(log.time >= middle)


def table(path: Path) -> np.ndarray:
    return np.genfromtxt(path, delimiter=",", skip_header=1)  # gzip or not


def log_of(robot: Robot, t: np.ndarray, q: np.ndarray, u: np.ndarray, step: float, every: int = 1, **how) -> Dataset:
    raw = dataset(Model(robot), t - t[0], q, u, np.zeros(len(t), int))
    return Preparation(every=every, **how).apply(resample(raw, step))


def tx40(folder: Path) -> Dataset:
    p, c = (table(folder / f"tx40/{name}.csv.gz").T for name in ("pos", "curr"))
    q = [p[0] / 32, p[1] / 32 - np.pi / 2, p[2] / 45 + np.pi / 2, -p[3] / 48, p[4] / 45, p[5] / 32 - p[4] / 45]
    u = [32 * c[0], 32 * c[1], 45 * c[2], -48 * c[3], 45 * c[4] + 32 * c[5], 32 * c[5]]
    robot = Robot.from_file(folder / "tx40/tx40.urdf", inertias="nearest", armature={"joint_6": 0.05})
    return log_of(robot, 2e-4 * np.arange(len(p[0])), np.stack(q, 1), np.stack(u, 1), 2e-4, 25, cutoff=60.0, trim=0.1)


def tiago(folder: Path) -> Dataset:
    text = gzip.decompress((folder / "tiago/tiago_48_schunk.urdf.gz").read_bytes()).decode()
    own = ["torso_lift_joint", *(f"arm_{k}_joint" for k in range(1, 8))]
    moving = [each for each in ET.fromstring(text).iter("joint") if each.get("type", "fixed") != "fixed"]
    names = [str(each.get("name")) for each in moving if each.find("mimic") is None]
    locked = {name: 0.0 for name in names if name not in own}
    robot = Robot.from_urdf_text(text, locked=locked, inertias="nearest", base="fixed")
    position, effort = (table(folder / f"tiago/tiago_{name}.csv.gz") for name in ("position", "effort"))
    gain = np.array([1, 13.6, 13.6, -8.7, -8.7, -20.5968, -20.5968, -20.5968])
    fresh = np.r_[True, np.diff(position[:, 0]) > 0.0]
    t, q, u = position[fresh, 0], position[fresh, 1:], effort[fresh, 1:] * gain
    return log_of(robot, t, q, u, float(np.median(np.diff(t))), cutoff=10.0, trim=0.25)


def go2(folder: Path) -> Dataset:
    text = re.sub(r"<freejoint[^>]*/>|<mesh [^>]*/>|<geom[^>]*mesh=[^>]*/>", "", (folder / "go2/go2.xml").read_text())
    robot, data = Robot.from_mjcf_text(text), table(folder / "go2/go2_traj0.csv.gz")
    return log_of(robot, data[:, 0], data[:, 1:13], data[:, 13:25], 0.005, cutoff=15.0, trim=0.2)


def lbr(folder: Path) -> Dataset:
    data = table(folder / "lbr_med7/measurements.csv.gz")
    robot = Robot.from_file(folder / "lbr_med7/med7dock.urdf", inertias="nearest")
    return log_of(robot, 0.01 * np.arange(len(data)), data[:, :7], -data[:, 7:14], 0.01, cutoff=5.0, trim=0.2)


def triple(folder: Path) -> tuple[Dataset, Dataset]:
    pieces = [x for _, x in sorted(np.load(folder / "triple_pendulum/triple_id.npz").items()) if x.ndim == 2]
    q = np.concatenate([np.stack([x[:, 0] + np.pi, x[:, 1] - x[:, 0], x[:, 2] - x[:, 1]], 1) for x in pieces])
    episode, steps = np.repeat(np.arange(len(pieces)), [len(x) for x in pieces]), [np.arange(len(x)) for x in pieces]
    model = Model(Robot.from_file(folder / "triple_pendulum/published.urdf"))
    raw = dataset(model, 1e-3 * np.concatenate(steps), q, np.zeros_like(q), episode)
    rows = Preparation(cutoff=25.0, trim=0.1, every=5).apply(raw)
    return rows.rows(rows.episode % 3 > 0), rows.rows(rows.episode % 3 == 0)


def blocks(log: Dataset, guard: float = 0.25) -> tuple[Dataset, Dataset]:
    """Of five blocks of time the third and the fifth are unseen."""
    log, ends = with_strokes(log), np.linspace(log.time[0], log.time[-1] + 1e-9, 6)
    block = np.searchsorted(ends, log.time, side="right") - 1
    near, test = (abs(log.time[:, None] - ends[2:5]) <= guard).any(1), np.isin(block, (2, 4))
    return log.rows(~test & ~near), log.rows(test)
