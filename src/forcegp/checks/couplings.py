"""Joints that drives turn together: a parallelogram, a belt, a differential, whose log is not of single joints."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np
import torch
from jaxtyping import Float

from forcegp.checks.causes import NUMBER, Candidate, Cause, changed, number
from forcegp.checks.check_input import CheckInput
from forcegp.checks.torques import Change, Comparison
from forcegp.doubts import listed

LEAST_SHARE = 0.2  # of the larger weight in a torque, from which on the other joint's is part of it
ROUNDED = (0.25, 2.5 * NUMBER), (0.01, 4.5 * NUMBER)  # to which weights are rounded, and what these numbers cost
HALVES = [0.5 * np.array([[a, s * a], [b, -s * b]]) for a, b, s in product((1.0, -1.0), repeat=3)]
"""Weights of two drives that turn one joint together and the other against each other, under all signs."""
OWN, ALIKE = 5.0, 0.5  # factor of the torque of a joint up to which it is its own; of the larger torque of two
PARALLEL = 0.99  # cosine of the angle between the axes of a parallelogram
EASILY = 20.0  # condition of the weights up to which torques can be told apart again


def coupled_joints(now: Comparison, inputs: CheckInput, bad: np.ndarray, first: bool) -> Iterator[Candidate]:
    """A joint logged as its own and the one before it, or signals that drives share; `bad` (nv,) fit badly."""
    # With p = L q of a log, power is the same where the joints' torques are L' times those logged
    layout, names = now.robot.layout, inputs.names
    kinematics = now.robot.kinematics(torch.tensor(now.rows.q[:1], device=now.robot.device))
    for body, parent in ((body, parent) for body, parent in enumerate(layout.parents) if parent >= 0):
        one, other = layout.drives[parent].joint, layout.drives[body].joint
        if one == other or not bad[[one, other]].any():
            continue
        axes = kinematics.frame_jacobian(layout.bodies[body].child)[0, 3:, [one, other]].cpu().numpy()
        for sign in (1.0, -1.0) if abs(axes[:, 0] @ axes[:, 1]) > PARALLEL else ():
            L = np.eye(now.rows.nv)
            L[other, one] = sign
            how = "the sum of its own and that" if sign > 0.0 else "its own less that"
            what = f"the position of {names[other]} is logged as {how} of {names[one]}, as of a parallelogram, or of a "
            mix = {"q": np.linalg.inv(L), "v": np.linalg.inv(L), "u": L.T}
            yield from _apart(now, f"{what}motor at the base", (one, other), mix, 1.5 * NUMBER)
        both, place = bad[[one, other]].all(), np.ix_((one, other), (one, other))
        found = _needed(now, [one, other]) if both else np.zeros((2, 2))
        for cost, weights in (*_rounded(found), *((1.5 * NUMBER, each) for each in HALVES)) if both else ():
            each = [f"{x[0]:+.3g} of {names[one]} {x[1]:+.3g} of {names[other]}" for x in weights]
            what = f"the torques of {names[one]} and {names[other]} are those of drives that turn both joints, "
            what += f"{each[0]} and {each[1]} of what these need: a differential"
            U = np.eye(now.rows.nv)
            U[place] = np.linalg.inv(weights)
            yield from _apart(now, what, (one, other), {"u": U}, cost)
        for weights in HALVES if both and first else ():
            D, U = np.eye(now.rows.nv), np.eye(now.rows.nv)
            D[place], U[place] = weights.T, np.linalg.inv(weights)
            what = f"all signals of {names[one]} and {names[other]} are those of motors that turn both: a differential"
            yield from _apart(now, what, (one, other), {"q": D, "v": D, "u": U}, 1.5 * NUMBER)
        sizes, own = now.rows.u[:, [one, other]].std(axis=0), found.diagonal()  # in sums a large one hides the other
        if now.drives is None and 1.0 / OWN < own.min() <= own.max() < OWN and sizes.min() > ALIKE * sizes.max():
            D = np.eye(now.rows.nv)
            D[place] = np.linalg.inv(HALVES[0])
            yield _sticking(now, inputs, (one, other), D)


def _sticking(now: Comparison, inputs: CheckInput, joints: tuple[int, int], drives: np.ndarray) -> Candidate:
    """Torques of joints whose friction is that of these drives."""
    names = listed(inputs.named(joints))
    what = f"friction of {names} is that of drives that turn with their sum and their difference: a differential"
    do = "forcegp auto and forcegp fit --forces gear choose such motors."
    cause = number("coupled joints", what, joints[0], 0.0, 1.5 * NUMBER, joints=joints, do=do, numbers={})
    at_drives = now.after(lambda rows: replace(changed()(rows), u=rows.u @ np.linalg.inv(drives)))
    return cause, replace(at_drives, drives=drives)


def _apart(
    now: Comparison, what: str, joints: tuple[int, int], mix: dict[str, np.ndarray], cost: float
) -> Iterator[Candidate]:
    """The log whose signals are these sums of those of all joints, with friction of joints and of drives."""

    def changing(*signals: str) -> Change:
        weights = {"a": mix.get("v"), **mix}
        return lambda rows: replace(changed()(rows), **{x: getattr(rows, x) @ weights[x].T for x in signals})

    names = now.robot.joint_names
    sums = (
        f"{signal} of {names[k]} is {' '.join(f'{w:+.3g} {names[m]}' for m, w in enumerate(row) if w)}"
        for signal, weights in mix.items()
        for k, row in enumerate(weights)
        if np.count_nonzero(row) > 1
    )
    do = f"Import sums of columns, as in forcegp import --u 'COLUMN_A + COLUMN_B', so that {'; '.join(sums)}."
    told = {"joints": joints, "correction": {"mix": {name: tuple(x.tolist()) for name, x in mix.items()}}}
    cause = Cause(about="coupled joints", what=what, do=do, cost=cost, number="q" not in mix, **told)
    if "q" not in mix:
        yield cause, now.with_torques(changing("u"))
        of_drives = replace(now.after(changed()), drives=mix["u"].T)
        vars(of_drives)["tau"] = now.tau @ np.linalg.inv(mix["u"].T)
        yield cause, of_drives
    else:
        of_joints = now.after(changing(*"qvau"))
        yield cause, of_joints
        of_drives = replace(now.after(changing(*"qva")), drives=np.linalg.inv(mix["q"]))
        vars(of_drives)["tau"] = of_joints.tau @ mix["q"]
        yield cause, of_drives


def _needed(now: Comparison, pair: list[int]) -> Float[np.ndarray, "2 2"]:
    """Weights of what two joints need in each of their torques, beside friction of both."""
    friction = np.concatenate([now.friction[:, k] for k in pair], axis=-1)
    columns = np.c_[now.tau[:, pair], friction, np.ones(len(friction))]
    size = np.linalg.norm(columns, axis=0) + 1e-300
    return np.linalg.lstsq(columns / size, now.rows.u[:, pair], rcond=1e-9)[0][:2].T / size[:2]


def _rounded(found: Float[np.ndarray, "2 2"]) -> Iterator[tuple[float, Float[np.ndarray, "2 2"]]]:
    """Weights of torques that share what joints need, and their cost; none where each has its own."""
    for step, cost in ROUNDED:
        rounded = step * np.round(found / step)
        size = np.abs(rounded)
        if (size.min(axis=1) >= LEAST_SHARE * size.max(axis=1)).any() and np.linalg.cond(rounded) < EASILY:
            yield cost, rounded
