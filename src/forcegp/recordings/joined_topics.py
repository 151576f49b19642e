"""ROS topics with different clocks as one table: rows of one topic, the others held or interpolated at its stamps."""

from array import array
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool
from typing_extensions import override

from forcegp.errors import DatasetError, InvalidInput
from forcegp.recordings.mapping import LogUnit
from forcegp.recordings.ros_bag import LOG_TIME, STAMP, RosBag
from forcegp.recordings.signal_plan import SignalPlan
from forcegp.recordings.source import Columns, Source, as_column
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

    def elsewhere(expression: Any) -> set[str]:
        return {name for name in expression.weights if source.topic_of(name) != clock}

    parts: dict[str, list[str]] = {}  # of quaternions
    for item in plan.signals:
        base, _, part = item.joint.rpartition(".")
        if item.signal == "q" and part in QUATERNION and item.unit.si == "1":
            parts.setdefault(base, []).extend(item.expression.weights)
    held = set[str]().union(*(elsewhere(item.expression) for item in plan.signals if item.signal == "u"))
    held -= set().union(*(item.expression.weights for item in plan.signals if item.signal != "u"))
    inputs, place = [item for item in plan.signals if item.signal == "u"], plan.layout.places["u"].start
    columns = {place + row for row, item in enumerate(inputs) if elsewhere(item.expression)}
    layout = replace(plan.layout, held=tuple(sorted({*plan.layout.held, *columns})))
    half = {
        name: np.pi / abs(weight * item.factor * _in_si(item.unit))
        for item in plan.signals
        for name, weight in item.expression.weights.items()
        if item.signal == "q" and item.unit.si == "rad"
    }
    return JoinedTopics(source, time, _in_si(plan.time_unit), held, half, list(parts.values())), replace(
        plan, layout=layout
    )


def _in_si(unit: LogUnit) -> float:
    return unit.in_si(np.ones(1)).item()


@dataclass
class _Track:
    """The messages of one topic around the present row: stamp, then values.

    Values that differ by `most` or more are held: those of commands always, angles where they wrap. `turns` are places
    of quaternions, whose sign means nothing.
    """

    most: list[float]
    turns: list[list[int]]
    seen: deque[list[Any]] = field(default_factory=deque)
    steps: array = field(default_factory=lambda: array("d"))
    ages: array = field(default_factory=lambda: array("d"))

    def at(self, time: Any) -> list[Any] | None:
        """Values at a time, and how long nothing was heard about them; None before the first or behind the last."""
        seen = self.seen
        while len(seen) > 1 and seen[1][0] <= time:
            seen.popleft()
        if not seen or seen[0][0] > time:
            return None
        stamp, *values = seen[0]
        age = time - stamp
        if age and any(self.most):
            if len(seen) == 1:
                return None
            later, *others = seen[1]
            for turn in self.turns:
                if sum(values[k] * others[k] for k in turn) < 0.0:
                    others = [-x if k in turn else x for k, x in enumerate(others)]
            share, span = age / (later - stamp), later - stamp
            pairs = zip(self.most, values, others, strict=True)
            values, age = [x + share * (y - x) if abs(y - x) < most else x for most, x, y in pairs], span
        return [age, *values]


