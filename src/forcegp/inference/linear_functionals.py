"""Exact inference from linear functionals of the data: weighted sums over states instead of single rows.

A functional observes a whole stretch of a motion, y_w = sum_i c_wi (m_i + W_i f(z_i)) + noise, with n states i and
weights c_wi of its own. It is linear in the latent functions, so their posterior stays Gaussian, and its mean a sum of
kernel functions about all N n states (Särkkä 2011, "Linear operators and stochastic partial differential equations in
Gaussian process regression"). With noise covariance R_w = L_w L_w^T and G_wi = L_w^-1 c_wi W_i,

    S_wv = sum_c sum_ij G_wic k_c(z_wi, z_vj) G_vjc^T + delta_wv I
    E f_c(z) = sum_wi k_c(z, z_wi) G_wic . (S^-1 y~)_w

of size DN for D outputs and N functionals. There is no deflation: the directions that a contact takes turn within a
functional. With n = 1 all of this is what `likelihood` and `posterior` compute.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.inference.cholesky import CholeskyFactor, factorize
from forcegp.inference.dense_kernels import LatentKernels
from forcegp.inference.likelihood import Terms, scaled_gradients, whiten
from forcegp.inference.memory import require_memory
from forcegp.inference.posterior import FactorizedPosterior

REMEDY = "use fewer points (windows), or fewer nodes in each"


@dataclass(frozen=True, eq=False)
class Functionals:
    """N functionals of n states each, whitened: G (N, D, n, C), t = y~ (N, D) and sum_w log|L_w|."""

    G: Float[Tensor, "N D n C"]
    t: Float[Tensor, "N D"]
    log_noise: Float[Tensor, ""]

    @classmethod
    def of(cls, weights: Float[Tensor, "N n"], terms: Terms) -> "Functionals":
        """From the terms of the N n states, functional by functional; differentiable in all of them.

        Every state has its own residual, y_w - m_i for example, and its own noise covariance. Those of a functional are
        sum_i c_wi residual_i, and sum_i s_wi R_i with s_wi = c_wi^2 / sum_j c_wj^2: noise that is the same in all
        states is that of the functional, and one that turns with the state, such as H F H^T, is white in time.
        """
        count, size = weights.shape
        outputs, latents = terms.W.shape[-2:]
        W = (weights[..., None, None] * terms.W.view(count, size, outputs, latents)).transpose(1, 2)
        residual = weighted(weights, terms.residual)
        noise = terms.noise
        if len(noise) > 1:
            shares = weights.square() / weights.square().sum(-1, keepdim=True)
            noise = weighted(shares, noise)
        G, y, log_noise = whiten(W.reshape(count, outputs, size * latents), residual, noise)
        return cls(G.view(count, outputs, size, latents), y, log_noise)

    def through(self, index: int, K: Float[Tensor, "Nn _"]) -> Float[Tensor, "ND _"]:
        """sum_i G_wic K_wi,: of one latent: what the functionals make of functions whose values are columns of K."""
        count, outputs, size, _ = self.G.shape
        return torch.bmm(self.G[..., index], K.reshape(count, size, -1)).reshape(count * outputs, -1)

    def back(self, index: int, alpha: Float[Tensor, "ND _"]) -> Float[Tensor, "Nn _"]:
        """The transpose of `through`."""
        count, outputs, size, _ = self.G.shape
        return torch.bmm(self.G[..., index].mT, alpha.reshape(count, outputs, -1)).reshape(count * size, -1)

    def covariance(self, kernel_matrices: Sequence[Float[Tensor, "Nn Nn"]]) -> Float[Tensor, "ND ND"]:
        """S, differentiable in G and in the kernel matrices."""
        rows = self.t.numel()
        S = torch.eye(rows, dtype=self.t.dtype, device=self.t.device)
        for index, K in enumerate(kernel_matrices):
            S = S + self.through(index, self.through(index, K).mT)
        return S


def weighted(weights: Float[Tensor, "N n"], values: Float[Tensor, "Nn *rest"]) -> Float[Tensor, "N *rest"]:
    """sum_i w_wi values_wi over the states of every functional."""
    count, size = weights.shape
    rest = values.shape[1:]
    return torch.bmm(weights[:, None, :], values.reshape(count, size, -1)).view(count, *rest)


def functional_negative_log_likelihood(
    weights: Float[Tensor, "N n"], terms: Terms, kernel_matrices: Sequence[Float[Tensor, "Nn Nn"]]
) -> Float[Tensor, ""]:
    """Exact -log p(y) of `Functionals.of`; once differentiable. Raises NumericalError without a factorisation."""
    functionals = Functionals.of(weights, terms)
    quadratic_and_logdet = _NormalNLL.apply(functionals.covariance(kernel_matrices), functionals.t.flatten())
    constant = 0.5 * functionals.t.numel() * math.log(2.0 * math.pi)
    return quadratic_and_logdet + functionals.log_noise + constant


def require_memory_for_functionals(weights: Float[Tensor, "N n"], outputs: int, latents: int) -> None:
    """Raise NotEnoughMemory where the likelihood and its gradients do not fit into memory."""
    count, size = weights.shape
    states, rows = count * size, count * outputs
    needed = 8 * (3 * latents * states**2 + 2 * latents * rows * states + 4 * rows**2)
    require_memory(needed, f"the likelihood of {count} windows of {size} nodes", REMEDY, weights.device)


class _NormalNLL(torch.autograd.Function):
    """1/2 y^T S^-1 y + 1/2 log|S|; slopes 1/2 (S^-1 - alpha alpha^T) and alpha = S^-1 y, from the one factor."""

    @staticmethod
    def forward(ctx, S: Tensor, y: Tensor) -> Tensor:  # type: ignore[override]  # the base takes *args
        factor = factorize(lambda: 0.5 * (S + S.mT))
        alpha = factor.solve(y[:, None])[:, 0]
        value = 0.5 * (y @ alpha + factor.log_determinant())
        slope = None
        if ctx.needs_input_grad[0]:
            lower = factor.into_inverse().tril()
            slope = 0.5 * (lower + lower.tril(-1).mT - torch.outer(alpha, alpha))
        ctx.gradients = slope, alpha if ctx.needs_input_grad[1] else None
        return value

    @staticmethod
    def backward(ctx, upstream: Tensor):  # type: ignore[override]  # the base takes *args
        return scaled_gradients("the likelihood of functionals", upstream, ctx.gradients)


@dataclass(frozen=True, eq=False)
class FunctionalSystem:
    """S factorised, with the weights that every prediction needs; the centres are all N n states."""

    deflation: Functionals
    factor: CholeskyFactor
    alpha: Float[Tensor, " ND"]
    beta: Float[Tensor, "Nn C"]


@dataclass(frozen=True, eq=False)
class FunctionalPosterior(FactorizedPosterior):
    """The exact posterior given functionals; the centres of every latent are all N n states."""

    kernels: LatentKernels
    features: tuple[Float[Tensor, "Nn _"], ...]
    system: FunctionalSystem
    remedy: ClassVar[str] = "fit to accelerations, for which single rows are what is observed"

    @classmethod
    def condition(cls, kernels: LatentKernels, weights: Float[Tensor, "N n"], terms: Terms) -> "FunctionalPosterior":
        """Condition on the functionals of these terms (`Functionals.of`)."""
        with torch.no_grad():
            functionals = Functionals.of(weights, terms)
            S = functionals.covariance(kernels(terms.features))
            factor = factorize(lambda: 0.5 * (S + S.mT))
            alpha = factor.solve(functionals.t.reshape(-1, 1))
            each = (functionals.back(c, alpha) for c in range(terms.W.shape[-1]))
            beta = torch.cat([alpha.new_zeros(len(terms.W), 0), *each], dim=-1)  # known forces alone have no latent
        system = FunctionalSystem(functionals, factor, alpha[:, 0], beta)
        return cls(kernels, tuple(z.detach() for z in terms.features), system)
