"""`import_recordings`: log files as one dataset; which reader reads which, files side by side, files of options."""

import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import yaml
from typing_extensions import override

import forcegp
from forcegp.atomic_files import file_digest
from forcegp.data import Dataset, is_dataset
from forcegp.data.dataset import FORCE, SENSORS
from forcegp.data.filters import JITTER
from forcegp.errors import DatasetError, DataWarning, FileFormatError, InvalidInput, require_known, usable_arguments
from forcegp.progress import tell
from forcegp.recordings.arrays import ARRAYS, ArrayFile
from forcegp.recordings.mapping import SIGNALS, ColumnMapping
from forcegp.recordings.recording import Recording, read_recording
from forcegp.recordings.ros_bag import RosBag
from forcegp.recordings.signal_plan import LACKING, SignalPlan, signal_plan
from forcegp.recordings.source import Columns, Source, reading
from forcegp.recordings.tables import DelimitedText

ROUND_RATE = 1e-3  # a median rate within 0.1 % of one with three digits is taken for it: 499.93 Hz is a log at 500 Hz
LARGEST = 2**16  # bytes: some thousand names
OF_FOLDER = "forcegp.yaml"
KINDS = {"step": (float, "seconds"), "ned": (bool, "true or false"), "side_by_side": (bool, "true or false")}
"""What is no text, and its name."""


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """How stamps become rows.

    gap: seconds without a row, or a message of one of several topics, that begin another episode; None: ten steps.
    rate: "auto" gives uneven rows even times at the median of the recordings' median rates, a number (Hz) all rows at
        that rate; "log" keeps every stamp.
    start, end: seconds from the first row of each episode that are kept.
    without: begins and ends of stretches in these seconds that are left out, as of contacts.
    unwrap: add whole turns to positions of turning joints where they jump by more than half a turn.
    bad_rows: "skip" leaves out rows in which a value is missing or no finite number, up to 5 % of a log; "refuse" only
        those in which every value is.
    beyond_limits: accept positions beyond the limits of the URDF.
    stance: "auto" takes logs whose u lacks the switches of contacts. They are 0 in the dataset, and "open_switches" of
        what was done names them: `Preparation(stance="auto")` has to find them. "log" refuses such logs.

    Raises InvalidInput for numbers that make no sense.
    """

    gap: float | None = None
    rate: float | Literal["auto", "log"] = "auto"
    start: float | None = None
    end: float | None = None
    without: tuple[float, ...] = ()
    unwrap: bool = False
    bad_rows: Literal["refuse", "skip"] = "refuse"
    beyond_limits: bool = False
    stance: Literal["log", "auto"] = "log"

    @usable_arguments("ImportOptions")
    def __post_init__(self) -> None:
        if self.gap is not None and not 0.0 < self.gap < float("inf"):
            raise InvalidInput(f"gap is {self.gap}; it must be positive and finite.")
        if self.rate not in ("auto", "log") and not (isinstance(self.rate, int | float) and 0.0 < self.rate < 1e9):
            raise InvalidInput(f"rate is {self.rate!r}; give rows per second, 'auto' or 'log'.")
        if self.start is not None and self.end is not None and not self.start < self.end:
            raise InvalidInput(f"start ({self.start} s) must come before end ({self.end} s).")
        if len(self.without) % 2 or (np.diff(self.without) < 0.0).any():
            raise InvalidInput(f"without is {self.without}; give begin and end of each stretch in s, in their order.")
        for name, allowed in (("stance", ("log", "auto")), ("bad_rows", ("refuse", "skip"))):
            if getattr(self, name) not in allowed:
                raise InvalidInput(f"{name} is {getattr(self, name)!r}; allowed: {allowed[0]!r} or {allowed[1]!r}.")


