"""Bags of ROS 1 and 2, .mcap (also cut ones) and .db3, by `rosbags` (extra "logs"); several topics on one clock."""

import io
import os
import re
import sys
import tempfile
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped
from typing_extensions import override

from forcegp.errors import DatasetError, DataWarning, FileFormatError, InvalidInput, required_extra
from forcegp.recordings.source import LONGEST_VECTOR, Columns, Source, element_names, reading
from forcegp.sandbox import MEMORY, SECONDS, read_apart

MAGIC = b"\x89MCAP0\r\n"
CHUNK, DATA_END = 6, 15  # kinds of records; each begins with its kind and the length of its content
END = b"\x0f" + (4).to_bytes(8, "little") + bytes(4) + b"\x02" + (20).to_bytes(8, "little") + bytes(20) + MAGIC
ZSTD = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
READERS = {"zstd": (ZSTD, "ZstdDecompressor"), "lz4": ("lz4.frame", "LZ4FrameDecompressor")}
LOG_TIME = "log_time"
ROWS_AT_A_TIME = 2**16  # numbers of Python take ten times the memory of those in an array
LOOKED_AT = 100  # messages of each topic that decide which columns there are: publishers may share a topic
STAMP = "header.stamp"
JOINT_STATE = "sensor_msgs/msg/JointState"
NAMES = re.compile(r"name|\w*names")
"""Fields whose texts name the elements of vectors beside them, and of those in messages beside them."""
TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
NANOSECONDS = 10**9
NUMBER, ARRAY = (int, float), (np.ndarray, list)  # a union written at the call would be made for every field
TWICE = re.compile(r"(pose|twist|accel)\.\1$")
MOST_WHOLE = 0.5
"""Of the rows of a table: where more have all columns, the others were lost, and no topics stand side by side."""


