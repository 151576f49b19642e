"""Datasets: HDF5 whose arrays, attributes and texts are others, or whose bytes are damaged."""

import contextlib
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from hypothesis import strategies as st
from tests.fuzz.made import INPUTS
from tests.fuzz.oracle import Target, allowed, require_ended_well, require_no_code
from tests.fuzz.values import DAMAGE, JSON, JSON_EDITS, SCALARS, WORDS, Damage, damaged, edited_json, words

from forcegp import Dataset
from forcegp.data.hdf5 import fixed_text

NAMES = words("q v u a time episode noise_std strokes truth/a truth/lambda joint_names metadata model")
ATTRIBUTES = ("format", "format_version", "written_by", "time_ordered", "units")
ARRAYS = {
    "no quaternions": lambda x: x * 1.5, "fewer columns": lambda x: x[..., :-1],
    "more columns": lambda x: np.concatenate([x, x[..., :1]], -1) if x.ndim else x,
    "w first": lambda x: np.roll(x, 1, -1),
    "nan": lambda x: np.where(np.arange(x.size).reshape(x.shape) == 1, np.nan, x), "infinite": lambda x: x + np.inf,
    "huge": lambda x: x * 1e300, "zero": lambda x: x * 0, "negative": lambda x: -x - 1,
    "integers": lambda x: x.astype(np.int8), "float16": lambda x: x.astype(np.float16),
    "complex": lambda x: x.astype(complex), "booleans": lambda x: x > 0, "bytes": lambda x: np.full(x.shape, b"x"),
    "flat": lambda x: x.ravel(), "empty": lambda x: x.ravel()[:0], "no rows": lambda x: x[:0],
    "fewer rows": lambda x: x[:-1], "scalar": lambda x: np.float64(3.0), "deeper": lambda x: x[None],
    "backwards": lambda x: x[::-1], "big ends": lambda x: x.astype(">f8"),
    "record": lambda x: np.zeros(x.shape, [("a", "f8"), ("b", "i4")]),
}  # fmt: skip
OTHERS = (
    *({"preparation": value} for value in ({"cutoff": "x"}, 5, [], {"delay": [None]}, {"why": []}, {"earlier": 5})),
    *({"import": value} for value in (5, [1], {"recordings": 5}, {"recordings": [1]}, {"recordings": [{"gaps": 5}]})),
    *({"import": {"episodes": value}} for value in (5, [5], [{"recording": []}])),
    {"config": []},
)
"""Metadata that look like ours."""


@dataclass(frozen=True)
class Change:
    """`how` is done to the entry `name`."""

    name: str
    how: str
    value: Any = None


CHANGES = st.one_of(
    st.builds(Change, st.sampled_from(NAMES), st.sampled_from(tuple(ARRAYS))),
    st.builds(Change, st.sampled_from(NAMES), st.sampled_from(("delete", "group", "soft link", "external", "swap"))),
    st.builds(Change, st.sampled_from(NAMES), st.just("text"), JSON | st.sampled_from(OTHERS)),
    st.builds(Change, st.just("metadata"), st.just("text"), st.sampled_from(OTHERS) | st.dictionaries(WORDS, JSON)),
    st.builds(Change, st.just("metadata"), st.just("motion"), JSON),
    st.builds(Change, st.sampled_from(ATTRIBUTES), st.just("attribute"), SCALARS),
    st.builds(Change, st.just("joint_names"), st.just("names"), st.lists(WORDS, max_size=4)),
    st.builds(Change, st.just("model"), st.just("edit"), st.lists(JSON_EDITS, min_size=1, max_size=2)),
)


@dataclass(frozen=True)
class DataFile:
    base: str
    changes: list[Change]
    damage: Damage | None


CASES = st.builds(
    DataFile, st.sampled_from(("train.h5", "test.h5", "bare.h5", "moving.h5")),
    st.lists(CHANGES, min_size=1, max_size=3), st.none() | st.none() | st.none() | DAMAGE,
)  # fmt: skip


def write(case: DataFile, path: Path) -> Path:
    shutil.copyfile(INPUTS.folder / case.base, path)
    with h5py.File(path, "r+") as file:
        for change in case.changes:
            with contextlib.suppress(KeyError, OSError, RuntimeError):  # links that lead nowhere
                _apply(file, change)
    if case.damage is not None:
        path.write_bytes(damaged(path.read_bytes(), case.damage))
    return path


def _apply(file: h5py.File, change: Change) -> None:
    name, value = change.name, change.value
    if change.how == "attribute":
        holder = file["q"] if name == "units" and isinstance(file.get("q", getlink=True), h5py.HardLink) else file
        text = np.bytes_(value.encode("utf-8", "replace").replace(b"\0", b"?")) if isinstance(value, str) else value
        try:
            holder.attrs[name] = [] if text is None else text
        except (TypeError, OverflowError):  # a number that HDF5 does not have
            holder.attrs[name] = 1e300
        return
    linked = file.get(name, getlink=True)
    stored = file[name] if isinstance(linked, h5py.HardLink) else None
    array = isinstance(stored, h5py.Dataset) and stored.dtype.kind in "fiu"
    content = stored[()] if array else None
    text = stored.asstr()[()] if isinstance(stored, h5py.Dataset) and stored.shape == () and not array else "{}"
    units = dict(stored.attrs) if stored is not None else {}
    if linked is not None:
        del file[name]
    match change.how:
        case "delete":
            return
        case "group":
            file.create_group(name)
        case "soft link":
            file[name] = h5py.SoftLink("/v")
        case "external":
            file[name] = h5py.ExternalLink("other.h5", "/q")
        case "swap":
            if isinstance(file.get("v", getlink=True), h5py.HardLink):
                file[name] = file["v"]
        case "text":
            file[name] = fixed_text(json.dumps(value).replace("@deep", ""))
        case "motion":
            file[name] = fixed_text(
                json.dumps({"preparation": value, "source": value, "import": value, "windows": value})
            )
        case "names":
            file[name] = (
                fixed_text([x.replace("\0", "").encode("utf-8", "replace").decode() for x in value])
                if value
                else np.zeros(0)
            )
        case "edit":
            edited = edited_json({} if len(text) > 100_000 or "9" * 99 in text else json.loads(text), value)
            file[name] = fixed_text(edited)
        case how:
            file[name] = ARRAYS[how](np.ones(3) if content is None else np.atleast_1d(content))
    for key, unit in units.items():
        if isinstance(file.get(name, getlink=True), h5py.HardLink):
            file[name].attrs[key] = unit


def check(case: DataFile, folder: Path) -> None:
    """Refused, or a Dataset of finite numbers that can be written again."""
    path = write(case, folder / "data.h5")
    with allowed():
        data = Dataset.load(path)
        repr(data)
        for name in ("q", "v", "u", "a", "time"):
            assert np.isfinite(getattr(data, name)).all()
        data.rows(slice(0, 3))
        data.save(folder / "again.h5")
        Dataset.load(folder / "again.h5")
    require_no_code(folder)


def check_commands(case: DataFile, folder: Path) -> None:
    """The same files under the commands that read datasets."""
    write(case, folder / "data.h5")
    number = sum(map(ord, repr(case)))
    lines = (
        "check data.h5", "import data.h5 --cutoff 20 --lag 0.05 --out o.h5", "import data.h5 --cutoff 20 --out o.h5",
        f"score {INPUTS.folder / 'carried'} data.h5",
    )  # fmt: skip
    require_ended_well(lines[number % 4].split(), folder)


TARGET = Target(CASES, check, fast=38, nightly=3000)
COMMANDS_TARGET = Target(CASES, check_commands, fast=5, nightly=1500)
