"""Kernel functions of all latents about the centres of a posterior, prepared for many calls with few points.

Scaled squared exponentials of latents that share their centres are one matrix product and one exponential:

    log k_c(z, z_j) = log s_c - 1/2 |z / l_c|^2 + (z / l_c^2) . z_j - 1/2 |z_j / l_c|^2

is linear in z_j and in what depends on j alone, so the centres are read once for all latents. Every other kernel is
evaluated by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor

from forcegp.inference.kernel_matrices import squared_exponential_parameters
from forcegp.inference.kernels import kernel_cross, kernel_diagonal
from forcegp.inference.posterior import LatentPosterior


@dataclass(frozen=True, eq=False)
class SharedCenters:
    """Squared exponentials of latents with the same centres (N, d)."""

    latents: tuple[int, ...]
    shift: Float[Tensor, " d"]
    precisions: Float[Tensor, "G d"]  # 1 / l^2
    variances: Float[Tensor, " G"]
    table: Float[Tensor, "width N"]

    @classmethod
    def of(
        cls, latents: tuple[int, ...], centers: Float[Tensor, "N d"], scales: Sequence[tuple[Tensor, Tensor]]
    ) -> SharedCenters:
        """`scales` are the length scales and the variance of every latent."""
        width = centers.shape[-1]
        precisions = torch.stack([length.detach().expand(width) ** -2 for length, _ in scales])
        variances = torch.stack([variance.detach().reshape(()) for _, variance in scales])
        shift = centers.mean(0)
        z = centers - shift  # or what cancels would be large
        own = variances.log()[:, None] - 0.5 * precisions @ z.square().mT
        return cls(latents, shift, precisions, variances, torch.cat([z.mT, own, torch.ones_like(own[:1])]))

    def inputs(self, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n _"]:
        """Left factors of the matrix product, (n, G (d + G + 1)) flattened."""
        z = features[self.latents[0]] - self.shift
        scaled = z[:, None] * self.precisions
        chosen = torch.eye(len(self.latents), dtype=z.dtype, device=z.device).expand(len(z), -1, -1)
        own = -0.5 * (scaled * z[:, None]).sum(-1, keepdim=True)
        return torch.cat([scaled, chosen, own], dim=-1).flatten(1)

    def cross(self, inputs: Float[Tensor, "n _"]) -> Float[Tensor, "n G N"]:
        """k_c(z_i, z_j)."""
        rows = inputs.reshape(-1, len(self.table)) @ self.table
        return rows.exp_().view(len(inputs), len(self.latents), -1)

    def diagonal(self, inputs: Float[Tensor, "n _"]) -> Float[Tensor, "n G"]:
        """k_c(z_i, z_i)."""
        return self.variances.expand(len(inputs), -1)


@dataclass(frozen=True, eq=False)
class AnyKernel:
    """One latent with a kernel of any kind."""

    latents: tuple[int]
    kernel: Kernel
    centers: Float[Tensor, "N d"]

    def inputs(self, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n d"]:
        """Its features."""
        return features[self.latents[0]]

    def cross(self, inputs: Float[Tensor, "n d"]) -> Float[Tensor, "n 1 N"]:
        """k(z_i, z_j)."""
        return kernel_cross(self.kernel, inputs, self.centers)[:, None]

    def diagonal(self, inputs: Float[Tensor, "n d"]) -> Float[Tensor, "n 1"]:
        """k(z_i, z_i)."""
        return kernel_diagonal(self.kernel, inputs)[:, None]


KernelGroup = SharedCenters | AnyKernel


@dataclass(frozen=True, eq=False)
class PreparedMean:
    """The posterior mean of all latents from `inputs`, one tensor per group; `weights` are (G, N, 1)."""

    groups: tuple[KernelGroup, ...]
    weights: tuple[Float[Tensor, "G N 1"], ...]
    order: Tensor | None

    @classmethod
    def of(cls, latent: LatentPosterior) -> PreparedMean:
        """Prepared once for a posterior."""
        groups = kernel_groups(latent)
        weights = tuple(torch.stack([latent.weights[c].detach() for c in g.latents])[..., None] for g in groups)
        order = [c for group in groups for c in group.latents]
        back = torch.tensor(order, dtype=torch.long).argsort()
        return cls(groups, weights, None if order == sorted(order) else back.to(latent.features[0].device))

    def inputs(self, features: Sequence[Float[Tensor, "n _"]]) -> list[Float[Tensor, "n _"]]:
        """What the kernels need of the features of all latents, group by group."""
        return [group.inputs(features) for group in self.groups]

    def cross(self, inputs: Sequence[Float[Tensor, "n _"]]) -> list[Float[Tensor, "n G N"]]:
        """Kernel functions about the centres."""
        return [group.cross(x) for group, x in zip(self.groups, inputs, strict=True)]

    def mean(self, cross: Sequence[Float[Tensor, "n G N"]]) -> Float[Tensor, "n C"]:
        """E f_c from what `cross` returned."""
        parts = [torch.bmm(k.transpose(0, 1), w)[..., 0].mT for k, w in zip(cross, self.weights, strict=True)]
        return self._ordered(parts)

    def diagonal(self, inputs: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n C"]:
        """Prior variances."""
        return self._ordered([group.diagonal(x) for group, x in zip(self.groups, inputs, strict=True)])

    def _ordered(self, parts: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n C"]:
        joined = parts[0] if len(parts) == 1 else torch.cat(list(parts), dim=-1)
        return joined if self.order is None else joined[:, self.order]


def kernel_groups(latent: LatentPosterior) -> tuple[KernelGroup, ...]:
    """Latents by what they share."""
    shared: list[tuple[Tensor, list[int]]] = []
    scales: dict[int, tuple[Tensor, Tensor]] = {}
    groups: list[KernelGroup] = []
    for index, (kernel, centers) in enumerate(zip(latent.kernels, latent.features, strict=True)):
        found = squared_exponential_parameters(kernel)
        if found is None:
            groups.append(AnyKernel((index,), kernel, centers))
            continue
        scales[index] = found
        same = next((members for other, members in shared if torch.equal(other, centers)), None)
        if same is None:
            shared.append((centers, [index]))
        else:
            same.append(index)
    for centers, members in shared:
        groups.append(SharedCenters.of(tuple(members), centers, [scales[c] for c in members]))
    return tuple(groups)
