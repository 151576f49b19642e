"""ROS topics with different clocks on that of one of them: commands are held, everything else is interpolated."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped

from forcegp.errors import DatasetError, InvalidInput
from forcegp.recordings.ros_bag import LOG_TIME, STAMP, RosBag
from forcegp.recordings.signal_plan import SignalPlan
from forcegp.recordings.source import Columns, Source
from forcegp.robots.manifold import QUATERNION


@dataclass(frozen=True)
class Read:
    """Columns of one length, remarks, rows of u that hold, and of other topics the median step and the age per row."""

    columns: Columns
    notes: tuple[str, ...]
    held: tuple[int, ...] = ()
    silent: tuple[tuple[float, Float[np.ndarray, " rows"]], ...] = ()

    def paused(self, gap: float | None, steps: float) -> Bool[np.ndarray, " rows"]:
        """Rows for which a topic was silent: for `gap` seconds, or so many of its median steps."""
        rows = len(next(iter(self.columns.values())))
        return np.any([ages > (steps * step if gap is None else gap) for step, ages in self.silent] or [[False] * rows],
                      axis=0)  # fmt: skip


def read_on_one_clock(source: Source, plan: SignalPlan) -> Read:
    """The columns of a plan, all at the messages of the topic of its time.

    Angles that move by half a turn or more between two messages are held, as they wrap, and of quaternions the sign
    means nothing. Raises InvalidInput where joining has no meaning, DatasetError for stamps that run backwards or do
    not overlap.
    """
    if not isinstance(source, RosBag) or len({source.topic_of(name) for name in plan.columns}) == 1:
        columns = source.read(plan.columns)
        return Read(columns, source.notes())
    if plan.time is None or not plan.time.is_column:
        raise InvalidInput(f"{source.path}: several topics are joined by their stamps; name one column as `time`.")
    [time] = plan.time.weights
    clock, seconds = source.topic_of(time), plan.time_unit.in_si(np.ones(1)).item()
    measured = {name for item in plan.signals if item.signal != "u" for name in item.expression.weights}
    most, turns, held = dict[str, float](), dict[str, list[str]](), set(plan.layout.held)
    inputs = [item for item in plan.signals if item.signal == "u"]
    for item in plan.signals:
        base, _, part = item.joint.rpartition(".")
        if item.signal == "q" and item.unit.si == "1" and part in QUATERNION:
            turns.setdefault(base, []).extend(item.expression.weights)
        if item.signal == "q" and item.unit.si == "rad":  # half a turn, in the units of the log
            half = np.pi / item.unit.in_si(np.ones(1)).item()
            most |= {name: half / abs(weight) for name, weight in item.expression.weights.items()}
        if item.signal == "u" and (own := {x for x in item.expression.weights if source.topic_of(x) != clock}):
            most |= dict.fromkeys(own - measured, 0.0)
            held.add(inputs.index(item))
    own: dict[str, list[str]] = {clock: [time]}
    for name in plan.columns:
        own.setdefault(source.topic_of(name), []).append(name)
    found = source.read(list(dict.fromkeys(own[clock])))
    notes, ways, tracks = list(source.notes()), list[str](), []
    stamps = found[time]
    kept = np.ones(len(stamps), bool)
    for topic in [topic for topic in own if topic != clock]:
        stamp = _stamp_beside(source, topic, time.removeprefix(f"{clock}:"))
        read = source.read(list(dict.fromkeys([stamp, *own[topic]])))
        notes += source.notes()
        steps = np.diff(read[stamp]) * seconds
        if len(steps) and steps.min() < 0.0:
            raise DatasetError(
                f"{source.path}: the stamps of {topic} run backwards by {-steps.min():.6g} s; topics are joined in the "
                f"order of time. Name `time` {clock}:{LOG_TIME}, or mend the bag."
            )
        largest = np.array([most.get(name, np.inf) for name in own[topic]])
        places = [[own[topic].index(name) for name in turn] for turn in turns.values() if {*turn} <= {*own[topic]}]
        table = np.stack([read[name] for name in own[topic]], axis=1).astype(np.float64)
        values, ages, there = _at(stamps, read[stamp], table, largest, places)
        how = "interpolated" if largest.all() else "interpolated, u held" if largest.any() else "held"
        other = stamp.removeprefix(topic) != time.removeprefix(clock)
        ways.append(f"{topic} {how}" + f" (by {LOG_TIME})" * other)
        kept &= there
        tracks.append((float(np.median(steps)) if len(steps) else np.inf, ages * seconds))
        found |= {name: values[:, column] for column, name in enumerate(own[topic])}
    if not kept.any():
        raise DatasetError(
            f"{source.path}: the stamps of {', '.join(own)} do not overlap; compare their clocks, or name `time` "
            f"{clock}:{LOG_TIME}."
        )
    outside = int((~kept).sum())
    lost = f"; {outside} rows before the first or behind the last message of a topic left out" * bool(outside)
    notes.append(f"rows are those of {clock}: {', '.join(ways)}{lost}")
    columns = {name: found[name][kept] for name in plan.columns}
    return Read(columns, tuple(notes), tuple(sorted(held)), tuple((step, ages[kept]) for step, ages in tracks))


def _at(
    time: Shaped[np.ndarray, " rows"],
    stamps: Shaped[np.ndarray, " messages"],
    table: Float[np.ndarray, "messages columns"],
    most: Float[np.ndarray, " columns"],
    turns: Sequence[Sequence[int]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values (rows, columns), how long nothing was heard about them, and whether there are any, at these times.

    Values that differ by `most` or more are held. `turns` are places of quaternions.
    """
    before = np.searchsorted(stamps, time, side="right") - 1
    there, first = before >= 0, np.maximum(before, 0)
    since, after = time - stamps[first], first
    if most.any():
        after = first + (since > 0)
        there &= after < len(stamps)
        after = np.minimum(after, len(stamps) - 1)
    values, later = table[first], table[after]
    for turn in turns:
        later[:, turn] *= np.where((values[:, turn] * later[:, turn]).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    span = stamps[after] - stamps[first]
    change = np.where(np.abs(later - values) < most, later - values, 0.0)
    share = np.divide(since, span, out=np.zeros(len(time)), where=span > 0)
    return values + share[:, None] * change, np.where(span > 0, span, since), there


def _stamp_beside(bag: RosBag, topic: str, wanted: str) -> str:
    """The clock of a topic: that of the time where the topic has it. Raises InvalidInput for another kind."""
    kinds = [wanted, *((STAMP, LOG_TIME) if wanted in (STAMP, LOG_TIME) else ())]
    found: Any = next((f"{topic}:{kind}" for kind in kinds if f"{topic}:{kind}" in bag.columns()), None)
    if found is None:
        raise InvalidInput(f"{bag.path}: {topic} has no {wanted}; name as `time` a {LOG_TIME}.")
    return found
