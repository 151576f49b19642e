"""Small dense linear algebra without branches on values, so that a tape can hold it; derivatives are right as well."""

from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from typing_extensions import override

SWEEPS = {1: 0, 2: 2, 3: 5}
"""Rounds of Jacobi rotations by the number of rows: two columns need one, for more the convergence is quadratic."""

MOST_SWEEPS = 7


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

    One-sided Jacobi rotations (Demmel & Veselic, SIAM J. Matrix Anal. Appl. 13, 1992): columns of A^T V become
    orthogonal, their lengths are the singular values, to high relative accuracy. What is left of their products is
    zero but for its derivatives, and counted to first order.
    """
    count = matrix.shape[-2]
    columns = list(matrix.unbind(-2))
    turns = list(
        torch.eye(count, dtype=matrix.dtype, device=matrix.device).expand(*matrix.shape[:-2], -1, -1).unbind(-1)
    )
    for _ in range(SWEEPS.get(count, MOST_SWEEPS)):
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
