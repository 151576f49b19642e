"""A mapping applied to a table: which combination of its columns each joint's signals are."""

import ast
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float

import forcegp
from forcegp.data import differentiate
from forcegp.data.configurations import in_base
from forcegp.data.dataset import FORCE, IMU, ROTATION, TORQUE, TRANSLATION, imu_place
from forcegp.errors import FileFormatError, InvalidInput, require_known
from forcegp.recordings.mapping import (
    ORIENTATIONS,
    SIGNALS,
    UNITS,
    ColumnMapping,
    Expression,
    LogUnit,
    counted_columns,
    expanded,
    guessed_columns,
    guessed_time,
    in_short,
    log_unit,
    named_after,
    named_unit,
    parse_expression,
)
from forcegp.recordings.source import Columns, Source
from forcegp.robots import Robot
from forcegp.robots.layout import WORLD
from forcegp.robots.manifold import POSITIONS, TURN, ConfigurationSpace, Group
from forcegp.summary import listed

ANGLES = ("roll", "pitch", "yaw")
TURNED = ("y", "z", "qy", "qz", "sin", "ry", "rz", "pitch", "yaw")
"""What changes sign by half a turn of world and base about x: north, east, down becomes north, west, up."""
LACKING = Expression("derive", {}, ast.Constant(0.0), ())
"""This very object: an entry of v or a that the log lacks, which is differentiated, or a switch of a contact."""
OF_IMU, OF_LINKS = "imu", "torque"  # before the frame of an IMU, and the joint of a torque, in `force`
LACKS = re.compile(r"derive\d*")
EPISODE = "episode_index"  # numbers the episodes where nothing else is stated, as in datasets of LeRobot
MOST_NAMES = 40  # of columns in a message
PLACE_WORDS = {"", "p", "pos", "position", "base", "body", "trunk", "torso", "root", "pelvis"}
TURN_WORDS = {"q", "quat", "quaternion", "orientation", "rotation", "rot"}
"""The last word before x, y, z, and before the parts of a turn, in columns of the pose of a base."""


@dataclass(frozen=True)
class JointSignal:
    """One signal of one joint: `sign * unit(expression)`, in SI."""

    signal: str
    joint: str
    expression: Expression
    unit: LogUnit
    sign: float

    def value(self, columns: Columns, rows: int) -> np.ndarray:
        """(rows,) in SI; a column in SI comes out to the last bit."""
        values = self.unit.in_si(self.expression.value(columns, rows))
        return values if self.sign == 1.0 else -values


