"""Messages of bags as numbers, read with `rosbags` in the process of `forcegp.sandbox`, without torch."""

import os
import re
import tempfile
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from forcegp.errors import FileFormatError, required_extra
from forcegp.recordings.cut_mcap import is_cut, whole_copy
from forcegp.recordings.source import LONGEST_VECTOR, element_names, reading, require_plausible_size

KEPT = "columns.npz"
LOG_TIME = "log_time"
ROWS_AT_A_TIME = 2**16  # numbers of Python take ten times the memory of those in an array
LOOKED_AT = 100  # messages of each topic that decide which columns there are: publishers may share a topic
JOINT_STATE = "sensor_msgs/msg/JointState"
NAMES = re.compile(r"name|\w*names")
"""Fields whose texts name the elements of vectors beside them, and of those in messages beside them."""
TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
NANOSECONDS = 10**9
NUMBER, ARRAY = (int, float), (np.ndarray, list)  # a union written at the call would be made for every field


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """Topics, their columns and vectors; with `topic` and its `wanted` fields, these columns in the file KEPT.

    `refused` is a sentence that says why not.
    """
    path, scratch, tempfile.tempdir = Path(request["path"]), Path(request["scratch"]), request["scratch"]
    bag = path.absolute()
    os.chdir(bag if bag.is_dir() else bag.parent)  # rosbags makes URIs of paths: SQLite would decode their folders
    try:
        with reading(path, "a bag"):
            own = sorted(Path().glob("*.mcap")) if bag.is_dir() else [Path(bag.name)]
            cut = [file for file in own if is_cut(file)]
            read = own if cut or not bag.is_dir() or not Path("metadata.yaml").is_file() else [Path()]
            read = [whole_copy(file, scratch) if file in cut else file for file in read]
            with _opened(path, read) as reader:
                if "topic" in request:
                    return {"left_out": _keep(path, reader, request["topic"], request["wanted"], scratch / KEPT)}
                return {"listed": _listed(reader), "cut": bool(cut), "count": reader.message_count if cut else 0}
    except FileFormatError as error:
        return {"refused": str(error)}


@contextmanager
def _opened(path: Path, read: Sequence[Path]) -> Iterator[Any]:
    reader_of, types = (required_extra(f"rosbags.{name}", "logs", "reading bags") for name in ("highlevel", "typesys"))
    known = types.get_typestore(types.Stores.ROS1_NOETIC if path.suffix.lower() == ".bag" else types.Stores.LATEST)
    with reader_of.AnyReader(read, default_typestore=known) as reader:
        # rosbags 0.11 does not publish its list of MCAP chunks; a version without it reads them unchecked
        for storage in (getattr(bag, "storage", None) for bag in reader.readers):
            for store in getattr(storage, "storages", [storage]):  # a directory has several, a file is one
                for chunk in getattr(store, "chunks", ()):
                    require_plausible_size(path, "a chunk", chunk.uncompressed_size, chunk.compressed_size)
        yield reader


def _listed(reader: Any) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    """Topic -> its columns, and the vectors whose elements have names."""
    found: dict[str, dict[str, None]] = {}
    named = dict[str, dict[str, None]]()
    for connection in reader.connections:
        names = found.setdefault(connection.topic, {})
        for _, _, raw in islice(reader.messages([connection]), LOOKED_AT):
            vectors: dict[str, list[str]] = {}
            names |= dict.fromkeys(numbers(reader.deserialize(raw, connection.msgtype), None, vectors))
            for vector, elements in vectors.items():
                of = f"{connection.topic}:"
                named.setdefault(of + vector, {}).update(dict.fromkeys(of + name for name in elements))
            names[LOG_TIME] = None
    topics = {topic: [f"{topic}:{name}" for name in names] for topic, names in found.items()}
    return topics, {vector: [*names] for vector, names in named.items()}


def _keep(path: Path, reader: Any, topic: str, wanted: Sequence[str], kept: Path) -> int:
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
    message: Any, fields: Collection[str] | None = None, vectors: dict[str, list[str]] | None = None
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
                        vectors[path] = paths
                elif elements and not isinstance(elements[0], str):
                    for inside, element in zip(paths, elements, strict=True):
                        collect(element, f"{inside}.", names)
            elif value.__msgtype__ in TIMES:
                found[path] = value.sec * NANOSECONDS + value.nanosec
            else:
                collect(value, f"{path}.", names)

    collect(message, "", ())
    return found
