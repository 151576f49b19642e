"""Force sensors beside torques and motion: sign, axes, unit, offset, drift, delay, and a weight that counts twice.

What the rows need less what drives deliver is J^T F, beside what friction, rotors and any masses explain. Of the axes
of F all orders and signs are tried, also as if F were along the axes of the frame, or had been along the world's.

Any masses also explain a tool that hangs from a sensor. Its motion alone shows the axes of that: F = -m (a - g), of a
mass and its center, beside an offset. What torques need beyond the masses of the robot's file shows the unit.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
from forcegp.data.imu import SECONDS, SHIFTS, expected, late_doubts, short_means
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
UNITS = {"kN": 1e3, "mN": 1e-3, "kgf": 9.80665, "lbf": 4.4482216152605}  # N
AXES = sorted(_EVERY, key=lambda Q: (abs(np.trace(Q)) < 3.0, -np.trace(Q), -np.linalg.det(Q)))
"""As it is, turned altogether, other axes; then those that are no rotation."""
Readings = Mapping[str, tuple[Float[np.ndarray, "rows 3 3"], Float[np.ndarray, "rows 3"]]]
"""By what an import states of the axes: what turns columns into the world's axes, and the columns."""
WORDS = {"": "", "own": " along the axes of the frame", "body": " along the axes of the frame"}
WORDS |= {"world": " along the axes of the world"}


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
        means = short_means(dataset, *columns.swapaxes(0, 1))
        parts = [np.linalg.svd(each, full_matrices=False)[:2] for each in means]
        return [basis[:, values > 1e-9 * values[0]] for basis, values in parts]

    of_file, of_any = bases_of(laws), bases_of(np.concatenate([laws, regressor], axis=-1))
    apart = min(1.0, float(np.median(np.diff(dataset.time))) / SECONDS) if dataset.time_ordered else 1.0
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

    for frame, F in sensed.items():
        J = arm(rows.kinematics, model, frame).cpu().numpy()
        R = rows.kinematics.frame_pose(frame)[..., :3, :3].cpu().numpy()
        needed = (missing + (J @ F[..., None])[..., 0])[..., None]
        columns = dataset.metadata.get("import", {}).get("columns", {}).get(f"{FORCE}{frame}", ())
        sensor = _Sensor(frame, F, R, [each for each in columns if NAME.fullmatch(each)])
        doubt, values, left_of = None, F, partial(_left, unexplained(needed)[:, 0], J, unexplained)
        if frame not in dict(held) and (tool := _Tool.of(dataset, model, sensor)):
            at_center = rows.kinematics.frame_jacobian(frame, tool.center)[..., :3, :].mT.cpu().numpy()
            both = np.concatenate([at_center @ R @ tool.expected[..., None], needed], axis=-1)
            noise = np.square(unexplained(needed).reshape(robot.nv, -1)).mean(axis=1) ** 0.5 + 1e-12  # of friction
            x, y = unexplained(both / np.maximum(noise, 0.05 * noise.max())[:, None], of_file).T
            if _fitted(-x, y)[0] > FOLLOWS:  # else torques need the other sign: it is no weight
                doubt, values, left_of = tool.doubt(model, x, y), tool.measured, tool.left_of
        if doubt is None:
            doubt = _beside(sensor, J, needed, unexplained)
        yield doubt
        follows = values is not F or doubt.numbers.get("left", 1.0) < FOLLOWS
        if follows and len(dataset.episodes) == 1 and dataset.time_ordered:
            moved = (np.stack([np.interp(dataset.time + s, dataset.time, x) for x in values.T], axis=1) for s in SHIFTS)
            yield from late_doubts(sensor.name, [*map(left_of, moved)], float(np.median(np.diff(dataset.time))))


def _fitted(x: Float[np.ndarray, " rows"], y: Float[np.ndarray, " rows"]) -> tuple[float, float]:
    """What a positive multiple of x leaves of the power of y, and the factor of least squares."""
    power, shared = float(x @ x) + 1e-300, float(x @ y)
    return max(0.0, 1.0 - max(shared, 0.0) ** 2 / (power * float(y @ y) + 1e-300)), shared / power


def _left(y: Float[np.ndarray, " rows"], J: Float[np.ndarray, "rows nv 3"], unexplained: Shown, F: np.ndarray) -> float:
    """What forces leave of y, as a root mean square over that of y."""
    return _fitted(unexplained(J @ F[..., None])[:, 0], y)[0] ** 0.5


def _by_axes(arms: Float[np.ndarray, "rows k 3"], columns: Float[np.ndarray, "rows 3"]) -> np.ndarray:
    """What each column along each axis makes (rows, k, 9), times the entries of Q."""
    return (arms[..., None] * columns[:, None, None]).reshape(*arms.shape[:2], 9)


