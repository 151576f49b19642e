"""Columns of a log: lists in short, names that are guessed, and linear combinations in Python's grammar.

Known columns are recognised letter by letter, the longest first, so most names need no quotes; backticks settle the
rest.
"""

import ast
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from forcegp.errors import InvalidInput, require_known
from forcegp.recordings.source import Source

BRACES = re.compile(r"\{([^{}]*)\}")
RANGE = re.compile(r"(\d+)\.\.(\d+)")
LONGEST_LIST = 4096
JOINTS = "joints"


def expanded(pattern: str, joints: Sequence[str]) -> list[str]:
    """Every text that a pattern stands for, in order; the braces furthest left change slowest.

    `{1..7}` counts (`{01..12}` with leading zeros, `{7..1}` downwards), `{a,b}` lists, `{joints}` is every joint name.
    Raises InvalidInput for other braces, and for lists longer than 4096.
    """
    found = BRACES.search(pattern)
    if found is None:
        if "{" in pattern or "}" in pattern:
            raise InvalidInput(f"{pattern!r} has a brace without its partner; write for example pos{{1..7}}.")
        return [pattern]
    before, after = pattern[: found.start()], pattern[found.end() :]
    rests = expanded(after, joints)
    texts = [before + choice + rest for choice in _choices(pattern, found[1], joints) for rest in rests]
    if len(texts) > LONGEST_LIST:
        raise InvalidInput(f"{pattern!r} stands for more than {LONGEST_LIST} columns.")
    return texts


def listed(text: str) -> list[str]:
    """The parts of a text between commas; commas in braces, backticks and brackets do not count."""
    parts, depth, quoted, start = [], 0, False, 0
    for position, letter in enumerate(text):
        if letter == "`":
            quoted = not quoted
        elif not quoted and letter in "{[(":
            depth += 1
        elif not quoted and letter in "}])":
            depth -= 1
        elif letter == "," and depth == 0 and not quoted:
            parts.append(text[start:position].strip())
            start = position + 1
    parts.append(text[start:].strip())
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


WORDS = {
    "q": {"q", "pos", "position", "positions", "angle", "angles", "joint_pos", "joint_position"},
    "v": {"v", "qd", "dq", "vel", "velocity", "velocities", "joint_vel", "joint_velocity"},
    "u": {"u", "tau", "torque", "torques", "effort", "efforts", "eff", "joint_torque", "joint_effort"},
    "a": {"a", "qdd", "ddq", "acc", "acceleration", "accelerations"},
    "time": {"t", "time", "timestamp", "stamp", "time_s", "seconds"},
}
"""What the rest of a column's name, beside that of the joint, must mean."""


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
    fitting = [
        tuple(found[joint] for joint in joints)
        for around, found in templates.items()
        if len(found) == len(joints) and _says(signal, around)
    ]
    if len(fitting) > 1:
        candidates = " or ".join(", ".join(columns) for columns in fitting)
        raise InvalidInput(f"{source.path}: {signal} could be {candidates}; choose with --{signal}.")
    return fitting[0] if fitting else None


def guessed_time(source: Source, used: Sequence[str]) -> str | None:
    """The column that must be the time: by the format, or the only one of such a name. None if there is none."""
    by_format = source.time_beside(used)
    if by_format is not None:
        return by_format
    named = [column for column in source.columns() if column.lower() in WORDS["time"]]
    if len(named) > 1:
        raise InvalidInput(f"{source.path}: the time could be {' or '.join(named)}; choose with `time`.")
    return named[0] if named else None


def _says(signal: str, around: tuple[str, str]) -> bool:
    """Do the last word before the joint's name or the first after it name the signal?"""
    before = re.split(r"[^A-Za-z_]+", around[0].rstrip("_.:/ -["))[-1]
    after = re.split(r"[^A-Za-z_]+", around[1].lstrip("_.:/ -]"))[0]
    words = {word.strip("_").lower() for word in (before, after)} - {""}
    return bool(words & WORDS[signal])


TOKEN = (
    r"`(?P<quoted>[^`]*)`|(?P<name>%s)|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?!\w))|(?P<word>[^\s+*/`()-]+)"
)


