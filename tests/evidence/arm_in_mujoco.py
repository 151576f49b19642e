"""An arm in MuJoCo that follows sines: what its joints do, what moves them and what its sensors measure."""

import mujoco as untyped
import numpy as np
from tests.posterior.arm import URDF

mujoco = untyped
START = np.array([0.0, 0.6, 0.7])


def followed(prepare, seconds, rate, substeps, taken=lambda q, v: 0.0, seed=0):
    """q, v, u, a (rows, 3), and sensors (rows, k), of a model that `prepare` compiles of the arm's spec."""
    # `taken` is what does not arrive of the torques u
    spec = mujoco.MjSpec.from_string(URDF)
    spec.option.timestep, spec.option.integrator = 1.0 / (substeps * rate), mujoco.mjtIntegrator.mjINT_RK4
    model = prepare(spec)
    model.dof_damping[:], model.dof_frictionloss[:] = [0.8, 0.7, 0.5], 0.0
    data, rng, out = mujoco.MjData(model), np.random.default_rng(seed), []
    f, shift = rng.uniform(0.2, 1.1, (3, 4)), rng.uniform(0.0, 6.0, (3, 4))
    size = np.array([[0.25], [0.15], [0.2]]) / f**0.7
    for k in range(seconds * rate * substeps):
        phase = 2.0 * np.pi * f * k * model.opt.timestep + shift
        q, v = START + (size * np.sin(phase)).sum(1), (size * 2.0 * np.pi * f * np.cos(phase)).sum(1)
        if not k:
            data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        u = data.qfrc_bias + [60, 60, 25] * (q - data.qpos) + [6, 6, 2.5] * (v - data.qvel)
        data.qfrc_applied[:] = u - taken(data.qpos, data.qvel)
        if not k % substeps:
            mujoco.mj_forward(model, data)
            out.append(np.concatenate([data.qpos, data.qvel, u, data.qacc, data.sensordata]))
        mujoco.mj_step(model, data)
    return np.split(np.array(out), [3, 6, 9, 12], axis=1), rng
