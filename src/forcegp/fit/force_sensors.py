"""Force sensors beside torques and motion: sign, axes, unit, offset, drift, delay, and a weight that counts twice.

What the rows need less what drives deliver is J^T F, beside what friction, rotors and any masses explain. Of the axes
of F all orders and signs are tried, also as if F were along the axes of the frame, or had been along the world's.

Any masses also explain a tool that hangs from a sensor. Its motion alone shows the axes of that: F = -m (a - g), of a
mass and its center, beside an offset. What torques need beyond the masses of the robot's file shows the unit.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations, product
from re import compile
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from forcegp.data import Dataset
from forcegp.data.dataset import FORCE, IMU
from forcegp.data.delay import torques_of_joints
from forcegp.data.imu import SECONDS, SHIFTS, expected, late_doubts, short_means
from forcegp.data.units import UNITS
from forcegp.data.views import tensors
from forcegp.doubts import Doubt, look, ok, wrong
from forcegp.evidence import torque_regressor
from forcegp.evidence.recorded_rows import arm, sensed_of
from forcegp.fit.unseen import rows_of_known_physics
from forcegp.model import Model

FOLLOWS, OTHER, OFF, NEAR, FELT, MOST_ROWS = 0.5, 0.3, 0.1, 0.15, 0.02, 6000
"""Share of what is needed that a sensor leaves where it follows; what another reading leaves of that at most; offset
over what it measures that is worth a word; logarithm by which a factor is off a unit; least share of torques; rows."""
CARRIES = 0.1
"""Share of its power that a tool alone leaves of a sensor, at most: noise. More is left where the tool touches."""
_EVERY = [np.eye(3)[list(k)] * signs for k in permutations(range(3)) for signs in product((1.0, -1.0), repeat=3)]
NAME = compile(r"[\w.\[\]/]+")  # of a column that stands alone
Shown = Callable[..., Float[np.ndarray, "windows k"]]
Leaves = Callable[[np.ndarray], float]
IN_N = {name: 1.0 / unit.per_si for name, unit in UNITS["force"].items() if name != "N"}
AXES = sorted(_EVERY, key=lambda Q: (abs(np.trace(Q)) < 3.0, -np.trace(Q), -np.linalg.det(Q)))
"""As it is, turned altogether, other axes; then those that are no rotation."""
TARE = "Tare it; or take it off the columns, as in forcegp import --force 'FRAME=FX-1.2,FY,FZ'."
WORDS = {"": "", "own": " along the axes of the frame"}
WORDS |= {"body": WORDS["own"], "world": " along the axes of the world"}
"""By the axes that it has: as stated, also its frame's, its frame's where the world's are stated, and reversed."""


