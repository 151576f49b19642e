"""Combinations of columns.

Known columns are recognised letter by letter, the longest first, so most names need no quotes; backticks settle others.
"""

import ast
import math
import operator
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from forcegp.errors import InvalidInput, require_known

TOKEN = (
    r"`(?P<quoted>[^`]*)`|(?P<name>%s)|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?!\w))|(?P<word>[^\s+*/`()-]+)"
)
OPERATIONS: Any = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv}
MOST_PARTS = 500


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
