"""A mapping applied to a table: which combination of its columns each joint's signals are."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import forcegp.mechanics
import forcegp.robots
from forcegp.data.dataset_fields import ROTATION, TRANSLATION, sliding_joints
from forcegp.errors import FileFormatError, InvalidInput, require_known
from forcegp.recordings.column_names import (
    LinearExpression,
    expanded,
    guessed_columns,
    guessed_time,
    named_after,
    parse_expression,
)
from forcegp.recordings.mapping import ORIENTATIONS, SIGNALS, ColumnMapping, LogUnit, log_unit
from forcegp.recordings.moving_base import TURNED, Layout, bases, columns_of, layout_of
from forcegp.recordings.source import Columns, Source
from forcegp.summary import listed

LACKING = LinearExpression({}, 0.0)
"""This very object: an entry of v or a that the log lacks, which is differentiated, or a switch of a contact."""
LACKS = re.compile(r"derive\d*")
EPISODE = "episode_index"  # numbers the episodes where nothing else is stated, as in datasets of LeRobot
MOST_NAMES = 40  # of columns in a message


@dataclass(frozen=True)
class JointSignal:
    """One signal of one joint: `sign * unit(expression)`, in SI."""

    signal: str
    joint: str
    expression: LinearExpression
    unit: LogUnit
    sign: float

    def __str__(self) -> str:
        return "derive" if self.expression is LACKING else str(self.expression)

    def value(self, columns: Columns, rows: int) -> np.ndarray:
        """(rows,) in SI; a column in SI comes out to the last bit."""
        values = self.unit.in_si(self.expression.value(columns, rows))
        return values if self.sign == 1.0 else -values


@dataclass(frozen=True)
class SignalPlan:
    """Everything that is read from a table. `signals` stand signal by signal, each in the order of `joints`."""

    joints: tuple[str, ...]
    sliding: tuple[str, ...]
    signals: tuple[JointSignal, ...]
    layout: Layout
    orientation: str
    time: LinearExpression | None
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
        expressions = [item.expression for item in self.signals]
        needed = [name for each in (self.time, *expressions) if each is not None for name in each.weights]
        return tuple(dict.fromkeys([*needed, *([] if self.episode is None else [self.episode])]))


def signal_plan(
    mapping: ColumnMapping, source: Source, model: forcegp.Model | None, *, may_lack_switches: bool = False
) -> SignalPlan:
    """What a mapping means for this table, with joints in the order of the robot if there is one.

    Signals that the mapping does not name are looked for by the names of the joints (`guessed` lists what was found).
    With `may_lack_switches`, u may end with the actuators.
    Raises InvalidInput for columns, joints and numbers of them that do not fit, FileFormatError for missing columns.
    """
    robot = None if model is None else model.robot
    joints = _joints(mapping, robot)
    log, order = columns_of(mapping, model, joints)
    guessed: list[str] = []
    found: dict[str, list[LinearExpression]] = {}
    for signal in SIGNALS:
        patterns = getattr(mapping, signal)
        if patterns is None and log[signal]:
            names = tuple(log[signal])
            patterns = guessed_columns(signal, names, source)
            if patterns is None and signal == "u" and may_lack_switches and model is not None and model.actuators:
                patterns = guessed_columns(signal, names[: len(model.actuators)], source)
            if patterns is not None:
                guessed.append(f"{signal} = {', '.join(patterns)}")
                found[signal] = [LinearExpression({name: 1.0}) for name in patterns]
        elif patterns is not None:
            found[signal] = _expressions(patterns, joints, source, may_lack=signal in ("v", "a"))
    switches = len({x.switch for x in (model.contacts if model and may_lack_switches else ())} - {None})
    if model is not None and switches and len(found.get("u", ())) == len(model.inputs) - switches:
        found["u"] = [*found.get("u", ()), *[LACKING] * switches]
    for signal, why in (("q", "positions"), ("u", "forces of the actuators; 0 for a passive robot")):
        if signal not in found and (model is None or log[signal]):
            lacking = [name for name in joints if not any(map(named_after(name).search, source.columns()))]
            raise InvalidInput(
                f"no columns for {signal} ({why}); name them with --{signal}"
                + (
                    f", in the order {', '.join(log[signal])} (angles: `orientation`)"
                    if robot is not None and robot.space.groups
                    else ""
                )
                + f". {source.path} has {listed(source.columns(), MOST_NAMES)}"
                + f"; no column is named after {listed(lacking)} (`locked` holds what was not recorded)"
                * (0 < len(lacking) < len(joints))
                + "."
            )
    if model is None and not joints:
        example = ",".join(f"joint{index + 1}" for index in range(len(found["q"])))
        raise InvalidInput(f"the joints have no names; add `joints`, for example {example}, or `model`.")
    if mapping.time is None and mapping.step is None:
        used = [name for expressions in found.values() for item in expressions for name in item.weights]
        name = guessed_time(source, used)
        if name is None:
            raise InvalidInput(
                "no column for the time; name it with `time`, or `step` for the time between rows. "
                f"{source.path} has {listed(source.columns(), MOST_NAMES)}."
            )
        guessed.append(f"time = {name}")
        time = LinearExpression({name: 1.0})
    else:
        time = parse_expression(mapping.time, source.columns(), str(source.path)) if mapping.time is not None else None
    if time is not None and not time.weights:
        raise InvalidInput(f"time is the constant {mapping.time!r}; give a column, or `step` for the time of a row.")
    sliding = _sliding(mapping, joints) if robot is None else sliding_joints(robot)
    if robot is None:
        log = {
            name: {joint: (TRANSLATION if joint in sliding else ROTATION)[name] for joint in joints} for name in SIGNALS
        }
    turned = {f"{x.name}.{part}" for x in (bases(robot) if robot and mapping.ned else ()) for part in TURNED}
    signals = tuple(
        item
        for name, expressions in found.items()
        for item in _signals(mapping, name, expressions, log[name], order[name], joints, turned)
    )
    lacking = {name: [x.expression is LACKING for x in signals if x.signal == name != "u"] for name in found}
    episode = mapping.episode or (EPISODE if EPISODE in source.columns() else None)
    if episode is not None:
        require_known("column", episode, str(source.path), source.columns(), FileFormatError)
    # stamps of ROS are whole nanoseconds; everything else is taken for seconds
    stamps = time is not None and time.is_column and next(iter(time.weights)).endswith((":header.stamp", ":log_time"))
    [time_unit, *_] = mapping.unit.get("time", ("ns" if stamps else "s",))
    return SignalPlan(
        joints=tuple(order["v"]),
        sliding=sliding,
        signals=signals,
        layout=layout_of(mapping, model, lacking, len(order["v"])),
        orientation=mapping.orientation or ORIENTATIONS[0],
        time=time,
        time_unit=log_unit("time", time_unit),
        step=mapping.step,
        episode=episode,
        guessed=tuple(guessed),
    )


def _joints(mapping: ColumnMapping, robot: forcegp.robots.Robot | None) -> tuple[str, ...]:
    """Joints of one degree of freedom, in the order of the log."""
    stated = [name for name in ("orientation", "axes", "ned") if getattr(mapping, name)]
    if stated and (robot is None or robot.space.is_vector_space):
        raise InvalidInput(f"{stated[0]} is about a base that moves; give a robot with one, by base='floating'.")
    if robot is None:
        return mapping.joints
    own = robot.single_joint_names
    if mapping.joints and sorted(mapping.joints) != sorted(own):
        raise InvalidInput(
            f"the mapping names the joints {', '.join(mapping.joints)}; {robot.name!r} has {', '.join(own)}. "
            "Give the columns of exactly these, or another `model`."
        )
    return mapping.joints or own


def _expressions(
    patterns: Sequence[str], joints: Sequence[str], source: Source, may_lack: bool
) -> list[LinearExpression]:
    names: list[str] = []
    columns = source.columns()
    for pattern in patterns:
        for text in expanded(pattern, joints):
            names += [text] if text in columns else source.vectors.get(text, (text,))
    return [
        LACKING
        if may_lack and LACKS.fullmatch(name) and name not in columns
        else parse_expression(name, columns, str(source.path))
        for name in names
    ]


def _sliding(mapping: ColumnMapping, joints: tuple[str, ...]) -> tuple[str, ...]:
    """Without a robot, units that are stated decide which joints slide."""

    def slides(index: int) -> bool:
        own = {
            name: _at(f"unit of {name}", units, index, joints) for name, units in mapping.unit.items() if name != "time"
        }
        return any(log_unit(name, unit).si == TRANSLATION[name] for name, unit in own.items())

    return tuple(joint for index, joint in enumerate(joints) if slides(index))


def _signals(
    mapping: ColumnMapping,
    signal: str,
    expressions: list[LinearExpression],
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
            remedy = (
                "the base was not measured: record its pose by motion capture or a state estimator (position and "
                "quaternion). Without, learn joint friction on a stand: a robot with `base` fixed."
            )
        elif signal in "qu":
            more = {"q": "angles of a base have `orientation` angles", "u": "0 for a joint that nothing drives"}
            remedy = f"{remedy}; {more[signal]}." if names else "leave u out, or give actuators (`identified`)."
        raise InvalidInput(
            f"{signal} has {len(expressions)} columns for {len(names)} {what} ({', '.join(names) or 'none'}); {remedy}"
        )
    given = [log_unit(signal, name) for name in mapping.unit.get(signal, ())]
    signs, driven = mapping.sign.get(signal, (1.0,)), sum(signal != "u" or columns[name] != "1" for name in names)
    if driven < len(names) and len(signs) in (1, driven):  # they do not change a switch that stands behind actuators
        signs = (*signs * (driven // len(signs)), *[1.0] * (len(names) - driven))
    for name in order:
        index, si = names.index(name), columns[name]
        unit = _unit(signal, given, index, columns, by_kind=not plain)
        if si not in (None, unit.si):
            kind = "is part of a turn" if si == "1" else "turns" if si in ROTATION.values() else "slides"
            raise InvalidInput(
                f"unit of {signal} of joint {name!r} is {unit.name}, but the joint {kind}: give a unit of {si}, or one "
                "per joint."
            )
        sign = _at(f"sign of {signal}", signs, index, names)
        yield JointSignal(signal, name, expressions[index], unit, -sign if name in turned and signal != "u" else sign)


def _unit(
    signal: str, given: Sequence[LogUnit], index: int, columns: Mapping[str, str | None], by_kind: bool
) -> LogUnit:
    """That of a column: one for all or one for each; of a base that moves or of actuators also one for each kind."""
    kinds = list(columns.values())
    if not given:
        return log_unit(signal, kinds[index] or "1")
    if len(given) == len(kinds) or not by_kind:
        return _at(f"unit of {signal}", given, index, list(columns))
    fitting = [[unit for unit in given if kind in (None, unit.si)] for kind in kinds]
    idle = [unit.name for unit in given if not any(unit in own for own in fitting)]
    if idle or any(len(own) > 1 for own in fitting):
        needed = ", ".join(dict.fromkeys(kind or "the actuators" for kind in kinds))
        raise InvalidInput(
            f"unit of {signal} is {', '.join(unit.name for unit in given)}; give at most one of each kind ({needed}), "
            f"or one for each of the {len(kinds)} columns."
        )
    return fitting[index][0] if fitting[index] else log_unit(signal, kinds[index] or "1")


def _at(what: str, values: Sequence[Any], index: int, joints: Sequence[str]) -> Any:
    if len(values) not in (1, len(joints)):
        raise InvalidInput(f"{what} has {len(values)} entries; give one, or {len(joints)}, one per joint.")
    return values[index if len(values) > 1 else 0]
