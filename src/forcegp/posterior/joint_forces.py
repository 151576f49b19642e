"""Joint forces of a posterior beside its functions: noise, what contacts hid from a log, what accelerations tell."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.evidence.likelihood import observed
from forcegp.mechanics import AffineMap, ConstrainedDynamics
from forcegp.posterior.prediction import Gaussian, Rows


def joint_forces_given(
    latents: Gaussian,
    B: Float[Tensor, "rows nv C"],
    extra: Float[Tensor, "*rows nv nv"] | None,
    acceleration: AffineMap,
    seen: tuple[Rows, Float[Tensor, " nv"]] | None,
) -> tuple[Gaussian, Gaussian]:
    """Joint forces B f + e with e ~ N(0, `extra`), and B f alone: given accelerations that were `seen`, if any.

    a = offset + H (B f + e) + N(0, s^2) with (a, s) = `seen`: a normal distribution conditioned on a part of it
    (Rasmussen & Williams 2006, eq. A.6).
    """
    learned = latents.through(B)
    if extra is None:
        extra = torch.zeros_like(acceleration.matrix[..., :1, :1])
    whole = Gaussian(learned.mean, None if learned.covariance is None else learned.covariance + extra)
    if seen is None:
        return whole, learned
    assert whole.covariance is not None, "as above"
    a, std = seen
    H, missed = acceleration.matrix, a - acceleration(learned.mean)
    V = H @ whole.covariance @ H.mT + torch.diag_embed(std.square())

    def given(prior: Gaussian, across: Tensor) -> Gaussian:
        gain = torch.linalg.solve(V, across.mT).mT
        covariance: Tensor = prior.covariance - gain @ across.mT  # type: ignore[operator]  # `predict` computes it
        return Gaussian(prior.mean + (gain @ missed[..., None])[..., 0], 0.5 * (covariance + covariance.mT))

    assert learned.covariance is not None, "as above"
    return given(whole, whole.covariance @ H.mT), given(learned, learned.covariance @ H.mT)


SHARP = 1e-9  # of what evidence shows of hidden torques, the variance that conditioning on it leaves: rounding


def hidden_forces(
    hidden: Float[Tensor, " nv"], dynamics: ConstrainedDynamics, sensors: Sequence[str]
) -> Float[Tensor, "rows nv nv"]:
    """The covariance of joint forces of these standard deviations that nothing showed.

    What changes accelerations, or what `sensors` measure, was seen and is not among them: N(0, h^2) given that
    H e = 0 and C e = 0, which is (A h^-2 A^T)^-1 for the multipliers of independent contacts.
    """
    prior, G = torch.diag(hidden.square()), observed(dynamics, sensors).matrix
    across = prior @ G.mT
    V = G @ across
    V = V + SHARP * V.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] * torch.eye(V.shape[-1]).to(V)
    left = prior - across @ torch.linalg.solve(V, across.mT)
    return 0.5 * (left + left.mT)
