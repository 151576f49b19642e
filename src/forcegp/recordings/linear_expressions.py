"""Linear combinations of columns, `theta2 - theta1` or `0.001*tau + 0.5`: parsed here, never evaluated as code.

    expression = ["+"] term { ("+" | "-") term }
    term       = ["-"] factor { ("*" | "/") factor }    at most one column, and only numbers below "/"
    factor     = number | "pi" | column | `column`

Known columns are recognised letter by letter, the longest first, so most names need no quotes whatever they contain;
backticks settle the rest.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from forcegp.errors import InvalidInput, unknown_name_message

NUMBER = re.compile(r"(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
WORD = re.compile(r"[^\s+*/`]+")
NAME_LETTER = re.compile(r"\w")


@dataclass(frozen=True)
class LinearExpression:
    """`constant + sum of weight * column`.

    `weights` maps column names to their weights, none of them twice.
    """

    weights: Mapping[str, float]
    constant: float = 0.0

    @property
    def is_column(self) -> bool:
        """Is this one column as it is?"""
        return self.constant == 0.0 and list(self.weights.values()) == [1.0]

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

    Raises InvalidInput, saying where, for anything that is not a linear combination, and for a column of another name.
    """
    if text in columns:
        return LinearExpression({text: 1.0})
    return _Parser(text, columns, owner).expression()


class _Parser:
    def __init__(self, text: str, columns: Collection[str], owner: str) -> None:
        self.text = text
        self.columns = columns
        self.owner = owner
        self.longest_first = sorted(columns, key=len, reverse=True)
        self.position = 0

    def expression(self) -> LinearExpression:
        weights: dict[str, float] = {}
        constant = 0.0
        sign = 1.0
        self._taken("+")
        while True:
            name, factor = self._term()
            if name is None:
                constant += sign * factor
            else:
                weights[name] = weights.get(name, 0.0) + sign * factor
            if self._taken("+"):
                sign = 1.0
            elif self._taken("-"):
                sign = -1.0
            elif self._rest() == "":
                break
            else:
                raise self._wrong("expected + or -")
        if not math.isfinite(constant) or not all(math.isfinite(weight) for weight in weights.values()):
            raise InvalidInput(f"{self.text!r} has a number that is not finite.")
        return LinearExpression({name: weight for name, weight in weights.items() if weight != 0.0}, constant)

    def _term(self) -> tuple[str | None, float]:
        sign = -1.0 if self._taken("-") else 1.0
        name, value = self._factor()
        value *= sign
        while True:
            if self._taken("*"):
                other, factor = self._factor()
                if name is not None and other is not None:
                    raise self._wrong(f"{name!r} times {other!r} is not linear")
                name, value = name or other, value * factor
            elif self._taken("/"):
                other, factor = self._factor()
                if other is not None or factor == 0.0:
                    raise self._wrong("only division by a number other than 0 is linear")
                value /= factor
            else:
                return name, value

    def _factor(self) -> tuple[str | None, float]:
        rest = self._rest()
        if rest.startswith("`"):
            end = rest.find("`", 1)
            if end < 0:
                raise self._wrong("a backtick without its partner")
            return self._column(rest[1:end], end + 1), 1.0
        for name in self.longest_first:
            if rest.startswith(name) and not (NAME_LETTER.match(rest[len(name) :]) and NAME_LETTER.match(name[-1])):
                return self._column(name, len(name)), 1.0
        number = NUMBER.match(rest)
        if number and not NAME_LETTER.match(rest[number.end() :]):
            self.position += number.end()
            return None, float(number[0])
        if rest.startswith("pi") and not NAME_LETTER.match(rest[2:]):
            self.position += 2
            return None, math.pi
        word = WORD.match(rest)
        if not word:
            raise self._wrong("expected a column or a number")
        return self._column(word[0], len(word[0])), 1.0

    def _column(self, name: str, length: int) -> str:
        if name not in self.columns:
            where = "" if name == self.text else f" (in {self.text!r})"
            raise InvalidInput(unknown_name_message("column", name, f"{self.owner}{where}", self.columns))
        self.position += length
        return name

    def _rest(self) -> str:
        while self.text[self.position : self.position + 1].isspace():
            self.position += 1
        return self.text[self.position :]

    def _taken(self, sign: str) -> bool:
        if not self._rest().startswith(sign):
            return False
        self.position += 1
        return True

    def _wrong(self, why: str) -> InvalidInput:
        return InvalidInput(
            f"{self.text!r} is not a linear combination of columns: {why} at {self._rest()[:20]!r}. "
            "For example: theta2 - theta1, 0.5*`a-b` + pi/2."
        )
