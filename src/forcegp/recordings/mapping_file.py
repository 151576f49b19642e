"""Options of columns in a YAML file, which belongs to many logs of one robot: their words, as on the command line."""

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml

from forcegp.errors import FileFormatError, require_known
from forcegp.recordings.source import reading

LARGEST = 2**16  # bytes: some thousand names
OF_FOLDER = "forcegp.yaml"
KINDS = {"step": (float, "seconds"), "ned": (bool, "true or false"), "side_by_side": (bool, "true or false")}
"""What is no text, and its name."""


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
