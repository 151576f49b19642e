"""Linear algebra on nested lists of scalars, in which structural zeros and ones cost nothing.

A scalar is a Python float, known when the computation is written down, or anything that multiplies and adds: a tensor
(batch,) or an :class:`~forcegp.robots.expressions.Expression`. Products with the float 0.0 are the float 0.0, products
with 1.0 and sums with 0.0 are the other operand: what the structure of a robot makes zero never becomes an operation.
A matrix is a list of rows. Nothing here branches on values that are not floats.

Because a structural zero stays one, a Cholesky factor has no entry where none fills in. :func:`factorize` starts from
the last row, and for a mass matrix, whose joints are numbered with parents before children, nothing fills in then
(Featherstone, "Rigid Body Dynamics Algorithms", 2008, ch. 6.5: ``M = L^T D L``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeAlias

Scalar: TypeAlias = Any  # a float, a tensor (batch,) or an Expression: what they share is arithmetic, not a type
Vector: TypeAlias = list[Scalar]
Matrix: TypeAlias = list[list[Scalar]]


def is_zero(x: Scalar) -> bool:
    """Whether ``x`` is the float 0.0; a tensor of zeros is not."""
    return isinstance(x, float) and x == 0.0


def add(x: Scalar, y: Scalar) -> Scalar:
    """``x + y``."""
    if is_zero(x):
        return y
    return x if is_zero(y) else x + y


def subtract(x: Scalar, y: Scalar) -> Scalar:
    """``x - y``."""
    if is_zero(y):
        return x
    return negate(y) if is_zero(x) else x - y


def negate(x: Scalar) -> Scalar:
    """``-x``, and 0.0 rather than -0.0."""
    return 0.0 if is_zero(x) else -x


def multiply(x: Scalar, y: Scalar) -> Scalar:
    """``x y``."""
    for factor, other in ((x, y), (y, x)):
        if isinstance(factor, float):
            if factor == 0.0:
                return 0.0
            if factor == 1.0:
                return other
            if factor == -1.0:
                return negate(other)
    return x * y


def divide(x: Scalar, y: Scalar) -> Scalar:
    """``x / y``."""
    if is_zero(x):
        return 0.0
    return multiply(x, 1.0 / y) if isinstance(y, float) else x / y


def sine(x: Scalar) -> Scalar:
    """``sin(x)``."""
    return math.sin(x) if isinstance(x, float) else x.sin()


def cosine(x: Scalar) -> Scalar:
    """``cos(x)``."""
    return math.cos(x) if isinstance(x, float) else x.cos()


# ---------------------------------------------------------------------- vectors and matrices


def dot(x: Sequence[Scalar], y: Sequence[Scalar]) -> Scalar:
    """``sum_k x_k y_k``."""
    total: Scalar = 0.0
    for left, right in zip(x, y, strict=True):
        total = add(total, multiply(left, right))
    return total


def plus(x: Sequence[Scalar], y: Sequence[Scalar]) -> Vector:
    """Sum of two vectors."""
    return [add(left, right) for left, right in zip(x, y, strict=True)]


def minus(x: Sequence[Scalar], y: Sequence[Scalar]) -> Vector:
    """Difference of two vectors."""
    return [subtract(left, right) for left, right in zip(x, y, strict=True)]


def cross(x: Sequence[Scalar], y: Sequence[Scalar]) -> Vector:
    """Vector product in three dimensions."""
    return [subtract(multiply(x[i], y[j]), multiply(x[j], y[i])) for i, j in ((1, 2), (2, 0), (0, 1))]


def transpose(matrix: Sequence[Sequence[Scalar]]) -> Matrix:
    """Rows as columns."""
    return [list(column) for column in zip(*matrix, strict=True)]


def apply(matrix: Sequence[Sequence[Scalar]], vector: Sequence[Scalar]) -> Vector:
    """``matrix vector``."""
    return [dot(row, vector) for row in matrix]


def product(left: Sequence[Sequence[Scalar]], right: Sequence[Sequence[Scalar]]) -> Matrix:
    """``left right``."""
    columns = transpose(right)
    return [[dot(row, column) for column in columns] for row in left]


def symmetric_product(left: Sequence[Sequence[Scalar]], right: Sequence[Sequence[Scalar]]) -> Matrix:
    """``left right^T`` where that is symmetric: only one triangle is computed."""
    lower = [[dot(left[i], right[j]) for j in range(i + 1)] for i in range(len(left))]
    return symmetric(lower)


def symmetric(lower: Sequence[Sequence[Scalar]]) -> Matrix:
    """The full matrix of a lower triangle; rows may be longer than the triangle, what is above it is not read."""
    n = len(lower)
    return [[lower[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]


# ---------------------------------------------------------------------- factorisations


def factorize(matrix: Sequence[Sequence[Scalar]]) -> tuple[Matrix, Vector]:
    """``matrix = L^T D L`` with L unit lower-triangular, from the last row to the first, no square roots.

    Returns L (its diagonal 1.0) and the diagonal of D. The matrix is positive definite if and only if D is positive.
    Reads the lower triangle. Featherstone's LTDL, table 6.3.
    """
    n = len(matrix)
    rest: Matrix = [list(row[: i + 1]) for i, row in enumerate(matrix)]
    L: Matrix = [[float(i == j) for j in range(n)] for i in range(n)]
    for k in reversed(range(n)):
        inverse = None
        for i in reversed(range(k)):
            if is_zero(rest[k][i]):
                continue
            inverse = divide(1.0, rest[k][k]) if inverse is None else inverse
            L[k][i] = multiply(rest[k][i], inverse)
            for j in range(i + 1):
                rest[i][j] = subtract(rest[i][j], multiply(L[k][i], rest[k][j]))
    return L, [rest[k][k] for k in range(n)]


def solve_factorized(L: Sequence[Sequence[Scalar]], D: Sequence[Scalar], b: Sequence[Scalar]) -> Vector:
    """``(L^T D L)^-1 b`` for what :func:`factorize` returns."""
    n = len(L)
    x = list(b)
    for i in reversed(range(n)):  # L^T x = b
        x[i] = subtract(x[i], dot([L[k][i] for k in range(i + 1, n)], x[i + 1 :]))
    x = [divide(value, pivot) for value, pivot in zip(x, D, strict=True)]
    for i in range(n):  # L x = ...
        x[i] = subtract(x[i], dot(L[i][:i], x[:i]))
    return x
