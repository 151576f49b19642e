"""The same model written plainly: one DN x DN covariance, autograd through torch.linalg. The oracle of this folder."""

import math

import mpmath  # comes with torch
import numpy as np
import torch


def dense_covariance(W, noise, kernel_matrices):
    count, outputs, _ = W.shape
    S = torch.zeros(count, outputs, count, outputs, dtype=torch.float64)
    for c, K in enumerate(kernel_matrices):
        S = S + torch.einsum("id,ij,je->idje", W[..., c], K, W[..., c])
    R = torch.diag_embed(noise) if noise.ndim == 2 else noise
    R = R.expand(count, outputs, outputs)
    S = S + torch.einsum("ide,ij->idje", R, torch.eye(count, dtype=torch.float64))
    return S.reshape(count * outputs, count * outputs)


def dense_negative_log_likelihood(W, residual, noise, kernel_matrices):
    y, lower = residual.reshape(-1), torch.linalg.cholesky(dense_covariance(W, noise, kernel_matrices))
    quadratic = y @ torch.cholesky_solve(y[:, None], lower)[:, 0]
    return 0.5 * quadratic + lower.diagonal().log().sum() + 0.5 * y.numel() * math.log(2.0 * math.pi)


def precise_value_and_gradients(W, residual, noise, kernel_matrices):
    """Value and gradients with respect to W, residual, noise (1, D) and each kernel matrix, from S^-1 in 40 digits."""
    count, outputs, _ = W.shape
    with mpmath.workdps(40):
        exact = np.vectorize(lambda number: mpmath.mpf(float(number)), otypes=[object])
        w, y, variances = (exact(tensor.detach().numpy()) for tensor in (W, residual, noise))
        K = exact(torch.stack(list(kernel_matrices)).detach().numpy())
        S = np.einsum("idc,cij,jec->idje", w, K, w).reshape(count * outputs, -1)
        S = mpmath.matrix((S + np.diag(np.tile(variances[0], count))).tolist())
        inverse = S**-1
        alpha = inverse * mpmath.matrix(y.ravel().tolist())
        value = mpmath.fdot(y.ravel(), alpha) / 2 + mpmath.log(mpmath.det(S)) / 2
        value += mpmath.mpf(y.size) / 2 * mpmath.log(2 * mpmath.pi)
        G = np.array(((inverse - alpha * alpha.T) / 2).tolist()).reshape(count, outputs, count, outputs)
        gradients = [
            2 * np.einsum("idje,cij,jec->idc", G, K, w), np.array(list(alpha)).reshape(count, outputs),
            np.einsum("idid->d", G)[None], *np.einsum("idc,idje,jec->cij", w, G, w),
        ]  # fmt: skip
        return float(value), [torch.as_tensor(gradient.astype(np.float64)) for gradient in gradients]


def dense_posterior(W, residual, noise, kernel_matrices, cross, prior):
    """Mean (n, C) and covariance (n, C, C) of the latents from k_c(z*, z_j) (C, n, N) and k_c(z*, z*) (n, C)."""
    count, outputs, _ = W.shape
    S = dense_covariance(W, noise, kernel_matrices)
    with_data = torch.einsum("cnj,jdc->ncjd", cross, W).reshape(prior.shape[0], prior.shape[1], count * outputs)
    mean = with_data @ torch.linalg.solve(S, residual.reshape(-1))
    return mean, torch.diag_embed(prior) - with_data @ torch.linalg.solve(S, with_data.mT)
