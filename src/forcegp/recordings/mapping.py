"""`ColumnMapping`: which columns are what, in which units; names in short and guessed; sums of columns.

Known columns are recognised in sums letter by letter, the longest first, so most names need no backticks.
"""

import ast
import math
import operator
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import product
from numbers import Real
from typing import Any

import numpy as np
from jaxtyping import Float

from forcegp.data.units import UNITS, LogUnit
from forcegp.doubts import Correction, stated_as
from forcegp.errors import InvalidInput, require_known, require_type, usable_arguments
from forcegp.recordings.source import Source

TOKEN = (
    r"`(?P<quoted>[^`]*)`|(?P<name>%s)|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?!\w))|(?P<word>[^\s+*/`()-]+)"
)
OPERATIONS: Any = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv}
MOST_PARTS = 500
UNIT_OF_A_NAME = re.compile(r"[\[(]([^\d\[(][^\[(]*)[\])]$|_([A-Za-z]{2,})$")
NUMBERED = re.compile(r"(?P<stem>(?P<word>.*?)[\[(_. ]*)(?P<number>\d{1,4})?[\])]?\s*$")
COMMA = re.compile(r",(?![^{\[]*[}\]])(?=(?:[^`]*`[^`]*`)*[^`]*$)")
EXAMPLES = {"unit": "q=deg,time=ms", "sign": "u=-1,1", "axes": "v=world,body", "force": "foot=fx,fy,fz"}
MEASURED = re.compile(r"(?<![A-Za-z])(present|actual|measured|meas|feedback)_(?=[A-Za-z])", re.IGNORECASE)
BRACES = re.compile(r"\{([^{}]*)\}")
RANGE = re.compile(r"(\d+)\.\.(\d+)")
LONGEST_LIST = 4096
JOINTS = "joints"
WORDS = {
    "q": {"q", "pos", "position", "positions", "angle", "angles", "joint_pos", "joint_position"},
    "v": {"v", "qd", "dq", "vel", "velocity", "velocities", "speed", "rate", "joint_vel", "joint_velocity"},
    "u": {"u", "tau", "torque", "torques", "effort", "efforts", "eff", "joint_torque", "joint_effort"},
    "a": {"a", "qdd", "ddq", "acc", "acceleration", "accelerations"},
    "time": {"t", "time", "timestamp", "stamp", "time_s", "seconds"},
}
"""What the rest of a column's name, beside that of the joint, must mean."""


def log_unit(quantity: str, name: str) -> LogUnit:
    """The unit of that name. Raises InvalidInput listing those of the quantity."""
    spelled = name.replace(" ", "").replace("**", "^").replace("²", "^2").replace("µ", "u").replace("·", "")
    spelled, units = spelled.replace("°", "deg"), UNITS[quantity]
    meant = {known.lower(): known for known in units}
    require_known("unit", spelled, f"the units of {quantity}", units, synonyms=meant)
    return units[spelled]


def named_unit(quantity: str, column: str, stated: Mapping[str, str] = {}) -> str | None:
    """The unit of a column that is stated, or ends its name, as in `pos [mm]` and `pos_mm`; None where it is none."""
    found = UNIT_OF_A_NAME.search(f"[{stated[column]}]" if column in stated else column.strip())
    try:
        return None if found is None else log_unit(quantity, found[1] or found[2]).name
    except InvalidInput:
        return None


def in_short(quantity: str, units: Sequence[str]) -> tuple[str, ...]:
    """Units of all columns, as a mapping states them: one of each kind where those of a kind share it."""
    once = dict.fromkeys(name for name in units if name != "1")
    return tuple(once) if len({log_unit(quantity, name).si for name in once}) == len(once) else tuple(units)


SIGNALS = ("q", "v", "u", "a")
ORIENTATIONS = ("xyzw", "wxyz", "angles")
"""Quaternions with w last or first; roll, pitch and yaw with R = Rz(yaw) Ry(pitch) Rx(roll), or the yaw of a plane."""
AXES = {"v": ("body", "world"), "a": ("body", "world", "imu"), "force": ("world", "body")}
"""What linear and angular velocities and accelerations may be measured in."""


