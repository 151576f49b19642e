"""How many robot files does forcegp take, and are the numbers those of Pinocchio and MuJoCo?

Every file below the folders whose root element is <robot> (.urdf, .xacro) or <mujoco> is read once as it is, and where
that fails once more with exactly the arguments that the error names (`error.remedy`); equal files count once. Counted
are robot files: those that Pinocchio (URDF) or MuJoCo (MJCF) loads, with a joint that moves, and, of a URDF, whose
bodies all have mass in Pinocchio's model; MuJoCo itself requires that. Of every file that is loaded, mass matrix, bias
forces and forward dynamics at a random state are compared, relative to the largest entry (of bias forces that vanish:
to those of 1 rad/s^2). Joints that mimic others are compared by projecting the full model with the constant matrix G of
the file. Of MuJoCo acts what a robot has: no springs, damping, tendons, actuators, contacts, medium or
rotors of free bodies.

    python -m benchmarks.robot_files FOLDER [FOLDER ...]       counts
    python -m benchmarks.robot_files FOLDER --each             a line for every file that moves
"""

from __future__ import annotations

import argparse
import hashlib
import re
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco as untyped
import numpy as np
import pinocchio as pin
import torch
from defusedxml import ElementTree

from forcegp.errors import ForceGPError, RobotFileWarning
from forcegp.robots import Robot
from forcegp.robots.layout import BASE
from forcegp.robots.mjcf import is_mjcf
from forcegp.robots.urdf_file import read_robot_file

mujoco: Any = untyped
CLOSE = 1e-9
SUFFIXES = (".urdf", ".xacro", ".xml", ".mjcf")


@dataclass(frozen=True)
class File:
    """What happened to one file."""

    path: Path
    format: str
    oracle: str
    """ "robot", "massless" (some body has no mass), "still" (nothing moves), or why it could not be loaded."""
    outcome: str
    """ "as it is", "one round", or the class of the error after it."""
    remedy: Mapping[str, Any]
    message: str
    error: float
    """Largest difference from the oracle, relative."""


def measured(path: Path, *, mjcf: bool) -> File:
    """Read one file, and compare."""
    kind, compared = _mujoco(path) if mjcf else _pinocchio(path)
    robot, remedy, message, outcome = None, {}, "", "as it is"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RobotFileWarning)
        try:
            robot = Robot.from_file(path)
        except ForceGPError as first:
            remedy, outcome = getattr(first, "remedy", {}), type(first).__name__
            message = str(first)
            if remedy:
                try:
                    robot, outcome = Robot.from_file(path, **remedy), "one round"
                except ForceGPError as second:
                    outcome, message = f"{type(second).__name__} after one round", str(second)
    wrong = np.nan
    if robot is not None and kind in ("robot", "massless"):
        theirs = compared(robot)
        wrong, message = _difference(robot, theirs), f"condition of M {np.linalg.cond(theirs[0]):.1e}"
    return File(path, "MJCF" if mjcf else "URDF", kind, outcome, remedy, message, wrong)