@dataclass(frozen=True)
class Layout:
    """What is left to do about signals once they are read: those of a base are turned, what lacks is differentiated.

    space: of the positions.
    bases: joints of several degrees of freedom whose parent is the world.
    axes: of v and a, those of the linear and of the angular part.
    gravity: (3,) [m/s^2], for accelerometers.
    derived: entries of v and a that the log lacks.
    held: columns of u that hold from row to row.
    """

    space: ConfigurationSpace
    bases: tuple[Group, ...] = ()
    axes: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    gravity: tuple[float, ...] = (0.0, 0.0, 0.0)
    derived: Mapping[str, list[int]] = field(default_factory=dict)
    held: tuple[int, ...] = ()

    def signals(self, logged: Mapping[str, np.ndarray], time: Float[np.ndarray, " rows"]) -> dict[str, np.ndarray]:
        """q, v, u and a, with differences (second order) for what was not logged."""
        found = dict(logged)
        if not self.space.is_vector_space:  # a spline through quaternions does not end on the sphere
            found["q"] = self.space.normalized(torch.tensor(found["q"])).numpy()
        for name, source in (("v", "q"), ("a", "v")):
            lacking = self.derived.get(name, [])
            if name in found:
                found[name] = self._in_body(name, found[name], found["q"], found["v"])
            if name not in found or lacking:
                made = differentiate(found[source], time, self.space if name == "v" else None)
                own = np.isin(np.arange(self.space.nv), lacking) | (not lacking)
                found[name] = np.where(own, made, found.get(name, made))
        return found

    def _in_body(self, signal: str, values: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """v or a (rows, nv) as a Dataset has them; `v` in body axes where a is asked for."""
        if signal not in self.axes:
            return values
        found, moving, at = (torch.tensor(x) for x in (values, v, q))
        more = {"gravity": torch.tensor(self.gravity, dtype=torch.float64)} if signal == "a" else {}
        for group in self.bases:
            own = {**more, "v": moving[:, group.rows]} if more else {}
            found[:, group.rows] = in_base(at[:, group.places], found[:, group.rows], self.axes[signal], **own)
        return found.numpy()


@dataclass(frozen=True)
class SignalPlan:
    """Everything that is read from a table. `signals` stand signal by signal, each in the order of `joints`."""

    joints: tuple[str, ...]
    positions: tuple[str, ...]  # in the order of the log
    signals: tuple[JointSignal, ...]
    layout: Layout
    orientation: str
    time: Expression | None
    time_unit: LogUnit
    step: float | None
    episode: str | None
    guessed: tuple[str, ...] = ()

    @property
    def logged(self) -> tuple[str, ...]:
        """Which of q, v, u, a are in the log, in this order."""
        return tuple(dict.fromkeys(item.signal for item in self.signals))

    @property
    def open_switches(self) -> tuple[str, ...]:
        """Switches of contacts that the log lacks: columns of u that are 0."""
        return tuple(item.joint for item in self.signals if item.signal == "u" and item.expression is LACKING)

    @property
    def columns(self) -> tuple[str, ...]:
        """Every column that is needed, each once."""
        needed = [name for each in (self.time, *(x.expression for x in self.signals)) if each for name in each.weights]
        return tuple(dict.fromkeys([*needed, *([] if self.episode is None else [self.episode])]))


def signal_plan(mapping: ColumnMapping, source: Source, model: forcegp.Model, open_u: bool = False) -> SignalPlan:
    """What a mapping means for this table, with joints in the order of the robot.

    Signals that the mapping does not name are looked for by the names of the joints (`guessed` lists what was found).
    With `open_u` it may end with the actuators, without switches of contacts.
    Raises InvalidInput for columns, joints and numbers of them that do not fit, FileFormatError for missing columns.
    """
    robot = model.robot
    joints = _joints(mapping, robot)
    log, order = columns_of(mapping, model, joints)
    guessed, by_number = list[str](), "q"
    found: dict[str, list[Expression]] = {}
    for signal in SIGNALS:
        patterns = getattr(mapping, signal)
        if patterns is None and log[signal]:
            names = tuple(log[signal])
            patterns = guessed_columns(signal, names, source)
            if patterns is None and signal == "q" and len(bases(robot)) == 1:
                own = [name for name in names if name not in joints]
                pose = guessed_pose([name.rpartition(".")[2] for name in own], source)
                rest = guessed_columns(signal, joints, source) if joints else ()
                found_by = {**dict(zip(own, pose or (), strict=False)), **dict(zip(joints, rest or (), strict=False))}
                patterns = tuple(found_by[name] for name in names) if len(found_by) == len(names) else None
            if patterns is None and signal == "u" and open_u and model.actuators:
                patterns = guessed_columns(signal, names[: len(model.actuators)], source)
            if patterns is None and signal in by_number and {*names} <= {*joints}:
                patterns = counted_columns(signal, len(names), source)
                by_number = "qvu" if patterns else by_number  # nothing beside columns with names of joints
            if patterns is not None:
                guessed.append(f"{signal} = {' ... '.join(dict.fromkeys(patterns[:: max(len(patterns) - 1, 1)]))}")
                found[signal] = [parse_expression(name, [name], str(source.path)) for name in patterns]
        elif patterns is not None:
            found[signal] = _expressions(patterns, joints, source, may_lack=signal in ("v", "a"))
    switches = len({x.switch for x in (model.contacts if open_u else ())} - {None})
    if switches and len(found.get("u", ())) == len(model.inputs) - switches:
        found["u"] = [*found.get("u", ()), *[LACKING] * switches]
    for signal, why in (("q", "positions"), ("u", "forces or efforts of the actuators; 0 for a passive robot")):
        if signal not in found and log[signal]:
            lacking = [name for name in joints if not any(map(named_after(name).search, source.columns()))]
            in_order = f", in the order {', '.join(log[signal])} (angles: `orientation`)" * bool(robot.space.groups)
            if signal == "u" and any(each := [guessed_columns(signal, [name], source) for name in log[signal]]):
                in_order = f" {','.join(x[0] if x else '0' for x in each)} (0 for a joint without motor)"
            few = f"; no column is named after {listed(lacking)} (`locked` holds what was not recorded)"
            there = f"{source.path} has {listed(source.columns(), MOST_NAMES)}{few * (0 < len(lacking) < len(joints))}"
            raise InvalidInput(f"no columns for {signal} ({why}); name them with --{signal}{in_order}. {there}.")
    if mapping.time is None and mapping.step is None:
        used = [name for expressions in found.values() for item in expressions for name in item.weights]
        name = guessed_time(source, used)
        if name is None:
            seen = "no column for the time; name it with `time`, or `step` for the time between rows"
            raise InvalidInput(f"{seen}. {source.path} has {listed(source.columns(), MOST_NAMES)}.")
        guessed.append(f"time = {name}")
        time = parse_expression(name, [name], str(source.path))
    else:
        time = parse_expression(mapping.time, source.columns(), str(source.path)) if mapping.time is not None else None
    if time is not None and not time.weights:
        raise InvalidInput(f"time is the constant {mapping.time!r}; give a column, or `step` for the time of a row.")
    turned = {f"{x.name}.{part}" for x in (bases(robot) if mapping.ned else ()) for part in TURNED}
    signals = tuple(
        item
        for name, expressions in found.items()
        for item in _signals(mapping, source, name, expressions, log[name], order[name], joints, turned)
    )
    signals += tuple(item for frame in mapping.force for item in _sensor(mapping, frame, source, model))
    for name in found.keys() - mapping.unit.keys():
        if any(x.unit.per_si != 1.0 for x in signals if x.signal == name):
            units = ",".join(in_short(name, [x.unit.name for x in signals if x.signal == name]))
            guessed.append(f"unit {name}={units}, as the log says")
    lacking = {name: [x.expression is LACKING for x in signals if x.signal == name != "u"] for name in found}
    episode = mapping.episode or (EPISODE if EPISODE in source.columns() else None)
    if episode is not None:
        require_known("column", episode, str(source.path), source.columns(), FileFormatError)
    name = next(iter(time.weights)) if time is not None and time.is_column else ""
    # stamps of ROS are whole nanoseconds; what is called nothing else is taken for seconds
    said = named_unit("time", name, source.units)
    usual = "ns" if name.endswith((":header.stamp", ":log_time")) else said or "s"
    [time_unit, *_] = mapping.unit.get("time", (usual,))
    if said not in (None, "s") and "time" not in mapping.unit:
        guessed.append(f"unit time={said}, as the log says")
    return SignalPlan(
        joints=tuple(order["v"]),
        positions=tuple(log["q"]),
        signals=signals,
        layout=layout_of(mapping, model, lacking, len(order["v"])),
        orientation=mapping.orientation or ORIENTATIONS[0],
        time=time,
        time_unit=log_unit("time", time_unit),
        step=mapping.step,
        episode=episode,
        guessed=tuple(guessed),
    )


def guessed_pose(parts: Sequence[str], source: Source) -> tuple[str, ...] | None:
    """Columns of a base by `parts`: x, y, z and qx, ..., or roll, ...; None where none or several may be meant."""
    known = {column.lower(): column for column in source.columns()}

    def before(ends: Sequence[str], words: Collection[str]) -> str | None:
        stems = [column.removesuffix(ends[0]) for column in known if column.endswith(ends[0])]
        stems = [each for each in stems if re.split(r"[^a-z]+", each.rstrip("_.:/ -["))[-1] in words]
        fitting = [each for each in stems if all(each + end in known for end in ends)]
        return fitting[0] if len(fitting) == 1 else None

    ends = [part.removeprefix("q") for part in parts]
    stems = before(ends[:3], PLACE_WORDS), before(ends[3:], TURN_WORDS if "w" in ends else TURN_WORDS | PLACE_WORDS)
    return None if None in stems else tuple(known[f"{stems[k > 2]}{end}"] for k, end in enumerate(ends))


def _joints(mapping: ColumnMapping, robot: Robot) -> tuple[str, ...]:
    given = {"orientation": mapping.orientation, "axes": mapping.axes.keys() - {"force"}, "ned": mapping.ned}
    stated = [name for name, value in given.items() if value]
    if stated and robot.space.is_vector_space:
        raise InvalidInput(f"{stated[0]} is about a base that moves; give a robot with one, by base='floating'.")
    own = robot.single_joint_names
    if mapping.joints and sorted(mapping.joints) != sorted(own):
        seen = f"the mapping names the joints {', '.join(mapping.joints)}; {robot.name!r} has {', '.join(own)}"
        raise InvalidInput(f"{seen}. Give the columns of exactly these, or another `model`.")
    return mapping.joints or own


def _sensor(mapping: ColumnMapping, frame: str, source: Source, model: forcegp.Model) -> Iterator[JointSignal]:
    """The force at a frame, what an IMU there measures, or the torque at the link of a joint or of all."""
    before, colon, place = frame.partition(":")
    kind, own = ("imu", f"{IMU}{place}") if before == OF_IMU else ("force", FORCE + frame)
    joints, names, each = (), [(own, axis) for axis in "xyz"], "x, y and z, with 0 for what was not measured"
    if before == OF_LINKS:
        kind, joints = "torque", (place,) if colon else model.robot.single_joint_names
        require_known("joint", joints[0], model.robot.name, model.robot.single_joint_names)
        names, each = [(f"{TORQUE}{joint}", "torque") for joint in joints], f"one for each of {', '.join(joints)}"
    else:
        model.robot.frame(imu_place(own)[0] if kind == "imu" else frame)
    expressions = _expressions(mapping.force[frame], joints, source, may_lack=False)
    if len(expressions) != len(names):
        raise InvalidInput(f"force of {frame} has {len(expressions)} columns; give {each}.")
    unit = log_unit(kind, mapping.unit.get(kind, (next(iter(UNITS[kind])),))[0])
    yield from (JointSignal(*name, x, unit, 1.0) for name, x in zip(names, expressions, strict=True))


def _expressions(patterns: Sequence[str], joints: Sequence[str], source: Source, may_lack: bool) -> list[Expression]:
    names, columns, vectors = list[str](), source.columns(), source.vectors
    for pattern in patterns:
        for text in expanded(pattern, joints, {*columns, *vectors}):
            by_name = [f"{text}.{joint}" for joint in joints]  # messages may list the joints in another order
            known = text not in columns and joints and set(by_name) <= set(vectors.get(text, ()))
            names += [text] if text in columns else by_name if known else vectors.get(text, (text,))
    return [
        LACKING
        if may_lack and LACKS.fullmatch(name) and name not in columns
        else parse_expression(name, columns, str(source.path))
        for name in names
    ]


def _signals(
    mapping: ColumnMapping,
    source: Source,
    signal: str,
    expressions: list[Expression],
    columns: Mapping[str, str | None],
    order: Sequence[str],
    joints: Sequence[str],
    turned: Collection[str],
) -> Iterator[JointSignal]:
    """One signal in the order of the Dataset; `columns` (name, SI unit) in that of the log; `turned` change sign."""
    names = list(columns)
    plain = set(names) <= set(joints)
    if len(expressions) == 1 and len(names) > 1 and not expressions[0].weights:
        expressions = expressions * len(names)
    if len(expressions) != len(names):
        what = "joints" if plain and names else {"q": "positions", "u": "inputs"}.get(signal, "velocities")
        remedy = "name one column for each"
        if signal == "q" and not plain and len(expressions) == len(set(names) & set(joints)):
            pose = "its pose by motion capture or a state estimator (position and quaternion)"
            stand = "Without, learn joint friction on a stand: a robot with `base` fixed."
            remedy = f"the base was not measured: record {pose}. {stand}"
        elif signal in "qu":
            more = {"q": "angles of a base have `orientation` angles", "u": "0 for a joint that nothing drives"}
            remedy = f"{remedy}; {more[signal]}." if names else "leave u out, or give actuators (`identified`)."
        seen = f"{signal} has {len(expressions)} columns for {len(names)} {what} ({', '.join(names) or 'none'})"
        raise InvalidInput(f"{seen}; {remedy}")
    units = [{named_unit(signal, name, source.units) for name in x.weights} for x in expressions]
    known = (None if len(u) != 1 or x.has_numbers else [*u] for u, x in zip(units, expressions, strict=True))
    named = [(x[0] if x else None) or columns[name] or "1" for x, name in zip(known, names, strict=True)]
    given = [log_unit(signal, name) for name in mapping.unit.get(signal, named)]
    signs, driven = mapping.sign.get(signal, (1.0,)), sum(signal != "u" or columns[name] != "1" for name in names)
    if driven < len(names) and len(signs) in (1, driven):  # they do not change a switch that stands behind actuators
        signs = (*signs * (driven // len(signs)), *[1.0] * (len(names) - driven))
    for name in order:
        index, si = names.index(name), columns[name]
        unit = _unit(signal, given, index, columns)
        if si not in (None, unit.si):
            kind = "is part of a turn" if si == "1" else "turns" if si in ROTATION.values() else "slides"
            seen = f"unit of {signal} of joint {name!r} is {unit.name}, but the joint {kind}"
            advice = f"give a unit of {si}, or one per joint."
            raise InvalidInput(f"{seen}: {advice}")
        if len(signs) not in (1, len(names)):
            raise InvalidInput(f"sign of {signal} has {len(signs)} entries; give one, or {len(names)}, one per joint.")
        sign = signs[index if len(signs) > 1 else 0]
        yield JointSignal(signal, name, expressions[index], unit, -sign if name in turned and signal != "u" else sign)


def _unit(signal: str, given: Sequence[LogUnit], index: int, columns: Mapping[str, str | None]) -> LogUnit:
    """That of a column: one for each, or one for all of its kind; SI where none is given."""
    kinds = list(columns.values())
    if given and len(given) == len(kinds):
        return given[index]
    fitting = [[unit for unit in given if kind in (None, unit.si)] for kind in kinds]
    idle = [unit.name for unit in given if not any(unit in own for own in fitting)]
    if idle or any(len(own) > 1 for own in fitting):
        needed = ", ".join(dict.fromkeys(kind or "the actuators" for kind in kinds))
        seen = f"unit of {signal} is {', '.join(unit.name for unit in given)}"
        advice = f"give at most one of each kind ({needed}), or one for each of the {len(kinds)} columns."
        raise InvalidInput(f"{seen}; {advice}")
    return fitting[index][0] if fitting[index] else log_unit(signal, kinds[index] or "1")


def position_columns(robot: Robot, joints: Sequence[str], orientation: str) -> tuple[str, ...]:
    """Names of the columns of q in a log: `joints` are those of one degree of freedom, in its order."""
    names = list(joints)
    for group, span in spans(robot.space, orientation):
        names[span.start : span.start] = [f"{group.name}.{part}" for part in _written(orientation)]
    return tuple(names)


def spans(space: ConfigurationSpace, orientation: str) -> Iterator[tuple[Group, slice]]:
    """Every base and its columns among those of q in a log."""
    more = 0
    for group in space.groups:
        start, size = group.place + more, len(_written(orientation))
        more += size - len(POSITIONS)
        yield group, slice(start, start + size)


def _written(orientation: str) -> tuple[str, ...]:
    place, turn = POSITIONS[: TURN.start], POSITIONS[TURN]
    return place + (ANGLES if orientation == "angles" else turn[-1:] + turn[:-1] if orientation == "wxyz" else turn)


def bases(robot: Robot) -> tuple[Group, ...]:
    """The joints of several degrees of freedom whose parent is the world: their axes are its."""
    return tuple(group for group in robot.space.groups if robot.layout.parents[group.body] == WORLD)


def columns_of(
    mapping: ColumnMapping, model: forcegp.Model, joints: tuple[str, ...]
) -> tuple[dict[str, dict[str, str | None]], dict[str, tuple[str, ...]]]:
    """By signal: name and SI unit of its columns in the order of the log, and names in the order of the Dataset.

    Unit None: whatever the actuator takes.
    """
    robot, own = model.robot, model.robot.single_joint_names
    kinds = {joint.name: TRANSLATION if joint.type == "prismatic" else ROTATION for joint in robot.joints}
    of_log, driven = dict(zip(own, joints, strict=True)), tuple(model.actuation.names) == own
    switches = model.inputs[len(model.actuators) :]

    def unit(signal: str, name: str) -> str | None:
        if signal == "u" and not (driven and name in own):
            return "1" if name in switches else None
        return kinds[name][signal] if name in kinds else "rad" if name.endswith(ANGLES) else "1"

    written = mapping.orientation or ORIENTATIONS[0]
    velocities = tuple(of_log.get(name, name) for name in robot.joint_names)
    inputs = tuple(of_log.get(name, name) if driven else name for name in model.inputs)
    log = {"q": position_columns(robot, joints, written), "v": velocities, "u": inputs, "a": velocities}
    stored = position_columns(robot, own, "angles" if written == "angles" else ORIENTATIONS[0])
    order = {"q": stored, "v": robot.joint_names, "u": model.inputs, "a": robot.joint_names}
    return {signal: {name: unit(signal, name) for name in names} for signal, names in log.items()}, order


def layout_of(mapping: ColumnMapping, model: forcegp.Model, lacking: Mapping[str, Sequence[bool]], nv: int) -> Layout:
    """What is left to do once positions are those of a Dataset.

    `lacking`: of each logged signal, which of its entries the log lacks. InvalidInput for half of a turned vector.
    """
    groups = bases(model.robot)
    derived = {name: [row for row, lacks in enumerate(own) if lacks] for name, own in lacking.items()}
    axes = {name: (own[0], own[-1] if own[-1] != "imu" else "body") for name, own in mapping.axes.items()}
    for name in axes.keys() - lacking.keys() - ({"force"} if mapping.force else set()):
        raise InvalidInput(f"axes of {name} are stated, and the log has no {name}; name its columns, or leave it out.")
    for name, group in ((name, group) for name in axes if name != "force" for group in groups):
        for part, words in (((0, 1, 2), "linear"), ((3, 4, 5), "angular")):
            rows = {group.row + k for k in part}
            if axes[name][words == "angular"] == "world" and 0 < len(rows & {*derived.get(name, ())}) < len(rows):
                raise InvalidInput(f"{name} in the axes of the world needs all of its {words} part, or all `derive`.")
    switches = tuple(range(len(model.actuators), len(model.inputs)))
    return Layout(model.robot.space, groups, axes, tuple(model.robot.gravity.tolist()), derived, switches)