@dataclass(frozen=True, kw_only=True)
class ColumnMapping:
    """What the columns of a log mean. A value in SI is `sign * unit * (combination of columns)`.

    time, step: a column or combination that is the time, or the time in s between two rows; one of both.
    q, v, u, a: per signal, its columns: patterns (`pos{1..7}`), names of vectors, combinations (`theta2 - theta1`), or
        one constant. None: v and a are differentiated, the others are looked for by the names of the joints.
    force: by frame of the robot, three columns of a force sensor there: the force on the robot, x, y, z in world axes.
        By "imu:FRAME", "imu:FRAME@x,y,z" or "imu:FRAME@x,y,z,roll,pitch,yaw" those of an accelerometer, in its axes.
        By "torque:JOINT" the torque sensor between gear and link, which accelerates the link; by "torque" all joints.
    joints: their names, in the order of the columns; columns of a base that moves stand where its robot has them.
    orientation: of a base that moves: quaternions "xyzw" (default) or "wxyz", or "angles" roll, pitch and yaw.
    axes: of its v and a, of the linear and the angular part: "body" (default), "world", or "imu" for what an
        accelerometer at its origin measures; of `force` "world" (default), or "body", those of its frame.
    ned: the log's world is north, east, down and its base forward, right, down; both are turned about x by half a turn.
    unit: by signal and "time", one unit for all joints or one for each. Default: SI. With a base that moves, each unit
        is for the columns of its kind.
    sign: by signal, 1 or -1 for all joints or for each.
    episode: a column that numbers the episodes.
    episodes: a pattern (`piece*`) for arrays or groups of the file, each of which is an episode.
    headerless: for text without header, the columns of each file in their order.
    side_by_side: the files given are one recording, not one each.

    Raises InvalidInput for units that do not exist and numbers that make no sense.
    """

    time: str | None = None
    step: float | None = None
    q: tuple[str, ...] | None = None
    v: tuple[str, ...] | None = None
    u: tuple[str, ...] | None = None
    a: tuple[str, ...] | None = None
    force: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    joints: tuple[str, ...] = ()
    orientation: str | None = None
    axes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    ned: bool = False
    unit: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    sign: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    episode: str | None = None
    episodes: str | None = None
    headerless: tuple[int, ...] = ()
    side_by_side: bool = False

    @usable_arguments("ColumnMapping")
    def __post_init__(self) -> None:
        kinds = dict.fromkeys("qvua", Sequence) | dict.fromkeys(("time", "episode", "episodes"), str)
        for name, kind in kinds.items():
            if getattr(self, name) is not None:
                require_type(name, getattr(self, name), kind)
        if self.time is not None and self.step is not None:
            raise InvalidInput("give a column for the time or the step between rows, not both.")
        if self.step is not None and not (isinstance(self.step, Real) and 0.0 < self.step < float("inf")):
            raise InvalidInput(f"step is {self.step} s; it must be positive and finite.")
        if self.orientation not in (None, *ORIENTATIONS):
            raise InvalidInput(f"orientation is {self.orientation!r}; give {', '.join(ORIENTATIONS)}.")
        for signal, names in self.axes.items():
            if not 1 <= len(names) <= 2 or not set(names) <= set(AXES.get(signal, ())) or names[1:] == ("imu",):
                seen = f"axes of {signal} are {','.join(names)}"
                kinds = "v body or world, a body, world or imu, or two of them: of the linear and of the angular part"
                raise InvalidInput(f"{seen}; give {kinds}, which no `imu` measures as an acceleration.")
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

    def corrected_by(
        self, correction: Correction, joints: tuple[str, ...], columns: Mapping[str, Sequence[str]]
    ) -> "ColumnMapping":
        """The mapping after a correction that `forcegp.check` found, whose entries are in the order of `joints`.

        Units, orientation and axes replace what was stated, signs multiply it, and an order (joint k has the column of
        joint order[k]) or a mix (joint k has the sum of all with the weights mix[k]) needs the `columns` of every
        signal, as `import_recordings` returns them.
        """
        places = [joints.index(name) for name in self.joints or joints]

        def in_order(values: Sequence[Any]) -> tuple[Any, ...]:
            each = values if len(values) != len(places) else [values[place] for place in places]  # once for each kind
            return tuple(each[:1] if len(set(each)) == 1 else each)

        sign = dict(self.sign)
        for signal, values in correction.get("sign", {}).items():
            now = sign.get(signal, (1.0,))
            now = now * len(places) if len(now) == 1 else now
            sign[signal] = tuple(old * float(values[place]) for old, place in zip(now, places, strict=True))
        units = {name: in_short(name, in_order(values)) for name, values in correction.get("unit", {}).items()}
        axes = {**self.axes, **correction.get("axes", {})}
        changes: dict[str, Any] = {"unit": {**self.unit, **units}, "sign": sign, "axes": axes}
        if "orientation" in correction:
            [changes["orientation"]] = correction["orientation"]["q"]
            if self.q is None and not self.joints:  # found by name: now their places count
                changes["q"] = tuple(columns["q"])
        for signal, order in correction.get("order", {}).items():
            if signal in columns:
                changes[signal] = tuple(columns[signal][order[place]] for place in places)
        for signal, mix in correction.get("mix", {}).items():
            turned = dict(zip(places, (sign.get(signal, (1.0,)) * len(places))[: len(places)], strict=True))
            if signal in columns:
                rows = ([turned[k] * turned[m] * w for m, w in enumerate(mix[k])] for k in places)
                changes[signal] = tuple(weighted_sum(columns[signal], row) for row in rows)
        return replace(self, **changes)

    def flags(self) -> list[str]:
        """The words of `forcegp import` that state columns, units and signs."""
        words: list[str] = []
        for name, value in self.plain().items():
            entries = value if isinstance(value, tuple) else (value,)
            text = stated_as(value) if isinstance(value, Mapping) else ",".join(map(str, entries))
            words += [f"--{name.replace('_', '-')}", *([] if value is True else [text])]
        return words

    def plain(self) -> dict[str, Any]:
        """What is stated, by name."""
        found = {item.name: getattr(self, item.name) for item in fields(self)}
        return {name: value for name, value in found.items() if value not in (None, (), {}, False)}


