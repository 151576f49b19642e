"""Kernel functions of all latents about the centres of a posterior, prepared for many calls with few points.

Scaled squared exponentials of latents that share their centres are one matrix product and one exponential:

    log k_c(z, z_j) = log s_c - 1/2 |z / l_c|^2 + (z / l_c^2) . z_j - 1/2 |z_j / l_c|^2

is one matrix product with the centres for all of them. Every other kernel is evaluated by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.inference.dense_kernels import DenseKernel
from forcegp.inference.kernel_matrices import squared_exponential_parameters
from forcegp.inference.kernel_sums import KernelSum
from forcegp.inference.posterior import LatentPosterior


@dataclass(frozen=True, eq=False)
class SharedCenters:
    """Squared exponentials of latents with the same centres (N, d), which are given about their mean `shift`."""

    latents: tuple[int, ...]
    shift: Float[Tensor, " d"]
    centers: Float[Tensor, "N d"]
    precisions: Float[Tensor, "G d"]  # 1 / l^2
    variances: Float[Tensor, " G"]
    own: Float[Tensor, "G N"]  # log s - 1/2 |z_j / l|^2
    own_centers: Float[Tensor, "N d"]  # as they are in the posterior

    @classmethod
    def of(
        cls, latents: tuple[int, ...], centers: Float[Tensor, "N d"], scales: Sequence[tuple[Tensor, Tensor]]
    ) -> SharedCenters:
        """`scales` are the length scales and the variance of every latent."""
        precisions = torch.stack([length.detach().expand(centers.shape[-1]) ** -2 for length, _ in scales])
        variances = torch.stack([variance.detach().reshape(()) for _, variance in scales])
        given, shift = centers, centers.mean(0)
        centers = centers - shift  # or what cancels would be large
        return cls(
            latents,
            shift,
            centers,
            precisions,
            variances,
            variances.log()[:, None] - 0.5 * precisions @ centers.square().mT,
            given,
        )

    def inputs(self, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n _"]:
        """z / l^2 and -1/2 |z / l|^2 of all latents, (n, G (d + 1)) flattened."""
        z = (features[self.latents[0]] - self.shift)[:, None]
        scaled = z * self.precisions
        return torch.cat([scaled, -0.5 * (scaled * z).sum(-1, keepdim=True)], dim=-1).flatten(1)

    def cross(self, inputs: Float[Tensor, "n _"]) -> Float[Tensor, "n G N"]:
        """k_c(z_i, z_j)."""
        rows = inputs.view(len(inputs), len(self.latents), -1)
        products = (rows[..., :-1].flatten(0, 1) @ self.centers.mT).view(*rows.shape[:2], -1)
        return (products + self.own + rows[..., -1:]).exp_()

    def diagonal(self, inputs: Float[Tensor, "n _"]) -> Float[Tensor, "n G"]:
        """k_c(z_i, z_i)."""
        return self.variances.expand(len(inputs), -1)

    def pair(self, z: Float[Tensor, "1 d"], center: Float[Tensor, "1 d"]) -> Float[Tensor, "1 G"]:
        """k_c(z, z_j) - s_c from the features themselves: with long length scales k is nearly s, and sums cancel."""
        z, center = z - self.shift, center - self.shift
        scaled = z * self.precisions
        own = -0.5 * (self.precisions * center.square()).sum(-1)
        return self.variances * (((scaled * center).sum(-1) + own) - 0.5 * (scaled * z).sum(-1)).expm1()

    @property
    def level(self) -> tuple[float, ...]:
        """What `pair` leaves out."""
        return tuple(self.variances.tolist())

    def variances_at(self, z: Float[Tensor, "1 d"]) -> Float[Tensor, "1 G"]:
        """k_c(z, z)."""
        return self.variances[None]


@dataclass(frozen=True, eq=False)
class AnyKernel:
    """One latent with a kernel of any kind."""

    latents: tuple[int]
    kernel: DenseKernel
    centers: Float[Tensor, "N d"]

    def inputs(self, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n d"]:
        """Its features."""
        return features[self.latents[0]]

    def cross(self, inputs: Float[Tensor, "n d"]) -> Float[Tensor, "n 1 N"]:
        """k(z_i, z_j)."""
        return self.kernel.cross(inputs, self.centers)[:, None]

    def diagonal(self, inputs: Float[Tensor, "n d"]) -> Float[Tensor, "n 1"]:
        """k(z_i, z_i)."""
        return self.kernel.diagonal(inputs)[:, None]

    def pair(self, z: Float[Tensor, "1 d"], center: Float[Tensor, "1 d"]) -> Float[Tensor, "1 1"]:
        """k(z, z_j)."""
        return self.kernel.cross(z, center)

    @property
    def own_centers(self) -> Float[Tensor, "N d"]:
        """As they are in the posterior."""
        return self.centers

    @property
    def level(self) -> tuple[float, ...]:
        """What `pair` leaves out."""
        return (0.0,)

    def variances_at(self, z: Float[Tensor, "1 d"]) -> Float[Tensor, " 1"]:
        """k(z, z)."""
        return self.kernel.diagonal(z)


KernelGroup = SharedCenters | AnyKernel


@dataclass(frozen=True, eq=False)
class PreparedKernels:
    """The kernels of all latents by what they share, and the weights of the posterior mean."""

    groups: tuple[KernelGroup, ...]
    weights: tuple[Float[Tensor, "_ _"], ...]
    order: Tensor | None

    @classmethod
    def of(cls, latent: LatentPosterior) -> PreparedKernels:
        """Prepared once for a posterior."""
        groups = kernel_groups(latent)
        weights = tuple(torch.stack([latent.weights[c].detach() for c in group.latents]) for group in groups)
        order = [c for group in groups for c in group.latents]
        back = None if order == sorted(order) else torch.tensor(order).argsort().to(weights[0].device)
        return cls(groups, weights, back)

    def sums(self) -> tuple[KernelSum, ...]:
        """The groups as C functions. Raises InvalidInput for a kernel that cannot be traced."""
        found = []
        for k, (group, weights) in enumerate(zip(self.groups, self.weights, strict=True)):
            given = (group.own_centers, weights, group.pair, group.variances_at, group.level)
            found.append(KernelSum.of(f"latents{k}", group.latents, *given))
        return tuple(found)

    def inputs(self, features: Sequence[Float[Tensor, "n _"]]) -> list[Float[Tensor, "n _"]]:
        """What the kernels need of the features of all latents, group by group."""
        return [group.inputs(features) for group in self.groups]

    def mean(self, inputs: Sequence[Float[Tensor, "n _"]]) -> tuple[Float[Tensor, "n C"], list[Float[Tensor, "n _ _"]]]:
        """E f_c, and the kernel functions of every group about its centres."""
        cross = [group.cross(x) for group, x in zip(self.groups, inputs, strict=True)]
        return self.ordered([(k * w).sum(-1) for k, w in zip(cross, self.weights, strict=True)]), cross

    def diagonal(self, inputs: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n C"]:
        """Prior variances."""
        return self.ordered([group.diagonal(x) for group, x in zip(self.groups, inputs, strict=True)])

    def ordered(self, parts: Sequence[Float[Tensor, "n _ ..."]]) -> Float[Tensor, "n C ..."]:
        """Values of all latents in the order of the posterior, from those of every group."""
        joined = parts[0] if len(parts) == 1 else torch.cat(list(parts), dim=1)
        return joined if self.order is None else joined[:, self.order]


def kernel_groups(latent: LatentPosterior) -> tuple[KernelGroup, ...]:
    """Latents by what they share."""
    shared: list[tuple[Tensor, list[int]]] = []
    scales: dict[int, tuple[Tensor, Tensor]] = {}
    groups: list[KernelGroup] = []
    for index, (kernel, centers) in enumerate(zip(latent.kernels, latent.features, strict=True)):
        found = squared_exponential_parameters(kernel)
        if found is None:
            groups.append(AnyKernel((index,), latent.kernels.dense[index], centers))
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
