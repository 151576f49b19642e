"""Logs of two-joint robots, and what goes wrong with such logs: each corruption is a function of a clean log."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import numpy as np
import torch
from tests.checks.logs import column, exchanged
from tests.robots.robot_models import loaded

from forcegp.checks import CheckReport
from forcegp.data import Dataset
from forcegp.doubts import Doubt, Doubts
from forcegp.errors import ForceGPError
from forcegp.mechanics import Contact, Plane
from forcegp.model import Model
from forcegp.robots import Robot

DEGREES = 180.0 / np.pi


def two_links(
    lengths: tuple[float, float] = (0.4, 0.3),
    masses: tuple[float, float] = (1.5, 0.8),
    axes: tuple[str, str] = ("0 1 0", "0 1 0"),
    kinds: tuple[str, str] = ("continuous", "continuous"),
    elbow: tuple[float, float] | None = None,
    size: float = 1.0,
    **options: object,
) -> Robot:
    """Two links that hang down at q = 0, with the centre of mass of each in its middle; `size` times as long."""
    lengths, masses = (lengths[0] * size, lengths[1] * size), (masses[0] * size**3, masses[1] * size**3)
    x, z = (0.0, -lengths[0]) if elbow is None else elbow
    at, limits = f"{x} 0 {z}", '<limit lower="-9" upper="9" effort="900" velocity="90"/>'
    links = "".join(
        f'<link name="link{k + 1}"><inertial><origin xyz="{0.01 * size} 0 {-length / 2}"/><mass value="{mass}"/>'
        f'<inertia ixx="{mass * length**2 / 12 + 1e-3 * size**5}" iyy="{mass * length**2 / 12 + 1e-3 * size**5}" '
        f'izz="{mass * 2e-3 * size**2}"'
        ' ixy="0" ixz="0" iyz="0"/></inertial></link>'
        for k, (length, mass) in enumerate(zip(lengths, masses, strict=True))
    )
    joints = "".join(
        f'<joint name="joint{k + 1}" type="{kinds[k]}"><parent link="{("base", "link1")[k]}"/>'
        f'<child link="link{k + 1}"/>'
        f'<axis xyz="{axes[k]}"/><origin xyz="{("0 0 0", at)[k]}"/>{limits}</joint>'
        for k in range(2)
    )
    text = f'<robot name="two"><link name="base"/>{links}{joints}</robot>'
    return Robot.from_urdf_text(text, **options)  # type: ignore[arg-type]


ROBOTS: Mapping[str, Callable[[], Robot]] = {
    "planar": two_links,
    "heavy": lambda: two_links((0.4, 0.5), (6.0, 3.0)),
    "spatial": lambda: two_links((0.4, 0.35), (2.0, 1.2), ("0 0 1", "0 1 0"), elbow=(0.4, -0.1)),
    "geared": lambda: two_links((0.5, 0.3), (3.0, 2.0), armature=(0.15, 0.05)),
    "crane": lambda: two_links((0.4, 0.4), (4.0, 1.0), ("0 0 1", "0 1 0"), ("prismatic", "continuous")),
}


def clean(robot: Robot, seed: int, *, rate: float = 250.0, seconds: float = 8.0, noise: str = "a") -> Dataset:
    """Sums of sines with friction that nobody modelled; noise on `a` alone (simulated), or on q, v and u (logged)."""
    generator, time = np.random.default_rng(seed), np.arange(round(seconds * rate)) / rate
    omega = 2 * np.pi * generator.uniform(0.1, 1.0, (5, 1, 2))
    size, phase = generator.uniform(0.1, 0.3, (5, 1, 2)), generator.uniform(0, 2 * np.pi, (5, 1, 2))
    angle = omega * time[:, None] + phase
    q, v = (size * np.sin(angle)).sum(0), (size * omega * np.cos(angle)).sum(0)
    a = (-size * omega**2 * np.sin(angle)).sum(0)
    u = robot.inverse_dynamics(*(torch.tensor(x) for x in (q, v, a))).numpy()
    u, noise_std = u + np.std(u, axis=0) * (0.05 * v + 0.1 * np.tanh(v / 0.05)), None
    if noise == "a":
        a, noise_std = a + 0.1 * generator.normal(size=a.shape), np.full(2, 0.1)
    elif noise == "qvu":
        q, v = q + 2e-5 * generator.normal(size=q.shape), v + 3e-4 * generator.normal(size=v.shape)
        u, a = u + 0.01 * np.std(u, axis=0) * generator.normal(size=u.shape), np.gradient(v, time, axis=0, edge_order=2)
    return Dataset(q=q, v=v, u=u, a=a, time=time, model=Model(robot), noise_std=noise_std)


LINE = Plane((1.0, 0.0, 0.0), 0.35)
POINT = (0.0, 0.0, -0.3)


def on_a_line(seed: int, *, rate: float = 250.0, seconds: float = 8, noise: float = 0.1, push: float = 8) -> Dataset:
    """A planar arm whose tip stays on the line x = 0.35 m, pushed against it, with friction along the line."""
    robot, generator, time = two_links(), np.random.default_rng(seed), np.arange(round(seconds * rate)) / rate
    omega, phase = 2 * np.pi * generator.uniform(0.15, 0.8, (4, 1)), generator.uniform(0, 2 * np.pi, (4, 1))
    size = generator.uniform(0.02, 0.05, (4, 1))
    z, dz = -0.4 + (size * np.sin(omega * time + phase)).sum(0), (size * omega * np.cos(omega * time + phase)).sum(0)
    ddz = (-size * omega**2 * np.sin(omega * time + phase)).sum(0)
    # the tip lies at -(l1 sin q1 + l2 sin(q1 + q2)), -(l1 cos q1 + l2 cos(q1 + q2)) in x and z
    bend = np.arccos((np.hypot(0.35, z) ** 2 - 0.4**2 - 0.3**2) / (2 * 0.4 * 0.3))
    q = np.stack([np.arctan2(-0.35, -z) - np.arctan2(0.3 * np.sin(bend), 0.4 + 0.3 * np.cos(bend)), bend], axis=1)
    tensors = torch.tensor(q)
    J = robot.kinematics(tensors, 0 * tensors).frame_jacobian("link2", POINT)[:, [0, 2]].numpy()
    v = np.linalg.solve(J, np.stack([0 * z, dz], axis=1)[..., None])[..., 0]
    bias = robot.kinematics(tensors, torch.tensor(v)).frame_bias_acceleration("link2", POINT)[:, [0, 2]].numpy()
    a = np.linalg.solve(J, (np.stack([0 * z, ddz], axis=1) - bias)[..., None])[..., 0]
    force = push * (1.0 + 0.4 * np.sin(1.7 * time + seed))
    u = robot.inverse_dynamics(tensors, torch.tensor(v), torch.tensor(a)).numpy()
    u = u + force[:, None] * J[:, 0] + 3.0 * dz[:, None] * J[:, 1]
    noisy, model = a + noise * generator.normal(size=a.shape), Model(robot, (Contact("link2", POINT, LINE),))
    return Dataset(q=q, v=v, u=u, a=noisy, time=time, model=model, noise_std=np.full(2, noise) if noise else None)


def at(data: Dataset, names: str, sign: list[float]) -> Dataset:
    return replace(data, **{name: getattr(data, name) * np.array(sign) for name in names})


def degrees(data: Dataset) -> list[float]:
    """Factors that turn radians into degrees, and leave metres."""
    assert data.model is not None
    return [1.0 if joint.type == "prismatic" else DEGREES for joint in data.model.robot.joints]


def late(data: Dataset, names: str, seconds: float) -> Dataset:
    moved = {
        name: np.stack([np.interp(data.time - seconds, data.time, x) for x in getattr(data, name).T], axis=1)
        for name in names
    }
    return replace(data, **moved)


def other_robot(data: Dataset, **changes: object) -> Dataset:
    """The model states another robot than the one that was recorded: attributes of the URDF times factors."""
    assert data.model is not None
    robot = data.model.robot
    text, gravity = robot.urdf_text, changes.pop("gravity", robot.gravity.tolist())
    for find, by in changes.pop("text", ()):  # type: ignore[attr-defined]
        assert find in text, find
        text = text.replace(find, by)
    made = Robot.from_urdf_text(text, gravity=gravity, armature=robot.armature)  # type: ignore[arg-type]
    return replace(data, model=data.model.with_robot(made))


def scaled(data: Dataset, masses: tuple[float, float] = (1.0, 1.0), length: float = 1.0) -> Dataset:
    """With masses (and inertias) of the links, and the distance between the joints, times a factor in the URDF."""
    import xml.etree.ElementTree as ElementTree

    assert data.model is not None
    robot = data.model.robot
    root = ElementTree.fromstring(robot.urdf_text)
    for name, factor in zip(("link1", "link2"), masses, strict=True):
        inertial = root.find(f"link[@name='{name}']/inertial")
        assert inertial is not None
        for tag in ("mass", "inertia"):
            element = inertial.find(tag)
            assert element is not None
            for key, value in element.attrib.items():
                element.set(key, str(float(value) * factor))
    origin = root.find("joint[@name='joint2']/origin")
    assert origin is not None
    origin.set("xyz", " ".join(str(float(x) * length) for x in origin.get("xyz", "").split()))
    text = ElementTree.tostring(root, encoding="unicode")
    made = Robot.from_urdf_text(text, gravity=robot.gravity.tolist(), armature=robot.armature)
    return replace(data, model=data.model.with_robot(made))


def recorded_under(data: Dataset, gravity: tuple[float, float, float]) -> Dataset:
    """The same motion under another gravity than the model states."""
    assert data.model is not None
    robot = data.model.robot
    there = Robot.from_urdf_text(robot.urdf_text, gravity=gravity, armature=robot.armature)
    tensors = [torch.tensor(x) for x in (data.q, data.v, data.a)]
    return replace(data, u=data.u + (there.inverse_dynamics(*tensors) - robot.inverse_dynamics(*tensors)).numpy())


def dropped(data: Dataset, names: str, share: float, seed: int = 0) -> Dataset:
    """A share of the rows set to zero, in bursts of a few rows."""
    generator, lost = np.random.default_rng(seed), np.zeros(len(data), dtype=bool)
    while lost.mean() < share:
        start = generator.integers(1, len(data) - 4)
        lost[start : start + generator.integers(1, 4)] = True
    return replace(data, **{name: np.where(lost[:, None], 0.0, getattr(data, name)) for name in names})


def registers(x: np.ndarray) -> np.ndarray:
    step = np.abs(x).max() / 7.0
    raw = np.round(x / step)
    return step * np.where(raw < 0.0, 10.0 - raw, raw)


def limited(x: np.ndarray, share: float = 0.97) -> np.ndarray:
    return np.minimum(x, np.quantile(x, share, axis=0))


def held(x: np.ndarray) -> np.ndarray:
    rows, start, stop = np.arange(len(x)), int(0.3 * len(x)), int(0.3 * len(x)) + max(25, len(x) // 25)
    return np.where((rows > start) & (rows < stop), x[start], x)


def mixed(data: Dataset, weights: list[list[float]], signals: str) -> Dataset:
    """Positions of drives, which are these sums of joints, or torques alone; power is that of the joints."""
    of = np.array(weights)
    u = np.linalg.inv(of).T if "q" in signals else of
    return replace(data, **{name: getattr(data, name) @ (u if name == "u" else of).T for name in signals})


def sticking(data: Dataset, weights: list[list[float]]) -> Dataset:
    """A differential whose motors have far more dry friction than torque."""
    moved, v = mixed(data, weights, "u"), data.v @ np.linalg.inv(weights)
    return replace(moved, u=moved.u + 3.0 * np.std(moved.u, axis=0) * np.tanh(v / 0.05))


def gripped(data: Dataset, begin: float, every: float = np.inf) -> Dataset:
    """A load of .6 kg on the last link from some time on, or so long, then as long without, again and again."""
    assert data.model is not None
    needed = [
        robot.inverse_dynamics(*(torch.tensor(x) for x in (data.q, data.v, data.a))).numpy()
        for robot in (data.model.robot, loaded(data.model.robot, "link2", mass=0.2))
    ]
    held = (data.time >= begin) & ((data.time - begin) % (2.0 * every) < every)
    return replace(data, u=data.u + np.where(held[:, None], needed[1] - needed[0], 0.0))


def moved(data: Dataset, by: tuple[float, float, float]) -> Dataset:
    """With every contact point elsewhere on its link."""
    assert data.model is not None
    contacts = [replace(each, point=tuple(np.add(each.point, by))) for each in data.model.contacts]
    return replace(data, model=data.model.with_contacts(contacts), truth={})


def invented(data: Dataset) -> Dataset:
    """A contact through which the middle of the motion passes."""
    assert data.model is not None
    robot, q = data.model.robot, torch.tensor(data.q)
    pose = robot.kinematics(q, 0 * q).frame_pose("link2").numpy()
    offset = float(np.median((pose[:, :3, :3] @ np.array(POINT) + pose[:, :3, 3])[:, 0]))
    return replace(data, model=data.model.with_contacts([Contact("link2", POINT, Plane((1.0, 0.0, 0.0), offset))]))


Corruption = Callable[[Dataset], Dataset]
CORRUPTIONS: Mapping[str, tuple[Corruption, str]] = {
    "degrees": (lambda d: at(d, "qva", degrees(d)), "degrees|velocity"),
    "q in degrees": (lambda d: at(d, "q", degrees(d)), "degrees|velocity|jumps"),
    "v in degrees": (lambda d: at(d, "v", degrees(d)), "velocity"),
    "a in degrees": (lambda d: at(d, "a", degrees(d)), "acceleration"),
    "u in mNm": (lambda d: at(d, "u", [1000.0] * 2), "torque unit"),
    "motor side of gears, u": (lambda d: at(d, "u", [1 / 50, 1 / 100]), "torque unit"),
    "torque constant 30 % off": (lambda d: at(d, "u", [1.0, 1.3]), "torque constant|torque unit|mass"),
    "torque sign of one": (lambda d: at(d, "u", [1, -1]), "torque sign"),
    "torque sign of all": (lambda d: at(d, "u", [-1, -1]), "torque sign"),
    "motion sign of one": (lambda d: at(d, "qva", [-1, 1]), "sign"),
    "axis of one": (lambda d: at(d, "qvau", [1, -1]), "sign"),
    "velocity sign": (lambda d: at(d, "v", [1, -1]), "velocity"),
    "torques exchanged": (lambda d: exchanged(d, "u", [1, 0]), "joints exchanged"),
    "motions exchanged": (lambda d: exchanged(d, "qva", [1, 0]), "joints exchanged"),
    "joints exchanged": (lambda d: exchanged(d, "qvau", [1, 0]), "joints exchanged"),
    "velocities exchanged": (lambda d: exchanged(d, "v", [1, 0]), "velocity"),
    "torques 20 ms late": (lambda d: late(d, "u", 0.02), "delay"),
    "velocities 20 ms late": (lambda d: late(d, "v", 0.02), "velocity"),
    "gravity upside down": (lambda d: recorded_under(d, (0, 0, 9.81)), "gravity"),
    "gravity not stated": (lambda d: other_robot(d, gravity=(0, 0, 0)), "gravity"),
    "a mass doubled": (lambda d: scaled(d, (1.0, 2.0)), "mass"),
    "a mass halved": (lambda d: scaled(d, (0.5, 1.0)), "mass|torque unit|inertia"),
    "length .4 -> .6": (lambda d: scaled(d, length=1.5), "length"),
    "3 % of all rows zero": (lambda d: dropped(d, "qvau", 0.03), "zero|drop"),
    "3 % of q zero": (lambda d: dropped(d, "q", 0.03), "zero|drop|velocity"),
    "frozen position": (lambda d: column(replace(d, u=np.round(d.u, 2)), "q", 1, held), "frozen"),
    "saturation": (lambda d: column(d, "u", 0, lambda x: np.clip(x, *np.quantile(x, [0.1, 0.9]))), "saturation"),
    "saturation of a warm drive": (
        lambda d: column(d, "u", 0, lambda x: np.r_[x[:300], limited(x[300:], 0.8)]),
        "saturation",
    ),
    "encoder zero off by .4": (lambda d: replace(d, q=d.q + np.array([0.0, 0.4])), "zero"),
    "frozen torque": (lambda d: column(d, "u", 0, held), "frozen"),
    "torque channel dead": (lambda d: column(d, "u", 1, lambda x: 0 * x), "constant channel"),
    "registers of sign and magnitude": (lambda d: column(d, "u", 0, registers), "register"),
    "targets of the controller": (lambda d: replace(d, u=limited(np.roll(d.q, -9, axis=0))), "targets"),
    "no torque": (lambda d: replace(d, u=0.0 * d.u), "no torque was measured"),
    "turns": (lambda d: at(d, "qva", [0.5 / np.pi] * 2), "turns"),
    "time in ms": (lambda d: replace(d, time=1000 * d.time), "velocity|acceleration|sampling"),
    "gear ratio of 1.6": (lambda d: at(d, "qva", [1.0, 0.625]), "gear ratio"),
    "gear ratio of 1.4, of torques too": (lambda d: at(at(d, "qva", [1.0, 1 / 1.4]), "u", [1.0, 1.4]), "gear ratio"),
    "parallelogram": (lambda d: mixed(d, [[1.0, 0.0], [1.0, 1.0]], "qvau"), "coupled joints"),
    "a load from 2.6 s on": (lambda d: gripped(d, 2.6), "load"),
    "parallelogram, turned": (lambda d: mixed(d, [[1.0, 0.0], [-1.0, 1.0]], "qvau"), "coupled joints"),
    "differential": (lambda d: mixed(d, [[0.5, 0.5], [-0.5, 0.5]], "u"), "coupled joints"),
    "differential of other gears": (lambda d: mixed(d, [[0.8, 0.3], [-0.3, 0.8]], "u"), "coupled joints"),
    "differential whose motors stick": (lambda d: sticking(d, [[0.5, 0.5], [-0.5, 0.5]]), "coupled joints"),
    "a wrist's motors": (lambda d: mixed(d, [[1.0, 1.0], [1.0, -1.0]], "qvau"), "coupled joints"),
    "a slow clock": (lambda d: replace(d, time=1.12 * d.time), "clock"),
}


def named(said: str, words: str) -> bool:
    return any(word in said.lower() for word in words.split("|"))


def said_by(report: CheckReport) -> str:
    return "\n".join(f"[{each.level}] {each.about}: {each.what}" for each in report.doubts if each.level != "ok")


def numbers(doubts: Iterable[Doubt]) -> dict[str, object]:
    """What goldens keep of doubts: all but the sentences."""
    return {
        f"{k} {each.level} {each.about} {' '.join(each.joints)}": {**each.numbers, **each.correction}
        for k, each in enumerate(doubts)
    }


def said_by_fit(data: Dataset, quick: Doubts) -> str:
    """The line that `forcegp fit` prints of these doubts, or why it refuses these rows."""
    assert data.model is not None
    try:
        q, v, u = (torch.tensor(getattr(data.rows([*range(0, len(data), 50)]), name)) for name in "qvu")
        data.model.check_states(q, v, u)
    except ForceGPError as error:
        return str(error)
    return quick.in_one_line()
