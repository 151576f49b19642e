"""What do learned forces cost in MuJoCo, and are they those of `predict`?

The arm of `tracking` (KUKA iiwa) with `joint-friction` of 100 rows as MuJoCo's passive force. Largest difference of
`mj_forward` from `posterior.predict` over 200 states; time of `mj_step` with the force over that without, 20,000 steps
of 1 ms of an arm that falls for a second again and again, medians of seven in turn; 64 motions of 300 steps on 8
threads against one.

    python -m benchmarks mujoco_forces
"""

from __future__ import annotations

import contextlib
import re
import statistics
import time
from typing import Any

import mujoco as untyped
import numpy as np
from mujoco import rollout

from benchmarks.tracking import GAINS, PDGravity, excitation, followed, robot_of, rows_of
from forcegp import JointFriction, Model, Robot, fit
from forcegp.control.mujoco_forces import MujocoForces

mujoco: Any = untyped
SEED, STATES, STEPS, REPEATS = 1, 200, 20_000, 7


def model_of(robot: Robot) -> Any:
    """The arm in MuJoCo: without shapes, limits and the friction of the URDF, with its inertias as they are."""
    text = re.sub(r"<(visual|collision)>.*?</\1>|<dynamics[^>]*/>", "", robot.urdf_text, flags=re.DOTALL)
    text = text.replace("</robot>", '<mujoco><compiler balanceinertia="false"/></mujoco></robot>')
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.gravity[:], model.opt.timestep, model.jnt_limited[:] = robot.gravity.numpy(), 1e-3, 0
    return model


def seconds_per_step(model: Any, data: Any) -> float:
    begun = time.process_time()
    for k in range(STEPS):
        if k % 1000 == 0:
            mujoco.mj_resetData(model, data)
        mujoco.mj_step(model, data)
    return (time.process_time() - begun) / STEPS


def ends(model: Any, begin: np.ndarray, threads: int) -> np.ndarray:
    with rollout.Rollout(nthread=threads) as runner:
        data = [mujoco.MjData(model) for _ in range(threads)]
        return np.asarray(runner.rollout([model] * len(begin), data, begin, nstep=300)[0])


def run() -> dict[str, float]:
    robot = robot_of()
    given, rng = Model(robot), np.random.default_rng(SEED)
    motion = followed(robot, excitation(SEED), PDGravity(robot, **GAINS), 20.0)
    rows = rows_of(motion, given, SEED, STATES)
    posterior = fit(given.with_forces(JointFriction()), rows.rows(slice(100)), restarts=1)
    model = model_of(robot)
    forces, data = MujocoForces(posterior.predictor(covariance="none"), model), mujoco.MjData(model)
    expected, apart = posterior.predict(rows.q, rows.v, rows.u, covariance=False).mean.numpy(), []
    begin = np.zeros((64, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    with forces:
        for q, v, u, a in zip(rows.q, rows.v, rows.u, expected, strict=True):
            data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, v, u
            mujoco.mj_forward(model, data)
            apart.append(np.abs(data.qacc - a).max())
        for row in begin:
            data.qpos[:], data.qvel[:] = 0.3 * rng.standard_normal((2, 7))
            mujoco.mj_getState(model, data, row, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        same = np.array_equal(ends(model, begin, 1), ends(model, begin, 8))
    times = {True: [], False: []}
    for _ in range(REPEATS):
        for on, context in ((False, contextlib.nullcontext()), (True, forces)):
            with context:
                times[on].append(seconds_per_step(model, data))
    plain, learned = statistics.median(times[False]), statistics.median(times[True])
    print(
        f"largest difference {max(apart):.2e} rad/s^2; mj_step {1e6 * plain:.2f} us, with forces {1e6 * learned:.2f} us"
    )
    return {
        "mujoco_difference": float(max(apart)),
        "mujoco_step_ratio": statistics.median(x / y for x, y in zip(times[True], times[False], strict=True)),
        "mujoco_step_us": 1e6 * learned,
        "mujoco_threads_identical": float(same),
    }
