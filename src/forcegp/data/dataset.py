"""`Dataset`: what was measured on a robot, checked once and never changed."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from typing_extensions import override

import forcegp.model
import forcegp.robots
from forcegp.data.hdf5 import read_fields, write_fields
from forcegp.errors import DatasetError, FileFormatError, InvalidInput, require_known, require_type, usable_arguments
from forcegp.robots.arguments import real_array
from forcegp.robots.inertia import rotation_from_rpy
from forcegp.summary import Summary, listed, rounded

ROTATION = {"q": "rad", "v": "rad/s", "u": "Nm", "a": "rad/s^2"}  # units of a revolute or continuous joint
TRANSLATION = {"q": "m", "v": "m/s", "u": "N", "a": "m/s^2"}  # units of a prismatic joint
SENSORS = FORCE, IMU, TORQUE = "force.", "imu.", "torque."
"""Begin names of measured forces and what accelerometers measure, by frame, and of torques at links, by joint."""


def units_for(robot: forcegp.robots.Robot) -> dict[str, Any]:
    """Units of q, v, u, a and time of its Datasets: one text where all joints agree, else one per joint."""
    kinds = [TRANSLATION if joint.type == "prismatic" else ROTATION for joint in robot.joints]
    each = {name: tuple(kind[name] for kind in kinds) for name in ROTATION}
    return {name: texts[0] if len(set(texts)) == 1 else texts for name, texts in each.items()} | {"time": "s"}


LARGEST_MEASURED = 1e15  # whatever its SI unit, no sensor measures more; squares of squares of it are finite
BEYOND = f"above {LARGEST_MEASURED:g}: of another unit, or of another register."
SHORTEST_STEP = 1e-9  # s

ORDER = "a", "lambda", "Q_U"
TRUTH = re.compile(r"a|lambda|Q_U|(Q_U|force)\.[a-zA-Z0-9-]*[a-zA-Z0-9][a-zA-Z0-9-]*")
"""Names of what is true; parts of Q_U and forces on points of the robot have names of their own."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Dataset(Summary):
    """Rows `(q, v, u) -> a` of one robot, with everything needed to read them.

    Arrays are copied to float64, made read-only and checked; a Dataset that exists is valid. In row k, `a` is the
    acceleration that the state `(q, v)` and the actuator forces `u` of the same row produce.

    q, v, u: (rows, nv) positions, velocities and actuator forces [units]. Where the base moves, q has the columns
        `model.robot.position_names`, and u the columns `model.inputs`.
    a: (rows, nv) measured acceleration, with its noise.
    time: (rows,) [s]; strictly increasing within an episode (see `time_ordered`).
    episode: (rows,) integers; rows of equal number are one continuous motion. Default: all 0.
    model: the robot, whose joints the columns are, and what it touches.
    noise_std: standard deviation of the noise on `a`, (nv,), if known.
    measured: what other sensors say by name: "force.FRAME" (rows, 3) is the force on the robot at that frame [N, world
        axes], of a force sensor; where a contact is there, at its point. "imu.FRAME" (rows, 3) is what an accelerometer
        there measures, R^T (p'' - g) [m/s^2, its axes]: at rest 9.81 upwards. It sits elsewhere in the frame where the
        name goes on with "@x,y,z" or "@x,y,z,roll,pitch,yaw".
    truth: what a simulation provides: noise-free "a" (rows, nv), constraint multipliers "lambda" (rows, m) [N],
        the unknown joint forces "Q_U" (rows, nv), their parts "Q_U.<name>" (rows, nv), and forces on the robot
        "force.<name>" (rows, 3) [N, world axes].
    metadata: a copy of anything that JSON can hold.
    strokes: what rows know of the motion before them (`forcegp.data.strokes`), (rows, nv, k), for friction that
        remembers. Of a log of postures they are those before its filter. Those of motors are not stored.
    transmission: of the motors whose strokes these are, (nv, nv); None: those of the joints.
    time_ordered: False for rows drawn in another order (`rows`): times are then only required to differ.

    Raises DatasetError naming the array, row and column that break this, and what to do.
    """

    q: Float[np.ndarray, "rows nq"]
    v: Float[np.ndarray, "rows nv"]
    u: Float[np.ndarray, "rows nu"]
    a: Float[np.ndarray, "rows nv"]
    time: Float[np.ndarray, " rows"]
    model: forcegp.model.Model
    episode: Int[np.ndarray, " rows"] = None  # type: ignore[assignment]  # None becomes zeros
    noise_std: Float[np.ndarray, " nv"] | None = None
    measured: Mapping[str, np.ndarray] = field(default_factory=dict)
    truth: Mapping[str, np.ndarray] = field(default_factory=dict)
    metadata: Mapping[str, Any] = field(default_factory=dict)
    time_ordered: bool = True
    strokes: Float[np.ndarray, "rows nv strokes"] | None = None
    transmission: Float[np.ndarray, "nv nv"] | None = None

    @usable_arguments("Dataset")
    def __post_init__(self) -> None:
        def put(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        robot = require_type("model", self.model, forcegp.model.Model, ", such as Model(Robot.from_file(file))").robot
        names = robot.joint_names
        put("q", finite_columns("q", self.q, robot.position_names))
        rows = len(self.q)
        for name, columns in (("v", names), ("u", self.model.inputs), ("a", names)):
            put(name, finite_columns(name, getattr(self, name), columns, rows))
        try:
            robot.space.check(torch.tensor(self.q))
        except InvalidInput as error:  # a quaternion of another length than 1
            raise DatasetError(str(error)) from None
        put("time", finite_columns("time", self.time, None, rows))
        given = real_array("episode", np.zeros(rows, int) if self.episode is None else self.episode, "iu", DatasetError)
        if given.shape != (rows,):
            raise DatasetError(f"episode has shape {given.shape}; expected ({rows},).")
        put("episode", _read_only(given.astype(np.int64)))
        if self.noise_std is not None:
            put("noise_std", finite_columns("noise_std", self.noise_std, None, len(names), what="joints"))
            for column in np.flatnonzero(self.noise_std <= 0)[:1]:
                seen = f"noise_std of joint {names[column]!r} is {self.noise_std[column]}; it must be > 0"
                raise DatasetError(f"{seen}. Give None if it is not known or if there is no noise.")
        if self.strokes is not None:
            past = real_array("strokes", self.strokes, "fiu", DatasetError).astype(np.float64)
            if past.ndim != 3 or past.shape[:2] != self.v.shape or not (np.abs(past) <= LARGEST_MEASURED).all():
                raise DatasetError(f"strokes have shape {past.shape}; give finite numbers ({rows}, {len(names)}, k).")
            put("strokes", _read_only(past))
        put("measured", _measured(self.measured, rows, robot))
        put("truth", _truth(self.truth, names, rows, self.model))
        try:
            put("metadata", json.loads(json.dumps(self.metadata, allow_nan=False)))
        except (TypeError, ValueError) as error:
            allowed = "text, finite numbers, True, False, None, and lists or mappings of them"
            raise DatasetError(f"metadata cannot be written as JSON: {error}. Allowed: {allowed}.") from error
        put("time_ordered", bool(self.time_ordered))
        order = np.arange(rows) if self.time_ordered else np.lexsort((self.time, self.episode))
        if (row := _first_disorder(self.time[order], self.episode[order])) is not None:
            at, number = self.time[order][row], self.episode[order][row]
            if not self.time_ordered:
                raise DatasetError(f"time {at} s occurs twice in episode {number}; drop the repeated rows.")
            seen = f"time does not increase at row {row} (episode {number}, time {at} s)"
            advice = "drop stamps less than a nanosecond apart, or number a new recording as a new episode."
            raise DatasetError(f"{seen}. Sort the rows, {advice}")

    def __len__(self) -> int:
        return len(self.q)

    @property
    def units(self) -> dict[str, Any]:
        """SI units of "q", "v", "u", "a" and "time": one text, or one per joint where joints differ."""
        return units_for(self.model.robot)

    @property
    def turns(self) -> Bool[np.ndarray, " nv"]:
        """Whether a joint turns; others slide."""
        return np.array([joint.type != "prismatic" for joint in self.model.robot.joints])

    @override
    def facts(self) -> dict[str, object]:
        """Rows, joints, episodes, robot, and what else is known."""
        robot = f"{self.model.robot.name!r}, {len(self.model.contacts)} contacts"
        facts: dict[str, object] = {"rows": len(self), "joints": listed(self.joint_names, most=7)}
        facts |= {"episodes": listed(self.episodes), "robot": robot}
        noise = self.noise_std
        facts |= {"noise std": "not stated" if noise is None else rounded(noise), "truth": listed(self.truth)}
        return facts | ({"measured": listed(self.measured)} if self.measured else {})

    def __reduce__(self) -> tuple[Any, ...]:  # pickling and copying restore writable arrays; the constructor does not
        return partial(Dataset, **self._fields()), ()

    @property
    def nv(self) -> int:
        """Number of degrees of freedom."""
        return self.v.shape[1]

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the columns of v and a, which are the robot's."""
        return self.model.robot.joint_names

    @property
    def episodes(self) -> tuple[int, ...]:
        """The episode numbers in order of first appearance."""
        values, first = np.unique(self.episode, return_index=True)
        return tuple(int(value) for value in values[np.argsort(first)])

    @usable_arguments("Dataset.rows")
    def rows(self, index: slice | Sequence[int] | np.ndarray) -> "Dataset":
        """The rows of a slice, boolean mask (rows,) or list of row numbers, in the order given.

        Raises InvalidInput for row numbers that do not exist, DatasetError where one repeats and for none at all.
        """
        chosen = np.arange(len(self))[index]
        truth, measured = ({name: values[chosen] for name, values in of.items()} for of in (self.truth, self.measured))
        names = ("q", "v", "u", "a", "time", "episode", "strokes")
        arrays = {name: values[chosen] for name in names if (values := getattr(self, name)) is not None}
        ordered = _first_disorder(arrays["time"], arrays["episode"]) is None
        return replace(self, **arrays, measured=measured, truth=truth, time_ordered=ordered)

    def knows_strokes(self, transmission: Float[np.ndarray, "nv nv"] | torch.Tensor | None = None) -> bool:
        """Whether rows know the strokes of joints, or those of motors with this transmission."""
        T = None if transmission is None else np.asarray(torch.as_tensor(transmission).cpu())
        return self.strokes is not None and np.array_equal(self.transmission, T)  # type: ignore[arg-type]  # None is None

    def select_episodes(self, ids: Iterable[int]) -> "Dataset":
        """All rows of the given episodes, in their present order. Raises InvalidInput for numbers that do not occur."""
        wanted = tuple(ids)
        missing = [number for number in wanted if number not in self.episodes]
        if missing or not wanted:
            seen = f"no episodes {missing if wanted else '(none asked for)'}"
            raise InvalidInput(f"{seen}; this Dataset has {list(self.episodes)}.")
        return self.rows(np.isin(self.episode, wanted))

    def save(self, path: str | Path) -> None:
        """Write an HDF5 file (docs/how-to/data-format.md); an interrupted write leaves the old file, or none."""
        write_fields(Path(path), self._fields(), self.units)

    @staticmethod
    @usable_arguments("Dataset.load")
    def load(path: str | Path) -> "Dataset":
        """Read a file written by `save`. Raises FileFormatError saying what is wrong with the file."""
        try:
            return Dataset(**read_fields(Path(path)))
        except DatasetError as error:
            raise FileFormatError(f"{path} holds data that are not valid: {error}") from error

    def _fields(self) -> dict[str, Any]:
        return {item.name: getattr(self, item.name) for item in fields(self)}


def imu_place(name: str) -> tuple[str, list[float], Float[np.ndarray, "3 3"]]:
    """Frame, point [m] and axes of "imu.FRAME@x,y,z,roll,pitch,yaw", of which the end may lack. Raises InvalidInput."""
    frame, at, numbers = name.removeprefix(IMU).partition("@")
    try:
        pose = [float(x) for x in numbers.split(",")] if at else [0.0] * 3
        if len(pose) not in (3, 6) or not np.isfinite(pose).all():
            raise ValueError
    except ValueError:
        seen = f"{name!r} has no place in its frame"
        raise InvalidInput(f"{seen}; give FRAME@x,y,z [m] or FRAME@x,y,z,roll,pitch,yaw [m, rad].") from None
    return frame, pose[:3], rotation_from_rpy(pose[3:] or [0.0] * 3)


def _measured(given: Mapping[str, object], rows: int, robot: forcegp.robots.Robot) -> dict[str, np.ndarray]:
    for name in given:
        if not str(name).startswith(SENSORS):
            raise DatasetError(f"measured has {name!r}; allowed: force.FRAME, imu.FRAME and torque.JOINT of the robot.")
        if name.startswith(TORQUE):
            require_known("joint", name.removeprefix(TORQUE), robot.name, robot.single_joint_names, DatasetError)
            continue
        body, _ = robot.frame(imu_place(name)[0] if name.startswith(IMU) else name.removeprefix(FORCE))
        if name.startswith(IMU) and body < 0:
            raise DatasetError(f"{name!r} is fixed in the world, so it measures no motion; name a link that moves.")
    axes = {name: ("torque",) if name.startswith(TORQUE) else ("x", "y", "z") for name in sorted(given)}
    return {name: finite_columns(f"measured[{name!r}]", given[name], own, rows) for name, own in axes.items()}


def _truth(
    given: Mapping[str, object], joint_names: tuple[str, ...], rows: int, model: forcegp.model.Model
) -> dict[str, np.ndarray]:
    if unknown := sorted(name for name in given if not TRUTH.fullmatch(name)):
        raise DatasetError(f"truth has no {unknown}; allowed: a, lambda, Q_U, Q_U.<name>, force.<name>.")
    checked = {}
    for name in sorted(given, key=lambda name: ORDER.index(name) if name in ORDER else len(ORDER)):
        columns = () if name == "lambda" else joint_names if name.startswith(("a", "Q_U")) else ("x", "y", "z")
        checked[name] = values = finite_columns(f"truth[{name!r}]", given[name], columns, rows)
        if name == "lambda" and values.shape[1] != len(model.contacts):
            seen = f"truth[{name!r}] has {values.shape[1]} columns"
            raise DatasetError(f"{seen}; the model has {len(model.contacts)} contacts.")
    return checked


def finite_columns(
    name: str, given: object, columns: Sequence[str] | None, rows: int | None = None, *, what: str = "rows"
) -> np.ndarray:
    """float64, C-contiguous, read-only copy of a table of finite numbers.

    `columns` None asks for a vector, names for one column each, and an empty sequence for any number of columns.
    """
    values = real_array(name, given, error=DatasetError).astype(np.float64)  # astype always copies
    expected = f"({what},)" if columns is None else f"({what}, {len(columns) or 'any'})"
    wrong_columns = columns is not None and values.ndim == 2 and columns and values.shape[1] != len(columns)
    if values.ndim != (1 if columns is None else 2) or wrong_columns:
        raise DatasetError(f"{name} has shape {values.shape}; expected {expected}.")
    if rows is not None and len(values) != rows:
        raise DatasetError(f"{name} has {len(values)} {what}; expected {rows}.")
    if values.shape[0] == 0:
        raise DatasetError(f"{name} has no {what}; at least one is needed.")
    if not (inside := np.abs(values) <= LARGEST_MEASURED).all():  # False of NaN
        finite = np.isfinite(values)
        bad, how = (~inside, BEYOND) if finite.all() else (~finite, "not finite.")
        row, *at = np.argwhere(bad)[0]
        column = f", column {at[0]}" + (f" ({columns[at[0]]})" if columns else "") if at else ""
        seen = f"{name} is {values[row, *at]} at row {row}{column}; {int(bad.sum())} values are {how}"
        raise DatasetError(f"{seen} Drop or repair these rows first.")
    return _read_only(values)


def _read_only(values: np.ndarray) -> np.ndarray:
    values = np.ascontiguousarray(values)
    values.flags.writeable = False
    return values


def _first_disorder(time: np.ndarray, episode: np.ndarray) -> int | None:
    """Row whose time does not come after that of the row before it in the same episode."""
    order = np.argsort(episode, kind="stable")  # stable: keeps the order of rows inside an episode
    wrong = (np.diff(time[order]) < SHORTEST_STEP) & (np.diff(episode[order]) == 0)
    return int(order[1:][wrong].min()) if wrong.any() else None


def require_rows(name: str, rows: object, joint_names: Sequence[str], whose: str, example: str = "") -> None:
    """Raise InvalidInput unless `rows` is a Dataset with these joints, which are those of `whose`."""
    own = require_type(name, rows, Dataset, example).joint_names
    if tuple(own) != tuple(joint_names):
        seen = f"the joints of {name} are {', '.join(own)}, those of {whose} {', '.join(joint_names)}"
        raise InvalidInput(f"{seen}; give data of the same robot, with its joints in the same order")
