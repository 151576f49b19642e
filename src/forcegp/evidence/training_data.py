"""What a model is conditioned on: rows or windows with standardised features, which touch its contacts."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.data import Dataset
from forcegp.errors import ContactError, DataWarning, InvalidInput
from forcegp.evidence.evidence import WindowedRows
from forcegp.forces import Scaling
from forcegp.mechanics import AffineMap
from forcegp.model import Model

CONSTANT = 1e-12
"""Spread of a feature, relative to 1 plus its size, below which it is constant."""
RESIDUAL_FLOOR = 1e-6
"""Smallest start variance of a latent over the largest: one that the start residual misses can still grow."""


@dataclass(frozen=True, eq=False)
class TrainingData:
    """States and measured accelerations (N, nv), float64; `noise_std` where the data state the noise of every row.

    `reference` holds the rows that features are standardised by and that the level of the noise refers to, where they
    are not these rows themselves: then parameters mean the same as for the reference, on which they were fitted.

    With `weights` (see `forcegp.data.WindowedRows`) the rows are nodes of windows, one window after the other, and what
    was measured is the weighted sum of the accelerations of each; `a` and `noise_std` of a window are repeated for all
    of its nodes.

    Errors of filtered and resampled logs resemble each other from row to row. Where they do over `correlated_rows`, as
    many rows count as one: the covariance of each in the likelihood is so many times that of its noise.
    """

    q: Float[Tensor, "N nq"]
    v: Float[Tensor, "N nv"]
    u: Float[Tensor, "N nu"]
    a: Float[Tensor, "N nv"]
    noise_std: Float[Tensor, "N nv"] | None = None
    reference: "TrainingData | None" = None
    weights: Float[Tensor, "windows nodes"] | None = None
    correlated_rows: float = 1.0

    def __len__(self) -> int:
        """How many observations there are: rows, or windows."""
        return len(self.q if self.weights is None else self.weights)

    @classmethod
    def of(cls, given: Dataset | WindowedRows, device: torch.device) -> "TrainingData":
        """Copies of all rows of a Dataset, or of all windows."""
        rows = given.nodes if isinstance(given, WindowedRows) else given
        weights = torch.tensor(given.weights, device=device) if isinstance(given, WindowedRows) else None
        noise = rows.noise_std if rows.noise_std is not None and rows.noise_std.ndim == 2 else None
        noise_std = None if noise is None else torch.tensor(noise, device=device)
        states = (torch.tensor(x, device=device) for x in (rows.q, rows.v, rows.u, rows.a))
        return cls(*states, noise_std=noise_std, weights=weights)

    def to(self, device: torch.device) -> "TrainingData":
        """The same rows on another device."""
        return replace(self, **{name: x.to(device) for name, x in vars(self).items() if hasattr(x, "to")})

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
    ) -> "Standardization":
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


def second_moments(a: Float[Tensor, "N nv"]) -> Float[Tensor, "nv nv"]:
    """S of accelerations; a joint that never moved counts as moving a millionth as much as the others."""
    squares = a.square().mean(0)
    return torch.diag_embed(squares + 1e-12 * squares.sum())


def shrunk(
    acceleration: AffineMap,
    H: Float[Tensor, "*batch nv nv"],
    force_std: Float[Tensor, "nv"],
    moments: Float[Tensor, "nv nv"],
) -> tuple[AffineMap, Float[Tensor, "*batch nv nv"]]:
    """G a_f as a function of the unknown force, and the covariance that is left, H F H^T G^T.

    Forward dynamics divides by the inertia: 0.05 Nm of noise at a wrist of 1e-3 kg m^2 are 50 rad/s^2, while the wrist
    moves at 1. The torque of a prediction is as noisy as those of the training rows, u = u_true + e with e ~ N(0, F),
    so at given forces f the measured u implies a ~ N(a_f, H F H^T), with a_f what the noise-free model computes from u.
    The motions of the robot imply a ~ N(0, S). By Bayes' rule

        a | u, f ~ N(G a_f, H F H^T G^T),      G = S (H F H^T + S)^-1,

    linear in f, so that everything stays Gaussian; along constraints, where H = 0, nothing changes: A G = A.
    (Regression with errors in variables; Carroll et al., "Measurement error in nonlinear models", 2006, section 4.2.) S
    is diagonal: correlations between joints are those of one motion and not of the next. With them, on two held-out
    fifths of a recording of a Franka Panda, intervals of 95 % covered 76 to 92 % and the negative log density was 10.6
    nats a row, without them 87 to 100 % and 5.4 (docs/benchmarks/real-robots.md).
    """
    torque_noise = (H * force_std.square()) @ H.mT
    kept = torch.linalg.solve(torque_noise + moments, moments.expand_as(torque_noise)).mT  # G
    covariance = torque_noise @ kept.mT
    matrix, offset = kept @ acceleration.matrix, (kept @ acceleration.offset[..., None])[..., 0]
    return AffineMap(offset, matrix), 0.5 * (covariance + covariance.mT)


FAR_FROM_SURFACE = 0.01
"""Median distance of the training points from a contact's surface, in m, beyond which a warning is given."""


def check_distance(model: Model, training: TrainingData) -> None:
    """Refuse a surface that no training state touches, and warn where half of them are far from it."""
    kinematics = model.robot.kinematics(training.q)
    for index, contact in enumerate(model.contacts):
        # divided by |s_p|, which is 1 for signed distances, the value of any surface is a distance near it
        size = torch.linalg.vector_norm(contact.surface.gradient(contact.position(kinematics)), dim=-1)
        distances = (contact.distance(kinematics) / size).abs()
        distance = float(distances.median())
        what = f"the surface of contact {index} (frame {contact.frame!r})"
        remedy = "check its surface, point and units (m), or leave the contact out"
        if float(distances.min()) > FAR_FROM_SURFACE:
            raise ContactError(
                f"no training point touches {what}: the nearest is {float(distances.min()):.3g} m away, half of them "
                f"more than {distance:.3g} m; {remedy}"
            )
        if distance > FAR_FROM_SURFACE:
            _warn(
                f"half of the training points lie more than {distance:.3g} m from {what}; {remedy}, or train on the "
                "rows in contact only (forcegp.data.rows_in_contact)"
            )


def _warn(text: str) -> None:
    warnings.warn(text, DataWarning, stacklevel=6)
