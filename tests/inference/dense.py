"""The same likelihood written plainly: one DN x DN covariance, autograd through torch.linalg. The oracle of this folder."""

import math

import torch


def dense_covariance(W, noise, kernel_matrices):
    count, outputs, _ = W.shape
    S = torch.zeros(count, outputs, count, outputs, dtype=torch.float64)
    for c, K in enumerate(kernel_matrices):
        S = S + torch.einsum("id,ij,je->idje", W[..., c], K, W[..., c])
    R = torch.diag_embed(noise) if noise.ndim == 2 else noise
    R = R.expand(count, outputs, outputs)
    eye = torch.eye(count, dtype=torch.float64)
    S = S + torch.einsum("ide,ij->idje", R, eye)
    return S.reshape(count * outputs, count * outputs)


def dense_negative_log_likelihood(W, residual, noise, kernel_matrices):
    S = dense_covariance(W, noise, kernel_matrices)
    y = residual.reshape(-1)
    lower = torch.linalg.cholesky(S)
    quadratic = y @ torch.cholesky_solve(y[:, None], lower)[:, 0]
    return 0.5 * quadratic + lower.diagonal().log().sum() + 0.5 * y.numel() * math.log(2.0 * math.pi)