def by_quantity(flag: str, text: str) -> dict[str, tuple[str, ...]]:
    """`q=deg,m,time=ms` as {"q": ("deg", "m"), "time": ("ms",)}: what follows a name up to the next is its list."""
    found: dict[str, tuple[str, ...]] = {}
    name = None
    placed = re.sub(r"(?<![^,])imu:[^=]*=", lambda own: own[0].replace(",", ";"), text)  # a place has commas
    for part in placed.split(","):
        before, equals, after = part.partition("=")
        if equals:
            name, part = before.strip().replace(";", ","), after
            if name in found:
                raise InvalidInput(f"--{flag} names {name} twice.")
        if name is None or not part.strip():
            raise InvalidInput(f"--{flag} is {text!r}; write for example {flag} {EXAMPLES[flag]}.")
        found[name] = (*found.get(name, ()), part.strip())
    return found


def expanded(pattern: str, joints: Sequence[str], names: Collection[str] = ()) -> list[str]:
    """Every text that a pattern stands for, in order; the braces furthest left change slowest.

    `{1..7}` counts (`{01..12}` with leading zeros, `{7..1}` downwards), `{a,b}` lists, `{joints}` is every joint name.
    In a combination of columns, whose `names` are known, braces of equal length go on together.
    Raises InvalidInput for other braces, and for lists longer than 4096.
    """
    before, *others = BRACES.split(pattern)
    inside, after = others[::2], others[1::2]
    if any(brace in text for text in (before, *after) for brace in "{}"):
        raise InvalidInput(f"{pattern!r} has a brace without its partner; write for example pos{{1..7}}.")
    choices = [_choices(pattern, each, joints) for each in inside]

    def written(rows: Iterable[Sequence[str]]) -> list[str]:
        return [before + "".join(choice + text for choice, text in zip(row, after, strict=True)) for row in rows]

    joined = len(inside) > 1 and all(re.search(r"[-+*/()]", text) for text in after[:-1])
    if joined and len(set(map(len, choices))) == 1 and (texts := written(zip(*choices, strict=True)))[0] not in names:
        return texts
    if math.prod(map(len, choices)) > LONGEST_LIST:
        raise InvalidInput(f"{pattern!r} stands for more than {LONGEST_LIST} columns.")
    return written(product(*choices))


def listed(text: str) -> list[str]:
    """The parts of a text between commas; commas in braces, brackets and backticks do not count."""
    parts = [part.strip() for part in COMMA.split(text)]
    if "" in parts:
        raise InvalidInput(f"{text!r} has an empty place in its list; write for example: pos1,pos2")
    return parts


