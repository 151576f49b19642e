"""A KUKA iiwa in MuJoCo whose gears have LuGre friction (Canudas de Wit et al. 1995), a law that no model here has.

Its rotors and its payload are not in the URDF; positions come from encoders, velocities and torques with noise, and the
torques are logged a little before they act.
"""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline

from forcegp import Dataset, Model, Robot
from forcegp.simulation import kuka_file

URDF = kuka_file()
STEP, SUBSTEPS = 1e-3, 4
MIDDLE = np.array([0.0, 0.3, 0.0, -0.9, 0.0, 0.6, 0.0])
REACH = 0.6 * np.array([2.2, 1.6, 2.2, 1.6, 2.2, 1.6, 2.2])
ENCODER, NOISE_V = 1e-5, 2e-3  # rad, rad/s
NOISE_U = np.array([0.2, 0.2, 0.15, 0.15, 0.08, 0.08, 0.05])
STIFF = 4.0 * np.array([800.0, 800.0, 500.0, 500.0, 200.0, 200.0, 80.0])
Torques = Callable[[int, np.ndarray, np.ndarray], np.ndarray]
Push = tuple[float, int, np.ndarray]
"""When it begins [s], which body, and a force [N] along the world's axes, for half a second."""


def reference(seed: int, seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q, v, a of sines from rest, at every step."""
    rng, time = np.random.default_rng(seed), np.arange(0.0, seconds, STEP)
    q = np.zeros((len(time), 7))
    for j in range(7):
        order = 1.0 + np.arange(5)
        at = 0.3 * np.pi * order * rng.uniform(0.8, 1.2) * time[:, None] + rng.uniform(0.0, 6.0, 5)
        wave = (rng.standard_normal(5) / order * np.sin(at)).sum(1)
        q[:, j] = REACH[j] * wave / np.abs(wave).max()
    rise = np.minimum(0.5 * time, 1.0)
    q = MIDDLE + q * (rise**2 * (3.0 - 2.0 * rise))[:, None]
    v = np.gradient(q, time, axis=0)
    return q, v, np.gradient(v, time, axis=0)


@dataclass
class LuGreArm:
    """One arm, whose numbers the seed draws; `presliding` in rad."""

    seed: int
    presliding: float = 1e-3

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        self.mass, self.center = rng.uniform(0.8, 3.0), rng.uniform(-0.08, 0.08, 3) + 0.08 * np.eye(3)[2]
        self.rotors = 0.5 * np.array([4.0, 4.0, 2.5, 2.5, 1.2, 1.2, 0.5]) * rng.uniform(0.6, 1.4, 7)
        self.level = np.array([8.0, 8.0, 6.0, 6.0, 3.0, 3.0, 2.0]) * rng.uniform(0.7, 1.4, 7)
        self.breakaway, self.stribeck = self.level * rng.uniform(0.1, 0.5, 7), rng.uniform(0.03, 0.1, 7)
        self.viscous = np.array([10.0, 10.0, 8.0, 8.0, 4.0, 4.0, 2.0]) * rng.uniform(0.5, 1.2, 7)
        self.model = self._model()

    def _model(self) -> mujoco.MjModel:
        spec = mujoco.MjSpec.from_file(str(URDF))
        for geom in list(spec.geoms):
            spec.delete(geom)
        for mesh in list(spec.meshes):
            spec.delete(mesh)
        load = spec.bodies[-1].add_body(pos=self.center)
        load.mass, load.inertia, load.ipos = self.mass, np.full(3, 6.4e-4 * self.mass), np.zeros(3)
        load.explicitinertial, spec.compiler.fusestatic = True, False
        spec.option.timestep = STEP / SUBSTEPS
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
        model = spec.compile()
        model.dof_armature[:], model.dof_damping[:], model.dof_frictionloss[:] = self.rotors, 0.0, 0.0
        return model

    def move(self, start: np.ndarray, steps: int, torques: Torques, pushes: tuple[Push, ...] = ()) -> np.ndarray:
        """q, v and u (steps, 3, 7) under the torques of (step, q, v), held for a step."""
        data, z, out = mujoco.MjData(self.model), np.zeros(7), np.zeros((steps, 3, 7))
        data.qpos[:] = start
        bristles, dt = self.level / self.presliding, STEP / SUBSTEPS
        damping = 0.3 * np.sqrt(bristles * np.array([3.0, 3.0, 1.0, 1.0, 0.3, 0.3, 0.1]))
        for k in range(steps):
            q, v = data.qpos.copy(), data.qvel.copy()
            u = torques(k, q, v)
            out[k] = q, v, u
            for _ in range(SUBSTEPS):
                v = data.qvel
                rate = bristles * np.abs(v) / (self.level + self.breakaway * np.exp(-((v / self.stribeck) ** 2)))
                bend = v - rate * z
                friction = bristles * z + damping * np.exp(-((v / 0.02) ** 2)) * bend + self.viscous * v
                z = z + bend * -np.expm1(-rate * dt) / np.maximum(rate, 1e-9) if rate.any() else z
                data.qfrc_applied[:] = u - friction
                for begin, body, force in pushes:
                    if begin <= k * STEP < begin + 0.5:
                        at, none = data.xipos[body], np.zeros(3)
                        mujoco.mj_applyFT(self.model, data, force, none, at, body, data.qfrc_applied)
                mujoco.mj_step(self.model, data)
        return out

    def log(self, seed: int, seconds: float, late: float = -0.0025, pushes: tuple[Push, ...] = ()) -> Dataset:
        """What sensors say of a motion under joint control with the masses of the arm."""
        (q_d, v_d, a_d), rng = reference(seed, seconds), np.random.default_rng(seed)
        data, damping = mujoco.MjData(self.model), 2.0 * np.sqrt(STIFF * self.rotors)

        def control(k: int, q: np.ndarray, v: np.ndarray) -> np.ndarray:
            data.qpos[:], data.qvel[:] = q, v
            mujoco.mj_forward(self.model, data)
            feedback = STIFF * (q_d[k] - np.round(q / ENCODER) * ENCODER) + damping * (v_d[k] - v)
            return data.qfrc_bias + feedback + self.rotors * a_d[k]

        q, v, u = self.move(q_d[0], len(q_d), control, pushes).transpose(1, 0, 2)
        time = STEP * np.arange(len(q))
        u = CubicSpline(time, u)(time - late) + NOISE_U * rng.standard_normal(u.shape)
        v = v + NOISE_V * rng.standard_normal(v.shape)
        q, a = np.round(q / ENCODER) * ENCODER, np.gradient(v, time, axis=0)
        return Dataset(q=q, v=v, u=u, a=a, time=time, model=Model(Robot.from_file(URDF)))
