"""Negative log marginal likelihood of the deflated model y_i = m_i + W_i f(x_i) + noise_i, with hand-written gradients.

Whitened, L_i^-1 W_i = U_i C_i with orthonormal U_i. What is orthogonal to U_i is standard normal; t_i = U_i^T y~_i has
covariance T = (c_ic . c_jc k_c(x_i, x_j))_ij + I. With alpha = T^-1 t, beta_c = sum_a C_iac alpha_ia, V_c = L^-1 C_c,

    NLL = 1/2 t^T alpha + 1/2 log|T| + 1/2 |remainder|^2 + sum_i log|L_i| + D N / 2 log 2 pi
    dNLL/dk_c      = 1/2 (V_c^T V_c - beta_c beta_c^T)
    dNLL/dC_iac    = sum_jb T^-1_(ia)(jb) C_jbc k_c[i,j] - alpha_ia (K_c beta_c)_i, for changes of the noise alone
    dNLL/dW~_i     = U_i dNLL/dC_i - remainder_i (K_c beta_c)_i^T           dNLL/dy~_i = U_i alpha_i + remainder_i

T lives in one buffer of (rN)^2 doubles that becomes its own factor L and L^-1, lower triangle only.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

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
        # The row-major lower triangle is the column-major upper one: LAPACK takes the transposed view without a copy.
        inverse, info = lapack.dtrtri(self.lower.numpy().T, lower=0, overwrite_c=1)
        if info != 0:
            raise NumericalError(f"inverting the Cholesky factor of the covariance failed (LAPACK dtrtri info={info})")
        return torch.from_numpy(inverse.T)


def factorize(build: Callable[[], Float[Tensor, "n n"]]) -> CholeskyFactor:
    """Cholesky factor of the matrix that `build` returns, whose lower triangle is read and overwritten.

    A matrix that is not positive definite in floating point is built again with more of its mean diagonal added
    (`JITTER_LADDER`), and a NumericalWarning. NumericalError where entries are not finite, or that does not help.
    """
    jitter = 0.0
    for relative in JITTER_LADDER:
        matrix = build()
        if not bool(torch.isfinite(matrix.diagonal()).all()):
            remedy = "check the data for huge or constant columns and the start values of the hyper-parameters"
            raise NumericalError(f"the covariance matrix has entries that are not finite; {remedy}")
        jitter = relative * float(matrix.diagonal().mean()) if relative and matrix.shape[0] else relative
        if jitter:
            matrix.diagonal().add_(jitter)
        lower, ok = _cholesky_in_place(matrix)
        if ok:
            if jitter:
                warnings.warn(
                    f"added {jitter:.2e} ({relative:.0e} of the mean diagonal) to make a {len(matrix)} x {len(matrix)} "
                    "covariance positive definite; larger noise or fewer duplicate points avoid this",
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


RANK_TOLERANCE = 1e-12
"""Singular values of W~_i below this fraction of the largest count as zero: rounding in H A^T = 0."""


class Deflation(NamedTuple):
    """W~_i = U_i C_i, t_i = U_i^T y~_i and the remainder y~_i - U_i t_i, for N points."""

    U: Float[Tensor, "N D r"]
    C: Float[Tensor, "N r C"]
    t: Float[Tensor, "N r"]
    remainder: Float[Tensor, "N D"]

    @property
    def rank(self) -> int:
        """The largest rank of W_i over the points (r)."""
        return self.C.shape[-2]

    def through(self, index: int, K: Float[Tensor, "N _"]) -> Float[Tensor, "Nr _"]:
        """What t is of one latent whose values at the points are columns of K."""
        return (K[:, None, :] * self.C[:, :, index, None]).flatten(0, 1)

    def back(self, index: int, alpha: Float[Tensor, "Nr _"]) -> Float[Tensor, "N _"]:
        """The transpose of `through`."""
        return (self.C[:, :, index, None] * alpha.unflatten(0, self.t.shape)).sum(1)


def whiten(
    W: Float[Tensor, "N D C"], residual: Float[Tensor, "N D"], noise: Float[Tensor, "#N D"] | Float[Tensor, "#N D D"]
) -> tuple[Float[Tensor, "N D C"], Float[Tensor, "N D"], Float[Tensor, ""]]:
    """W~ = L^-1 W, y~ = L^-1 residual and sum_i log|L_i| for noise variances (N or 1, D) or covariances (N or 1, D, D).

    Differentiable in all arguments. Raises NumericalError when a noise covariance is not positive definite.
    """
    count = W.shape[0]
    if noise.ndim == 2:
        if not bool((noise > 0).all()):
            raise NumericalError(f"noise variances must be positive, the smallest is {float(noise.detach().min()):.3e}")
        std = noise.sqrt()
        return W / std[..., None], residual / std, std.log().expand(count, -1).sum()
    lower, info = torch.linalg.cholesky_ex(noise)
    if bool((info != 0).any()):
        seen = f"the noise covariance of row {int(torch.nonzero(info)[0])} is not positive definite"
        raise NumericalError(f"{seen}; raise the acceleration noise")
    logdet = lower.diagonal(dim1=-2, dim2=-1).log().sum(-1).expand(count).sum()
    W_white = torch.linalg.solve_triangular(lower, W, upper=False)
    return W_white, torch.linalg.solve_triangular(lower, residual[..., None], upper=False)[..., 0], logdet


def deflate(W_white: Float[Tensor, "N D C"], y_white: Float[Tensor, "N D"]) -> Deflation:
    """Split whitened data into what depends on the latents and what does not, by singular values of W~_i.

    Points of lower rank than the largest have zero rows in C_i, which is exact too. Not differentiable on its own.
    Raises NumericalError where W~ or y~ is not finite.
    """
    with torch.no_grad():
        if not bool(torch.isfinite(W_white).all() & torch.isfinite(y_white).all()):  # one wait for a GPU, not two
            _require_finite(W_white, "the mixing vectors W", "check q, v, u and the contact geometry")
            _require_finite(y_white, "the residuals y - m", "check the measured accelerations and the mean")
        U, singular, _ = torch.linalg.svd(W_white, full_matrices=False)
        rank = 0
        if singular.numel():
            rank = int((singular > RANK_TOLERANCE * singular.amax(dim=-1, keepdim=True)).sum(-1).max())
        U = U[..., :rank].contiguous()
        C, t = U.mT @ W_white, (U.mT @ y_white[..., None])[..., 0]
        remainder = y_white - (U @ t[..., None])[..., 0]
    return Deflation(U, C, t, remainder)


def _require_finite(values: Tensor, what: str, remedy: str) -> None:
    finite = torch.isfinite(values)
    if not bool(finite.all()):
        raise NumericalError(f"{what} of row {int(torch.nonzero(~finite)[0, 0])} are not finite; {remedy}")


class Terms(NamedTuple):
    """Features z_c (N, d_c) of every latent, W (N, D, C), residual y - m (N, D), and the noise.

    `noise` holds variances (N or 1, D) or covariance matrices (N or 1, D, D).
    """

    features: list[Tensor]
    W: Tensor
    residual: Tensor
    noise: Tensor

    def deflated(self) -> Deflation:
        """Whitened, and split into what depends on the latents and what does not."""
        W_white, y_white, _ = whiten(self.W, self.residual, self.noise)
        return deflate(W_white, y_white)


PANEL_BYTES = 4 * 2**20  # working memory of one panel of rows; measured flat between 2 and 8 MiB, slower outside

INNER = 256  # rows of L^-1 that are multiplied at once, the inner dimension of products of N x N matrices


def negative_log_likelihood(
    W: Float[Tensor, "N D C"],
    residual: Float[Tensor, "N D"],
    noise: Float[Tensor, "#N D"] | Float[Tensor, "#N D D"],
    kernel_matrices: Sequence[Float[Tensor, "N N"]],
) -> Float[Tensor, ""]:
    """Exact -log p(y) of y = m + sum_c W_c f_c + noise, residual = y - m; differentiable in all but W.

    `noise` holds variances (N or 1, D) or covariances (N or 1, D, D); one N x N kernel matrix per latent (Rasmussen &
    Williams 2006, eq. 2.30). Raises NumericalError when a covariance cannot be factorised.
    """
    count, outputs, _ = W.shape
    if outputs > 1 and noise.ndim == 2 and _acts_apart(W):
        each = zip((slice(d, d + 1) for d in range(outputs)), kernel_matrices, strict=True)
        alone = [negative_log_likelihood(W[:, d, d], residual[:, d], noise[:, d], [K]) for d, K in each]
        return torch.stack(alone).sum()
    W_white, y_white, log_noise = whiten(W.detach(), residual, noise)
    quadratic_and_logdet = _DeflatedNLL.apply(W_white, y_white, *kernel_matrices)
    return quadratic_and_logdet + log_noise + 0.5 * count * outputs * math.log(2.0 * math.pi)


def _acts_apart(W: Float[Tensor, "N D C"]) -> bool:
    """Whether every latent acts on an output of its own: then D problems of size N cost D^2 times less than one."""
    if W.shape[1] != W.shape[2]:
        return False
    size = W.detach().abs()
    own = size.diagonal(dim1=-2, dim2=-1)
    return bool(((size - torch.diag_embed(own)).amax((-2, -1)) <= RANK_TOLERANCE * own.amin(-1)).all())


@dataclass(frozen=True, eq=False)
class DeflatedSystem:
    """T factorised, with the weights that every prediction needs."""

    deflation: Deflation
    factor: CholeskyFactor
    alpha: Float[Tensor, "N r"]
    beta: Float[Tensor, "N C"]


def solve_deflated(deflation: Deflation, kernel_matrices: Sequence[Float[Tensor, "N N"]]) -> DeflatedSystem:
    """Build and factorise T, then alpha = T^-1 t and beta_ic = sum_a C_iac alpha_ia."""
    factor = factorize(lambda: deflated_covariance(deflation.C, kernel_matrices))
    alpha = factor.solve(deflation.t.reshape(-1, 1)).reshape(deflation.t.shape)
    return DeflatedSystem(deflation, factor, alpha, torch.einsum("irc,ir->ic", deflation.C, alpha))


def deflated_covariance(
    C: Float[Tensor, "N r C"], kernel_matrices: Sequence[Float[Tensor, "N N"]]
) -> Float[Tensor, "n n"]:
    """T of size (rN, rN), point-major; only the lower triangle (and the diagonal panels) are filled."""
    count, rank, latents = C.shape
    T = torch.empty(count * rank, count * rank, dtype=C.dtype, device=C.device)
    C_by_latent = C.permute(2, 0, 1).contiguous()
    height = max(1, min(count, PANEL_BYTES // max(1, 8 * latents * count * rank)))
    for start in range(0, count if rank else 0, height):
        stop = min(count, start + height)
        kernel = torch.stack([K[start:stop, :stop] for K in kernel_matrices], dim=1)
        weighted = (kernel[..., None] * C_by_latent[None, :, :stop]).flatten(2)  # k_c[i, j] C_jbc
        rows = T[start * rank : stop * rank, : stop * rank]
        rows.copy_(torch.bmm(C[start:stop], weighted).reshape(rows.shape))
    T.diagonal().add_(1.0)
    return T


class _DeflatedNLL(torch.autograd.Function):
    """1/2 y~^T S~^-1 y~ + 1/2 log|S~|; the gradients are computed in the forward pass while T^-1 is in memory."""

    @staticmethod
    def forward(ctx, W_white: Tensor, y_white: Tensor, *kernel_matrices: Tensor) -> Tensor:  # type: ignore[override]  # the base takes *args
        deflation = deflate(W_white, y_white)
        system = solve_deflated(deflation, kernel_matrices)
        alpha, beta = system.alpha, system.beta
        value = (deflation.t * alpha).sum() + system.factor.log_determinant() + deflation.remainder.square().sum()
        W_needed, y_needed, *K_needed = ctx.needs_input_grad
        gradients: list[Tensor | None] = [None] * (2 + len(kernel_matrices))
        if y_needed:
            gradients[1] = (deflation.U @ alpha[..., None])[..., 0] + deflation.remainder
        if not kernel_matrices:
            gradients[0] = torch.zeros_like(W_white)
        elif W_needed or any(K_needed):
            C_gradient, gradients[2:] = _contractions(system, K_needed)
            if W_needed:
                latent_mean = torch.stack([K @ beta[:, c] for c, K in enumerate(kernel_matrices)], dim=-1)
                C_gradient = C_gradient - alpha[..., None] * latent_mean[:, None, :]
                gradients[0] = deflation.U @ C_gradient - deflation.remainder[..., None] * latent_mean[:, None, :]
        ctx.gradients = gradients
        return 0.5 * value

    @staticmethod
    def backward(ctx, upstream: Tensor):  # type: ignore[override]  # the base takes *args
        if torch.is_grad_enabled():  # create_graph=True: the gradients would pass for constants
            seen = "the deflated likelihood has first derivatives only"
            # the type that torch raises itself where a Function has no second derivative
            raise NotImplementedError(f"{seen}; for a Hessian take finite differences of its gradient")
        return tuple(None if g is None else upstream * g for g in ctx.gradients)


def _contractions(system: DeflatedSystem, K_needed: Sequence[bool]) -> tuple[Tensor, list[Tensor | None]]:
    """sum_jb T^-1 C k and dNLL/dK from one sweep over L^-1; the factor's memory is used up."""
    # as the noise alone moves W~_i, it is ``sum_j [T^-1]_ij C_j k_ij C_i^T = 1 - [T^-1]_ii`` that counts
    C, beta = system.deflation.C, system.beta
    count, rank, _ = C.shape
    inverse = system.factor.into_inverse_factor()
    K_gradients = [torch.outer(beta[:, c], -0.5 * beta[:, c]) if need else None for c, need in enumerate(K_needed)]
    diagonal, height = C.new_zeros(count, rank, rank), max(1, INNER // max(1, rank))
    for start in range(0, count, height):
        stop = min(count, start + height)
        rows = inverse[start * rank : stop * rank, : stop * rank]
        rows[:, start * rank :].tril_()  # LAPACK leaves the upper triangle as it is
        X = rows.view((stop - start) * rank, stop, rank).permute(1, 2, 0)
        V = torch.bmm(C[:stop].mT, X)  # (j, c, rows)
        for c, K_gradient in enumerate(K_gradients):
            if K_gradient is not None:
                K_gradient[:stop, :stop].addmm_(V[:, c], V[:, c].mT, alpha=0.5)
        diagonal[:stop] += torch.bmm(X, X.mT)
    squares = C.square().sum(-1, keepdim=True)  # the rows of C_i are orthogonal
    dual = torch.where(squares > RANK_TOLERANCE**2 * squares.sum(1, keepdim=True), C / squares, torch.zeros_like(C))
    return dual - (1.0 + system.factor.jitter) * diagonal @ dual, K_gradients
