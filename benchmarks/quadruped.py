"""A quadruped of MuJoCo that lifts its feet in turn, or trots, with 2 kg on its trunk that no file states.

Feet are balls with MuJoCo's own contacts and friction; joints have dry and viscous friction and rotors. Poses have
.5 mm and 1 mrad of white noise, joints .1 mrad, torques .05 Nm. No sensor tells which foot stands. Reported: rows that
stay, flags that are right, the load by `fit` and by `payload` with 95 % intervals, and forces of the feet predicted on
another motion from q, v and u, beside MuJoCo's. For docs/how-to/moving-bases.md.

    python -m benchmarks.quadruped [trot]
"""

import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mujoco as untyped
import numpy as np
import torch
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from forcegp import Dataset, Model, Robot, load_posterior
from forcegp.atomic_files import read_json
from forcegp.cli.main import main as command
from forcegp.data import Preparation
from forcegp.data.views import decided
from forcegp.mechanics import fixed_point
from forcegp.mechanics.gauss_principle import OPEN

mujoco: Any = untyped  # its stubs lack what is called here
LEGS = {"FL": (1, 1), "FR": (1, -1), "RL": (-1, 1), "RR": (-1, -1)}
TRUNK, LENGTH, STEP, EVERY = 6.0, 0.21, 0.0005, 4  # kg, m, s, steps per row
LOAD = '<body pos=".05 .01 .08"><inertial pos="0 0 0" mass="2" diaginertia=".004 .006 .008"/></body>'
UNKNOWN = 'damping=".05" armature=".008" frictionloss=".25"'


def leg(name: str, x: int, y: int) -> str:
    return f"""<body name="{name}_hip" pos="{0.19 * x} {0.05 * y} 0">
    <inertial pos="0 0 0" mass=".6" diaginertia=".0005 .0007 .0006"/><joint name="{name}_hip_joint" axis="1 0 0"/>
    <body name="{name}_thigh" pos="0 {0.08 * y} 0"><inertial pos="-.003 {-0.02 * y} -.03" mass="1"
    diaginertia=".005 .005 .001"/><joint name="{name}_thigh_joint" axis="0 1 0"/><body name="{name}_calf"
    pos="0 0 -{LENGTH}"><inertial pos=".005 0 -.11" mass=".2" diaginertia=".002 .002 .0001"/>
    <joint name="{name}_calf_joint" axis="0 1 0"/><geom name="{name}" type="sphere" size=".02" pos="0 0 -{LENGTH}"
    friction="1.3 .01 .001" priority="1" mass="0" solref=".015 1"/></body></body></body>"""


def scene(load: str = "", joints: str = "") -> str:
    legs = "".join(leg(name, *place) for name, place in LEGS.items())
    motors = "".join(f'<motor joint="{name}_{part}_joint"/>' for name in LEGS for part in ("hip", "thigh", "calf"))
    return f"""<mujoco><compiler angle="radian"/><option timestep="{STEP}" integrator="implicitfast" cone="elliptic"
    impratio="10"/><default><joint {joints}/></default><worldbody>
    <geom type="plane" size="5 5 .1"/><body name="trunk" pos="0 0 .31"><freejoint/><inertial pos=".01 0 .005"
    mass="{TRUNK}" diaginertia=".03 .09 .1"/>{load}{legs}</body></worldbody>
    <actuator>{motors}</actuator></mujoco>"""


def walker() -> Model:
    feet = (fixed_point(f"{name}_calf", (0.0, 0.0, -LENGTH), f"{name}_stands", radius=0.02) for name in LEGS)
    return Model(Robot.from_mjcf_text(scene(), base="floating"), tuple(contact for foot in feet for contact in foot))