@dataclass(frozen=True)
class LinearExpression:
    """`constant + sum of weight * column`; `weights` maps names of columns to their weights."""

    weights: Mapping[str, float]
    constant: float = 0.0

    @property
    def is_column(self) -> bool:
        """Is this one column as it is?"""
        return self.constant == 0.0 and list(self.weights.values()) == [1.0]

    def __str__(self) -> str:
        terms = [name if weight == 1.0 else f"{weight:g}*`{name}`" for name, weight in self.weights.items()]
        return " + ".join(terms + [f"{self.constant:g}"] * (self.constant != 0.0 or not terms))

    def value(self, columns: Mapping[str, np.ndarray], rows: int) -> Float[np.ndarray, " rows"]:
        """The combination of these columns; a column by itself comes out to the last bit."""
        result = None
        for name, weight in self.weights.items():
            term = np.asarray(columns[name], dtype=np.float64)
            term = term if weight == 1.0 else weight * term
            result = term if result is None else result + term
        if result is None:
            return np.full(rows, self.constant)
        return result if self.constant == 0.0 else result + self.constant


def parse_expression(text: str, columns: Collection[str], owner: str) -> LinearExpression:
    """Read a linear combination of `columns`; `owner` is the file that has them, for messages.

    Raises InvalidInput for anything that is not a linear combination, and for a column of another name.
    """
    if text in columns:
        return LinearExpression({text: 1.0})
    names = sorted(columns, key=len, reverse=True)
    known = "|".join(re.escape(name) + (r"(?!\w)" if re.match(r"\w", name[-1]) else "") for name in names)
    words: list[str] = []

    def placed(found: re.Match[str]) -> str:
        """A name that Python can read in place of a column, or of a word that is none."""
        if found.lastgroup == "number":
            return found[0]
        if found.lastgroup == "word" and found[0] == "pi":
            return repr(math.pi)
        words.append(found[found.lastgroup or 0])
        return f" _{len(words) - 1} "

    try:
        tree = ast.parse(re.sub(TOKEN % (known or "(?!)"), placed, text).strip(), mode="eval")
        weights = _linear(tree.body, words)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise InvalidInput(
            f"{text!r:.200} is no linear combination of columns: {getattr(error, 'msg', error)}. For example: "
            "theta2 - theta1, 0.5*`a-b` + pi/2."
        ) from None
    if not all(map(math.isfinite, weights.values())):
        raise InvalidInput(f"{text!r:.200} has a number that is not finite.")
    constant = weights.pop(None, 0.0)
    for word in weights:
        where = "" if word == text else f" (in {text!r})"
        require_known("column", word, f"{owner}{where}", columns)
    return LinearExpression({name: weight for name, weight in weights.items() if name and weight != 0.0}, constant)


def _linear(node: ast.expr, words: Sequence[str]) -> dict[str | None, float]:
    """Weights of the columns, and under None the constant. Raises ValueError for what is not linear."""
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return {None: float(value)}
        case ast.Name(id=name):
            return {words[int(name[1:])]: 1.0}
        case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=operand):
            own = _linear(operand, words)
            return own if isinstance(sign, ast.UAdd) else {name: -weight for name, weight in own.items()}
        case ast.BinOp(left=left, op=operator, right=right):
            one, other = _linear(left, words), _linear(right, words)
            if isinstance(operator, ast.Mult) and not other.keys() <= {None}:
                one, other = other, one
            number = other.get(None, 0.0)
            match operator:
                case ast.Add() | ast.Sub():
                    side = 1.0 if isinstance(operator, ast.Add) else -1.0
                    return {
                        name: one.get(name, 0.0) + side * other.get(name, 0.0) for name in dict.fromkeys([*one, *other])
                    }
                case ast.Mult() if other.keys() <= {None}:
                    return {name: weight * number for name, weight in one.items()}
                case ast.Div() if other.keys() <= {None} and number != 0.0:
                    return {name: weight / number for name, weight in one.items()}
    raise ValueError("this is not linear")