@dataclass(frozen=True, eq=False)
class _Sensor:
    """What one measured, the axes of its frame, and names of its columns, where they stand alone."""

    frame: str
    F: Float[np.ndarray, "rows 3"]
    R: Float[np.ndarray, "rows 3 3"]
    columns: Sequence[str]

    @property
    def name(self) -> str:
        """With its frame."""
        return f"force sensor at {self.frame}"

    @property
    def tare(self) -> str:
        """What to do about an offset."""
        return f"Tare it; or take it off the columns, as in forcegp import --force '{self.frame}=FX-1.2,FY,FZ'."

    @property
    def rms(self) -> float:
        """What it measures [N]."""
        return float(np.sqrt(np.square(self.F).sum(1).mean()))

    @property
    def readings(self) -> Readings:
        """As stated, along the frame as well, only in truth along the frame, and only as stated."""
        one, own = np.broadcast_to(np.eye(3), self.R.shape), (self.R.mT @ self.F[..., None])[..., 0]
        return {"": (one, self.F), "own": (self.R, own), "body": (self.R, self.F), "world": (one, own)}

    def said(self, kind: Callable[..., Doubt], says: str, do: str = "", **numbers: Any) -> Doubt:
        """A doubt about it."""
        what = f"the {self.name} {says}; it measures about {self.rms:.3g} N."
        return kind(about="force sensor", what=what, do=do, numbers={"frame": self.frame, **numbers})

    def in_other_axes(self, fits: str, along: str, Q: np.ndarray, turned: str, **numbers: Any) -> Doubt:
        """It fits so; `turned` is what to do where only its sign is wrong."""
        places = [(int(np.abs(row).argmax()), "-" * int(row.sum() < 0)) for row in Q]
        signs, known = ", ".join(f"{sign}{'xyz'[k]}" for k, sign in places), len(self.columns) == 3
        order = ",".join(f"{sign}{self.columns[k]}" for k, sign in places) if known else "X,Y,Z"
        axes = "" if along in ("", "own") else f"--axes force={along} "
        do = f"forcegp import {axes}--force {self.frame}={order}"
        do = f"Give the columns {'so' if axes or known else 'in this order, with these signs'}: {do}"
        do = f"{do}, {turned}" if np.trace(Q) == -3.0 else f"{do}."
        numbers |= {"axes": (Q @ [1.0, 2.0, 3.0]).tolist()}
        return self.said(wrong, f"fits {fits} as ({signs}){WORDS[along]}", do, **numbers)


@dataclass(frozen=True, eq=False)
class _Tool:
    """What hangs from a sensor, m and m c, by the sensor alone, and how to read its axes for that.

    `left` of its power, so and as it is stated; `measured` and `expected` along the frame.
    """

    sensor: _Sensor
    numbers: Float[np.ndarray, " 4"]
    along: str
    Q: Float[np.ndarray, "3 3"]
    left: tuple[float, float]
    measured: Float[np.ndarray, "rows 3"]
    expected: Float[np.ndarray, "rows 3"]
    left_of: Callable[[Float[np.ndarray, "rows 3"]], float]

    @classmethod
    def of(cls, dataset: Dataset, model: Model, sensor: _Sensor) -> "_Tool | None":
        """None where the sensor feels more than that."""
        points = ("0,0,0", "1,0,0", "0,1,0", "0,0,1")
        still, *ends = (expected(dataset, model, f"{IMU}{sensor.frame}@{point}") for point in points)
        hangs = -np.stack([still, *(end - still for end in ends)], axis=-1)

        def means(values: Float[np.ndarray, "rows 3 k"]) -> Float[np.ndarray, "windows 3 k"]:
            return short_means(dataset, values.reshape(len(values), -1))[0].reshape(-1, *values.shape[1:])

        B = means(hangs)
        moves = (B - B.mean(axis=0)).reshape(-1, 4)

        def fitted(y: Float[np.ndarray, "windows 3"]) -> tuple[float, np.ndarray]:
            """What such a tool leaves of the power beside an offset, and its numbers."""
            y = (y - y.mean(axis=0)).ravel()
            numbers = np.linalg.lstsq(moves, y)[0]
            left = np.square(y - moves @ numbers).sum() / (y @ y + 1e-300)
            return float(left) if numbers[0] > 0.0 else 1.0, numbers

        found = []
        for along, (turn, columns) in sensor.readings.items():
            values = _by_axes(sensor.R.mT @ turn, columns)
            if not along or np.linalg.norm(columns.std(axis=0)) > OFF * sensor.rms:  # else a dead one would be a weight
                X = means(values)
                found += [(*fitted(X @ Q.ravel()), along, Q, values) for Q in AXES]
        least = min(each[0] for each in found)
        left, numbers, along, Q, values = next(each for each in found if each[0] <= 1.1 * least + 1e-3)
        if least > CARRIES:
            return None
        known = sensor, numbers, along, Q, (left, found[0][0]), values @ Q.ravel(), hangs @ numbers
        return cls(*known, lambda each: fitted(means(each))[0] ** 0.5)

    @property
    def offset(self) -> Float[np.ndarray, " 3"]:
        """Along the frame [N]."""
        return (self.measured - self.expected).mean(axis=0)

    @property
    def center(self) -> tuple[float, ...]:
        """Of mass, in the frame [m]."""
        return tuple((self.numbers[1:] / self.numbers[0]).tolist())

    def doubt(self, model: Model, x: Float[np.ndarray, " rows"], y: Float[np.ndarray, " rows"]) -> Doubt:
        """Beside torques: y of what they need beyond the masses of the file, of which it makes x."""
        (left, factor), as_stated = _fitted(x, y), np.square(y - x).sum() / (y @ y + 1e-300)
        mass, factors = float(self.numbers[0]), {"mass": float(self.numbers[0]), "factor": factor}
        sensor, where = self.sensor, f"kg at {_vector(1e3 * self.numbers[1:] / mass, '.0f')} mm"
        if self.left[0] < OTHER * self.left[1]:
            turned = "that is, give the columns with a minus, for the force on the robot."
            factors["mass"] *= 1.0 if np.trace(self.Q) > -3.0 else -1.0
            return sensor.in_other_axes(f"what {mass:.3g} {where} need there", self.along, self.Q, turned, **factors)
        kind, says, do = ok, f"agrees with the motion: it carries {mass:.3g} {where}", ""
        if left < OTHER * as_stated and (unit := _unit_of(factor)):
            kind, says = look, f"carries {mass * UNITS[unit]:.3g} {where} if it is in {unit}, as torques need it"
            do = f"State its unit: forcegp import --unit force={unit}."
        elif left < FOLLOWS:
            says = f"{says}, and torques need {factor:.3g} times that"
        elif OTHER * as_stated > 1.0:
            beyond = _beyond(model, sensor.frame)
            kind, says = look, f"carries {mass:.3g} {where}; the file has {beyond:.3g} kg from there on"
            do = "Where both hold the same tool it counts twice: leave it out of one of them."
        if kind is ok and np.linalg.norm(self.offset) > OFF * sensor.rms:
            kind, says, do = look, f"{says}, and is off by {_vector(self.offset)} N along its own axes", sensor.tare
        return sensor.said(kind, says, do, **factors, offset=self.offset.tolist())


