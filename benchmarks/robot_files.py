"""How many robot files does `Robot.from_urdf` take, and are the numbers those of Pinocchio?

Every .urdf below the folders is read as it is, and where that fails once more with exactly the arguments that the error
names (`error.remedy`). Counted are robot files: those that Pinocchio loads, with a joint that moves, and whose bodies
all have mass in Pinocchio's model. Of every file that is loaded, mass matrix, bias forces and forward dynamics at a
random state are compared with Pinocchio's, relative to the largest entry (of bias forces that vanish: to those of 1
rad/s^2); joints that mimic others by projecting the full model with the constant matrix G of the file.

    python -m benchmarks.robot_files FOLDER [FOLDER ...]       counts
    python -m benchmarks.robot_files FOLDER --each             a line for every file that moves
"""

from __future__ import annotations

import argparse
import re
import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import torch
from defusedxml import ElementTree

from forcegp.errors import RobotFileWarning, RobotModelError, UnstatedBase
from forcegp.robots import Robot
from forcegp.robots.layout import BASE

CLOSE = 1e-9
ASKED = "not bolted"
"""What the message of an UnstatedBase says, also beside other problems."""


@dataclass(frozen=True)
class File:
    """What happened to one file."""

    path: Path
    pinocchio: str
    """ "robot", "massless" (some body has no mass), "still" (nothing moves), or why it could not be loaded."""
    outcome: str
    """ "as it is", "one round", or the class of the error after it."""
    remedy: Mapping[str, Any]
    asked: bool
    """Whether the base was asked for."""
    message: str = ""
    error: float = np.nan
    """Largest difference from Pinocchio, relative."""


def measured(path: Path) -> File:
    """Read one file, and compare."""
    try:
        model = pin.buildModelFromUrdf(str(path))
        masses = [inertia.mass for inertia in list(model.inertias)[1:]]
        kind = "still" if not masses else "robot" if min(masses) > 0.0 else "massless"
    except Exception as error:  # whatever its parser raises
        kind = f"{type(error).__name__}"
    robot, remedy, message, asked, outcome = None, {}, "", False, "as it is"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RobotFileWarning)
        try:
            robot = Robot.from_urdf(path)
        except RobotModelError as first:
            message, remedy, asked = str(first), first.remedy, isinstance(first, UnstatedBase) or ASKED in str(first)
            outcome = type(first).__name__
            if remedy:
                try:
                    robot, outcome = Robot.from_urdf(path, **remedy), "one round"
                except RobotModelError as second:
                    outcome = f"{type(second).__name__} after one round"
                    message = str(second)
    wrong = np.nan if robot is None or kind not in ("robot", "massless") else difference(robot)
    return File(path, kind, outcome, remedy, asked, message, wrong)


def difference(robot: Robot) -> float:
    """The largest relative difference of M, bias and accelerations at a random state."""
    random = np.random.default_rng(0)
    q, v, tau = random.uniform(-1.0, 1.0, (3, robot.nv))
    ours_alone = any(group.name == BASE for group in robot.layout.groups)  # a base that the file does not name
    free = [pin.JointModelFreeFlyer()] if ours_alone else []
    model = pin.buildModelFromXML(robot.urdf_text, *free)
    model.gravity.linear = robot.gravity.numpy()
    data = model.createData()
    G, positions = np.zeros((model.nv, robot.nv)), pin.neutral(model)
    x = robot.integrate(robot.neutral(), torch.from_numpy(q))
    groups = {"root_joint" if group.name == BASE else group.name: group for group in robot.layout.groups}
    followed = mimics(robot.urdf_text)
    for name, joint in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):
        if name in groups:  # in the same coordinates
            rows, places = groups[name].rows, groups[name].places
            G[joint.idx_v : joint.idx_v + joint.nv, rows] = np.eye(joint.nv)
            positions[joint.idx_q : joint.idx_q + joint.nq] = x[places].numpy()
            continue
        position, row = _motion(name, robot, followed, q)
        if joint.nv == 1:
            G[joint.idx_v] = row
            angle = [position] if joint.nq == 1 else [np.cos(position), np.sin(position)]
            positions[joint.idx_q : joint.idx_q + joint.nq] = angle
    upper = np.triu(pin.crba(model, data, positions))
    M = G.T @ (upper + np.triu(upper, 1).T) @ G
    bias = G.T @ pin.nonLinearEffects(model, data, positions, G @ v)
    if G.shape[0] == G.shape[1]:
        a = G.T @ pin.aba(model, data, positions, G @ v, G @ tau)
    else:
        a = np.linalg.solve(M, tau - bias)
    y, z = (torch.from_numpy(each) for each in (v, tau))
    ours = (robot.mass_matrix(x), robot.bias_forces(x, y), robot.forward_dynamics(x, y, z))
    triples = zip((mine.numpy() for mine in ours), (M, bias, a), (0.0, np.abs(M).max(), 0.0), strict=True)
    return max(float(np.abs(mine - their).max() / max(np.abs(their).max(), least)) for mine, their, least in triples)