class RosBag(Source):
    """The numeric fields of all messages, called `TOPIC:field`.

    Fields are `/wrench:wrench.force.x`, `/commands:data[3]`; where a message names its joints, by these names:
    `/joint_states:position.elbow`, `/controller_state:feedback.positions.elbow`. Times are `TOPIC:header.stamp` (when
    it was measured) and `TOPIC:log_time` (when the recorder got it), in ns. One table is one topic, with a row for
    every message that has all columns asked for; `read_on_one_clock` joins several.

    Raises MissingExtra without `rosbags`.
    """

    row_word = "message"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._left_out, real = 0, path.resolve()
        for file in path.iterdir() if path.is_dir() else (path,):
            inside = file.resolve()
            here = inside.is_relative_to(real) and (inside.is_file() or inside.is_dir())
            if not here or not {*"%?#"}.isdisjoint(file.name):  # SQLite takes names for URIs and decodes them
                why = "a pipe, a device, a link to elsewhere or named with %, ? or #; take it out, or rename it."
                raise FileFormatError(f"{path}: {file.name!r} is {why}")
        listed, _ = self._answer({})
        found = listed["found"]
        self._topics = {topic: tuple(f"{topic}:{x}" for x in names) for topic, (names, _) in found.items()}
        named = ((topic, *each) for topic, (_, vectors) in found.items() for each in vectors.items())
        self._named = {f"{topic}:{vector}": tuple(f"{topic}:{x}" for x in own) for topic, vector, own in named}
        if not self.columns():
            raise FileFormatError(f"{path} holds no messages with numbers.")
        if listed["cut"]:
            whole = f"the {listed['count']} whole messages before are read"
            warnings.warn(f"{path} ends in the middle of a record: {whole}.", DataWarning, stacklevel=2)

    def _answer(self, asked: Mapping[str, Any]) -> tuple[Mapping[str, Any], list[np.ndarray]]:
        """What `answer` says, and the columns asked for. Raises FileFormatError."""
        required_extra("rosbags", "logs", "reading bags")
        size, remedy = sum(file.stat().st_size for file in self.files()), "record it again, or give a whole one"
        with tempfile.TemporaryDirectory() as scratch:
            asked = {**asked, "module": __name__, "path": str(self.path), "kept": f"{scratch}/columns.npz"}
            asked |= {"seconds": SECONDS + (size >> 18), "memory": MEMORY + 20 * size}
            told = read_apart("rosbags", str(self.path), asked, FileFormatError, remedy)
            if "refused" in told:
                raise FileFormatError(told["refused"])
            if "topic" not in asked:
                return told, []
            with np.load(asked["kept"], allow_pickle=False) as kept:
                return told, [kept[name] for name in kept.files]

    @override
    def columns(self) -> tuple[str, ...]:
        return tuple(name for names in self._topics.values() for name in names)

    @property
    @override
    def vectors(self) -> Mapping[str, tuple[str, ...]]:
        """`TOPIC:position` for all joints that messages name, in their order, and vectors of geometry.

        A pose is x, y, z of its place and x, y, z, w of its turn, a twist its linear and its angular part.
        """
        known, found = set(self.columns()), {**super().vectors, **self._named}
        for name in self.columns():
            axes = tuple(f"{name[:-1]}{axis}" for axis in "xyzw")
            if name.endswith(".x") and known.issuperset(axes[:3]):
                found[name[:-2]] = axes[: 4 if axes[3] in known else 3]
        for first, second in (("position", "orientation"), ("translation", "rotation"), ("linear", "angular")):
            for name in [name for name in found if name.endswith((f".{first}", f":{first}"))]:
                whole, other = name[: -len(first) - 1], f"{name[: -len(first)]}{second}"
                if other in found:
                    for short in (whole, TWICE.sub(r"\1", whole)):  # pose.pose of a message with covariance
                        found[short] = found[name] + found[other]
        return found

    @override
    def time_beside(self, names: Sequence[str]) -> str | None:
        if not names:
            return None
        topic = self.topic_of(names[0])
        stamp = f"{topic}:{STAMP}"
        return stamp if stamp in self._topics[topic] else f"{topic}:{LOG_TIME}"

    @override
    def files(self) -> tuple[Path, ...]:
        if self.path.is_file():
            return (self.path,)
        return tuple(sorted(file for file in self.path.iterdir() if file.is_file()))

    @override
    def notes(self) -> tuple[str, ...]:
        if not self._left_out:
            return ()
        return (f"messages left out because they lack a column, as those of another publisher do: {self._left_out}",)

    def topic_of(self, name: str) -> str:
        """The topic that has a column."""
        return next(topic for topic, names in self._topics.items() if name in names)

    @override
    def table(self, names: Sequence[str]) -> Columns:
        topics = sorted({self.topic_of(name) for name in names})
        if len(topics) != 1:
            seen = f"{self.path}: the columns come from the topics {', '.join(topics)}"
            raise InvalidInput(f"{seen}, whose messages have times of their own; read them one by one.")
        answer, columns = self._answer({"topic": topics[0], "wanted": [name[len(topics[0]) + 1 :] for name in names]})
        self._left_out = answer["left_out"]
        return dict(zip(names, columns, strict=True))


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """Columns and named vectors by topic; with `topic`, its `wanted` fields in the file `kept`; `refused`: why not."""
    path, tempfile.tempdir = Path(request["path"]), str(Path(request["kept"]).parent)
    bag = path.absolute()
    os.chdir(bag if bag.is_dir() else bag.parent)  # rosbags makes URIs of paths: SQLite would decode their folders
    reader_of, types = (required_extra(f"rosbags.{name}", "logs", "reading bags") for name in ("highlevel", "typesys"))
    known = types.get_typestore(types.Stores.ROS1_NOETIC if path.suffix.lower() == ".bag" else types.Stores.LATEST)
    try:
        with reading(path, "a bag"):
            own = sorted(Path().glob("*.mcap")) if bag.is_dir() else [Path(bag.name)]
            cut = [file for file in own if is_cut(file)]
            read = own if cut or not bag.is_dir() or not Path("metadata.yaml").is_file() else [Path()]
            read = [whole_copy(file, Path(tempfile.tempdir)) if file in cut else file for file in read]
            with reader_of.AnyReader(read, default_typestore=known) as reader:
                if "topic" in request:
                    return {"left_out": _keep(reader, **request)}
                found: dict[str, tuple[dict[str, None], dict[str, dict[str, None]]]] = {}
                for connection in reader.connections:
                    names, vectors = found.setdefault(connection.topic, ({}, {}))
                    for _, _, raw in islice(reader.messages([connection]), LOOKED_AT):
                        message = reader.deserialize(raw, connection.msgtype)
                        names |= dict.fromkeys((*numbers(message, None, vectors), LOG_TIME))
                return {"found": found, "cut": bool(cut), "count": reader.message_count if cut else 0}
    except FileFormatError as error:
        return {"refused": str(error)}