def force_sensor_doubts(dataset: Dataset, model: Model) -> Iterator[Doubt]:
    """Each force sensor beside what torques and motion need there; none where others push."""
    middle = max(0, (len(dataset) - MOST_ROWS) // 2)
    dataset = dataset.rows(slice(middle, middle + MOST_ROWS))
    sensed, held = sensed_of(dataset), {(contact.frame, contact.point) for contact in model.contacts}
    alone = dict(held).keys() <= sensed.keys() and len(dict(held)) == len(held)
    if not sensed or not alone or not dataset.u.any() or model.carries_known_forces:
        return
    if model.actuation.learned:  # as logged
        model = model.with_forces(replace(model.actuation, gain=1.0))
    rows, robot = rows_of_known_physics(model, dataset), model.robot
    missing = rows.in_torque(np.zeros(0), rows.moving(dataset.a))[0][:, : robot.nv]
    q, v, _, a = tensors(dataset)
    with torch.no_grad():
        regressor = torque_regressor(robot.to("cpu"), q, v, a).numpy()
    driven = np.isin(robot.joint_names, robot.single_joint_names)
    laws = np.stack([dataset.v, np.sign(dataset.v), np.ones(dataset.v.shape), dataset.a], axis=-1) * driven[:, None]

    def bases_of(columns: Float[np.ndarray, "rows nv k"]) -> list[Float[np.ndarray, "windows r"]]:
        parts = [np.linalg.svd(each, full_matrices=False)[:2] for each in short_means(dataset, *columns.swapaxes(0, 1))]
        return [basis[:, values > 1e-9 * values[0]] for basis, values in parts]

    of_file, of_any = bases_of(laws), bases_of(np.concatenate([laws, regressor], axis=-1))
    step = float(np.median(np.diff(dataset.time))) if dataset.time_ordered else SECONDS
    apart = min(1.0, step / SECONDS)
    if any(apart * len(basis) < 2 * basis.shape[1] for basis in of_any):  # any masses would explain it
        yield ok(about="force sensor", what="the log is too short to compare force sensors with torques.")
        return
    size = np.sqrt(np.square(missing + rows.at_contacts).mean(axis=0)) + 1e-12
    idle = driven & (np.ptp(rows.delivered, axis=0) == 0.0)  # a hand may push it
    weight = np.where(idle, 0.0, 1.0 / np.maximum(size, 0.05 * size.max()))

    def unexplained(torques: Float[np.ndarray, "rows nv k"], bases: list[np.ndarray] = of_any) -> np.ndarray:
        """Torques over their size that no friction, rotor or mass explains, of each tenth of a second and joint."""
        means = short_means(dataset, *(torques * weight[:, None]).swapaxes(0, 1))
        return np.concatenate([each - basis @ (basis.T @ each) for each, basis in zip(means, bases, strict=True)])

    def beside_file(force: np.ndarray, R: np.ndarray, frame: str, center: np.ndarray, needed: np.ndarray) -> np.ndarray:
        """What a force along the frame makes there, and what torques need beyond the masses of the file."""
        J = rows.kinematics.frame_jacobian(frame, tuple(center.tolist()))[..., :3, :].mT.cpu().numpy()
        noise = np.square(unexplained(needed).reshape(robot.nv, -1)).mean(axis=1) ** 0.5 + 1e-12  # of friction
        both = np.concatenate([J @ R @ force[..., None], needed], axis=-1)
        return unexplained(both / np.maximum(noise, 0.05 * noise.max())[:, None], of_file).T

    for frame, F in sensed.items():
        J = arm(rows.kinematics, model, frame).cpu().numpy()
        R = rows.kinematics.frame_pose(frame)[..., :3, :3].cpu().numpy()
        needed = (missing + (J @ F[..., None])[..., 0])[..., None]
        columns = dataset.metadata.get("import", {}).get("columns", {}).get(f"{FORCE}{frame}", ())
        own, rms = (R.mT @ F[..., None])[..., 0], float(np.sqrt(np.square(F).sum(1).mean()))
        sensor = _Sensor(frame, F, own, R, [each for each in columns if NAME.fullmatch(each)], rms)
        found = None if frame in dict(held) else _of_tool(dataset, model, sensor, partial(beside_file, needed=needed))
        doubt, values, left_of = found or _of_torques(sensor, J, needed, unexplained)
        yield doubt
        if left_of is not None and len(dataset.episodes) == 1 and dataset.time_ordered:
            moved = (np.stack([np.interp(dataset.time + s, dataset.time, x) for x in values.T], axis=1) for s in SHIFTS)
            yield from late_doubts(f"force sensor at {frame}", [*map(left_of, moved)], step)


def with_touches(dataset: Dataset, doubts: Iterable[Doubt]) -> tuple[Dataset, list[Doubt]]:
    """u + J^T F of force sensors away from contacts [Nm or N], where torques need it; and these sensors, as told.

    As if drives had delivered it: what is learned is the robot that is not touched. Such sensors are then no evidence.
    """
    model, held = dataset.model, {contact.frame for contact in dataset.model.contacts}
    needed = (x for x in doubts if x.about == "force sensor" and x.level == "ok" and x.numbers.get("left", 1) < FOLLOWS)
    felt = [x for x in needed if x.numbers["frame"] not in held] if torques_of_joints(dataset) else []
    if not felt:
        return dataset, []
    q, _, u, _ = tensors(dataset)
    kinematics, sensed = model.robot.to("cpu").kinematics(q), sensed_of(dataset)
    measured, told = dict(dataset.measured), [replace(each, what=f"{each.what} It is added to u.") for each in felt]
    for frame in (each.numbers["frame"] for each in felt):
        u = u + (arm(kinematics, model, frame) @ torch.tensor(sensed[frame])[..., None])[..., 0]
        del measured[f"{FORCE}{frame}"]
    return replace(dataset, u=u.numpy(), measured=measured), told


def _fitted(x: Float[np.ndarray, " rows"], y: Float[np.ndarray, " rows"]) -> tuple[float, float]:
    """What a positive multiple of x leaves of the power of y, and the factor of least squares."""
    power, shared = float(x @ x) + 1e-300, float(x @ y)
    return max(0.0, 1.0 - max(shared, 0.0) ** 2 / (power * float(y @ y) + 1e-300)), shared / power


def _unit_of(factor: float) -> str:
    """The unit in which values times this factor are N; empty for none."""
    return next((name for name, size in IN_N.items() if factor > 0.0 and abs(np.log(factor / size)) < NEAR), "")


def _vector(values: Iterable[float], form: str = ".3g") -> str:
    return f"({', '.join(f'{x:{form}}' for x in values)})"


@dataclass(frozen=True, eq=False)
class _Sensor:
    """What one measured, also along its frame, the axes of that, and names of columns that stand alone."""

    frame: str
    F: Float[np.ndarray, "rows 3"]
    own: Float[np.ndarray, "rows 3"]
    R: Float[np.ndarray, "rows 3 3"]
    columns: Sequence[str]
    rms: float

    def by_axes(self, arms: Float[np.ndarray, "rows k 3"], along: str) -> Float[np.ndarray, "rows k 9"]:
        """What each column along each axis makes, times the entries of Q."""
        columns = self.own if along in ("own", "world") else self.F
        arms = arms @ self.R if along in ("own", "body") else arms
        return (arms[..., None] * columns[:, None, None]).reshape(*arms.shape[:2], 9)

    def read(self, arms: np.ndarray, means: Shown, leaves: Leaves) -> tuple[float, float, str, Any]:
        """What its forces leave as they are stated, and what at least, with the axes to read them along for that."""
        turns = np.linalg.norm(self.own.std(axis=0)) > OFF * self.rms  # a dead one would be a weight along the world
        ways = {along: means(self.by_axes(arms, along)) for along in WORDS if turns or along != "world"}
        found = [(leaves(X @ Q.ravel()), along, Q) for along, X in ways.items() for Q in AXES]
        least = min(each[0] for each in found)
        along, Q = next(each[1:] for each in found if each[0] <= 1.1 * least + 1e-3)
        return found[0][0], least, along, Q

    def said(self, kind: Callable[..., Doubt], says: str, do: str = "", **numbers: Any) -> Doubt:
        """A doubt about it."""
        what = f"the force sensor at {self.frame} {says}; it measures about {self.rms:.3g} N."
        numbers |= {"frame": self.frame}
        return kind(about="force sensor", what=what, do=do.replace("FRAME", self.frame), numbers=numbers)

    def in_other_axes(self, fits: str, along: str, Q: np.ndarray, turned: str, **numbers: Any) -> Doubt:
        """It fits so; `turned` is what to do where only its sign is wrong."""
        places = [(int(np.abs(row).argmax()), "-" * int(row.sum() < 0)) for row in Q]
        signs, known = ", ".join(f"{sign}{'xyz'[k]}" for k, sign in places), len(self.columns) == 3
        order = ",".join(f"{sign}{self.columns[k]}" for k, sign in places) if known else "X,Y,Z"
        given = "" if along in ("", "own") else along
        command = f"forcegp import --axes force={given} --force" if given else "forcegp import --force"
        do = f"Give the columns {'so' if given or known else 'in this order, with these signs'}: {command} FRAME="
        do += f"{order}, {turned}" if np.trace(Q) == -3.0 else f"{order}."
        numbers |= {"axes": (Q @ [1.0, 2.0, 3.0]).tolist()}
        return self.said(wrong, f"fits {fits} as ({signs}){WORDS[along]}", do, **numbers)


Found = tuple[Doubt, np.ndarray, Leaves | None]
"""A doubt; and forces, with what such forces leave when they are shifted in time."""


def _of_tool(dataset: Dataset, model: Model, sensor: _Sensor, beside_file: Shown) -> Found | None:
    """A sensor that a tool alone explains, by its mass and center; None where it feels more than that."""
    points = ("0,0,0", "1,0,0", "0,1,0", "0,0,1")
    still, *ends = (expected(dataset, model, f"{IMU}{sensor.frame}@{point}") for point in points)
    hangs = -np.stack([still, *(end - still for end in ends)], axis=-1)

    def means(values: Float[np.ndarray, "rows 3 *k"]) -> Float[np.ndarray, "windows 3 *k"]:
        each = short_means(dataset, values.reshape(len(values), -1))[0].reshape(-1, *values.shape[1:])
        return each - each.mean(axis=0)  # beside any offset

    moves = means(hangs).reshape(-1, 4)

    def numbers_of(y: Float[np.ndarray, "windows 3"]) -> np.ndarray:
        return np.linalg.lstsq(moves, y.ravel())[0]

    def leaves(y: Float[np.ndarray, "windows 3"]) -> float:
        left = np.square(y.ravel() - moves @ numbers_of(y)).sum() / (np.square(y).sum() + 1e-300)
        return float(left) if numbers_of(y)[0] > 0.0 else 1.0

    stated, least, along, Q = sensor.read(sensor.R.mT, means, leaves)
    if least > CARRIES:
        return None
    measured = sensor.by_axes(sensor.R.mT, along) @ Q.ravel()
    numbers = numbers_of(means(measured))
    mass, center = float(numbers[0]), numbers[1:] / numbers[0]
    x, y = beside_file(hangs @ numbers, sensor.R, sensor.frame, center)
    (left, factor), as_stated = _fitted(x, y), np.square(y - x).sum() / (y @ y + 1e-300)
    if _fitted(-x, y)[0] < FOLLOWS:  # torques need the other sign: it is no weight
        return None
    offset = (measured - hangs @ numbers).mean(axis=0)
    known, where = {"mass": mass, "factor": factor}, f"kg at {_vector(1e3 * center, '.0f')} mm"
    kind, says, do = ok, f"agrees with the motion: it carries {mass:.3g} {where}", ""
    if least < OTHER * stated:
        known["mass"] *= 1.0 if np.trace(Q) > -3.0 else -1.0
        fits, turned = f"what {mass:.3g} {where} need there", "that is, give the columns with a minus."
        return sensor.in_other_axes(fits, along, Q, turned, **known), measured, None
    if left < OTHER * as_stated and (unit := _unit_of(factor)):
        kind, says = look, f"carries {mass * IN_N[unit]:.3g} {where} if it is in {unit}, as torques need it"
        do = f"State its unit: forcegp import --unit force={unit}."
    elif left < FOLLOWS:
        says = f"{says}, and torques need {factor:.3g} times that"
    elif OTHER * as_stated > 1.0:
        kind, says = look, f"carries {mass:.3g} {where}, and torques need no more than the masses of the file"
        do = "The file has it as well, so it counts twice: leave it out of one of them."
    if kind is ok and np.linalg.norm(offset) > OFF * sensor.rms:
        kind, says, do = look, f"{says}, and is off by {_vector(offset)} N along its own axes", TARE
    doubt = sensor.said(kind, says, do, **known, offset=offset.tolist())
    return doubt, measured, lambda each: leaves(means(each)) ** 0.5


def _of_torques(sensor: _Sensor, J: np.ndarray, needed: np.ndarray, unexplained: Shown) -> Found:
    y, x, R = unexplained(needed)[:, 0], unexplained(J @ sensor.F[..., None])[:, 0], sensor.R
    left, least, along, Q = sensor.read(J, unexplained, lambda each: _fitted(each, y)[0])
    numbers, needs = dict[str, Any](left=left, factor=_fitted(x, y)[1]), "what torques and motion need there"
    if left >= FOLLOWS or least < OTHER * left:
        if np.square(x).sum() < FELT**2 * len(y):
            doubt = sensor.said(ok, "shows what torques would hardly notice")
        elif least < OTHER * left:
            doubt = sensor.in_other_axes(needs, along, Q, "or turn all torques.", **numbers)
        else:
            doubt = sensor.said(look, f"does not follow {needs}", "Compare its frame and the robot.", **numbers)
        return doubt, sensor.F, None
    drift = R * np.linspace(-0.5, 0.5, len(R))[:, None, None]
    X = np.c_[x, unexplained(J @ R), unexplained(J @ drift)]
    off = np.linalg.lstsq(X, y)[0]
    offset, drift = -off[1:4] / off[0], -off[4:] / off[0]
    far = np.square(y - X @ off).sum() < OTHER * left * (y @ y) and max(map(np.linalg.norm, (offset, drift)))
    numbers |= {"offset": offset.tolist(), "drift": drift.tolist()}
    kind, says, do = ok, f"leaves {100.0 * left:.2g} % of {needs}", ""
    if unit := _unit_of(numbers["factor"]):
        kind, says = look, f"fits what is needed there in {unit}, or torques are off by that factor"
        do = f"State its unit: forcegp import --unit force={unit}."
    elif far > OFF * sensor.rms:
        parts = f"is off by {_vector(offset)} N, and drifts by {_vector(drift)} N over the log, along its own axes"
        kind, says, do = look, parts, TARE
    doubt = sensor.said(kind, says, do, **numbers)
    return doubt, sensor.F, lambda each: _fitted(unexplained(J @ each[..., None])[:, 0], y)[0] ** 0.5
