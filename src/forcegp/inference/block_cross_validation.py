"""Rows that are left out, predicted from the rest of the data: closed-form predictive densities, without a refit.

For a normal vector with precision P the density of some entries I given all others needs only P_II (Rasmussen &
Williams 2006, eqs. 5.10-5.12, there for one entry): mean y_I - P_II^-1 (P y)_I and covariance P_II^-1. In deflated
coordinates the precision is that of t, T^-1, and the part of the whitened data orthogonal to U is N(0, I) whatever the
other rows predict. So with alpha = T^-1 t, the rows i in I and n = |I|,

    e_I = (T^-1_II)^-1 alpha_I                                  t_I less its prediction, of covariance (T^-1_II)^-1
    log p(y_I | rest) = -1/2 alpha_I^T e_I + 1/2 log|T^-1_II| - 1/2 |remainder_I|^2 - sum_i log|L_i| - n D / 2 log 2 pi

and y_i less its prediction is L_i (U_i e_i + remainder_i), of covariance L_i (I + U_i (Sigma_ii - I) U_i^T) L_i^T with
Sigma_ii the block of (T^-1_II)^-1 that belongs to row i. Hyper-parameters stay those of all rows.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from forcegp.errors import InvalidInput, NumericalError
from forcegp.inference.cholesky import CholeskyFactor
from forcegp.inference.likelihood import DeflatedSystem

Blocks = Sequence[Sequence[int]]


@dataclass(frozen=True, eq=False)
class LeaveOut:
    """How well rows are predicted from the rows outside their block, at the parameters that were fitted to all rows.

    Fields
    ------
    blocks: the rows of each block, by number of the training row.
    log_density: log p(a of the whole block | all rows outside it) in nats.
    rows: all rows of all blocks, ascending; what follows is in this order.
    per_row: log p(a of the row | all rows outside its block) in nats; equals `log_density` for blocks of one row.
    residual: measured less predicted acceleration in the units of each joint.
    covariance: of a measurement, noise included.
    """

    blocks: tuple[tuple[int, ...], ...]
    log_density: Float[Tensor, " blocks"]
    rows: Int[Tensor, " rows"]
    per_row: Float[Tensor, " rows"]
    residual: Float[Tensor, "rows D"]
    covariance: Float[Tensor, "rows D D"]

    @property
    def total(self) -> float:
        """Sum of `log_density` in nats, the score that models of the same data and blocks are compared by."""
        return float(self.log_density.sum())


def leave_blocks_out(
    system: DeflatedSystem, noise: Float[Tensor, "#N D"] | Float[Tensor, "#N D D"], blocks: Blocks | None = None
) -> LeaveOut:
    """Predict every block of rows from all rows outside it; None leaves one row out at a time.

    `noise` is that which `system` was whitened with. Costs one inversion of T and one copy of it, then the cube of the
    size of every block. Raises InvalidInput for rows that do not exist or are in several blocks, and for empty blocks.
    """
    count, outputs, rank = system.deflation.U.shape
    chosen = _checked_blocks(blocks, count)
    with torch.no_grad():
        precision = None
        if rank:
            precision = CholeskyFactor(system.factor.lower.clone(), system.factor.jitter).into_inverse()
        device = system.alpha.device
        parts = [_left_out_block(system, precision, torch.tensor(block, device=device)) for block in chosen]
        rows = torch.tensor([row for block in chosen for row in block], device=device)
        order = torch.argsort(rows)
        rows = rows[order]
        whole, *values = zip(*parts, strict=True)
        per_row, residual, covariance = (torch.cat(part)[order] for part in values)
        lower = _lower(noise).expand(count, outputs, outputs)
        scale = lower.diagonal(dim1=-2, dim2=-1).log().sum(-1) + 0.5 * outputs * math.log(2.0 * math.pi)
        whole = torch.stack(whole) - torch.stack([scale[list(block)].sum() for block in chosen])
        lower = lower[rows]
        residual = (lower @ residual[..., None])[..., 0]
        return LeaveOut(chosen, whole, rows.cpu(), per_row - scale[rows], residual, lower @ covariance @ lower.mT)


def _left_out_block(system: DeflatedSystem, precision: Tensor | None, rows: Int[Tensor, " rows"]) -> tuple[Tensor, ...]:
    """The fields of `LeaveOut` of one block in whitened coordinates; densities without their constants."""
    deflation = system.deflation
    U, remainder = deflation.U[rows], deflation.remainder[rows]
    count, outputs, rank = U.shape
    orthogonal = 0.5 * remainder.square().sum(-1)
    identity = torch.eye(outputs, dtype=U.dtype, device=U.device)
    if precision is None:
        return -orthogonal.sum(), -orthogonal, remainder, identity.expand(count, -1, -1)
    ascending, place = torch.sort(rows)  # only the lower triangle of the precision is there
    index = (ascending[:, None] * rank + torch.arange(rank, device=U.device)).reshape(-1)
    lower = precision[index[:, None], index].tril()
    factor, info = torch.linalg.cholesky_ex(lower + lower.tril(-1).mT)
    if bool(info):
        raise NumericalError(
            f"the precision of left-out rows {rows.tolist()} is not positive definite; the covariance is close to "
            "singular, so raise the noise level or remove duplicate points"
        )
    alpha = system.alpha[ascending].reshape(-1, 1)
    error = torch.cholesky_solve(alpha, factor).reshape(count, rank)
    log_density = factor.diagonal().log().sum() - 0.5 * (alpha[:, 0] @ error.reshape(-1)) - orthogonal.sum()
    spread = torch.cholesky_inverse(factor).reshape(count, rank, count, rank)
    each = torch.arange(count, device=U.device)
    given = torch.argsort(place)  # back to the order in which the block names its rows
    error, spread = error[given], spread[each, :, each][given]
    own = torch.linalg.cholesky(spread)
    white = torch.linalg.solve_triangular(own, error[..., None], upper=False)
    per_row = -0.5 * white.square().sum((-2, -1)) - own.diagonal(dim1=-2, dim2=-1).log().sum(-1) - orthogonal
    residual = (U @ error[..., None])[..., 0] + remainder
    covariance = identity + U @ (spread - torch.eye(rank, dtype=U.dtype, device=U.device)) @ U.mT
    return log_density, per_row, residual, covariance


def _lower(noise: Tensor) -> Tensor:
    return torch.diag_embed(noise.sqrt()) if noise.ndim == 2 else torch.linalg.cholesky(noise)


def _checked_blocks(blocks: Blocks | None, count: int) -> tuple[tuple[int, ...], ...]:
    if blocks is None:
        return tuple((row,) for row in range(count))
    chosen = tuple(tuple(int(row) for row in block) for block in blocks)
    if not chosen or not all(chosen):
        raise InvalidInput("there is no block, or one without rows; give at least one row in every block.")
    rows = [row for block in chosen for row in block]
    wrong = next((row for row in rows if not 0 <= row < count), None)
    if wrong is not None:
        raise InvalidInput(f"row {wrong} does not exist; there are {count} training rows, 0 to {count - 1}.")
    if len(set(rows)) < len(rows):
        repeated = next(row for row in rows if rows.count(row) > 1)
        raise InvalidInput(f"row {repeated} is in the blocks more than once; leave every row out once.")
    return chosen