def _keep(reader: Any, /, path: str, topic: str, wanted: Sequence[str], kept: str, **_: Any) -> int:
    """Write the columns that are wanted of a topic; how many messages lack some of them."""
    connections = [item for item in reader.connections if item.topic == topic]
    kinds = sorted({item.msgtype for item in connections})
    if len(kinds) > 1:
        raise FileFormatError(f"{path}: topic {topic} has messages of several types: {kinds}.")
    messages, left_out = reader.messages(connections), 0
    fields = {own.partition(".")[0].partition("[")[0] for own in wanted}
    pieces: list[list[np.ndarray]] = [[np.zeros(0, int)] for _ in wanted]
    while batch := list(islice(messages, ROWS_AT_A_TIME)):
        found = ({**numbers(reader.deserialize(raw, kinds[0]), fields), LOG_TIME: at} for _, at, raw in batch)
        table = [[values[own] for own in wanted] for values in found if values.keys() >= set(wanted)]
        left_out += len(batch) - len(table)
        for piece, column in zip(pieces, zip(*table, strict=True), strict=False):
            piece.append(np.array(column))
    np.savez(kept, *(np.concatenate(own[1:] or own) for own in pieces))
    return left_out


def numbers(
    message: Any, fields: Collection[str] | None = None, vectors: dict[str, dict[str, None]] | None = None
) -> dict[str, int | float]:
    """The numbers of a message by path, `wrench.force.x` or `data[3]`; stamps in ns, elements that have names by these.

    Texts and vectors of more than `LONGEST_VECTOR` numbers are left out; with `fields`, all but these fields of the
    message. `vectors` receives the paths in every vector whose elements have names. Raises FileFormatError for a
    JointState whose names and values differ in number.
    """
    found: dict[str, int | float] = {}

    def collect(message: Any, before: str, names: Sequence[str]) -> None:
        own = (texts for name, texts in vars(message).items() if NAMES.fullmatch(name) and isinstance(texts, list))
        names = next((texts for texts in own if len(set(map(str, texts))) == len(texts)), names)
        for name, value in vars(message).items():
            path = before + name
            if (fields is not None and not before and name not in fields) or isinstance(value, str):
                continue
            if isinstance(value, NUMBER):
                found[path] = value
            elif isinstance(value, ARRAY):
                if message.__msgtype__ == JOINT_STATE and len(value) not in (0, len(names)):
                    raise FileFormatError(f"a JointState has {len(names)} names but {len(value)} values of {name!r}.")
                elements = value if isinstance(value, list) else value.tolist() if len(value) <= LONGEST_VECTOR else []
                paths = element_names(path, len(elements))
                if len(names) == len(elements):
                    paths = [f"{path}.{each}" for each in names]
                if elements and isinstance(elements[0], NUMBER):
                    found.update(zip(paths, elements, strict=True))
                    if vectors is not None and len(names) == len(elements):
                        vectors.setdefault(path, {}).update(dict.fromkeys(paths))
                elif elements and not isinstance(elements[0], str):
                    for inside, element in zip(paths, elements, strict=True):
                        collect(element, f"{inside}.", names)
            elif value.__msgtype__ in TIMES:
                found[path] = value.sec * NANOSECONDS + value.nanosec
            else:
                collect(value, f"{path}.", names)

    collect(message, "", ())
    return found


@dataclass(frozen=True)
class Read:
    """Columns of one length, remarks, columns of u that hold, of other topics the median step and the age per row.

    And rows that were lost.
    """

    columns: Columns
    notes: tuple[str, ...]
    held: tuple[int, ...] = ()
    silent: tuple[tuple[float, Float[np.ndarray, " rows"]], ...] = ()
    lost: Bool[np.ndarray, " _"] = field(default_factory=lambda: np.zeros(0, bool))  # `_lost` looks for them later

    def paused(self, gap: float | None, steps: float) -> Bool[np.ndarray, " rows"]:
        """Rows for which a topic was silent: for `gap` seconds, or so many of its median steps."""
        rows = len(next(iter(self.columns.values())))
        return np.any([ages > (steps * step if gap is None else gap) for step, ages in self.silent] or [[False] * rows],
                      axis=0)  # fmt: skip


