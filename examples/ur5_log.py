"""A UR5's log as a first recording looks, from MuJoCo: python examples/ur5_log.py log.csv (writes ur5.urdf, too).

Time in ms with jitter, degrees, a turned torque at the elbow, torques 6 ms late, Stribeck friction in the gears, rotors
and 0.7 kg at the tool that the URDF does not have. `forcegp auto` finds all of it.
"""

import sys
from importlib.resources import files
from pathlib import Path

import mujoco
import numpy as np

URDF = files("forcegp.simulation").joinpath("ur5.urdf").read_text()
EFFORT = np.array([150.0, 150.0, 150.0, 28.0, 28.0, 28.0])  # Nm
RATE, LATE, PAYLOAD = 500, 3, '<inertial><origin xyz="{}"/><mass value="{}"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3"'


def recorded(seconds=80.0, seed=1, mass=0.7, center=(0.02, 0.0, 0.05)):
    """Rows of time, q, v and u in SI units, as they were."""
    held = PAYLOAD.format(" ".join(map(str, center)), mass) + ' ixy="0" ixz="0" iyz="0"/></inertial></link>'
    text = URDF.replace('<link name="tool0"/>', f'<link name="tool0">{held}') if mass else URDF
    model = mujoco.MjModel.from_xml_string(text)
    model.dof_armature[:], model.opt.timestep = 0.01 * EFFORT, 0.25 / RATE
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    data, rng, M, rows = mujoco.MjData(model), np.random.default_rng(seed), np.zeros((6, 6)), []
    home = data.qpos[:] = np.array([0.0, -1.2, 1.4, -0.8, -1.5, 0.0])
    size, w, phase = 0.3 * rng.uniform(0.5, 1, (3, 6)), rng.uniform(0.5, 3, (3, 6)), rng.uniform(0, 6.28, (3, 6))
    for t in np.arange(round(seconds * RATE)) / RATE:
        begun, at = 1.0 - np.exp(-(t**2)), w * t + phase
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, M)
        wanted = 100 * (home + begun * (size * np.sin(at)).sum(0) - data.qpos)
        wanted += 20 * (begun * (size * w * np.cos(at)).sum(0) - data.qvel)
        u = np.clip(M @ wanted + data.qfrc_bias, -EFFORT, EFFORT)
        rows.append((t, *data.qpos, *data.qvel, *u))
        for _ in range(4):
            v = data.qvel
            dry = (0.02 + 0.01 * np.exp(-((v / 0.1) ** 2))) * np.tanh(v / 0.02)
            data.qfrc_applied[:] = u - EFFORT * (dry + 0.01 * v)
            mujoco.mj_step(model, data)
    return np.array(rows)


def faulty(rows, seed=1):
    """The rows as they are logged."""
    rng = np.random.default_rng(seed)
    (t,), q, v, u = (x.T if x.shape[1] == 1 else x for x in np.split(rows, [1, 7, 13], axis=1))
    q, v = (np.rad2deg(x + e * rng.standard_normal(x.shape)) for x, e in ((q, 2e-5), (v, 1e-3)))
    u = np.vstack([u[:1]] * LATE + [u[:-LATE]]) + 0.002 * EFFORT * rng.standard_normal(u.shape)
    return np.column_stack([1e3 * (t + rng.uniform(-4e-4, 4e-4, len(t))), q, v, u * [1, 1, -1, 1, 1, 1]])


if __name__ == "__main__":
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "log.csv")
    names = ["time"] + [f"{name}_A{k}" for name in ("angle", "speed", "torque") for k in range(1, 7)]
    np.savetxt(out, faulty(recorded()), delimiter=";", header=";".join(names), comments="", fmt="%.7g")
    out.with_name("ur5.urdf").write_text(URDF)