def import_recordings(
    paths: Sequence[str | Path], mapping: ColumnMapping, *, model: forcegp.Model, options: ImportOptions | None = None
) -> Dataset:
    """The dataset of this robot that these logs hold; `metadata["import"]` is what was done.

    Gaps and episode numbers of a log make episodes. Only the columns that are used have to fit into memory.

    Raises FileFormatError, DatasetError and InvalidInput naming file, column, row, time and remedy. Warns
    (DataWarning) of what can be used but looks mistaken.
    """
    options = options or ImportOptions()
    if not paths:
        raise InvalidInput("no logs are given.")
    sources = _sources([Path(path) for path in paths], mapping)
    plans = [signal_plan(mapping, source, model, options.stance == "auto") for _, source in sources]
    plan = plans[0]
    for (label, _), other in zip(sources, plans, strict=True):
        if (other.joints, other.logged) != (plan.joints, plan.logged):
            raise InvalidInput(f"{label} has signals {other.logged} and {sources[0][0]} {plan.logged}; import alike.")
    recordings = []
    for index, ((label, source), own) in enumerate(zip(sources, plans, strict=True)):
        tell(index, len(sources), f"reading {label}")
        believed = own.joints if "q" in mapping.unit else ()
        recordings.append(read_recording(source, own, label, options, model.robot, believed))
    step = _even_step(recordings, options)
    done = _what_was_done(mapping, plan, recordings, step)
    pieces: list[dict[str, np.ndarray]] = []
    for recording in recordings:
        for number, rows in recording.stretches:
            for places, seen, remedy in recording.jumps:  # which derivatives would take for motion
                for row in places[(places > rows[0]) & (places <= rows[-1])][:1]:
                    where = f"{recording.source.place(int(row))} ({recording.time[row]:.6g} s from the start)"
                    raise DatasetError(f"{recording.told['name']}: {seen} at {where}; {remedy}")
            piece = recording.rows(rows, step)
            count, stamp = len(piece["time"]), recording.begin + float(recording.time[rows[0]])
            pieces.append(piece | {"episode": np.full(count, len(pieces))})
            told = {"recording": recording.told["name"], "number": number, "row": int(rows[0]), "begin": stamp}
            done["episodes"].append(told | {"rows": count})
    columns: dict[str, Any] = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
    columns.setdefault("u", np.zeros((len(columns["time"]), 0)))
    done["rows"] = len(columns["time"])
    measured = {name: columns.pop(name) for name in [*columns] if name.startswith(SENSORS)}
    if mapping.axes.get("force", ("world",)) == ("body",):
        at = model.robot.kinematics(torch.tensor(columns["q"]))
        for name, values in ((name, values) for name, values in measured.items() if name.startswith(FORCE)):
            measured[name] = (at.frame_pose(name.removeprefix(FORCE))[:, :3, :3].numpy() @ values[..., None])[..., 0]
    return Dataset(**columns, measured=measured, model=model, metadata={"import": done})


def _sources(paths: Sequence[Path], mapping: ColumnMapping) -> list[tuple[str, Source]]:
    widths = mapping.headerless
    if len(widths) not in (0, 1, len(paths)):
        raise InvalidInput(f"headerless has {len(widths)} numbers for {len(paths)} files; give one, or one per file.")

    def opened(index: int, within: str | None = None) -> Source:
        width = widths[index if len(widths) > 1 else 0] if widths else None
        return open_source(paths[index], headerless=width, within=within)

    if mapping.side_by_side:
        if mapping.episodes is not None:
            raise InvalidInput("files side by side are one recording; leave `episodes` out.")
        together = SideBySide([opened(index) for index in range(len(paths))])
        return [(str(together.path), together)]
    found: list[tuple[str, Source]] = []
    for index, path in enumerate(paths):
        if mapping.episodes is None:
            found.append((str(path), opened(index)))
            continue
        whole = open_source(path, within="")
        assert isinstance(whole, ArrayFile), "open_source refuses `within` for other formats"
        found += [(f"{path}: {name}", opened(index, name)) for name in whole.episodes(mapping.episodes)]
    return found


def _even_step(recordings: Sequence[Recording], options: ImportOptions) -> float | None:
    """The step of even times that all episodes get, or None if every stamp stays."""
    median = float(np.median([own.step for own in recordings]))
    if not isinstance(options.rate, str):
        if options.rate < 0.9 / median:
            seen = f"`rate` {options.rate:g} Hz is below the {1 / median:.6g} Hz of the log"
            effect = "what moves faster than half of that appears as slow motion"
            advice = "Filter first: forcegp import --cutoff --every."
            warnings.warn(f"{seen}; {effect}. {advice}", DataWarning, stacklevel=3)
        return 1.0 / options.rate
    alike = all(abs(own.step / median - 1.0) <= ROUND_RATE for own in recordings)
    if options.rate == "log" or (alike and all(own.worst <= JITTER for own in recordings)):
        return None
    rate = float(f"{1 / median:.3g}")
    return 1.0 / rate if abs(rate * median - 1.0) <= ROUND_RATE else median