class JoinedTopics(Source):
    """The messages of the topic of `time`, with columns of other topics.

    Those in `held` are as they were last, the others interpolated between the messages before and behind, but for
    angles that differ by more than `half` a turn; columns of `turns` are quaternions. Memory holds the messages until
    those of every topic have come, and the stamps. `seconds` is the unit of the time.
    """

    row_word = "message"

    def __init__(
        self,
        bag: RosBag,
        time: str,
        seconds: float,
        held: Collection[str],
        half: Mapping[str, float],
        turns: Sequence[Sequence[str]],
    ) -> None:
        super().__init__(bag.path)
        self.bag, self.seconds, self.turns = bag, seconds, turns
        self.most = {**half, **dict.fromkeys(held, 0.0)}
        self.clock = bag.topic_of(time)
        self.stamp = time.removeprefix(f"{self.clock}:")
        self._tracks: dict[str, _Track] = {}
        self._outside = 0

    @override
    def columns(self) -> tuple[str, ...]:
        return self.bag.columns()

    @override
    def files(self) -> tuple[Any, ...]:
        return self.bag.files()

    def _stamp_of(self, topic: str) -> str:
        """The clock of a topic: that of the time where the topic has it. Raises InvalidInput for another kind."""
        known = self.bag.columns()
        kinds = [self.stamp, *((STAMP, LOG_TIME) if self.stamp in (STAMP, LOG_TIME) else ())]
        found = next((kind for kind in kinds if f"{topic}:{kind}" in known), None)
        if found is None:
            raise InvalidInput(f"{self.path}: {topic} has no {self.stamp}; name `time` {self.clock}:{LOG_TIME}.")
        return found

    @override
    def notes(self) -> tuple[str, ...]:
        def how(topic: str, most: list[float]) -> str:
            way = "held" if not any(most) else "interpolated" if all(most) else "interpolated, u held"
            return f"{topic} {way}" + (f" (by {LOG_TIME})" if self._stamp_of(topic) != self.stamp else "")

        ways = ", ".join(how(topic, track.most) for topic, track in self._tracks.items())
        joined = f"rows are those of {self.clock}: {ways}"
        lost = f"; {self._outside} rows before the first or behind the last message of a topic left out"
        return (*self.bag.notes(), joined + lost * bool(self._outside))

    @override
    def paused(self, gap: float | None, steps: float) -> Bool[np.ndarray, " rows"] | None:
        paused = np.zeros(0, bool)
        for track in self._tracks.values():
            typical = steps * float(np.median(track.steps)) if track.steps else np.inf
            late = np.array(track.ages) > (typical if gap is None else gap / self.seconds)
            paused = late if not len(paused) else paused | late
        return paused

    @override
    def chunks(self, names: Sequence[str], rows: int) -> Iterator[Columns]:
        self.require(names)
        topics = list(dict.fromkeys([self.clock, *map(self.bag.topic_of, names)]))
        own = {topic: [name for name in names if self.bag.topic_of(name) == topic] for topic in topics}
        order = {name: k for k, name in enumerate(name for topic in topics for name in own[topic])}
        wanted = {
            topic: [self._stamp_of(topic), *(name.removeprefix(f"{topic}:") for name in own[topic])] for topic in topics
        }
        self._tracks = {topic: self._track(own[topic]) for topic in topics[1:]}
        self._outside, table = 0, list[list[Any]]()
        for row in self._rows(wanted):
            table.append(row)
            if len(table) == rows:
                yield _columns(table, order, names)
                table = []
        if table:
            yield _columns(table, order, names)
        elif not any(track.ages for track in self._tracks.values()):
            raise DatasetError(
                f"{self.path}: the stamps of {', '.join(topics)} do not overlap; compare their clocks, or name `time` "
                f"{self.clock}:{LOG_TIME}."
            )

    def _track(self, names: list[str]) -> _Track:
        turns = [[names.index(name) for name in turn] for turn in self.turns if {*turn} <= {*names}]
        return _Track([self.most.get(name, np.inf) for name in names], turns)

    def _rows(self, wanted: dict[str, list[str]]) -> Iterator[list[Any]]:
        """Values of all topics at every stamp of the clock, topic by topic."""
        waiting: deque[list[Any]] = deque()
        newest: dict[str, Any] = {}
        for topic, values in self.bag.messages(wanted):
            before, newest[topic] = newest.get(topic), values[0]
            if before is not None and values[0] < before:
                raise DatasetError(
                    f"{self.path}: the stamps of {topic} run backwards by {(before - values[0]) * self.seconds:.6g} s; "
                    f"topics are joined in the order of time. Name `time` {self.clock}:{LOG_TIME}, or mend the bag."
                )
            if topic == self.clock:
                waiting.append(values)
            else:
                track = self._tracks[topic]
                if before is not None:
                    track.steps.append(values[0] - before)
                track.seen.append(values)
            while waiting and all(name in newest and newest[name] > waiting[0][0] for name in self._tracks):
                yield from self._joined(waiting.popleft())
        for values in waiting:
            yield from self._joined(values)

    def _joined(self, values: list[Any]) -> Iterator[list[Any]]:
        found = [track.at(values[0]) for track in self._tracks.values()]
        complete = [each for each in found if each is not None]
        if len(complete) < len(found):
            self._outside += 1
            return
        for track, (age, *_) in zip(self._tracks.values(), complete, strict=True):
            track.ages.append(age)
        yield [*values[1:], *(value for each in complete for value in each[1:])]


def _columns(table: list[list[Any]], order: dict[str, int], names: Sequence[str]) -> Columns:
    columns = list(zip(*table, strict=True))
    return {name: as_column(np.array(columns[order[name]])) for name in names}
