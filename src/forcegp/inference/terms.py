"""What the likelihood and every engine are given: the data in the form y = m + sum_c W_c f_c(z_c) + noise."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from forcegp.inference.deflation import Deflation, deflate, whiten


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
