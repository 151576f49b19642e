"""ROS topics with different clocks as one table: rows of one topic, the others held or interpolated at its stamps."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped
from typing_extensions import override

from forcegp.errors import DatasetError, InvalidInput
from forcegp.recordings.ros_bag import LOG_TIME, STAMP, RosBag
from forcegp.recordings.signal_plan import SignalPlan
from forcegp.recordings.source import Columns, Source
from forcegp.robots.manifold import QUATERNION


def on_one_clock(source: Source, plan: SignalPlan) -> tuple[Source, SignalPlan]:
    """The source with the columns of all topics on the clock of that of the time; others stay as they are.

    Inputs u hold the last message, which a row never precedes; everything else is interpolated. Raises InvalidInput
    where that has no meaning.
    """
    if not isinstance(source, RosBag) or len({source.topic_of(name) for name in plan.columns}) == 1:
        return source, plan
    if plan.time is None or not plan.time.is_column:
        raise InvalidInput(f"{source.path}: several topics are joined by their stamps; name one column as `time`.")
    [time] = plan.time.weights
    clock = source.topic_of(time)
    own = {signal: [item for item in plan.signals if item.signal == signal] for signal in plan.logged}
    measured = {name for item in plan.signals if item.signal != "u" for name in item.expression.weights}
    most, turns, held = dict[str, float](), dict[str, list[str]](), list(plan.layout.held)
    for item in own["q"]:
        base, _, part = item.joint.rpartition(".")
        if item.unit.si == "1" and part in QUATERNION:
            turns.setdefault(base, []).extend(item.expression.weights)
        if item.unit.si == "rad":  # half a turn, in the units of the log
            half = {name: np.pi / abs(weight) for name, weight in item.expression.weights.items()}
            most |= {name: turn / item.unit.in_si(np.ones(1)).item() for name, turn in half.items()}
    for row, item in enumerate(own.get("u", ())):
        elsewhere = {name for name in item.expression.weights if source.topic_of(name) != clock}
        most |= dict.fromkeys(elsewhere - measured, 0.0)
        held += [row] * bool(elsewhere)
    seconds = plan.time_unit.in_si(np.ones(1)).item()
    joined = JoinedTopics(source, time, seconds, most, list(turns.values()))
    return joined, replace(plan, layout=replace(plan.layout, held=tuple(sorted(set(held)))))


@dataclass(frozen=True)
class _Topic:
    """The messages of one topic: stamps and values.

    Values that differ by `most` or more are held: those of commands always, angles where they wrap. `turns` are places
    of quaternions, whose sign means nothing.
    """

    stamps: Shaped[np.ndarray, " messages"]
    table: Float[np.ndarray, "messages columns"]
    most: Float[np.ndarray, " columns"]
    turns: Sequence[Sequence[int]]

    def at(self, time: Shaped[np.ndarray, " rows"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values (rows, columns), how long nothing was heard about them, and whether there are any, at these times."""
        before = np.searchsorted(self.stamps, time, side="right") - 1
        there, first = before >= 0, np.maximum(before, 0)
        since, after = time - self.stamps[first], first
        if self.most.any():
            after = first + (since > 0)
            there &= after < len(self.stamps)
            after = np.minimum(after, len(self.stamps) - 1)
        values, later = self.table[first], self.table[after]
        for turn in self.turns:
            later[:, turn] *= np.where((values[:, turn] * later[:, turn]).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
        span = self.stamps[after] - self.stamps[first]
        change = np.where(np.abs(later - values) < self.most, later - values, 0.0)
        share = np.divide(since, span, out=np.zeros(len(time)), where=span > 0)
        return values + share[:, None] * change, np.where(span > 0, span, since), there


class JoinedTopics(Source):
    """The messages of the topic of `time`, with columns of other topics.

    These are interpolated between the messages before and behind, but for values that differ by `most` or more; columns
    of `turns` are quaternions. `seconds` is the unit of the time.
    """

    row_word = "message"

    def __init__(
        self,
        bag: RosBag,
        time: str,
        seconds: float,
        most: Mapping[str, float],
        turns: Sequence[Sequence[str]],
    ) -> None:
        super().__init__(bag.path)
        self.bag, self.seconds, self.most, self.turns = bag, seconds, most, turns
        self.clock = bag.topic_of(time)
        self.stamp = time.removeprefix(f"{self.clock}:")
        self._notes: list[str] = []
        self._silent: list[tuple[float, np.ndarray]] = []

    @override
    def columns(self) -> tuple[str, ...]:
        return self.bag.columns()

    @override
    def files(self) -> tuple[Path, ...]:
        return self.bag.files()

    @override
    def notes(self) -> tuple[str, ...]:
        return tuple(self._notes)

    @override
    def paused(self, gap: float | None, steps: float) -> Bool[np.ndarray, " rows"] | None:
        limits = [(ages, steps * step if gap is None else gap / self.seconds) for step, ages in self._silent]
        return np.any([ages > limit for ages, limit in limits], axis=0)

    @override
    def pieces(self, names: Sequence[str]) -> Iterator[Columns]:
        own: dict[str, list[str]] = {self.clock: [f"{self.clock}:{self.stamp}"]}
        for name in names:
            own.setdefault(self.bag.topic_of(name), []).append(name)
        self._notes, self._silent, ways = [], [], []
        found = self.bag.read(list(dict.fromkeys(own[self.clock])))
        left_out, topics = self.bag.notes(), [topic for topic in own if topic != self.clock]
        time = found[f"{self.clock}:{self.stamp}"]
        kept, tracks = np.ones(len(time), bool), []
        for topic in topics:
            track = self._read(topic, own[topic])
            steps = np.diff(track.stamps)
            how = "interpolated" if track.most.all() else "interpolated, u held" if track.most.any() else "held"
            ways.append(f"{topic} {how}" + f" (by {LOG_TIME})" * (self._stamp_of(topic) != self.stamp))
            values, ages, there = track.at(time)
            kept &= there
            tracks.append((float(np.median(steps)) if len(steps) else np.inf, ages))
            found |= {name: values[:, column] for column, name in enumerate(own[topic])}
        if not kept.any():
            raise DatasetError(
                f"{self.path}: the stamps of {', '.join([self.clock, *topics])} do not overlap; compare their clocks, "
                f"or name `time` {self.clock}:{LOG_TIME}."
            )
        self._silent = [(step, ages[kept]) for step, ages in tracks]
        outside = int((~kept).sum())
        lost = f"; {outside} rows before the first or behind the last message of a topic left out" * bool(outside)
        self._notes += [*left_out, f"rows are those of {self.clock}: {', '.join(ways)}{lost}"]
        yield {name: found[name][kept] for name in names}

    def _read(self, topic: str, names: Sequence[str]) -> _Topic:
        """All messages of a topic. Raises DatasetError for stamps that run backwards."""
        stamp = f"{topic}:{self._stamp_of(topic)}"
        columns = self.bag.read(list(dict.fromkeys([stamp, *names])))
        self._notes += self.bag.notes()
        back = float(np.diff(columns[stamp]).min(initial=0)) * self.seconds
        if back < 0.0:
            raise DatasetError(
                f"{self.path}: the stamps of {topic} run backwards by {-back:.6g} s; topics are joined in the order of "
                f"time. Name `time` {self.clock}:{LOG_TIME}, or mend the bag."
            )
        turns = [[names.index(name) for name in turn] for turn in self.turns if {*turn} <= {*names}]
        table = np.stack([columns[name] for name in names], axis=1).astype(np.float64)
        return _Topic(columns[stamp], table, np.array([self.most.get(name, np.inf) for name in names]), turns)

    def _stamp_of(self, topic: str) -> str:
        """The clock of a topic: that of the time where the topic has it. Raises InvalidInput for another kind."""
        kinds = [self.stamp, *((STAMP, LOG_TIME) if self.stamp in (STAMP, LOG_TIME) else ())]
        found: Any = next((kind for kind in kinds if f"{topic}:{kind}" in self.bag.columns()), None)
        if found is None:
            raise InvalidInput(f"{self.path}: {topic} has no {self.stamp}; name `time` {self.clock}:{LOG_TIME}.")
        return found
