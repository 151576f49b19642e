"""Small dense linear algebra without branches on values, so that a tape can hold it; derivatives are right as well."""

from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from typing_extensions import override

SWEEPS = {1: 0, 2: 2, 3: 5, 4: 7, 5: 7, 6: 7}
"""Rounds of Jacobi rotations by the number of rows: two columns need one, for more the convergence is quadratic."""


class StraightLineAlgebra(TorchFunctionMode):
    """Within it, the functions of torch.linalg that Gauss' principle uses are those of this module."""

    @override
    def __torch_function__(self, func: Any, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None) -> Any:
        kwargs = kwargs or {}
        if func is torch.linalg.cholesky:
            return cholesky(*args)
        if func is torch.linalg.solve_triangular and not kwargs.get("upper", False) and kwargs.get("left", True):
            return solve_lower(*args)
        if func is torch.linalg.pinv:
            rows, columns = args[0].shape[-2:]
            tolerance = kwargs.get("rtol", max(rows, columns) * torch.finfo(args[0].dtype).eps)  # torch's own default
            if rows > columns:
                return pseudo_inverse(args[0].mT, tolerance).mT
            return pseudo_inverse(args[0], tolerance)
        return func(*args, **kwargs)


def cholesky(matrix: Tensor) -> Tensor:
    """The lower Cholesky factor (..., n, n); NaN where the matrix is not positive definite."""
    columns, rest = [], matrix
    for k in range(matrix.shape[-1]):
        column = rest[..., :, k] / rest[..., k, k, None].sqrt()
        column = torch.cat([torch.zeros_like(column[..., :k]), column[..., k:]], dim=-1)
        rest = rest - column[..., :, None] * column[..., None, :]
        columns.append(column)
    return torch.stack(columns, dim=-1)


def solve_lower(lower: Tensor, right: Tensor) -> Tensor:
    """lower^-1 right (..., n, k)."""
    rows: list[Tensor] = []
    for i in range(lower.shape[-1]):
        value = right[..., i, :]
        for k, row in enumerate(rows):
            value = value - lower[..., i, k, None] * row
        rows.append(value / lower[..., i, i, None])
    return torch.stack(rows, dim=-2)


def pseudo_inverse(matrix: Tensor, tolerance: float) -> Tensor:
    """The pseudo-inverse (..., n, m) of a matrix (..., m, n) with m <= n, singular values below tolerance dropped.

    One-sided Jacobi rotations (Demmel & Veselic, SIAM J. Matrix Anal. Appl. 13, 1992). Of more than six rows an
    orthonormal basis Q is a fifth of the work: A = L Q with L = A Q^T, L^T = R U, A^+ = Q^T R^-T U.
    """
    count = matrix.shape[-2]
    if count not in SWEEPS:
        Q = _basis(matrix, tolerance)
        R, U = _lower_and_orthonormal((matrix @ Q.mT).mT)
        R = R + torch.diag_embed(torch.where(R.diagonal(dim1=-2, dim2=-1) > 0.0, 0.0, 1.0))
        return (U.mT @ solve_lower(R, Q)).mT
    columns = list(matrix.unbind(-2))
    turns = list(
        torch.eye(count, dtype=matrix.dtype, device=matrix.device).expand(*matrix.shape[:-2], -1, -1).unbind(-1)
    )
    for _ in range(SWEEPS[count]):
        for i in range(count):
            for j in range(i + 1, count):
                c, s = _rotation(columns[i], columns[j])
                for vectors in (columns, turns):
                    vectors[i], vectors[j] = c * vectors[i] - s * vectors[j], s * vectors[i] + c * vectors[j]
    W, V = torch.stack(columns, dim=-1), torch.stack(turns, dim=-1)
    G = W.mT @ W
    squares = G.diagonal(dim1=-2, dim2=-1)
    largest = squares[..., :1]
    for k in range(1, count):
        largest = torch.where(squares[..., k : k + 1] > largest, squares[..., k : k + 1], largest)
    kept = squares > tolerance**2 * largest
    inverse = torch.where(kept, 1.0 / torch.where(kept, squares, torch.ones_like(squares)), torch.zeros_like(squares))
    apart = G - torch.diag_embed(squares)
    inner = torch.diag_embed(inverse) - inverse[..., :, None] * apart * inverse[..., None, :]
    return W @ inner @ V.mT


def _basis(matrix: Tensor, tolerance: float) -> Tensor:
    """Orthonormal rows (..., m, n) that span those of the matrix; zeros in the place of what is within the tolerance.

    The longest remainder comes first (Golub & Van Loan, 5.4): else redundant rows of a flat foot seem to be
    independent.
    """
    rest, basis, largest = matrix, matrix[..., :0, :], None
    for k in range(matrix.shape[-2]):
        squares = (rest * rest).sum(-1)
        row, square = rest[..., 0, :], squares[..., 0]
        for i in range(1, matrix.shape[-2]):
            longer = squares[..., i] > square
            row, square = (
                torch.where(longer[..., None], rest[..., i, :], row),
                torch.where(longer, squares[..., i], square),
            )
        largest = square if largest is None else largest
        if k:  # again, since rounding of the remainder is not orthogonal
            row = row - ((basis @ row[..., None])[..., 0][..., None, :] @ basis)[..., 0, :]
        unit = _unit(row, tolerance**2 * largest)[0]
        basis = torch.cat([basis, unit[..., None, :]], dim=-2)
        rest = rest - (rest @ unit[..., None]) * unit[..., None, :]
    return basis


def _lower_and_orthonormal(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """L (..., m, m) and Q (..., m, n), L Q the matrix of independent or zero rows, made orthogonal twice."""
    count, lower, basis = matrix.shape[-2], [], matrix[..., :0, :]
    for k, row in enumerate(matrix.unbind(-2)):
        along = torch.zeros_like(matrix[..., :k, 0])
        for _ in range(2 if k else 0):
            share = (basis @ row[..., None])[..., 0]
            row, along = row - (share[..., None, :] @ basis)[..., 0, :], along + share
        unit, length = _unit(row, torch.zeros_like(row[..., 0]))
        basis = torch.cat([basis, unit[..., None, :]], dim=-2)
        rest = torch.zeros_like(matrix[..., : count - k - 1, 0])
        lower.append(torch.cat([along, length[..., None], rest], dim=-1))
    return torch.stack(lower, dim=-2), basis


def _unit(row: Tensor, least: Tensor) -> tuple[Tensor, Tensor]:
    """The row over its length, and that; zeros where its square is not above the least."""
    square = (row * row).sum(-1)
    kept = square > least
    length = torch.where(kept, torch.where(kept, square, torch.ones_like(square)).sqrt(), torch.zeros_like(square))
    unit = row / torch.where(kept, length, torch.ones_like(length))[..., None]
    return torch.where(kept[..., None], unit, 0.0 * row), length


def _rotation(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine and sine (..., 1) of the rotation after which x and y are orthogonal."""
    difference = (y * y).sum(-1, keepdim=True) - (x * x).sum(-1, keepdim=True)
    product = 2.0 * (x * y).sum(-1, keepdim=True)
    length = (difference * difference + product * product).sqrt()
    sign = torch.where(difference < 0.0, -torch.ones_like(difference), torch.ones_like(difference))
    size = difference * sign + length
    needed = size > 0.0
    tangent = torch.where(needed, sign * product / torch.where(needed, size, torch.ones_like(size)), 0.0 * product)
    c = 1.0 / (1.0 + tangent * tangent).sqrt()
    return c, c * tangent