Numbers = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Mass matrix, bias forces and accelerations."""


def _state(robot: Robot) -> tuple[torch.Tensor, np.ndarray, np.ndarray]:
    q, v, tau = np.random.default_rng(0).uniform(-1.0, 1.0, (3, robot.nv))
    return robot.integrate(robot.neutral(), torch.from_numpy(q)), v, tau


def _difference(robot: Robot, theirs: Numbers) -> float:
    """The largest relative difference of M, bias and accelerations at a random state."""
    x, *rest = _state(robot)
    v, tau = map(torch.from_numpy, rest)
    ours = (robot.mass_matrix(x), robot.bias_forces(x, v), robot.forward_dynamics(x, v, tau))
    triples = zip((mine.numpy() for mine in ours), theirs, (0.0, np.abs(theirs[0]).max(), 0.0), strict=True)
    return max(float(np.abs(mine - their).max() / max(np.abs(their).max(), least)) for mine, their, least in triples)


def _pinocchio(path: Path) -> tuple[str, Callable[[Robot], Numbers]]:
    """What Pinocchio makes of a file, and its numbers for a robot of it."""
    try:
        model = pin.buildModelFromXML(read_robot_file(path))
    except Exception as error:  # whatever its parser, or xacro, raises
        return type(error).__name__, _pinocchio_numbers
    masses = [inertia.mass for inertia in list(model.inertias)[1:]]
    return "still" if not masses else "robot" if min(masses) > 0.0 else "massless", _pinocchio_numbers


def _pinocchio_numbers(robot: Robot) -> Numbers:
    ours_alone = any(group.name == BASE for group in robot.layout.groups)  # a base that the file does not name
    free = [pin.JointModelFreeFlyer()] if ours_alone else []
    model = pin.buildModelFromXML(robot.urdf_text, *free)
    model.gravity.linear = robot.gravity.numpy()
    data = model.createData()
    x, v, tau = _state(robot)
    G, positions = np.zeros((model.nv, robot.nv)), pin.neutral(model)
    groups = {"root_joint" if group.name == BASE else group.name: group for group in robot.layout.groups}
    followed = mimics(robot.urdf_text)
    for name, joint in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):
        if name in groups:  # in the same coordinates
            rows, places = groups[name].rows, groups[name].places
            G[joint.idx_v : joint.idx_v + joint.nv, rows] = np.eye(joint.nv)
            positions[joint.idx_q : joint.idx_q + joint.nq] = x[places].numpy()
            continue
        position, row = _motion(name, robot, followed)
        if joint.nv == 1:
            G[joint.idx_v] = row
            angle = [position] if joint.nq == 1 else [np.cos(position), np.sin(position)]
            positions[joint.idx_q : joint.idx_q + joint.nq] = angle
    upper = np.triu(pin.crba(model, data, positions))
    M = G.T @ (upper + np.triu(upper, 1).T) @ G
    bias = G.T @ pin.nonLinearEffects(model, data, positions, G @ v)
    if G.shape[0] == G.shape[1]:
        return M, bias, G.T @ pin.aba(model, data, positions, G @ v, G @ tau)
    return M, bias, np.linalg.solve(M, tau - bias)


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


def _motion(name: str, robot: Robot, followed: Mapping[str, tuple[str, float, float]]) -> tuple[float, np.ndarray]:
    """Position of a joint, and its velocity per unit of those of the robot."""
    if name in robot.locked or (name not in followed and name not in robot.joint_names):
        return robot.locked.get(name, 0.0), np.zeros(robot.nv)
    if name in followed:
        other, multiplier, offset = followed[name]
        position, row = _motion(other, robot, followed)
        return multiplier * position + offset, multiplier * row
    place = robot.joint_names.index(name)
    return float(_state(robot)[0][robot.position_names.index(name)]), np.eye(robot.nv)[place]


def _mujoco(path: Path) -> tuple[str, Callable[[Robot], Numbers]]:
    """What MuJoCo makes of a file, and its numbers for a robot of it."""
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        return type(error).__name__, lambda robot: _mujoco_numbers(None, robot)
    return "robot" if model.njnt else "still", lambda robot: _mujoco_numbers(model, robot)


def _mujoco_numbers(model: Any, robot: Robot) -> Numbers:
    """Free bodies move in their own axes in ours, and in those of the world in MuJoCo's: v' = T v, a' = T a + drift."""
    bits = mujoco.mjtDisableBit
    for bit in (bits.mjDSBL_CONSTRAINT, bits.mjDSBL_SPRING, bits.mjDSBL_DAMPER, bits.mjDSBL_ACTUATION):
        model.opt.disableflags |= int(bit)
    model.opt.density, model.opt.viscosity = 0.0, 0.0
    model.body_gravcomp[:], model.tendon_armature[:] = 0.0, 0.0
    for joint in np.flatnonzero(model.jnt_type == 0):
        model.dof_armature[model.jnt_dofadr[joint] : model.jnt_dofadr[joint] + 6] = 0.0
    mujoco.mj_setConst(model, mujoco.MjData(model))
    names = [joint.name for joint in robot.all_joints if joint.type != "fixed"]  # some have no name in the file
    followed = _couplings(model, names)
    x, v, tau = _state(robot)
    free = iter(robot.layout.groups)
    data, T, drift = mujoco.MjData(model), np.zeros((model.nv, robot.nv)), np.zeros(model.nv)
    for joint, kind in enumerate(model.jnt_type):
        place, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        if kind >= 2:
            data.qpos[place], T[dof] = _motion(names[joint], robot, followed)
            continue
        group = next(free)
        data.qpos[place : place + 7] = x[group.places].numpy()[[0, 1, 2, 6, 3, 4, 5]]
        T[dof : dof + 6, group.rows] = np.eye(6)
    mujoco.mj_kinematics(model, data)
    for joint in np.flatnonzero(model.jnt_type == 0):
        rows, turning = (model.jnt_dofadr[joint] + np.arange(3) + k for k in (0, 3))
        R, own = data.xmat[model.jnt_bodyid[joint]].reshape(3, 3), T @ v
        drift[rows] = R @ np.cross(own[turning], own[rows])
        T[rows] = R @ T[rows]
    data.qvel[:] = T @ v
    data.qfrc_applied[:] = T @ tau
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    M, bias = T.T @ full @ T, T.T @ (data.qfrc_bias + full @ drift)
    if T.shape[0] == T.shape[1]:
        return M, bias, T.T @ (data.qacc - drift)
    return M, bias, np.linalg.solve(M, tau - bias)