def _choices(pattern: str, inside: str, joints: Sequence[str]) -> list[str]:
    counted = RANGE.fullmatch(inside)
    if counted:
        first, last = int(counted[1]), int(counted[2])
        if abs(last - first) >= LONGEST_LIST:
            raise InvalidInput(f"{pattern!r} stands for more than {LONGEST_LIST} columns.")
        padded = len(counted[1]) if counted[1].startswith("0") and len(counted[1]) > 1 else 0
        step = 1 if last >= first else -1
        return [f"{number:0{padded}d}" for number in range(first, last + step, step)]
    if inside == JOINTS:
        if not joints:
            raise InvalidInput(f"{pattern!r} asks for the names of the joints, which are not known; add `joints`.")
        return list(joints)
    choices = [choice.strip() for choice in inside.split(",")]
    if len(choices) > 1 and all(choices):
        return choices
    raise InvalidInput(f"{pattern!r}: write {{1..7}}, {{a,b}} or {{joints}} in braces, not {{{inside}}}.")


def named_after(joint: str) -> re.Pattern[str]:
    """Matches the joint's name where no letter or digit continues it."""
    return re.compile(rf"(?<![A-Za-z0-9]){re.escape(joint)}(?![A-Za-z0-9])")


def guessed_columns(signal: str, joints: Sequence[str], source: Source) -> tuple[str, ...] | None:
    """One column per joint, its name in a text that means `signal`; None for none. Raises InvalidInput for several."""
    templates: dict[tuple[str, str], dict[str, str]] = {}
    for column in source.columns():
        for joint in joints:
            for found in named_after(joint).finditer(column):
                around = column[: found.start()], column[found.end() :]
                templates.setdefault(around, {})[joint] = column
    whole = {around: x for around, x in templates.items() if len(x) == len(joints)}
    saying = {around: x for around, x in whole.items() if _says(signal, around)}
    if not saying:
        saying = {(a, b): x for (a, b), x in whole.items() if _says(signal, (MEASURED.sub("", a), MEASURED.sub("", b)))}
    depths = [before.partition(":")[2].count(".") for before, _ in saying]  # what a message says itself comes first
    each = zip(saying.values(), depths, strict=True)
    fitting = [tuple(found[joint] for joint in joints) for found, depth in each if depth == min(depths)]
    if len(fitting) > 1:
        candidates = " or ".join(", ".join(columns) for columns in fitting)
        raise InvalidInput(f"{source.path}: {signal} could be {candidates}; choose with --{signal}.")
    bare = tuple(joint.removesuffix("_joint") for joint in joints)
    return fitting[0] if fitting else None if bare == tuple(joints) else guessed_columns(signal, bare, source)


def counted_columns(signal: str, count: int, source: Source) -> tuple[str, ...] | None:
    """`q1 ... q7`, `dq[0] ...` or `joint_torques[0] ...`, exactly `count`; None for none, and for several."""
    found: dict[str, dict[int, str]] = {}
    for column in source.columns():
        name = NUMBERED.match(UNIT_OF_A_NAME.sub("", column) if named_unit(signal, column) else column)
        word = name["word"].lower() if name else ""
        if name and {word, word.removeprefix("joint_"), word.removeprefix("q")} & WORDS[signal]:
            found.setdefault(name["stem"], {})[int(name["number"] or 0)] = column
    wanted = [*range(count)], [*range(1, count + 1)]
    fitting = [tuple(x[k] for k in sorted(x)) for x in found.values() if sorted(x) in wanted]
    return fitting[0] if len(fitting) == 1 else None


def guessed_time(source: Source, used: Sequence[str]) -> str | None:
    """The column that must be the time: by the format, or the only one of such a name. None if there is none."""
    by_format = source.time_beside(used)
    if by_format is not None:
        return by_format
    named = [column for column in source.columns() if column.lower().strip("_") in WORDS["time"]]
    if len(named) > 1:
        raise InvalidInput(f"{source.path}: the time could be {' or '.join(named)}; choose with `time`.")
    return named[0] if named else None


def _says(signal: str, around: tuple[str, str]) -> bool:
    """Do the last word before the joint's name or the first after it name the signal?"""
    before = re.split(r"[^A-Za-z_]+", around[0].rstrip("_.:/ -["))[-1]
    after = re.split(r"[^A-Za-z_]+", around[1].lstrip("_.:/ -]"))[0]
    return bool(({word.strip("_").lower() for word in (before, after)} - {""}) & WORDS[signal])


