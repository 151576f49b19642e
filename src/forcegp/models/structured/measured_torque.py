"""The acceleration under torques from a noisy sensor, whose noise forward dynamics would amplify.

Forward dynamics divides by the inertia: 0.05 Nm of noise at a wrist of 1e-3 kg m^2 are 50 rad/s^2, while the wrist
moves at 1. The torque of a prediction is as noisy as those of the training rows, u = u_true + e with e ~ N(0, F), so at
given forces f the measured u implies a ~ N(a_f, H F H^T), with a_f what the noise-free model computes from u. The
motions of the robot imply a ~ N(0, S). By Bayes' rule

    a | u, f ~ N(G a_f, H F H^T G^T),      G = S (H F H^T + S)^-1,

linear in f, so that everything stays Gaussian; along constraints, where H = 0, nothing changes: A G = A. (Regression
with errors in variables; Carroll et al., "Measurement error in nonlinear models", 2006, section 4.2.) S holds the mean
squares of the training accelerations on its diagonal. Correlations between joints are those of one motion and not of
the next: with them, on two held-out fifths of a recording of a Franka Panda, intervals of 95 % covered 76 to 92 %
and the negative log density was 10.6 nats a row, without them 87 to 100 % and 5.4 (docs/real-robots.md).
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.mechanics import AffineMap
from forcegp.models.noise import FORCE


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
    """G a_f as a function of the unknown force, and the covariance that is left, H F H^T G^T."""
    torque_noise = (H * force_std.square()) @ H.mT
    kept = torch.linalg.solve(torque_noise + moments, moments.expand_as(torque_noise)).mT  # G
    covariance = torque_noise @ kept.mT
    matrix, offset = kept @ acceleration.matrix, (kept @ acceleration.offset[..., None])[..., 0]
    return AffineMap(offset, matrix), 0.5 * (covariance + covariance.mT)


def without_force_noise(parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Parameters of what a measured acceleration has left of noise, once that of the torque counts as unknown."""
    return {name: value for name, value in parameters.items() if name != FORCE}


def plus(covariance: Tensor | None, more: Tensor) -> Tensor | None:
    """The sum, where a covariance was asked for."""
    return None if covariance is None else covariance + more
