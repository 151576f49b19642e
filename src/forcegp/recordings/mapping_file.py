"""Mappings as text: YAML files, and the short forms of the command line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import yaml

from forcegp.errors import FileFormatError, InvalidInput
from forcegp.recordings.column_names import listed
from forcegp.recordings.mapping import SIGNALS, ColumnMapping
from forcegp.recordings.signal_units import UNITS
from forcegp.recordings.source import reading

LARGEST = 2**20  # bytes
OF_FOLDER = "forcegp.yaml"


class _OnceLoader(yaml.SafeLoader):
    """Safe YAML in which no key may stand twice and nothing may refer to something else."""

    def compose_node(self, parent, index):
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.constructor.ConstructorError(
                None, None, "aliases (*name) are not read", self.peek_event().start_mark
            )
        return super().compose_node(parent, index)

    def construct_mapping(self, node, deep=False):
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        repeated = [key for key in keys if keys.count(key) > 1]
        if repeated:
            raise yaml.constructor.ConstructorError(None, None, f"{repeated[0]!r} stands twice", node.start_mark)
        return super().construct_mapping(node, deep)


def read_mapping(path: Path) -> ColumnMapping:
    """The mapping in a YAML file, whose keys are the fields of `ColumnMapping`.

    Raises FileFormatError naming the file and the key.
    """
    if not path.is_file():
        raise FileFormatError(f"{path} is not a file; give `mapping` a YAML file.")
    with reading(path, "YAML", yaml.YAMLError, RecursionError):
        if path.stat().st_size > LARGEST:
            raise FileFormatError(f"{path} is larger than 1 MiB; that is no mapping of columns.")
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=_OnceLoader)  # a SafeLoader
    if not isinstance(content, dict):
        raise FileFormatError(f"{path} must be a mapping such as 'q: pos{{1..7}}'.")
    try:
        return mapping_of(content)
    except InvalidInput as error:
        raise FileFormatError(f"{path}: {error}") from error


def mapping_of(content: Mapping[Any, Any]) -> ColumnMapping:
    """The mapping in plain values. Raises InvalidInput naming the key that is not known or has a wrong value."""
    known = [item.name for item in fields(ColumnMapping)]
    values: dict[str, Any] = {}
    for key, value in content.items():
        if key not in known:
            raise InvalidInput(f"key {key!r} is not known; there are {', '.join(known)}.")
        if value is None:
            continue
        if key in SIGNALS or key == "joints":
            values[key] = _texts(key, value)
        elif key == "unit":
            values[key] = {str(name): _texts(f"unit of {name}", entry) for name, entry in _dict(key, value).items()}
        elif key in ("sign", "scale", "offset"):
            values[key] = {
                signal: _numbers(f"{key} of {signal}", entry) for signal, entry in _by_signal(key, value).items()
            }
        elif key == "headerless":
            values[key] = tuple(_whole(number) for number in (value if isinstance(value, list) else [value]))
        elif key == "step":
            values[key] = _numbers(key, value)[0]
        elif key == "side_by_side":
            if not isinstance(value, bool):
                raise InvalidInput(f"side_by_side is {value!r}; give true or false.")
            values[key] = value
        else:
            if not isinstance(value, str):
                raise InvalidInput(f"{key} is {value!r}; give a text.")
            values[key] = value
    return ColumnMapping(**values)


def mapping_text(mapping: ColumnMapping) -> str:
    """The YAML of a mapping, which `read_mapping` reads."""
    return yaml.safe_dump(mapping.plain(), sort_keys=False, allow_unicode=True, default_flow_style=False, width=120)


def beside(log: Path) -> Path | None:
    """The mapping that belongs to a log: STEM.yaml beside it, or forcegp.yaml in its folder."""
    own = log.with_name(f"{log.name.split('.')[0]}.yaml")
    return next((path for path in (own, log.parent / OF_FOLDER) if path.is_file()), None)


def by_quantity(flag: str, text: str) -> dict[str, list[str]]:
    """`q=deg,m,time=ms` as {"q": ["deg", "m"], "time": ["ms"]}: what follows a name up to the next one is its list."""
    found: dict[str, list[str]] = {}
    name = None
    for part in text.split(","):
        before, equals, after = part.partition("=")
        if equals:
            name, part = before.strip(), after
            if name in found:
                raise InvalidInput(f"--{flag} names {name} twice.")
        if name is None or not part.strip():
            raise InvalidInput(f"--{flag} is {text!r}; write for example {flag} {_EXAMPLES[flag]}.")
        found.setdefault(name, []).append(part.strip())
    return found


_EXAMPLES = {"unit": "q=deg,time=ms", "sign": "u=-1,1", "scale": "u=0.001", "offset": "q=0,1.5708"}


def factors_of(flag: str, text: str) -> Any:
    """The value of `sign`, `scale` or `offset` as a YAML file would have it."""
    if "=" not in text:
        return [_number(flag, part) for part in text.split(",")]
    return {name: [_number(flag, part) for part in parts] for name, parts in by_quantity(flag, text).items()}


def _texts(key: str, value: Any) -> tuple[str, ...]:
    entries = value if isinstance(value, list) else listed(value) if isinstance(value, str) else [value]
    if not entries or any(isinstance(entry, bool) or not isinstance(entry, str | int | float) for entry in entries):
        raise InvalidInput(f"{key} is {value!r}; give a text or a list of texts.")
    return tuple(str(entry) for entry in entries)


def _by_signal(key: str, value: Any) -> Mapping[str, Any]:
    """A list without signals is for all of them, which only a sign can be: it turns the axis of a joint around."""
    if isinstance(value, dict):
        return {str(name): entry for name, entry in value.items()}
    if key != "sign":
        raise InvalidInput(f"{key} is {value!r}; name its signal, for example {_EXAMPLES[key]}.")
    return dict.fromkeys(SIGNALS, value)


def _dict(key: str, value: Any) -> Mapping[Any, Any]:
    if not isinstance(value, dict):
        raise InvalidInput(f"{key} is {value!r}; name the quantity, for example {_EXAMPLES[key]} ({', '.join(UNITS)}).")
    return value


def _numbers(key: str, value: Any) -> tuple[float, ...]:
    return tuple(_number(key, entry) for entry in (value if isinstance(value, list) else [value]))


def _number(key: str, value: Any) -> float:
    try:
        if isinstance(value, bool):
            raise ValueError
        return float(value)
    except (TypeError, ValueError):
        raise InvalidInput(f"{key} is {value!r}; give a number.") from None


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise InvalidInput(f"headerless is {value!r}; give the number of columns.")
    return value