@dataclass(frozen=True)
class Expression:
    """Columns and numbers joined by + - * /; `weights` are the slopes by its columns where all of them are 0."""

    text: str
    weights: Mapping[str, float]
    tree: ast.expr
    words: tuple[str, ...]

    @property
    def is_column(self) -> bool:
        """Is this one column as it is?"""
        return isinstance(self.tree, ast.Name)

    @property
    def has_numbers(self) -> bool:
        """Is this more than columns that are added and subtracted, which have their unit?"""
        return any(isinstance(part, ast.Constant) for part in ast.walk(self.tree))

    def __str__(self) -> str:
        return self.text

    def value(self, columns: Mapping[str, np.ndarray], rows: int) -> Float[np.ndarray, " rows"]:
        """The combination of these columns; a column by itself comes out to the last bit."""
        known = {name: np.asarray(columns[name], dtype=np.float64) for name in self.weights}
        with np.errstate(all="ignore"):  # what is not finite is refused, with its row
            return np.broadcast_to(_value(self.tree, [known.get(word) for word in self.words]), rows)


def parse_expression(text: str, columns: Collection[str], owner: str) -> Expression:
    """Read a combination of `columns`; `owner` is the file that has them, for messages.

    Raises InvalidInput for anything else, for a column of another name, and for what is not finite where columns are 0.
    """
    words: list[str] = []

    def placed(found: re.Match[str]) -> str:
        """A name that Python can read in place of a column, or of a word that is none."""
        if found.lastgroup == "number":
            return found[0]
        if found.lastgroup == "word" and found[0] == "pi":
            return repr(math.pi)
        words.append(found[found.lastgroup or 0])
        return f" _{len(words) - 1} "

    names = [] if text in columns else sorted(filter(None, columns), key=len, reverse=True)
    known = "|".join(re.escape(name) + (r"(?!\w)" if re.match(r"\w", name[-1]) else "") for name in names or [text])
    try:
        tree = ast.parse(re.sub(TOKEN % (known or "(?!)"), placed, text).strip(), mode="eval").body
        if sum(1 for _ in ast.walk(tree)) > MOST_PARTS:
            raise ValueError(f"it has more than {MOST_PARTS} parts")
        at_zero = _value(tree, [0.0] * len(words))
        slopes = {name: _value(tree, [float(word == name) for word in words]) - at_zero for name in words}
    except (SyntaxError, ValueError, ArithmeticError, RecursionError, MemoryError) as error:
        seen = f"{text!r:.200} is no combination of columns: {getattr(error, 'msg', error)}"
        raise InvalidInput(f"{seen}. For example: theta2 - theta1, 0.5*`a-b` + pi/2.") from None
    if not all(map(math.isfinite, (at_zero, *slopes.values()))):
        raise InvalidInput(f"{text!r:.200} has a number that is not finite.")
    for word in words:
        where = "" if word == text else f" (in {text!r})"
        require_known("column", word, f"{owner}{where}", columns)
    return Expression(text, slopes, tree, tuple(words))


def _value(node: ast.expr, words: Sequence[Any]) -> Any:
    """What a tree is where names stand for these values. Raises ValueError for other operations."""
    match node:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return float(number)
        case ast.Name(id=name):
            return words[int(name[1:])]
        case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=operand):
            return _value(operand, words) if isinstance(sign, ast.UAdd) else -_value(operand, words)
        case ast.BinOp(left=left, op=sign, right=right) if type(sign) in OPERATIONS:
            return OPERATIONS[type(sign)](_value(left, words), _value(right, words))
        case _:
            raise ValueError("it has more than columns, numbers and + - * /")


def weighted_sum(columns: Sequence[str], weights: Sequence[float]) -> str:
    """The sum of columns times weights, as the text of an expression."""
    some = [(x, w) for x, w in zip(columns, weights, strict=True) if w]
    if len(some) == 1 and some[0][1] == 1.0:
        return some[0][0]
    quoted = [x if re.fullmatch(r"[A-Za-z_]\w*", x) else f"`{x}`" for x, _ in some]
    factors = [f"{abs(w):g}*" if abs(w) != 1.0 else "" for _, w in some]
    signs = ["-" if w < 0.0 else "+" for _, w in some]
    return "".join(map("".join, zip(signs, factors, quoted, strict=True))).lstrip("+")