def read_on_one_clock(source: Source, plan: Any) -> Read:
    """The columns of a `SignalPlan`, all at the messages of the topic of its time; of a sparse table, of its positions.

    Angles that move by half a turn or more between two messages are held, as they wrap, and of quaternions the sign
    means nothing. Raises InvalidInput where joining has no meaning, DatasetError for stamps backwards or apart.
    """
    from forcegp.robots.manifold import QUATERNION  # with torch, which the process that reads bags lacks

    topics = {name: source.topic_of(name) for name in plan.columns} if isinstance(source, RosBag) else {}
    whole, filled = Columns(), dict[str, np.ndarray]()
    if len({*topics.values()}) < 2:
        whole = source.read(plan.columns)
        topics, filled = _topics(whole, plan)
        if not topics:
            return Read(whole, source.notes())

    def read(topic: str, names: Sequence[str]) -> Columns:
        names = list(dict.fromkeys(names))
        return {name: whole[name][filled[topic]] for name in names} if whole else source.read(names)

    if plan.time is None or not plan.time.is_column:
        raise InvalidInput(f"{source.path}: several topics are joined by their stamps; name one column as `time`.")
    [time] = plan.time.weights
    clock, seconds = topics[time], plan.time_unit.in_si(np.ones(1)).item()
    measured = {name for item in plan.signals if item.signal != "u" for name in item.expression.weights}
    most, turns, held = dict[str, float](), dict[str, list[str]](), set(plan.layout.held)
    inputs = [item for item in plan.signals if item.signal == "u"]
    for item in plan.signals:
        base, _, part = item.joint.rpartition(".")
        if item.signal == "q" and item.unit.si == "1" and part in QUATERNION:
            turns.setdefault(base, []).extend(item.expression.weights)
        if item.signal == "q" and item.unit.si == "rad":  # half a turn, in the units of the log
            half = np.pi / item.unit.in_si(np.ones(1)).item()
            most |= {name: half / max(abs(weight), 1e-300) for name, weight in item.expression.weights.items()}
        if item.signal == "u" and (far := {x for x in item.expression.weights if topics[x] != clock}):
            most |= dict.fromkeys(far - measured, 0.0)
            held.add(inputs.index(item))
    own: dict[str, list[str]] = {clock: [time]}
    for name in plan.columns:
        own.setdefault(topics[name], []).append(name)
    found = read(clock, own[clock])
    notes, ways, tracks = list(source.notes()), list[str](), []
    stamps = found[time]
    kept = np.ones(len(stamps), bool)
    for topic in [topic for topic in own if topic != clock]:
        wanted = time.removeprefix(f"{clock}:")  # its own clock is that of the time where it has it
        stamp: str | None = wanted
        if isinstance(source, RosBag):
            kinds = [wanted, *((STAMP, LOG_TIME) if wanted in (STAMP, LOG_TIME) else ())]
            stamp = next((f"{topic}:{kind}" for kind in kinds if f"{topic}:{kind}" in source.columns()), None)
        if stamp is None:
            raise InvalidInput(f"{source.path}: {topic} has no {wanted}; name as `time` a {LOG_TIME}.")
        track = read(topic, [stamp, *own[topic]])
        notes += source.notes()
        steps = np.diff(track[stamp]) * seconds
        if len(steps) and steps.min() < 0.0:
            seen = f"{source.path}: the stamps of {topic} run backwards by {-steps.min():.6g} s"
            advice = f"topics are joined in the order of time. Name `time` {clock}:{LOG_TIME}, or mend the bag."
            raise DatasetError(f"{seen}; {advice}")
        largest = np.array([most.get(name, np.inf) for name in own[topic]])
        places = [[own[topic].index(name) for name in turn] for turn in turns.values() if {*turn} <= {*own[topic]}]
        table = np.stack([track[name] for name in own[topic]], axis=1).astype(np.float64)
        values, ages, there = _at(stamps, track[stamp], table, largest, places)
        how = "interpolated" if largest.all() else "interpolated, u held" if largest.any() else "held"
        ways.append(f"{topic} {how}" + f" (by {LOG_TIME})" * (stamp.removeprefix(topic) != time.removeprefix(clock)))
        kept &= there
        tracks.append((float(np.median(steps)) if len(steps) else np.inf, ages * seconds))
        found |= {name: values[:, column] for column, name in enumerate(own[topic])}
    if not kept.any():
        seen = f"{source.path}: the stamps of {', '.join(own)} do not overlap"
        raise DatasetError(f"{seen}; compare their clocks, or name `time` {clock}:{LOG_TIME}.")
    outside = int((~kept).sum())
    lost = f"; {outside} rows before the first or behind the last message of a topic left out" * bool(outside)
    notes.append(f"rows are those of {clock}: {', '.join(ways)}{lost}")
    columns = {name: found[name][kept] for name in plan.columns}
    silent = tuple((step, ages[kept]) for step, ages in tracks)
    return Read(columns, tuple(dict.fromkeys(notes)), tuple(sorted(held)), silent)