def _what_was_done(
    mapping: ColumnMapping, plan: SignalPlan, recordings: Sequence[Recording], step: float | None
) -> dict[str, Any]:
    files = dict.fromkeys(file for recording in recordings for file in recording.source.files())
    made = {"u": "none", "v": "central differences of q", "a": "central differences of v"}
    lacking = {name: max(len(own.layout.derived.get(name, ())) for own in recordings) for name in SIGNALS}
    entries = Counter(item.signal for item in plan.signals)
    logged = {name: f"logged and {made[name]}" if count else "logged" for name, count in lacking.items()}
    columns = [(x.signal, x.expression.text) for x in plan.signals if x.signal != "u" or x.expression is not LACKING]
    return {
        "files": [{"name": str(file), "bytes": file.stat().st_size, "sha256": file_digest(file)} for file in files],
        "mapping": mapping.plain(),
        "guessed": list(plan.guessed),
        "columns": {name: [text for signal, text in columns if signal == name] for name in plan.logged},
        "units": {name: [x.unit.name for x in plan.signals if x.signal == name] for name in plan.logged},
        "open_switches": list(plan.open_switches),
        "signals": {name: made[name] if lacking[name] == entries[name] else logged[name] for name in SIGNALS},
        "recordings": [recording.told for recording in recordings],
        "resampled_to_step": step,
        "episodes": [],
    }


class SideBySide(Source):
    """The columns of several tables of equally many rows, called `STEM:name` with the file name up to its first dot.

    A stem by itself stands for all columns of its file. Raises InvalidInput for two files of one stem.
    """

    def __init__(self, sources: Sequence[Source]) -> None:
        super().__init__(Path(", ".join(str(source.path) for source in sources)))
        self.sources = {source.path.name.split(".")[0]: source for source in sources}
        self.units = {f"{stem}:{name}": unit for stem, x in self.sources.items() for name, unit in x.units.items()}
        if len(self.sources) < len(sources):
            raise InvalidInput(f"{self.path}: two files have the same name up to the first dot; rename one.")

    @cached_property
    def _owners(self) -> Mapping[str, tuple[Source, str]]:
        return {f"{stem}:{own}": (source, own) for stem, source in self.sources.items() for own in source.columns()}

    @override
    def columns(self) -> tuple[str, ...]:
        return tuple(self._owners)

    @property
    @override
    def vectors(self) -> Mapping[str, tuple[str, ...]]:
        """The vectors of each file, and the stem of each for all of its columns."""
        wholes = {name: [f"{name}:{x}" for x in source.columns()] for name, source in self.sources.items()}
        return {**super().vectors, **{name: tuple(columns) for name, columns in wholes.items()}}

    @override
    def files(self) -> tuple[Path, ...]:
        return tuple(file for source in self.sources.values() for file in source.files())

    @override
    def notes(self) -> tuple[str, ...]:
        return tuple(note for source in self.sources.values() for note in source.notes())

    @override
    def table(self, names: Sequence[str]) -> Columns:
        own: dict[Source, dict[str, str]] = {}
        for name in names:
            source, column = self._owners[name]
            own.setdefault(source, {})[name] = column
        read = {source: source.read(list(columns.values())) for source, columns in own.items()}
        rows = {source.path.name: len(next(iter(columns.values()))) for source, columns in read.items()}
        if len(set(rows.values())) > 1:
            listed = ", ".join(f"{name} {count}" for name, count in rows.items())
            raise FileFormatError(f"files side by side must have equally many rows; these have: {listed}.")
        return {name: read[source][column] for name, (source, column) in self._owners.items() if name in names}


TEXT = (".csv", ".tsv", ".txt", ".dat")
TABLES: dict[str, Callable[[Path], Source]] = {".bag": RosBag, ".mcap": RosBag, ".db3": RosBag}
"""A new format is a subclass of `Source`, and an entry here (or in `ARRAYS`) with its extension."""

READABLE = ", ".join([*(f"{name}[.gz]" for name in TEXT), *TABLES, *ARRAYS]) + ", folders of ROS 2 bags"
PICKLES = {".pkl", ".pickle", ".npy", ".pt", ".pth", ".joblib"}


