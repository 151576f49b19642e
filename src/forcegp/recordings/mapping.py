"""`ColumnMapping`: which columns are what, in which units; its YAML files, and the short forms of the command line."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from forcegp.errors import FileFormatError, InvalidInput, require_known, usable_arguments
from forcegp.recordings.column_names import listed
from forcegp.recordings.source import reading


@dataclass(frozen=True)
class LogUnit:
    """One unit in SI is so many of these: whole thousandths are divided once, and come out to the last bit."""

    name: str
    si: str
    per_si: float = 1.0

    def in_si(self, values: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
        """The values in the SI unit; those that are in it already come out as they are."""
        return values / self.per_si if self.per_si != 1.0 else values


def _units(si: str, per_si: Mapping[str, float]) -> dict[str, LogUnit]:
    return {name: LogUnit(name, si, float(number)) for name, number in per_si.items()}


_DEGREES, _TURNS = 180.0 / math.pi, 0.5 / math.pi  # in a radian
ONE = LogUnit("1", "1")  # of parts of a quaternion, of shares of a thrust and of switches
UNITS: dict[str, dict[str, LogUnit]] = {
    "time": _units("s", {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9, "min": 1 / 60}),
    "q": _units("rad", {"rad": 1, "mrad": 1e3, "deg": _DEGREES, "rev": _TURNS})
    | _units("m", {"m": 1, "cm": 100, "mm": 1e3, "um": 1e6})
    | {"1": ONE},
    "v": _units("rad/s", {"rad/s": 1, "mrad/s": 1e3, "deg/s": _DEGREES, "rev/s": _TURNS, "rpm": 60 * _TURNS})
    | _units("m/s", {"m/s": 1, "cm/s": 100, "mm/s": 1e3}),
    "u": _units("Nm", {"Nm": 1, "mNm": 1e3, "uNm": 1e6, "kNm": 1e-3, "Ncm": 100})
    | _units("N", {"N": 1, "mN": 1e3, "kN": 1e-3})
    | {"1": ONE}
    | _units("rad/s", {"rad/s": 1, "rev/s": _TURNS, "rpm": 60 * _TURNS}),
    "a": _units("rad/s^2", {"rad/s^2": 1, "deg/s^2": _DEGREES}) | _units("m/s^2", {"m/s^2": 1, "mm/s^2": 1e3}),
}
"""By quantity and name: what `ColumnMapping.unit` accepts."""


def log_unit(quantity: str, name: str) -> LogUnit:
    """The unit of that name. Raises InvalidInput listing those of the quantity."""
    spelled = name.strip().replace("**", "^").replace("²", "^2").replace("µ", "u").replace("·", "").replace("°", "deg")
    units = UNITS[quantity]
    meant = {known.lower(): known for known in units}
    require_known("unit", spelled, f"the units of {quantity}", units, synonyms=meant)
    return units[spelled]


SIGNALS = ("q", "v", "u", "a")
ORIENTATIONS = ("xyzw", "wxyz", "angles")
"""Quaternions with w last or first; roll, pitch and yaw with R = Rz(yaw) Ry(pitch) Rx(roll), or the yaw of a plane."""
AXES = {"v": ("body", "world"), "a": ("body", "world", "imu")}
"""What linear and angular velocities and accelerations may be measured in."""


@dataclass(frozen=True, kw_only=True)
class ColumnMapping:
    """What the columns of a log mean. A value in SI is `sign * unit * (combination of columns)`.

    Fields
    ------
    time, step: a column or combination that is the time, or the time in s between two rows; one of both.
    q, v, u, a: per signal, its columns: patterns (`pos{1..7}`), names of vectors, combinations (`theta2 - theta1`), or
        one constant. None: v and a are differentiated, the others are looked for by the names of the joints.
    joints: their names, in the order of the columns; columns of a base that moves stand where its robot has them.
    orientation: of a base that moves: quaternions "xyzw" (default) or "wxyz", or "angles" roll, pitch and yaw.
    axes: of its v and a, of the linear and the angular part: "body" (default), "world", or "imu" for what an
        accelerometer at its origin measures.
    ned: the log's world is north, east, down and its base forward, right, down; both are turned about x by half a turn.
    unit: by signal and "time", one unit for all joints or one for each. Default: SI. With a base that moves, each unit
        is for the columns of its kind.
    sign: by signal, 1 or -1 for all joints or for each.
    episode: a column that numbers the episodes.
    episodes: a pattern (`piece*`) for arrays or groups of the file, each of which is an episode.
    headerless: for text without header, the columns of each file in their order.
    delimiter: for text, if it cannot be detected.
    side_by_side: the files given are one recording, not one each.

    Raises InvalidInput for units that do not exist and numbers that make no sense.
    """

    time: str | None = None
    step: float | None = None
    q: tuple[str, ...] | None = None
    v: tuple[str, ...] | None = None
    u: tuple[str, ...] | None = None
    a: tuple[str, ...] | None = None
    joints: tuple[str, ...] = ()
    orientation: str | None = None
    axes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    ned: bool = False
    unit: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    sign: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    episode: str | None = None
    episodes: str | None = None
    headerless: tuple[int, ...] = ()
    delimiter: str | None = None
    side_by_side: bool = False

    @usable_arguments("ColumnMapping")
    def __post_init__(self) -> None:
        if self.time is not None and self.step is not None:
            raise InvalidInput("give a column for the time or the step between rows, not both.")
        if self.step is not None and not 0.0 < self.step < float("inf"):
            raise InvalidInput(f"step is {self.step} s; it must be positive and finite.")
        if len(set(self.joints)) < len(self.joints) or not all(self.joints):
            raise InvalidInput(f"joints are {', '.join(self.joints)}; every joint needs a name of its own.")
        if self.orientation not in (None, *ORIENTATIONS):
            raise InvalidInput(f"orientation is {self.orientation!r}; give {', '.join(ORIENTATIONS)}.")
        for signal, names in self.axes.items():
            known = AXES.get(signal, ())
            if not 1 <= len(names) <= 2 or not set(names) <= set(known) or names[1:] == ("imu",):
                raise InvalidInput(
                    f"axes of {signal} are {','.join(names)}; give v body or world, a body, world or imu, or two of "
                    "them: of the linear and of the angular part, which no `imu` measures as an acceleration."
                )
        for quantity, names in self.unit.items():
            if quantity not in UNITS:
                raise InvalidInput(f"unit names {quantity!r}; it has {', '.join(UNITS)}.")
            for name in names:
                log_unit(quantity, name)
        for signal, numbers in self.sign.items():
            if signal not in SIGNALS:
                raise InvalidInput(f"sign names {signal!r}; it has {', '.join(SIGNALS)}.")
            if not set(numbers) <= {1.0, -1.0}:
                raise InvalidInput(f"sign of {signal} is {', '.join(map(str, numbers))}; give 1 or -1.")
        if any(columns < 1 for columns in self.headerless):
            raise InvalidInput(f"headerless is {self.headerless}; a row has at least one number.")

    def changed_by(self, other: "ColumnMapping") -> "ColumnMapping":
        """The mapping with everything that the other one states; time and step take each other's place."""
        stated = {
            item.name: getattr(other, item.name)
            for item in fields(other)
            if getattr(other, item.name) not in (None, (), {}, False)
        }
        for name in ("axes", "unit", "sign"):
            if name in stated:
                stated[name] = {**getattr(self, name), **stated[name]}
        if {"time", "step"} & stated.keys():
            stated = {"time": None, "step": None} | stated
        return replace(self, **stated)

    def corrected_by(
        self,
        correction: Mapping[str, Mapping[str, tuple[Any, ...]]],
        joints: tuple[str, ...],
        columns: Mapping[str, Sequence[str]],
    ) -> "ColumnMapping":
        """The mapping after a correction that `forcegp.check` found, whose entries are in the order of `joints`.

        Units, orientation and axes replace what was stated, signs multiply it, and an order (joint k has the column of
        joint order[k]) needs the `columns` of every signal, as `import_recordings` returns them.
        """
        places = [joints.index(name) for name in self.joints or joints]

        def in_order(values: Sequence[Any]) -> tuple[Any, ...]:
            alike = len(set(values)) == 1
            return (values[0],) if alike else tuple(values[place] for place in places)

        sign = dict(self.sign)
        for signal, values in correction.get("sign", {}).items():
            now = sign.get(signal, (1.0,))
            now = now * len(places) if len(now) == 1 else now
            sign[signal] = tuple(old * float(values[place]) for old, place in zip(now, places, strict=True))
        units = {name: in_order(values) for name, values in correction.get("unit", {}).items()}
        axes = {**self.axes, **correction.get("axes", {})}
        changes: dict[str, Any] = {"unit": {**self.unit, **units}, "sign": sign, "axes": axes}
        if "orientation" in correction:
            [changes["orientation"]] = correction["orientation"]["q"]
            if self.q is None and not self.joints:  # found by name: now their places count
                changes["q"] = tuple(columns["q"])
        for signal, order in correction.get("order", {}).items():
            if signal in columns:
                changes[signal] = tuple(columns[signal][order[place]] for place in places)
        return replace(self, **changes)

    def flags(self) -> list[str]:
        """The words of `forcegp import` that state columns, units and signs."""
        words: list[str] = []
        for name, value in self.plain().items():
            each = (
                [f"{key}={_joined(own)}" for key, own in value.items()] if isinstance(value, dict) else [_joined(value)]
            )
            words += [f"--{name.replace('_', '-')}", *([] if value is True else [",".join(each)])]
        return words

    def plain(self) -> dict[str, Any]:
        """What is stated, as JSON and YAML hold it: a list of one is written as its only entry."""
        found: dict[str, Any] = {}
        for item in fields(self):
            value = getattr(self, item.name)
            if value in (None, (), {}, False):
                continue
            if isinstance(value, Mapping):
                value = {name: _shortened(entry) for name, entry in value.items()}
            found[item.name] = list(value) if item.name == "joints" else _shortened(value)
        return found


