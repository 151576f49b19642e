"""The kernel matrices of all latents as an operator: panels kept in memory as far as they fit, the rest made anew."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.inference.kernels import LatentKernels

PANEL_BYTES = 8 * 2**20
"""Largest size of one panel of one latent: it is read twice, and the second time it should still be in the cache."""


class KernelPanels:
    """x -> K_c x_c for all latents c, from the lower triangles of the K_c.

    A panel holds rows start..stop of K_c against columns 0..stop. Those that fit into `memory` bytes are kept from the
    first product on; the others are made again for every product.
    """

    def __init__(self, kernels: LatentKernels, features: Sequence[Float[Tensor, "N _"]], memory: int) -> None:
        self.kernels = kernels.dense
        self.features = features
        self.count = len(features[0])
        self.memory = memory
        self.kept: dict[tuple[int, int], Tensor] = {}
        self.bytes_kept = 0

    def __call__(self, x: Float[Tensor, "C N S"]) -> Float[Tensor, "C N S"]:
        """K_c x_c."""
        out = torch.zeros_like(x)
        start = 0
        while start < self.count:
            stop = min(self.count, start + max(1, PANEL_BYTES // (8 * self.count)))
            for c in range(len(self.kernels)):
                panel = self._panel(c, start, stop)
                out[c, start:stop] += panel @ x[c, :stop]
                out[c, :start] += panel[:, :start].mT @ x[c, start:stop]
            start = stop
        return out

    def release(self) -> None:
        """Give the memory of the panels back; the next product makes them anew."""
        self.kept.clear()
        self.bytes_kept = 0

    def _panel(self, c: int, start: int, stop: int) -> Float[Tensor, "rows stop"]:
        found = self.kept.get((c, start))
        if found is not None:
            return found
        z = self.features[c]
        panel = self.kernels[c].cross(z[start:stop], z[:stop])
        size = panel.numel() * panel.element_size()
        if self.bytes_kept + size <= self.memory:
            self.kept[c, start] = panel
            self.bytes_kept += size
        return panel
