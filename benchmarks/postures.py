"""Payloads of an arm that rests in a few postures, as its console asks for: errors, and whether 95 % intervals hold.

    python -m benchmarks.postures [FIRST LAST]

Arms are those of `tests/simulation/lugre_arm.py` (MuJoCo, gears with LuGre friction, .8 to 3 kg), the seeds FIRST to
LAST - 1. Their controller knows half of the payload. `rests` are the second halves of rests of 1.5 s, `moves` is the
whole log. A line for each kind, number of postures and laws: the median error of the mass and width of its interval in
%, and how many intervals of mass and centre hold. The second row of each is a rival without memory, from the same rows.
"""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from itertools import pairwise
from typing import Any

import mujoco as untyped
import numpy as np
from tests.simulation.lugre_arm import ENCODER, NOISE_U, NOISE_V, STEP, STIFF, URDF, LuGreArm

from forcegp import Dataset, Model, Robot
from forcegp.cli.payload import AT_REST
from forcegp.data import Preparation
from forcegp.evidence import Torques
from forcegp.fit import fit
from forcegp.forces import parse_forces

mujoco: Any = untyped
LINK = "lbr_iiwa_link_7"
LAWS = {"moves": ("viscous,gear,offset,rotor", "viscous,coulomb,offset,rotor"), "rests": (",".join(AT_REST), "offset")}
RANGE = 0.75 * np.array([2.9, 2.0, 2.9, 2.0, 2.9, 2.0, 3.0])  # rad
PHASE, EVERY = 1500, 4  # steps of a move and of a rest; rows that are logged
NUMBERS = ("mass", "center_of_mass.x", "center_of_mass.y", "center_of_mass.z")


def logs(arm: LuGreArm, count: int) -> dict[str, Dataset]:
    """Rests with the moves between them, and their second halves as an episode each."""
    rng, s = np.random.default_rng(1000 + arm.seed), np.linspace(0.0, 1.0, PHASE, endpoint=False)[:, None]
    at, rise = rng.uniform(-RANGE, RANGE, (count, 7)), 10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5
    q_d = [np.repeat(at[:1], PHASE, 0)]
    for begin, end in pairwise(at):
        q_d += [begin + rise * (end - begin), np.repeat(end[None], PHASE, 0)]
    wanted, time = np.concatenate(q_d), STEP * np.arange(PHASE * (2 * count - 1))
    v_d = np.gradient(wanted, time, axis=0)
    a_d, damping = np.gradient(v_d, time, axis=0), 2.0 * np.sqrt(STIFF * arm.rotors)
    model = LuGreArm(arm.seed).model
    model.body_mass[-1], model.body_inertia[-1] = 0.5 * arm.mass, 0.5 * model.body_inertia[-1]  # the last is the load
    data = mujoco.MjData(model)

    def control(k: int, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        feedback = STIFF * (wanted[k] - np.round(q / ENCODER) * ENCODER) + damping * (v_d[k] - v)
        return data.qfrc_bias + feedback + arm.rotors * a_d[k]

    q, v, u = arm.move(wanted[0], len(wanted), control).transpose(1, 0, 2)
    u, v = u + NOISE_U * rng.standard_normal(u.shape), v + NOISE_V * rng.standard_normal(v.shape)
    rows = {"q": np.round(q / ENCODER) * ENCODER, "v": v, "u": u, "a": np.gradient(v, time, axis=0), "time": time}
    whole = Dataset(**{name: x[::EVERY] for name, x in rows.items()}, model=Model(Robot.from_file(URDF)))
    k = np.arange(len(time))[::EVERY]
    rests = replace(whole, episode=k // (2 * PHASE)).rows((k % (2 * PHASE) > PHASE // 2) & (k % (2 * PHASE) < PHASE))
    return {"moves": whole, "rests": rests}


def main(first: int = 0, last: int = 18) -> None:
    """Measure all arms and print the table."""
    warnings.simplefilter("ignore")
    found: dict[tuple[str, int, str], list[list[float]]] = {}
    for seed in range(first, last):
        arm = LuGreArm(seed)
        for count in (4, 6, 12):
            for kind, log in logs(arm, count).items():
                rows = Preparation(cutoff="auto", delay="auto").apply(log)
                for laws in LAWS[kind]:
                    model = rows.model.with_forces(*parse_forces(f"{laws},payload:{LINK}"))
                    estimates = fit(model, rows, Torques(mean=0.4)).parameters
                    numbers = [estimates[f"payload.{name}"] for name in NUMBERS]
                    ends = [each.interval for each in numbers]
                    held = [low <= x <= high for (low, high), x in zip(ends, [arm.mass, *arm.center], strict=True)]
                    size = [abs(numbers[0].value / arm.mass - 1.0), (ends[0][1] - ends[0][0]) / arm.mass]
                    found.setdefault((kind, count, laws), []).append([*(100.0 * x for x in size), *map(float, held)])
    for (kind, count, laws), rows_of in found.items():
        table = np.array(rows_of)
        error, width = np.median(table[:, :2], axis=0)
        held_of = " ".join(f"{x:.0f}" for x in table[:, 2:].sum(0))
        print(f"{kind} {count:2d} {laws:32s} error {error:6.2f} % width {width:7.1f} % hold {held_of} of {len(table)}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]))
