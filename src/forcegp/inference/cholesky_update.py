"""Learning from more rows without starting again: the exact posterior with rows appended or left out.

Rows are appended by the block Cholesky factorisation of T in deflated coordinates (Golub & Van Loan 2013, section
4.2.9; docs/how-to/incremental.md). What a row is worth is the Kullback-Leibler divergence from the posterior without it
to the one with it. With P = T^-1 and alpha = P t it needs the row's own blocks only,

    1/2 (tr P_ii - log|P_ii| - r + alpha_i^T (P_ii^-1 - I) alpha_i),

for P_ii^-1 is the covariance of t_i given all other rows, noise I included, and P_ii^-1 alpha_i what these predict
wrongly of it. (Csato & Opper 2002, "Sparse on-line Gaussian processes", delete basis points by such a
score.) Leaving a row out of P is a step of Cholesky's algorithm on P, so that no other inversion is needed.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.inference.cholesky import CholeskyFactor, factorize
from forcegp.inference.likelihood import DeflatedSystem, Deflation, Terms, deflated_covariance
from forcegp.inference.posterior import ExactPosterior

COPIED_ROWS = 256
"""Rows of a factor that are copied at once, without what lies beyond their diagonal."""


def with_rows(latent: ExactPosterior, terms: Terms) -> ExactPosterior:
    """The posterior of the old rows and those of `terms`, at the same kernels; the old posterior stays valid.

    Equals `ExactPosterior.condition` on all rows but for rounding. Raises NumericalError where the new ones are not
    finite or the covariance cannot be factorised.
    """
    with torch.no_grad():
        features, added, old = terms.features, terms.deflated(), latent.system.deflation
        rank = max(old.rank, added.rank)
        factor = _with_rank(latent.system.factor, len(old.t), old.rank, rank)
        old, added = _padded(old, rank), _padded(added, rank)
        cross = added.t.new_zeros(added.t.numel(), old.t.numel())
        for c, (kernel, z, at) in enumerate(zip(latent.kernels.dense, features, latent.features, strict=True)):
            cross += added.through(c, old.through(c, kernel.cross(z, at).mT).mT)
        own = deflated_covariance(added.C, latent.kernels(features))
        factor = appended(factor, cross, own)
        joined = Deflation(*(torch.cat([getattr(part, name) for part in (old, added)]) for name in _PARTS))
        joint = tuple(torch.cat([z, new.detach()]) for z, new in zip(latent.features, features, strict=True))
        return ExactPosterior(latent.kernels, joint, _solved(joined, factor))


def with_only(latent: ExactPosterior, rows: Int[Tensor, " kept"]) -> ExactPosterior:
    """The posterior of some rows, in the order given, factorised anew. Raises NumericalError where it cannot be."""
    with torch.no_grad():
        deflation = Deflation(*(getattr(latent.system.deflation, name)[rows] for name in _PARTS))
        features = tuple(z[rows] for z in latent.features)
        matrices = latent.kernels(features)
        factor = factorize(lambda: deflated_covariance(deflation.C, matrices))
        return ExactPosterior(latent.kernels, features, _solved(deflation, factor))


def divergences(blocks: Float[Tensor, "N r r"], alpha: Float[Tensor, "N r"]) -> Float[Tensor, " N"]:
    """What every row is worth to the posterior, in nats, from its blocks P_ii and alpha_i."""
    factor, _ = torch.linalg.cholesky_ex(blocks)
    error = torch.linalg.solve_triangular(factor, alpha[..., None], upper=False).square().sum((-2, -1))
    trace = blocks.diagonal(dim1=-2, dim2=-1).sum(-1)
    surprise = 0.5 * (trace - blocks.shape[-1] + error - alpha.square().sum(-1))
    return surprise - factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def rows_to_keep(
    latent: ExactPosterior, budget: int, worth: Callable[[Tensor, Tensor], Tensor] = divergences
) -> Int[Tensor, " kept"]:
    """The rows that are left when the one that is worth least is left out again and again; ascending.

    Costs an inversion of T and, for d rows left out of N, O(N d^2) more. Raises InvalidInput for a budget below 1.
    """
    if budget < 1:
        raise InvalidInput(f"budget is {budget}; keep at least 1 row")
    system = latent.system
    count, rank = system.alpha.shape
    surplus = max(0, count - budget)
    if not surplus or not rank:
        return torch.arange(surplus, count, device=system.alpha.device)  # of rows without information the newest
    with torch.no_grad():
        lower = CholeskyFactor(system.factor.lower.clone(), system.factor.jitter).into_inverse().tril_()
        precision = (lower + lower.tril(-1).mT).reshape(count, rank, count * rank)
        blocks = lower.reshape(count, rank, count, rank).diagonal(dim1=0, dim2=2).permute(2, 0, 1)
        blocks = blocks + blocks.tril(-1).mT
        alpha = system.alpha.clone()
        left_out = torch.zeros(count, dtype=torch.bool, device=alpha.device)
        steps = alpha.new_zeros(surplus * rank, count * rank)
        identity = torch.eye(rank, dtype=alpha.dtype, device=alpha.device)
        for done in range(surplus):
            row = int(worth(blocks, alpha).masked_fill(left_out, torch.inf).argmin())
            before, here = steps[: done * rank], slice(row * rank, (row + 1) * rank)
            own = torch.linalg.cholesky(blocks[row])
            step = torch.linalg.solve_triangular(own, precision[row] - before[:, here].mT @ before, upper=False)
            error = torch.linalg.solve_triangular(own, alpha[row][:, None], upper=False)
            steps[done * rank : (done + 1) * rank] = step
            by_row = step.reshape(rank, count, rank).permute(1, 2, 0)
            blocks -= by_row @ by_row.mT
            alpha -= (by_row @ error)[..., 0]
            left_out[row] = True
            blocks[left_out] = identity  # what is left of them is rounding, which has no inverse
        return torch.nonzero(~left_out)[:, 0]


def appended(factor: CholeskyFactor, cross: Float[Tensor, "m n"], own: Float[Tensor, "m m"]) -> CholeskyFactor:
    """The factor of [[T11, cross^T], [cross, own]] from that of T11, which is copied; `own` is overwritten.

    Copied, because torch's triangular solves copy a view of a larger buffer at every call, which costs more. Only the
    lower triangle of `own` is read. Jitter is added to the new rows alone, as `factorize` does.
    """
    size, more = factor.lower.shape[0], own.shape[0]
    lower = factor.lower.new_empty(size + more, size + more)
    for start in range(0, size, COPIED_ROWS):  # memory that is never touched, above the diagonal, costs nothing
        stop = min(size, start + COPIED_ROWS)
        lower[start:stop, :stop] = factor.lower[start:stop, :stop]
    below = factor.solve_lower(cross.mT).mT if size else cross
    lower[size:, :size] = below
    own.sub_(below @ below.mT)
    corner = factorize(own.clone)
    lower[size:, size:] = corner.lower
    return CholeskyFactor(lower, max(factor.jitter, corner.jitter))


_PARTS = ("U", "C", "t", "remainder")


def _solved(deflation: Deflation, factor: CholeskyFactor) -> DeflatedSystem:
    """alpha = T^-1 t and beta from a factor of T."""
    white = factor.solve_lower(deflation.t.reshape(-1, 1))  # two solves of one column, 5 times as fast as LAPACK's
    alpha = factor.solve_upper(white).reshape(deflation.t.shape)
    return DeflatedSystem(deflation, factor, alpha, torch.einsum("irc,ir->ic", deflation.C, alpha))


def _padded(deflation: Deflation, rank: int) -> Deflation:
    """The same with zeros in place of the directions that rows of higher rank have; nothing depends on them."""
    more = rank - deflation.rank
    pad = torch.nn.functional.pad
    U, C, t = pad(deflation.U, (0, more)), pad(deflation.C, (0, 0, 0, more)), pad(deflation.t, (0, more))
    return Deflation(U, C, t, deflation.remainder)


def _with_rank(factor: CholeskyFactor, count: int, rank: int, wanted: int) -> CholeskyFactor:
    """The factor of T where every row has `wanted` directions; the new ones have variance 1, of noise alone."""
    if rank == wanted:
        return factor
    lower = torch.eye(count * wanted, dtype=factor.lower.dtype, device=factor.lower.device)
    place = torch.arange(count * wanted, device=lower.device).reshape(count, wanted)[:, :rank].reshape(-1)
    lower[place[:, None], place] = factor.lower.tril()
    return CholeskyFactor(lower, factor.jitter)