def _vector(values: Iterable[float], form: str = ".3g") -> str:
    return f"({', '.join(f'{x:{form}}' for x in values)})"


def _unit_of(factor: float) -> str:
    """The unit in which values times this factor are N; empty for none."""
    return next((name for name, size in UNITS.items() if factor > 0.0 and abs(np.log(factor / size)) < NEAR), "")


def _beside(sensor: _Sensor, J: np.ndarray, needed: np.ndarray, unexplained: Shown) -> Doubt:
    """One that feels other forces, beside torques."""
    y, F, R, found = unexplained(needed)[:, 0], sensor.F[..., None], sensor.R, []
    for along, (turn, columns) in sensor.readings.items():
        X = unexplained(_by_axes(J @ turn, columns))
        found += [(*_fitted(X @ Q.ravel(), y), along, Q) for Q in AXES]
    left, factor, *_ = found[0]
    least = min(each[0] for each in found)
    _, _, along, Q = next(each for each in found if each[0] <= 1.1 * least + 1e-3)
    numbers: dict[str, Any] = {"left": left, "factor": factor}
    if left < FOLLOWS and least > OTHER * left:
        drift = R * np.linspace(-0.5, 0.5, len(F))[:, None, None]
        X = np.c_[unexplained(J @ F), unexplained(J @ R), unexplained(J @ drift)]
        off = np.linalg.lstsq(X, y)[0]
        offset, drift = -off[1:4] / off[0], -off[4:] / off[0]
        far = np.square(y - X @ off).sum() < OTHER * left * (y @ y) and max(map(np.linalg.norm, (offset, drift)))
        numbers |= {"offset": offset.tolist(), "drift": drift.tolist()}
        kind, says, do = ok, f"leaves {100.0 * left:.2g} % of what torques and motion need there", ""
        if unit := _unit_of(factor):
            kind, says = look, f"fits what is needed there in {unit}, or torques are off by that factor"
            do = f"State its unit: forcegp import --unit force={unit}."
        elif far > OFF * sensor.rms:
            off = f"is off by {_vector(offset)} N, and drifts by {_vector(drift)} N over the log, along its own axes"
            kind, says, do = look, off, sensor.tare
        return sensor.said(kind, says, do, **numbers)
    if np.square(unexplained(J @ F)).sum() < FELT**2 * len(y):
        return sensor.said(ok, "shows what torques would hardly notice")
    if least < OTHER * left:
        return sensor.in_other_axes("what torques and motion need there", along, Q, "or turn all torques.", **numbers)
    says, do = "does not follow what torques and motion need there", "Compare its frame and the robot."
    return sensor.said(look, says, do, **numbers)


def _beyond(model: Model, frame: str) -> float:
    """Mass of the body of a frame and of all that it carries [kg]."""
    first, _ = model.robot.frame(frame)
    layout, inside = model.robot.layout, {first}
    for body, parent in enumerate(layout.parents):  # after its parent
        inside |= {body} if parent in inside else set()
    return float(model.robot.tree.inertias[sorted(inside), 3, 3, 0].sum())
