"""The rows or windows that a model is conditioned on, and how their features are standardised."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.data import Dataset, Windows
from forcegp.errors import InvalidInput
from forcegp.priors import Scaling

CONSTANT = 1e-12
"""Spread of a feature, relative to 1 plus its size, below which it is constant."""
RESIDUAL_FLOOR = 1e-6
"""Smallest start variance of a latent as a fraction of the largest: a latent that the start residual does not
excite can still grow.
"""


@dataclass(frozen=True, eq=False)
class TrainingData:
    """States and measured accelerations (N, nv), float64; `noise_std` where the data state the noise of every row.

    `reference` holds the rows that features are standardised by and that the level of the noise refers to, where they
    are not these rows themselves: then parameters mean the same as for the reference, on which they were fitted.

    With `weights` (see `forcegp.data.Windows`) the rows are the nodes of windows, one window after the other, and what
    was measured is the weighted sum of the accelerations of each; `a` and `noise_std` of a window are repeated for all
    of its nodes.
    """

    q: Float[Tensor, "N nv"]
    v: Float[Tensor, "N nv"]
    u: Float[Tensor, "N nv"]
    a: Float[Tensor, "N nv"]
    noise_std: Float[Tensor, "N nv"] | None = None
    reference: TrainingData | None = None
    weights: Float[Tensor, "windows nodes"] | None = None

    def __len__(self) -> int:
        """How many observations there are: rows, or windows."""
        return len(self.q if self.weights is None else self.weights)

    @classmethod
    def of(cls, given: Dataset | Windows, device: torch.device) -> TrainingData:
        """Copies of all rows of a Dataset, or of all windows."""
        rows = given.nodes if isinstance(given, Windows) else given
        weights = torch.tensor(given.weights, device=device) if isinstance(given, Windows) else None
        noise = rows.noise_std if rows.noise_std is not None and rows.noise_std.ndim == 2 else None
        noise_std = None if noise is None else torch.tensor(noise, device=device)
        states = (torch.tensor(x, device=device) for x in (rows.q, rows.v, rows.u, rows.a))
        return cls(*states, noise_std=noise_std, weights=weights)

    def to(self, device: torch.device) -> TrainingData:
        """The same rows on another device."""
        states = (getattr(self, name).to(device) for name in ("q", "v", "u", "a"))
        noise_std = None if self.noise_std is None else self.noise_std.to(device)
        reference = None if self.reference is None else self.reference.to(device)
        weights = None if self.weights is None else self.weights.to(device)
        return TrainingData(*states, noise_std=noise_std, reference=reference, weights=weights)

    @property
    def noise_factors(self) -> Float[Tensor, "N nv"] | None:
        """The noise of every row over its root mean square, joint by joint; None where all rows are equally noisy.

        Raises InvalidInput where only these rows or only their reference state the noise of every row.
        """
        level = self.noise_std if self.reference is None else self.reference.noise_std
        if (self.noise_std is None) != (level is None):
            raise InvalidInput(
                "only some of the rows state the noise of every row (noise_std of shape (rows, nv)); state it for all "
                "rows or for none, since the fitted noise is relative to it."
            )
        return None if level is None or self.noise_std is None else self.noise_std / level.square().mean(0).sqrt()


@dataclass(frozen=True, eq=False)
class Standardization:
    """Shift and scale of each latent's features, from the training points; constant features keep scale 1."""

    shift: tuple[Float[Tensor, "_"], ...]
    scale: tuple[Float[Tensor, "_"], ...]

    @classmethod
    def of(
        cls, features: Sequence[Float[Tensor, "N _"]], scalings: Sequence[tuple[Scaling, ...] | Scaling] | None = None
    ) -> Standardization:
        """As `scalings` say for each latent or each of its features; None shifts and scales all of them."""
        scalings = ("standardize",) * len(features) if scalings is None else scalings
        shifts, scales = [], []
        for z, given in zip(features, scalings, strict=True):
            ways = (given,) * z.shape[-1] if isinstance(given, str) else given
            shifted = torch.tensor([way == "standardize" for way in ways], dtype=torch.bool, device=z.device)
            scaled = torch.tensor([way != "none" for way in ways], dtype=torch.bool, device=z.device)
            shift = torch.where(shifted, z.mean(0), torch.zeros_like(z[0]))
            size = (z - shift).square().mean(0)
            # below rounding of the values themselves a feature counts as constant; the root comes after that choice,
            # for its derivative at 0 is infinite
            varies = scaled & (size > (CONSTANT * (1.0 + shift.abs())).square())
            shifts.append(shift)
            scales.append(torch.where(varies, size, torch.ones_like(size)).sqrt())
        return cls(tuple(shifts), tuple(scales))

    def __call__(self, features: Sequence[Float[Tensor, "*batch _"]]) -> list[Float[Tensor, "*batch _"]]:
        """Standardised features."""
        return [(z - m) / s for z, m, s in zip(features, self.shift, self.scale, strict=True)]
