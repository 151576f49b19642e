"""Mappings of columns: YAML of any shape, tags that would run code, aliases, bytes that are no text."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from hypothesis import strategies as st
from tests.fuzz.oracle import CANARY, Target, allowed, require_no_code
from tests.fuzz.values import DAMAGE, SCALARS, WORDS, Damage, damaged, words

from forcegp.recordings.mapping import mapping_text, read_mapping

KEYS = ("time", "step", "q", "v", "u", "a", "joints", "unit", "sign", "episode", "episodes")
KEYS += ("orientation", "axes", "ned", "headerless", "delimiter", "side_by_side", "x", "q")
COLUMNS = words("q_{joints} q{1..7} q{1..999999999} q{7..1} q{1..} {joints}{joints} a*b 2*a-b/3 a/0 ((((a a+1e400*b")
COLUMNS += ("/joint_states:position", "q" + 8 * "{1..3}", "a" + "+a" * 3000, "(" * 5000)
PLAIN = SCALARS.filter(lambda value: value != "\ud800") | WORDS | st.sampled_from(COLUMNS)
VALUES = st.recursive(
    PLAIN,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(KEYS) | WORDS, inner, max_size=3),
    max_leaves=5,
)
RAW = (
    f"q: !!python/object/apply:os.mkdir [{CANARY}]\n",
    f"!!python/object/apply:os.mkdir [{CANARY}]\n",
    f"? !!python/object/new:os.mkdir [{CANARY}]\n: 1\n",
    "a: &a [x, x]\nq: [*a, *a]\n",
    "<<: {q: a}\nq: b\n",
    "q: 2024-01-01\n",
    "q: !!binary aGk=\n",
    "q: !!set {a, b}\n",
    "time: 12:30:45\n",
    "q: 0o17\nu: 0b1\n",
    "%YAML 9.9\n---\nq: a\n",
    "q: a\n---\nq: b\n",
    "[" * 3000,
    "{a: " * 3000,
    "- " * 5000 + "a",
    "q: |\n" + " x\n" * 100,
    "step: " + "9" * 5000 + "\n",
    "step: !!int '" + "9" * 5000 + "'\n",
    "step: !!float x\n",
    "step: !!int x\n",
    "q: !!timestamp x\n",
    "q: !!bool x\n",
    "[a, b]: c\n",
    "{a: b}: c\n",
    "? [a]\n: b\n",
    "? {a: b}\n: b\n",
    "? !!set {a}\n: b\n",
    "!!pairs [a: b]: c\n",
    "q: !!omap [a]\n",
)


@dataclass(frozen=True)
class Mapping:
    content: Any
    damage: Damage | None


CASES = st.builds(
    Mapping,
    st.dictionaries(st.sampled_from(KEYS), VALUES, max_size=4)
    | VALUES
    | st.sampled_from(RAW).map(lambda text: ("raw", text)),
    st.none() | st.none() | st.none() | DAMAGE,
)


def write(case: Mapping, path: Path) -> None:
    """The YAML file."""
    raw = isinstance(case.content, tuple)
    text = case.content[1] if raw else yaml.safe_dump(case.content, allow_unicode=True)
    content = text.encode("utf-8", "surrogateescape")
    path.write_bytes(content if case.damage is None else damaged(content, case.damage))


def check(case: Mapping, folder: Path) -> None:
    """Refused, or a mapping that can be written and read."""
    write(case, folder / "log.yaml")
    with allowed():
        mapping = read_mapping(folder / "log.yaml")
        (folder / "again.yaml").write_text(mapping_text(mapping), encoding="utf-8")
        read_mapping(folder / "again.yaml")
    require_no_code(folder)


TARGET = Target(CASES, check, fast=40, nightly=3000)
