"""Logs of every format under `forcegp import`: other columns, types and bytes, objects that would run code."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from hypothesis import strategies as st
from tests.fuzz.made import INPUTS, LOGS, PAIR
from tests.fuzz.oracle import Target, require_ended_well
from tests.fuzz.values import DAMAGE, WORDS, Damage, Hostile, damaged, words

TABLE = "--time time --q q_{joints} --v v_{joints} --u u_{joints} --robot pair.urdf"
ARRAYS = "--time time --q q --v v --u u --robot pair.urdf"
FLAGS = {
    "log.csv": TABLE, "log.parquet": TABLE, "log.npz": ARRAYS,
    "log.mat": ARRAYS.replace("time", "log.time", 2).replace("--log.time", "--time"), "log73.mat": ARRAYS,
    "log.h5": ARRAYS, "log.mcap": "--q /joint_states:position --u /joint_states:effort --robot pair.urdf",
}  # fmt: skip
CELLS = st.sampled_from(
    ("0", "1", "", "nan", "inf", "x", "1e400", "-", "1,5", '"', "'", "\x00", "a" * 140_000, "é", "1 2", "#", "\r")
)
CELLS |= st.floats(allow_nan=False).map(repr)


@dataclass(frozen=True)
class Table:
    """A text file made of such cells."""

    header: list[str]
    rows: list[list[str]]
    delimiter: str
    encoding: str
    end: str


@dataclass(frozen=True)
class Array:
    """An archive in which q is that."""

    how: str


QS = {
    "object": lambda q: np.array([{}, []], object), "hostile": lambda q: np.array([Hostile()], object),
    "text": lambda q: np.array([["a", "b"]] * len(q)), "complex": lambda q: q * 1j,
    "dates": lambda q: np.full(q.shape, np.datetime64("2024-01-01")),
    "record": lambda q: np.zeros(len(q), [("a", "f8")]), "float16": lambda q: q.astype(np.float16),
    "booleans": lambda q: q > 0, "int8": lambda q: q.astype(np.int8),
    "unsigned": lambda q: np.full(q.shape, 2**64 - 1, np.uint64), "long double": lambda q: q.astype(np.longdouble),
    "fortran": lambda q: np.asfortranarray(q), "transposed": lambda q: q.T, "scalar": lambda q: np.float64(1.0),
    "deeper": lambda q: q[:, :, None], "empty": lambda q: q[:0], "no columns": lambda q: q[:, :0],
    "nan": lambda q: q * np.nan, "huge": lambda q: q * 1e308, "void": lambda q: np.zeros(len(q), "V8"),
    "bytes": lambda q: np.full(q.shape, b"1"),
}  # fmt: skip
TABLES = st.builds(
    Table,
    st.lists(
        st.sampled_from(("time", "q_shoulder", "q_elbow", "u_shoulder", "u_elbow", "v_shoulder", "v_elbow")) | WORDS,
        max_size=8,
    ),
    st.lists(st.lists(CELLS, max_size=8), max_size=6),
    st.sampled_from((",", ";", "\t", " ", "|", "")),
    st.sampled_from(("utf-8", "utf-16", "latin-1", "utf-8-sig", "utf-32", "cp037")),
    st.sampled_from(("\n", "\r\n", "\r", "\n\n", "\x00")),
)


@dataclass(frozen=True)
class Log:
    """A log, and more words of the command."""

    base: str
    change: Table | Array | Damage
    more: tuple[str, ...]


OPTIONS = words("--rate --gap --start --end --cutoff --headerless --unit --sign --step --episode --episodes")
MORE = st.lists(st.tuples(st.sampled_from((*OPTIONS, "--a", "--orientation", "--axes")), WORDS), max_size=2).map(
    lambda pairs: tuple(word for pair in pairs for word in pair) if len(pairs) == 2 else ()
)
CASES = st.one_of(
    st.builds(Log, st.just("log.csv"), TABLES, MORE),
    st.builds(Log, st.just("log.csv"), DAMAGE, MORE),
    st.builds(Log, st.just("log.npz"), st.builds(Array, st.sampled_from(tuple(QS))), MORE),
    st.builds(Log, st.sampled_from(LOGS), DAMAGE, st.just(())),
)


def check(case: Log, folder: Path) -> None:
    (folder / "pair.urdf").write_text(PAIR)
    path, change, source = folder / case.base, case.change, INPUTS.folder / case.base
    (shutil.copytree if source.is_dir() else shutil.copyfile)(source, path)
    flags = FLAGS[case.base].split()
    if isinstance(change, Damage):
        files = sorted(item for item in path.rglob("*") if item.is_file()) if path.is_dir() else [path]
        victim = files[change.seed % len(files)]
        victim.write_bytes(damaged(victim.read_bytes(), change))
    elif isinstance(change, Array):
        with np.load(path) as file:
            arrays = dict(file)
        np.savez(path, **{**arrays, "q": QS[change.how](arrays["q"])})
    else:
        lines = [change.delimiter.join(cells) for cells in (change.header, *change.rows)]
        path.write_bytes(change.end.join([*lines, ""]).encode(change.encoding, "replace"))
    require_ended_well(["import", case.base, *flags, *case.more, "--out", "out.h5"], folder)


TARGET = Target(CASES, check, fast=9, nightly=2000)
