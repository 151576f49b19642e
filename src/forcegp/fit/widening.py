"""How much wider than the posterior at the fitted hyper-parameters intervals have to be (docs/how-to/forces.md).

Two things are missing from that posterior; one factor on its standard deviations, found at the training states, makes
up for both. Means do not change.

* Hyper-parameters count as known. Every kind of them (the length scales of all latents, ...) is moved up and down
  together by its standard deviation (Laplace's approximation, Rasmussen & Williams 2006, section 3.4), and the variance
  of the mixture of these posteriors stands for the whole, as with the sigma points of Rue, Martino & Chopin (2009,
  "Approximate Bayesian inference for latent Gaussian models", J. R. Stat. Soc. B 71, section 6.5). Moved one by one,
  the factor was 1.09 instead of 1.04 (medians of 42 fits), for up to half of the time of a fit.
* Where the functions that the data leave open differ in a few numbers only, all intervals of one fit miss together. The
  factor is that of a tolerance interval (Krishnamoorthy & Mathew 2009, "Statistical tolerance regions", section 1.2):
  of the functions drawn from the posterior, `CONFIDENCE` have at least `CONTENT` of their states inside.
"""

import math
import re
from collections.abc import Iterable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import NumericalError
from forcegp.fit.search import MOST_POINTS_FOR_RESTARTS, FitObjective
from forcegp.inference import LatentPosterior
from forcegp.inference.memory import blas_threads
from forcegp.inference.posterior import FactorizedPosterior
from forcegp.posterior import Posterior
from forcegp.posterior.fitted import DEVIATIONS

CONTENT, CONFIDENCE = 0.9, 0.995
"""Share of the states that lie inside their 95 % intervals, in this share of the functions that the data leave open."""

STATES = 24
"""Training states at which functions and variances are compared."""

DRAWS = 2000

LARGEST_STEP = 2.0
"""Most that a parameter is moved by, on its log scale: the spread of the widest prior on one."""

NEGLIGIBLE = 1e-6
"""Standard deviation, as a fraction of the largest, below which a constraint leaves nothing open."""


def widened(posterior: Posterior) -> Posterior:
    """The posterior with its `widening`, at least 1; without latents, itself."""
    if not len(posterior.kernels.kernels):
        return posterior
    with torch.no_grad(), blas_threads(posterior.training.q.numel()):
        states = _States(posterior)
        assert isinstance(posterior.latent, FactorizedPosterior), "fits are exact"
        factor = states.content_factor(posterior.latent)
        if len(posterior.training) <= MOST_POINTS_FOR_RESTARTS:  # beyond, parameters are known well, and searches long
            factor *= states.mixture_factor(posterior)
    return posterior.with_settings(widening=factor)


class _States:
    """Some training states of a posterior, and the accelerations there as linear functions of the latents."""

    def __init__(self, posterior: Posterior) -> None:
        training = posterior.training
        count = len(training.q)
        at = torch.linspace(0, count - 1, min(STATES, count), device=training.q.device).round().long()
        dynamics = posterior.dynamics(training.q[at], training.v[at], training.u[at])
        self.W: Float[Tensor, "n nv C"] = dynamics.H @ posterior.trained.unknown.direction(dynamics)
        self.features = posterior.likelihood.standardization(posterior.trained.unknown.features(dynamics))

    def content_factor(self, latent: FactorizedPosterior) -> float:
        """What makes `CONTENT` of the states lie inside, in `CONFIDENCE` of the functions; at least 1."""
        n, nv, latents = self.W.shape
        # every state has latents of its own: (n nv) accelerations from (C n) values
        apart = torch.diag_embed(self.W.permute(1, 2, 0)).permute(2, 0, 1, 3)
        linear = apart.reshape(n * nv, latents * n)
        covariance = linear @ latent.joint_covariance(self.features) @ linear.mT
        std = covariance.diagonal().clamp_min(0.0).sqrt()
        open_ones = std > NEGLIGIBLE * std.max()
        if not bool(open_ones.any()):
            return 1.0
        values, vectors = torch.linalg.eigh(0.5 * (covariance + covariance.mT))
        generator = torch.Generator(device=std.device).manual_seed(0)
        normal = torch.randn(len(values), DRAWS, generator=generator, dtype=std.dtype, device=std.device)
        drawn = (vectors * values.clamp_min(0.0).sqrt()) @ normal
        inside = torch.quantile((drawn[open_ones] / std[open_ones, None]).abs(), CONTENT, dim=0)
        return max(1.0, float(torch.quantile(inside, CONFIDENCE)) / DEVIATIONS)

    def mixture_factor(self, posterior: Posterior) -> float:
        """Standard deviations with the hyper-parameters unknown, over those with them known; at least 1."""
        likelihood, kernels = posterior.likelihood, posterior.kernels
        _, fixed = likelihood.split_noise
        free = {name: value for name, value in posterior.hyperparameters.items() if name not in fixed}
        objective = FitObjective(likelihood, kernels, likelihood.noise, fixed)

        here = float(objective(free))
        mean, variance = self._moments(posterior.latent)
        more = torch.zeros_like(variance)
        scratch = kernels.at(free)
        for names in _kinds(free):
            try:
                # at an optimum the objective rises by half of the curvature
                curvature = 2.0 * (float(objective(_moved(free, names, 1.0))) - here)
            except (NumericalError, torch.linalg.LinAlgError):
                continue
            step = min(LARGEST_STEP, max(curvature, LARGEST_STEP**-2) ** -0.5)
            for sign in (1.0, -1.0):
                moved = _moved(free, names, sign * step) | fixed
                try:
                    other = self._moments(likelihood.condition(scratch.moved_to(moved), moved, at_parameters=True))
                except (NumericalError, torch.linalg.LinAlgError):
                    continue  # no posterior there: nothing that the data leave open
                more += 0.5 * ((other[0] - mean).square() + other[1] - variance)
        total = float(variance.mean())
        return math.sqrt(max(1.0, 1.0 + float(more.mean()) / total)) if total > 0.0 else 1.0

    def _moments(self, latent: LatentPosterior) -> tuple[Tensor, Tensor]:
        """Mean and variance (n, nv) of the accelerations that the latents make."""
        mean = (self.W @ latent.mean(self.features)[..., None])[..., 0]
        covariance = self.W @ latent.covariance(self.features) @ self.W.mT
        return mean, covariance.diagonal(dim1=-2, dim2=-1)


def _kinds(names: Iterable[str]) -> list[list[str]]:
    """Parameters that differ in the latent that they belong to only, `kernels.<number>.<kind>`."""
    kinds: dict[str, list[str]] = {}
    for name in names:
        kinds.setdefault(re.sub(r"^kernels\.\d+\.", "", name), []).append(name)
    return list(kinds.values())


def _moved(parameters: Mapping[str, Tensor], names: Iterable[str], step: float) -> dict[str, Tensor]:
    return {**parameters, **{name: parameters[name] + step for name in names}}