def _couplings(model: Any, names: list[str]) -> dict[str, tuple[str, float, float]]:
    """Joint, multiplier and offset of every active equality of two joints that is linear."""
    found: dict[str, tuple[str, float, float]] = {}
    for k in np.flatnonzero((model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)) * model.eq_active0):
        (joint, other), numbers = (model.eq_obj1id[k], model.eq_obj2id[k]), model.eq_data[k]
        if other >= 0 and not numbers[2:5].any():
            starts = [model.qpos0[model.jnt_qposadr[each]] for each in (joint, other)]
            offset = starts[0] + numbers[0] - numbers[1] * starts[1]
            found.setdefault(names[joint], (names[other], float(numbers[1]), float(offset)))
    return found


def report(files: list[File], *, each: bool) -> None:
    """Print the counts, and a line for every file that moves if wished."""
    for form in sorted({file.format for file in files}):
        _counts([file for file in files if file.format == form], "MuJoCo" if form == "MJCF" else "Pinocchio")
    for file in files:
        if file.oracle in ("robot", "massless") and (each or file.error > CLOSE):
            told = file.message if file.outcome in LOADED else ""
            print(f"{file.outcome:10} {file.error:8.1e} {file.path} {dict(file.remedy)} {told}")
    for file in files:
        if file.outcome not in LOADED and file.oracle != "still" and (each or file.oracle == "robot"):
            print(f"{file.oracle}: {file.outcome}: {file.message[:300]}")


LOADED = ("as it is", "one round")


def _counts(files: list[File], oracle: str) -> None:
    robots = [file for file in files if file.oracle == "robot"]
    outcomes = Counter(file.outcome for file in robots)
    as_is, once = (outcomes.pop(each, 0) for each in LOADED)
    print(f"{len(files)} {files[0].format} files: {dict(Counter(file.oracle for file in files))} in {oracle}")
    print(f"of {len(robots)} robots: {as_is} load as they are, {once} after one")
    print(f"round ({100.0 * (as_is + once) / max(len(robots), 1):.1f} %); refused: {dict(outcomes) or 'none'}")
    print(f"remedies: {dict(Counter(' '.join(file.remedy) for file in robots if file.outcome == LOADED[1]))}")
    errors = [file.error for file in files if np.isfinite(file.error)]
    beyond = sum(error > CLOSE for error in errors)
    worst = max(errors, default=0.0)
    print(f"compared with {oracle}: {len(errors)}, of which beyond {CLOSE:g}: {beyond}; largest {worst:.2g}\n")


def robot_files(folders: list[Path]) -> dict[str, tuple[Path, bool]]:
    """Path of every different robot file, and whether it is MJCF."""
    found: dict[str, tuple[Path, bool]] = {}
    for path in sorted(path for folder in folders for path in folder.rglob("*") if path.suffix in SUFFIXES):
        data = path.read_bytes() if path.is_file() else b""
        text = data.decode("utf-8", errors="replace")
        if is_mjcf(text) or (b"<robot" in data and path.suffix in (".urdf", ".xacro")):
            found.setdefault(hashlib.sha256(data).hexdigest(), (path, is_mjcf(text)))
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--each", action="store_true")
    given = parser.parse_args()
    found = robot_files(given.folders).values()
    report([measured(path, mjcf=mjcf) for path, mjcf in found], each=given.each)
