"""Cholesky factors computed in place, by LAPACK on the CPU, with a bounded jitter ladder that reports itself."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.linalg import lapack
from torch import Tensor

from forcegp.errors import NumericalError, NumericalWarning

JITTER_LADDER = (0.0, 1e-12, 1e-10, 1e-8)
"""Multiples of the mean diagonal that are added in turn; beyond the last one the factorisation fails."""


@dataclass(frozen=True, eq=False)
class CholeskyFactor:
    """Lower Cholesky factor L of T = L L^T; the strict upper triangle of `lower` (n, n) holds leftovers.

    `jitter` is what had to be added to the diagonal, 0 almost always.
    """

    lower: Float[Tensor, "n n"]
    jitter: float = 0.0

    def log_determinant(self) -> Float[Tensor, ""]:
        """log |T|."""
        return 2.0 * self.lower.diagonal().log().sum()

    def solve(self, right: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        """T^-1 right."""
        if not _is_for_lapack(self.lower):
            return torch.cholesky_solve(right, self.lower)
        solution, _ = lapack.dpotrs(self.lower.numpy().T, right.numpy(), lower=0)
        return torch.from_numpy(solution)

    def solve_lower(self, right: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        """L^-1 right."""
        return torch.linalg.solve_triangular(self.lower, right, upper=False)

    def solve_upper(self, right: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        """L^-T right."""
        return torch.linalg.solve_triangular(self.lower.mT, right, upper=True)

    def into_inverse_factor(self) -> Float[Tensor, "n n"]:
        """L^-1 in the lower triangle, written over the factor's own memory: the factor is used up."""
        if not _is_for_lapack(self.lower):
            return torch.linalg.inv(self.lower.tril_())
        return self._in_place(lapack.dtrtri, "dtrtri")

    def into_inverse(self) -> Float[Tensor, "n n"]:
        """T^-1 in the lower triangle, written over the factor's own memory: the factor is used up."""
        if not _is_for_lapack(self.lower):
            return torch.cholesky_inverse(self.lower.tril_(), out=self.lower)
        return self._in_place(lapack.dpotri, "dpotri")

    def _in_place(self, function: Callable[..., tuple[np.ndarray, int]], name: str) -> Float[Tensor, "n n"]:
        # The row-major lower triangle is the column-major upper one: LAPACK takes the transposed view without a copy.
        inverse, info = function(self.lower.numpy().T, lower=0, overwrite_c=1)
        if info != 0:
            raise NumericalError(
                f"inverting the covariance from its Cholesky factor failed (LAPACK {name} info={info})"
            )
        return torch.from_numpy(inverse.T)


def factorize(build: Callable[[], Float[Tensor, "n n"]]) -> CholeskyFactor:
    """Cholesky factor of the matrix that `build` returns, whose lower triangle is read and overwritten.

    A matrix that is not positive definite in floating point is built again with more of its mean diagonal added
    (`JITTER_LADDER`), and a NumericalWarning. Raises NumericalError where entries are not finite, or that does not
    help.
    """
    jitter = 0.0
    for relative in JITTER_LADDER:
        matrix = build()
        if not bool(torch.isfinite(matrix.diagonal()).all()):
            raise NumericalError(
                "the covariance matrix has entries that are not finite; check the data for huge or constant columns "
                "and the start values of the hyper-parameters"
            )
        jitter = relative * float(matrix.diagonal().mean()) if relative and matrix.shape[0] else relative
        if jitter:
            matrix.diagonal().add_(jitter)
        lower, ok = _cholesky_in_place(matrix)
        if ok:
            if jitter:
                warnings.warn(
                    f"added {jitter:.2e} ({relative:.0e} of the mean diagonal) to make a {matrix.shape[0]} x "
                    f"{matrix.shape[0]} covariance "
                    "positive definite; larger noise or fewer duplicate points avoid this",
                    NumericalWarning,
                    stacklevel=2,
                )
            return CholeskyFactor(lower, jitter)
    raise NumericalError(
        f"the covariance matrix is not positive definite even with {jitter:.2e} added to its diagonal; raise the noise "
        "level, remove duplicate points, or check that the inputs are finite and of similar scale"
    )


def _is_for_lapack(matrix: Tensor) -> bool:
    """Where scipy can work: on the CPU, and not on an empty matrix, which its LAPACK refuses."""
    return matrix.device.type == "cpu" and matrix.numel() > 0


def _cholesky_in_place(matrix: Float[Tensor, "n n"]) -> tuple[Float[Tensor, "n n"], bool]:
    if not _is_for_lapack(matrix):
        lower, info = torch.linalg.cholesky_ex(matrix)
        return lower, bool((info == 0) & torch.isfinite(lower.diagonal()).all())  # one wait for a GPU, not two
    factor, info = lapack.dpotrf(matrix.numpy().T, lower=0, clean=0, overwrite_a=1)
    lower = torch.from_numpy(factor.T)
    return lower, info == 0 and bool(torch.isfinite(lower.diagonal()).all())