def _joined(value: Any) -> str:
    return ",".join(each if isinstance(each, str) else f"{each:g}" for each in _listed(value))


def _shortened(value: Any) -> Any:
    if not isinstance(value, tuple):
        return value
    alone = len(value) == 1 and "," not in str(value[0])  # a text with a comma would be read as a list
    return value[0] if alone else list(value)


LARGEST = 2**20  # bytes
OF_FOLDER = "forcegp.yaml"


class _OnceLoader(yaml.SafeLoader):
    """Safe YAML in which no key may stand twice and nothing may refer to something else."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.constructor.ConstructorError(
                None, None, "aliases (*name) are not read", self.peek_event().start_mark
            )
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
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
    with reading(path, "YAML", yaml.YAMLError, AttributeError, IndexError):  # !!timestamp x, !!int ''
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
        require_known("key", key, "a mapping of columns", known)
        if value is None:
            continue
        if key in (*SIGNALS, "joints"):
            values[key] = _texts(key, value)
        elif key in ("unit", "axes"):
            quantities = ", ".join(UNITS if key == "unit" else AXES)
            _require(isinstance(value, dict), key, value, f"name the quantity, as {_EXAMPLES[key]} ({quantities})")
            values[key] = {str(name): _texts(f"{key} of {name}", entry) for name, entry in value.items()}
        elif key == "sign":  # for all signals, if none is named: it turns the axis of a joint
            named = value if isinstance(value, dict) else dict.fromkeys(SIGNALS, value)
            values[key] = {str(k): tuple(_number(f"{key} of {k}", x) for x in _listed(own)) for k, own in named.items()}
        elif key == "step":
            values[key] = _number(key, value)
        else:
            whole = key == "headerless"
            kind, remedy = {"headerless": (int, "give the number of columns"), "side_by_side": (bool, _TRUTH),
                            "ned": (bool, _TRUTH)}.get(key, (str, "give a text"))  # fmt: skip
            for entry in _listed(value) if whole else [value]:
                _require(type(entry) is kind, key, entry, remedy)
            values[key] = tuple(_listed(value)) if whole else value
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


_TRUTH = "give true or false"
_EXAMPLES = {"unit": "q=deg,time=ms", "sign": "u=-1,1", "axes": "v=world,body"}


def _texts(key: str, value: Any) -> tuple[str, ...]:
    entries = value if isinstance(value, list) else listed(value) if isinstance(value, str) else [value]
    plain = all(isinstance(entry, str | int | float) and not isinstance(entry, bool) for entry in entries)
    _require(bool(entries) and plain, key, value, "give a text or a list of texts")
    return tuple(str(entry) for entry in entries)


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _require(fits: bool, key: str, value: Any, remedy: str) -> None:
    if not fits:
        raise InvalidInput(f"{key} is {value!r}; {remedy}.")


def _number(key: str, value: Any) -> float:
    try:
        if isinstance(value, bool):
            raise ValueError
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise InvalidInput(f"{key} is {value!r:.60}; give a number.") from None