def lifted(time: float, gait: str) -> tuple[np.ndarray, np.ndarray]:
    """Of each foot [m], and where the trunk leans: each foot in turn, or diagonal pairs at 1.6 Hz."""
    places = np.array([*LEGS.values()])
    if gait == "trot":
        phase = (1.6 * time + 0.5 * (places.prod(1) < 0.0)) % 1.0
        return 0.035 * np.sin(np.pi * np.minimum(phase / 0.4, 1.0)) ** 2 * min(max(time - 1.0, 0.0), 1.0), np.zeros(2)
    phase = (time - 1.0) % 6.0 if time > 1.0 else 0.0
    turn, part = int(phase // 1.5), phase % 1.5
    lift = 0.03 * np.sin(np.pi * (part - 0.5) / 0.5) ** 2 if 0.5 < part < 1.0 else 0.0
    return lift * np.eye(4)[turn], places[turn] * 0.05 * np.sin(np.pi * part / 1.5) ** 2


def pose(time: float, rates: np.ndarray, phases: np.ndarray, gait: str) -> np.ndarray:
    """Joint positions: the trunk sways, and feet are lifted while the others carry more."""
    size, out = min(time, 1.0) * np.array([0.02, 0.02, 0.02, 0.06, 0.05, 0.05]), list[float]()
    height, x0, y0, pitch, roll, yaw = size * np.sin(2.0 * np.pi * rates * time + phases)
    lifts, lean = lifted(time, gait)
    for lift, (sx, sy) in zip(lifts, LEGS.values(), strict=True):
        x, y = x0 - 0.13 * yaw * sy + lean[0], y0 + 0.19 * yaw * sx + lean[1]
        z = -(0.29 + height - lift) + 0.19 * sx * pitch - 0.13 * sy * roll
        down = np.hypot(y, z)
        knee = -np.arccos(np.clip((x**2 + down**2) / (2.0 * LENGTH**2) - 1.0, -1.0, 1.0))
        out += [np.arctan2(y, -z), np.arctan2(-x, down) - 0.5 * knee, knee]
    return np.array(out)


def recorded(model: Model, seed: int, gait: str = "step", seconds: float = 24.0) -> tuple[Dataset, np.ndarray]:
    """The noisy log, whose flags of stance are 0, and the forces on the feet [N] at each row."""
    rng = np.random.default_rng(seed)
    rates, phases = rng.uniform(0.25, 0.6, 6), rng.uniform(0.0, 2.0 * np.pi, 6)
    plant = mujoco.MjModel.from_xml_string(scene(LOAD, UNKNOWN))
    data = mujoco.MjData(plant)
    data.qpos[7:] = before = pose(0.0, rates, phases, gait)
    feet, rows, forces = [plant.geom(name).id for name in LEGS], [], []
    for count in range(int(seconds / STEP)):
        wanted = pose(count * STEP, rates, phases, gait)
        rate, before = (wanted - before) / STEP, wanted
        data.ctrl[:] = np.clip(120.0 * (wanted - data.qpos[7:]) + 0.9 * (rate - data.qvel[6:]), -40.0, 40.0)
        if count % EVERY == 0 and count * STEP > 0.5:
            mujoco.mj_forward(plant, data)
            on = np.zeros((4, 3))
            for k, contact in enumerate(data.contact):
                wrench = np.zeros(6)
                mujoco.mj_contactForce(plant, data, k, wrench)
                on[feet.index(contact.geom2)] = contact.frame.reshape(3, 3).T @ wrench[:3]
            rows.append(np.concatenate([data.qpos, data.ctrl]))
            forces.append(on)
        mujoco.mj_step(plant, data)
    q, u = np.split(np.array(rows), [19], axis=1)
    turned = Rotation.from_quat(q[:, [4, 5, 6, 3]]) * Rotation.from_rotvec(1e-3 * rng.standard_normal((len(q), 3)))
    noise = np.repeat([5e-4, 1e-4], [3, 12])
    places = np.concatenate([q[:, :3], q[:, 7:]], axis=1) + noise * rng.standard_normal((len(q), 15))
    q = np.concatenate([places[:, :3], turned.as_quat(), places[:, 3:]], axis=1)
    u = np.concatenate([u + 0.05 * rng.standard_normal(u.shape), np.zeros((len(u), 4))], axis=1)
    rest = np.zeros((len(q), model.robot.nv))
    time = STEP * EVERY * np.arange(len(q))
    return Dataset(q=q, v=rest, a=rest, u=u, time=time, model=model), np.array(forces)


def found(folder: Path, dataset: Dataset) -> dict[str, list[float]]:
    """The load by both commands, each with its 95 % interval [kg]."""
    dataset.save(folder / "log.h5")
    forces = "bodies:trunk,viscous,coulomb,rotor"
    command(["fit", str(folder / "log.h5"), "--forces", forces, "--out", str(folder / "fit")])
    command(["payload", str(folder / "log.h5"), "--out", str(folder / "payload")])
    trunk = read_json(folder / "fit" / "estimates.json", "")["parameters"]["trunk.mass"]
    load = read_json(folder / "payload" / "payload.json", "")["parameters"]["payload.mass"]
    plain = [trunk["value"], *trunk["interval_95"]]
    return {"fit": [x - TRUNK for x in plain], "payload": [load["value"], *load["interval_95"]]}


def main(gait: str, runs: int = 4) -> None:
    model, prepare = walker(), Preparation(cutoff="auto", stance="auto")
    logs = [
        (log, prepare.apply(log), forces)
        for log, forces in (recorded(model, seed, gait) for seed in range(1, runs + 1))
    ]
    for seed, (log, rows, _) in enumerate(logs, start=1):
        kept = np.searchsorted(log.time, rows.time - 0.5 * STEP)
        with TemporaryDirectory() as folder, redirect_stdout(None), redirect_stderr(None):
            loads = found(Path(folder), rows)
            posterior = load_posterior(Path(folder) / "fit")
        flags = rows.u[:, -4:]
        right = (flags == (logs[seed - 1][2][kept, :, 2] > 1.0))[flags != OPEN].mean()
        told = ", ".join(f"{name} {x:.3f} ({low:.3f} to {high:.3f}) kg" for name, (x, low, high) in loads.items())
        _, test, forces = logs[seed % runs]
        test = decided(test)
        cutoff = test.metadata["preparation"]["cutoff"]
        smooth = sosfiltfilt(butter(2, cutoff, fs=1.0 / (STEP * EVERY), output="sos"), forces, axis=0)
        smooth = smooth[np.searchsorted(logs[seed % runs][0].time, test.time - 0.5 * STEP)]
        q, v, u = (torch.tensor(x[::10]) for x in (test.q, test.v, test.u))
        with torch.no_grad():
            predicted = posterior.dynamics(q, v, u).multiplier_map().offset.reshape(-1, 4, 3).numpy()
        error, size = (np.sqrt(np.square(x[..., 2]).mean()) for x in (predicted - smooth[::10], smooth[::10]))
        print(f"{seed}: rows {len(rows) / len(log):.0%}, decided {len(decided(rows)) / len(rows):.0%}, flags right")
        print(f"   {right:.2%}; {told}; forces of feet off by")
        print(f"   {error:.2f} N of {size:.0f} along z", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:] or ["step"])
