"""A mapping applied to a table: which combination of its columns each joint's signals are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import forcegp.robots
from forcegp.data import FrozenDict
from forcegp.data.dataset_fields import ROTATION, TRANSLATION, validated_units
from forcegp.errors import InvalidInput
from forcegp.recordings.column_names import LinearExpression, expanded, guessed_columns, guessed_time, parse_expression
from forcegp.recordings.mapping import SIGNALS, ColumnMapping, LogUnit, log_unit
from forcegp.recordings.source import Columns, Source


@dataclass(frozen=True)
class JointSignal:
    """One signal of one joint: `factor * unit(expression) + offset`, in SI."""

    signal: str
    joint: str
    expression: LinearExpression
    unit: LogUnit
    factor: float
    offset: float

    def value(self, columns: Columns, rows: int) -> np.ndarray:
        """(rows,) in SI; a column in SI without factor and offset comes out to the last bit."""
        values = self.unit.in_si(self.expression.value(columns, rows))
        if self.factor != 1.0:
            values = values * self.factor
        return values if self.offset == 0.0 else values + self.offset


@dataclass(frozen=True)
class SignalPlan:
    """Everything that is read from a table. `signals` stand signal by signal, each in the order of `joints`."""

    joints: tuple[str, ...]
    units: Mapping[str, Any]
    signals: tuple[JointSignal, ...]
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
    def columns(self) -> tuple[str, ...]:
        """Every column that is needed, each once."""
        expressions = [item.expression for item in self.signals]
        needed = [name for each in (self.time, *expressions) if each is not None for name in each.weights]
        return tuple(dict.fromkeys([*needed, *([] if self.episode is None else [self.episode])]))


def signal_plan(mapping: ColumnMapping, source: Source, robot: forcegp.robots.Robot | None) -> SignalPlan:
    """What a mapping means for this table, with joints in the order of the robot if there is one.

    Signals that the mapping does not name are looked for by the names of the joints (`guessed` lists what was found).
    Raises InvalidInput for columns, joints and numbers of them that do not fit.
    """
    joints = _joints(mapping, robot)
    guessed: list[str] = []
    found: dict[str, list[LinearExpression]] = {}
    for signal in SIGNALS:
        patterns = getattr(mapping, signal)
        if patterns is None and joints:
            patterns = guessed_columns(signal, joints, source)
            if patterns is not None:
                guessed.append(f"{signal} = {', '.join(patterns)}")
                found[signal] = [LinearExpression({name: 1.0}) for name in patterns]
        elif patterns is not None:
            found[signal] = _expressions(patterns, joints, source)
    for signal, why in (("q", "positions"), ("u", "forces of the actuators; 0 for a passive robot")):
        if signal not in found:
            raise InvalidInput(
                f"no columns for {signal} ({why}); name them with --{signal}. "
                f"{source.path} has {_some(source.columns())}"
            )
    if not joints:
        example = ",".join(f"joint{index + 1}" for index in range(len(found["q"])))
        raise InvalidInput(f"the joints have no names; add `joints`, for example {example}, or `system`.")
    if mapping.time is None and mapping.step is None:
        used = [name for expressions in found.values() for item in expressions for name in item.weights]
        name = guessed_time(source, used)
        if name is None:
            raise InvalidInput(
                "no column for the time; name it with `time`, or `step` for the time between rows. "
                f"{source.path} has {_some(source.columns())}"
            )
        guessed.append(f"time = {name}")
        time = LinearExpression({name: 1.0})
    else:
        time = parse_expression(mapping.time, source.columns(), str(source.path)) if mapping.time is not None else None
    if time is not None and not time.weights:
        raise InvalidInput(f"time is the constant {mapping.time!r}; give a column, or `step` for the time of a row.")
    order = range(len(joints)) if robot is None else [joints.index(name) for name in robot.joint_names]
    types = {} if robot is None else {joint.name: joint.type for joint in robot.joints}
    signals, units = _joint_signals(mapping, found, joints, order, types)
    names = tuple(joints[index] for index in order)
    episode = mapping.episode
    if episode is None and source.suggested_episode in source.columns():
        episode = source.suggested_episode
    if episode is not None:
        source.require([episode])
    time_unit = log_unit("time", mapping.unit["time"][0]) if "time" in mapping.unit else _default_time_unit(time)
    return SignalPlan(names, units, signals, time, time_unit, mapping.step, episode, tuple(guessed))


def _joints(mapping: ColumnMapping, robot: forcegp.robots.Robot | None) -> tuple[str, ...]:
    if robot is None:
        return mapping.joints
    own = tuple(robot.joint_names)
    if mapping.joints and sorted(mapping.joints) != sorted(own):
        raise InvalidInput(
            f"the mapping names the joints {', '.join(mapping.joints)}; {robot.name!r} has {', '.join(own)}. "
            "Give the columns of exactly these, or another `system`."
        )
    return mapping.joints or own


def _expressions(patterns: Sequence[str], joints: Sequence[str], source: Source) -> list[LinearExpression]:
    names: list[str] = []
    for pattern in patterns:
        for text in expanded(pattern, joints):
            names += [text] if text in source.columns() else source.vectors.get(text, (text,))
    return [parse_expression(name, source.columns(), str(source.path)) for name in names]


def _joint_signals(
    mapping: ColumnMapping,
    found: Mapping[str, list[LinearExpression]],
    joints: Sequence[str],
    order: Sequence[int],
    types: Mapping[str, str],
) -> tuple[tuple[JointSignal, ...], FrozenDict]:
    """The signals in the order of joints that is asked for, and the units of the Dataset."""
    given = {name: [log_unit(name, unit) for unit in units] for name, units in mapping.unit.items() if name != "time"}
    slides = [
        types[joint] == "prismatic" if types else _slides(given, index, joints) for index, joint in enumerate(joints)
    ]
    signals: list[JointSignal] = []
    units: dict[str, Any] = {"time": "s"}
    for signal in SIGNALS:
        si = [(TRANSLATION if slide else ROTATION)[signal] for slide in slides]
        units[signal] = tuple(si[index] for index in order)
        if signal not in found:
            continue
        expressions = found[signal]
        if len(expressions) == 1 and len(joints) > 1 and not expressions[0].weights:
            expressions = expressions * len(joints)
        if len(expressions) != len(joints):
            raise InvalidInput(
                f"{signal} has {len(expressions)} columns for {len(joints)} joints ({', '.join(joints)}); "
                "name one column per joint."
            )
        for index in order:
            unit = _at(f"unit of {signal}", given.get(signal, [log_unit(signal, name) for name in si]), index, joints)
            if unit.si != si[index]:
                raise InvalidInput(
                    f"unit of {signal} of joint {joints[index]!r} is {unit.name}, but the joint "
                    f"{'slides' if slides[index] else 'turns'}: give a unit of {si[index]}, or one per joint."
                )
            sign, scale, offset = (
                _at(f"{what} of {signal}", getattr(mapping, what).get(signal, (neutral,)), index, joints)
                for what, neutral in (("sign", 1.0), ("scale", 1.0), ("offset", 0.0))
            )
            signals.append(JointSignal(signal, joints[index], expressions[index], unit, sign * scale, offset))
    return tuple(signals), validated_units(units, [joints[index] for index in order])


def _slides(given: Mapping[str, list[LogUnit]], index: int, joints: Sequence[str]) -> bool:
    """Whether the units that are stated are those of a prismatic joint; the Dataset checks that all of them agree."""
    stated = [(name, _at(f"unit of {name}", units, index, joints)) for name, units in given.items()]
    return any(unit.si == TRANSLATION[name] for name, unit in stated)


def _at(what: str, values: Sequence[Any], index: int, joints: Sequence[str]) -> Any:
    if len(values) not in (1, len(joints)):
        raise InvalidInput(f"{what} has {len(values)} entries; give one, or {len(joints)}, one per joint.")
    return values[index if len(values) > 1 else 0]


def _default_time_unit(time: LinearExpression | None) -> LogUnit:
    """Stamps of ROS are whole nanoseconds; everything else is taken for seconds."""
    stamps = time is not None and time.is_column and next(iter(time.weights)).endswith((":header.stamp", ":log_time"))
    return log_unit("time", "ns" if stamps else "s")


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:40]) + (f" and {len(names) - 40} more" if len(names) > 40 else "") + "."