def mimics(text: str) -> dict[str, tuple[str, float, float]]:
    """Joint, multiplier and offset of every <mimic> of a joint that moves."""
    found = {}
    plain = re.sub(r"([<\s]/?)(\w+):(?=\w+)", r"\1\2-", text)  # prefixes need not be declared
    for joint in ElementTree.fromstring(plain).findall("joint"):
        mimic = joint.find("mimic")
        if mimic is not None and joint.get("type") != "fixed":
            numbers = (float(mimic.get("multiplier", 1.0)), float(mimic.get("offset", 0.0)))
            found[joint.get("name", "")] = (mimic.get("joint", ""), *numbers)
    return found


def _motion(
    name: str, robot: Robot, followed: Mapping[str, tuple[str, float, float]], q: np.ndarray
) -> tuple[float, np.ndarray]:
    """Position of a joint, and its velocity per unit of those of the robot."""
    if name in robot.locked or (name not in followed and name not in robot.joint_names):
        return robot.locked.get(name, 0.0), np.zeros(robot.nv)
    if name in followed:
        other, multiplier, offset = followed[name]
        position, row = _motion(other, robot, followed, q)
        return multiplier * position + offset, multiplier * row
    place = robot.joint_names.index(name)
    return float(q[place]), np.eye(robot.nv)[place]


def report(files: list[File], *, each: bool) -> None:
    """Print the counts, and a line for every file that moves if wished."""
    robots = [file for file in files if file.pinocchio == "robot"]
    loaded = {outcome: [file for file in robots if file.outcome == outcome] for outcome in ("as it is", "one round")}
    refused = Counter(file.outcome for file in robots if file.outcome not in loaded)
    both = sum(map(len, loaded.values()))
    print(f"{len(files)} files: {dict(Counter(file.pinocchio for file in files))} in Pinocchio")
    print(f"of {len(robots)} robots: {len(loaded['as it is'])} load as they are, {len(loaded['one round'])} after one")
    print(f"round ({100.0 * both / max(len(robots), 1):.1f} %); refused: {dict(refused) or 'none'}")
    print(f"remedies: {dict(Counter(' '.join(file.remedy) for file in loaded['one round']))}")
    compared = [file for file in files if np.isfinite(file.error)]
    wrong = [file for file in compared if not file.error < CLOSE]
    worst = max((file.error for file in compared), default=0.0)
    print(f"compared with Pinocchio: {len(compared)}, of which beyond {CLOSE:g}: {len(wrong)}; largest {worst:.2g}")
    print(f"asked for their base: {sum(file.asked for file in robots)}")
    for file in wrong:
        print(f"  {file.error:.2g} {file.path}")
    for file in files if each else ():
        if file.pinocchio in ("robot", "massless"):
            asked = "base?" if file.asked else "     "
            print(f"{file.outcome:10} {asked} {file.error:8.1e} {file.path.parent.name}/{file.path.name} {file.remedy}")
    for file in files:
        if file.outcome not in loaded and file.pinocchio != "still" and (each or file.pinocchio == "robot"):
            print(f"{file.pinocchio}: {file.message[:300]}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--each", action="store_true")
    given = parser.parse_args()
    report([measured(path) for folder in given.folders for path in sorted(folder.rglob("*.urdf"))], each=given.each)