def open_source(path: Path, *, headerless: int | None = None, within: str | None = None) -> Source:
    """The reader for a log, chosen by its extension or, for a folder, by what is in it.

    Parameters: `headerless` as for `DelimitedText`, `within` as for `ArrayFile`.
    Raises FileFormatError for what cannot be read, InvalidInput for parameters that mean nothing to the format.
    """
    kind = _kind(path)
    if kind not in TEXT and headerless:
        raise InvalidInput(f"`headerless` means nothing to {path}; it is for text files.")
    if kind not in ARRAYS and within is not None:
        raise InvalidInput(f"`episodes` means nothing to {path}; it is for {', '.join(ARRAYS)} files.")
    if kind in TEXT:
        return DelimitedText(path, headerless=headerless)
    if kind in ARRAYS:
        if kind in (".h5", ".hdf5", ".mat") and is_dataset(path):
            raise FileFormatError(f"{path} is a dataset of forcegp already; there is nothing to import.")
        return ArrayFile(path, ARRAYS[kind], within=within)
    return RosBag(path) if kind == "ros2" else TABLES[kind](path)


def _kind(path: Path) -> str:  # the extension without .gz, or "ros2"
    if path.is_dir():
        if (path / "metadata.yaml").is_file() or any(path.glob("*.mcap")):
            return "ros2"
        raise FileFormatError(f"{path} is a folder, but no ROS 2 bag (metadata.yaml); give the files in it.")
    if not path.is_file():
        raise FileFormatError(f"{path} does not exist, or is not a regular file; give the path of a log.")
    suffixes = [suffix.lower() for suffix in path.suffixes]
    kind = suffixes[-1] if suffixes else ""
    if kind == ".gz" and suffixes[-2:-1] and suffixes[-2] in TEXT:
        kind = suffixes[-2]
    if kind in PICKLES:
        raise FileFormatError(f"{path} may hold Python objects, and reading those runs code; save arrays as .npz.")
    if kind not in (*TEXT, *ARRAYS, *TABLES):
        raise FileFormatError(f"{path}: the extension {kind or 'of no name'!r} is not known. Readable: {READABLE}.")
    if path.stat().st_size == 0:
        raise FileFormatError(f"{path} is empty; give a log with rows.")
    return kind


class _OnceLoader(yaml.SafeLoader):
    """Safe YAML in which no key may stand twice and nothing may refer to something else."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            mark = self.peek_event().start_mark
            raise yaml.constructor.ConstructorError(None, None, "aliases (*name) are not read", mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        if repeated := [key for key, count in Counter(map(repr, keys)).items() if count > 1]:
            raise yaml.constructor.ConstructorError(None, None, f"{repeated[0]} stands twice", node.start_mark)
        return super().construct_mapping(node, deep)


def read_mapping(path: Path, known: Sequence[str]) -> dict[str, Any]:
    """What the file states of the `known` options: a truth, a number or a text for each, lists joined by commas.

    `{deg: q}` of units, signs and axes is "deg=q". Raises FileFormatError naming the file and the key.
    """
    if not path.is_file():
        raise FileFormatError(f"{path} is not a file; give `mapping` a YAML file.")
    with reading(path, "YAML"):
        if path.stat().st_size > LARGEST:
            raise FileFormatError(f"{path} is larger than 64 KiB; that is no mapping of columns.")
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=_OnceLoader)  # a SafeLoader
    if not isinstance(content, dict):
        raise FileFormatError(f"{path} must be a mapping such as 'q: pos{{1..7}}'.")
    for key in content:
        require_known("key", key, f"{path}, a mapping of columns", known, FileFormatError)
    return {key: _words(path, key, value) for key, value in content.items() if value is not None}


def _words(path: Path, key: str, value: Any) -> Any:
    if key in KINDS:
        kind, what = KINDS[key]
        with suppress(ValueError):  # YAML takes 1e-3 for a text
            value = float(value) if kind is float and type(value) in (int, str) else value
        if type(value) is not kind:
            raise FileFormatError(f"{path}: {key} is {value!r:.60}; give {what}.")
        return value
    if isinstance(value, str):
        return value
    if isinstance(value, dict) and value:
        return ",".join(f"{name}={_words(path, key, entry)}" for name, entry in value.items())
    entries = value if isinstance(value, list) else [value]
    plain = all(isinstance(entry, str | int | float) and not isinstance(entry, bool) for entry in entries)
    if not entries or not plain:
        raise FileFormatError(f"{path}: {key} is {value!r:.60}; give a text, a number or a list of them.")
    return ",".join(map(str, entries))


def beside(log: Path) -> Path | None:
    """The mapping that belongs to a log: STEM.yaml beside it, or forcegp.yaml in its folder."""
    own = log.parent / f"{log.name.split('.')[0]}.yaml"  # also of a folder such as '.', which has no name
    return next((path for path in (own, log.parent / OF_FOLDER) if path.is_file()), None)