def _at(
    time: Shaped[np.ndarray, " rows"],
    stamps: Shaped[np.ndarray, " messages"],
    table: Float[np.ndarray, "messages columns"],
    most: Float[np.ndarray, " columns"],
    turns: Sequence[Sequence[int]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values (rows, columns) then, how old they are, whether there are any; jumps of `most` or more are held."""
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
    span, change = stamps[after] - stamps[first], np.where(np.abs(later - values) < most, later - values, 0.0)
    share = np.divide(since, span, out=np.zeros(len(time)), where=span > 0)
    return values + share[:, None] * change, np.where(span > 0, span, since), there


def _topics(columns: Columns, plan: Any) -> tuple[dict[str, str], dict[str, Bool[np.ndarray, " rows"]]]:
    """Columns of a table by topic, called by its first column, and where it has values: exports join several topics."""
    # the time is that of the positions. One topic for a table of whole rows, or without a column of the time
    shared = {name for name in columns if plan.episode == name or (plan.time and name in plan.time.weights)}
    filled = {name: ~np.isnan(values) for name, values in columns.items() if name not in shared}
    filled = {name: own if own.any() else ~own for name, own in filled.items()}
    positions = [name for item in plan.signals if item.signal == "q" for name in item.expression.weights]
    whole = not filled or np.all(list(filled.values()), axis=0).mean() > MOST_WHOLE
    if whole or plan.time is None or not plan.time.is_column or not positions:
        return {}, filled
    first: dict[bytes, str] = {}
    topics = {name: first.setdefault(own.tobytes(), name) for name, own in filled.items()}
    return topics | dict.fromkeys(shared, topics[positions[0]]), filled


def is_cut(path: Path) -> bool:
    """Whether an MCAP file lacks its end."""
    with path.open("rb") as file:
        begin = file.read(len(MAGIC))
        file.seek(-min(len(MAGIC), path.stat().st_size), io.SEEK_END)
        return begin == MAGIC and file.read() != MAGIC


def whole_copy(path: Path, folder: Path) -> Path:
    """A copy of the records that are whole, those in the chunk at the cut among them. Raises FileFormatError."""
    copy = folder / path.name
    with reading(path, "a bag"), path.open("rb") as file, copy.open("wb") as made:
        made.write(file.read(len(MAGIC)))
        for kind, content, record in _records(file):
            size, name = int.from_bytes(content[16:24], "little"), int.from_bytes(content[28:32], "little")
            if kind == CHUNK and not record:
                packed = content[40 + name :]
                if name:
                    module, reader = READERS[content[32 : 32 + name].decode()]
                    packed = getattr(import_module(module), reader)().decompress(packed, max_length=size)
                record = b"".join(inside for _, _, inside in _records(io.BytesIO(packed)))
            made.write(b"" if kind >= DATA_END else record)
        made.write(END)
    return copy


def _records(file: Any) -> Iterator[tuple[int, bytes, bytes]]:
    """Kind, content, and the whole record, which is empty at the cut."""
    while len(head := file.read(9)) == 9:
        length = int.from_bytes(head[1:], "little")
        content = file.read(min(length, sys.maxsize))
        yield head[0], content, head + content if len(content) == length else b""
