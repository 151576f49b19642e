"""Where physics and Gaussian processes meet: from states and checked forces to (m, W), features, NLL."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.evidence.training_data import RESIDUAL_FLOOR, Standardization, TrainingData
from forcegp.forces import Unknown, UnknownForces
from forcegp.forces.unknown import Scaling
from forcegp.inference import (
    Engine,
    Exact,
    FunctionalPosterior,
    LatentKernels,
    LatentPosterior,
    ProblemSize,
    Terms,
    collapsed_bound,
    negative_log_likelihood,
)
from forcegp.inference.linear_functionals import functional_negative_log_likelihood, weighted
from forcegp.mechanics import ConstrainedDynamics
from forcegp.model import Model
from forcegp.noise import ACCELERATION, FORCE, Noise


def checked_values(forces: UnknownForces, dynamics: ConstrainedDynamics) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Directions (N, nv, C) and features (N, d) of every latent at N states. Raises InvalidInput for anything else."""
    parts = [_checked(term, dynamics) for term in forces.terms]
    return torch.cat([dynamics.H[..., :0], *(B for B, _ in parts)], dim=-1), tuple(z for _, own in parts for z in own)


def _checked(prior: Unknown, dynamics: ConstrainedDynamics) -> tuple[Tensor, tuple[Tensor, ...]]:
    robot, own = dynamics.state.robot, type(prior).__name__
    names = prior.latent_names(robot)
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise InvalidInput(f"{own}.latent_names gives {names!r}; it must give a tuple with a name per latent")
    rows, count = len(dynamics.state.q), len(names)
    B = _tensor(f"{own}.direction", prior.direction(dynamics), (rows, robot.nv, count), "(rows, nv, latents)")
    features = _one_per_latent(f"{own}.features", prior.features(dynamics), names)
    for name, z in zip(names, features, strict=True):
        _tensor(f"{own}.features of {name!r}", z, (rows, None), "(rows, features); one feature is z[..., None]")
    ways = get_args(Scaling)
    for name, given, z in zip(
        names, _one_per_latent(f"{own}.scalings", prior.scalings(robot), names), features, strict=True
    ):
        each = (given,) * z.shape[-1] if isinstance(given, str) else tuple(given)
        if len(each) != z.shape[-1] or not set(each) <= set(ways):
            allowed = ", ".join(map(repr, ways))
            raise InvalidInput(f"{own}.scalings of {name!r} is {given!r}; give one of {allowed}, or one per feature")
    return B, features


def _one_per_latent(what: str, given: Any, names: Any) -> tuple[Any, ...]:
    if not isinstance(given, list | tuple):
        raise InvalidInput(f"{what} gives a {type(given).__name__}; it must give a tuple with an entry per latent")
    if len(given) != len(names):
        raise InvalidInput(f"{what} gives {len(given)} entries for {len(names)} latents ({', '.join(names)})")
    return tuple(given)


def _tensor(what: str, given: Any, shape: tuple[int | None, ...], wanted: str) -> Tensor:
    if not isinstance(given, Tensor):
        raise InvalidInput(f"{what} is a {type(given).__name__}; it must be a float64 tensor {wanted}")
    if len(given.shape) != len(shape) or any(n not in (None, m) for n, m in zip(shape, given.shape, strict=True)):
        sizes = ", ".join("any" if size is None else str(size) for size in shape)
        raise InvalidInput(f"{what} has shape {tuple(given.shape)}; it must be ({sizes}), that is {wanted}")
    if given.dtype != torch.float64:
        raise InvalidInput(f"{what} is {given.dtype}; it must be float64: compute it from the state, or call .double()")
    if given.requires_grad:
        raise InvalidInput(f"{what} requires gradients, but only kernels are learned: detach the tensors that it holds")
    lost = ~torch.isfinite(given).flatten(1).all(1)
    if bool(lost.any()):
        raise InvalidInput(f"{what} is not finite at training row {int(lost.nonzero()[0])}; mend it there")
    return given


@dataclass(frozen=True, eq=False)
class MarginalLikelihood:
    """-log p(a | q, v, u, parameters) of one model on one training set, as a function of unconstrained parameters.

    Parameters by name: those of the kernels, `noise.log_acceleration` (nv,) and optionally `noise.log_force` (nv,). All
    of them receive gradients in one backward pass.
    """

    model: Model
    training: TrainingData
    fixed_standardization: Standardization | None = None
    """That of the reference rows where it is known already; None computes it."""

    @cached_property
    def dynamics(self) -> ConstrainedDynamics:
        """The constrained dynamics of the training states."""
        with torch.no_grad():
            return self.model.dynamics(self.training.q, self.training.v, self.training.u)

    @cached_property
    def standardization(self) -> Standardization:
        """From the features of the reference states."""
        if self.fixed_standardization is not None:
            return self.fixed_standardization
        if self._reference is not None:
            return self._reference.standardization
        forces = self.model.unknown
        return Standardization.of(forces.features(self.dynamics), forces.scalings(self.model.robot))

    @cached_property
    def _reference(self) -> "MarginalLikelihood | None":
        """The same model on the rows that standardise features, where they are others than the training rows."""
        rows = self.training.reference
        return None if rows is None else replace(self, training=rows)

    @cached_property
    def features(self) -> list[Tensor]:
        """Standardised features of the training states."""
        return self.standardization(self.model.unknown.features(self.dynamics))

    @cached_property
    def mixing(self) -> Float[Tensor, "N nv C"]:
        """W = H B of the training states."""
        return self.dynamics.H @ self.model.unknown.direction(self.dynamics)

    @cached_property
    def residual(self) -> Float[Tensor, "N nv"]:
        """a - m; that of a window is repeated for all of its nodes."""
        residual, weights = self.training.a - self.dynamics.acceleration_map().offset, self.training.weights
        if weights is None:
            return residual
        return weighted(weights, residual).repeat_interleave(weights.shape[1], dim=0)

    def terms(self, parameters: Mapping[str, Tensor]) -> Terms:
        """Standardised features, W (N, nv, C), residual a - m (N, nv) and the noise, at `parameters`.

        Of windows, those of all nodes.
        """
        factors, alike = self.training.noise_factors, self.training.correlated_rows
        noise = Noise.covariance(parameters, self.dynamics.H, factors) * alike
        return Terms(self.features, self.mixing, self.residual, noise)

    @cached_property
    def kernels(self) -> LatentKernels:
        """Kernels with moment-based start values.

        Each latent starts with the variance of its least-squares estimate W^+ (a - m), the pseudo-inverse force
        residual. Kernels that have the method `visit` take the range that the rows visit.
        """
        if self.training.reference is not None:  # on whose rows kernels were made
            return replace(self, training=self.training.reference).kernels
        features = self.features
        estimate = (torch.linalg.pinv(self.mixing, rtol=1e-8) @ self.residual[..., None])[..., 0]
        variances = estimate.square().mean(0)
        largest = float(variances.max()) if variances.numel() else 0.0
        if variances.numel() and not largest > 0.0:
            raise InvalidInput(
                "the accelerations equal the mean exactly, so no unknown force can be learned; check that a was "
                "measured and not computed from the model itself"
            )
        variances = variances.clamp_min(RESIDUAL_FLOOR * largest)
        dimensions = tuple(z.shape[-1] for z in features)
        kernels = self.model.unknown.kernels(self.model.robot, dimensions, variances)
        for kernel, z in zip(kernels, features, strict=True):
            for part in kernel.modules():
                visit: Any = getattr(part, "visit", None)
                if visit is not None:
                    visit(z)
        return LatentKernels(kernels).to(variances.device)

    def __call__(self, kernels: LatentKernels, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """The negative log marginal likelihood, exact and differentiable in every parameter.

        Raises InvalidInput for a parameter of a name that means nothing here.
        """
        return self.of_terms(*self.checked_terms(kernels, parameters))

    def checked_terms(
        self, kernels: LatentKernels, parameters: Mapping[str, Tensor]
    ) -> tuple[Terms, list[Float[Tensor, "N N"]]]:
        """Terms and kernel matrices at `parameters`. Raises InvalidInput for a name that means nothing here."""
        known = {*kernels.initial_parameters(), ACCELERATION, FORCE}
        unknown = next((name for name in parameters if name not in known), None)
        if unknown is not None:
            raise InvalidInput(f"no parameter {unknown!r}; there are {', '.join(sorted(known))}")
        terms = self.terms(parameters)
        return terms, kernels.matrices(parameters, terms.features)

    def of_terms(self, terms: Terms, matrices: Sequence[Float[Tensor, "N N"]]) -> Float[Tensor, ""]:
        """-log p of rows, or of windows, with these terms."""
        if self.training.weights is not None:
            return functional_negative_log_likelihood(self.training.weights, terms, matrices)
        return negative_log_likelihood(terms.W, terms.residual, terms.noise, matrices)

    def bound(
        self, kernels: LatentKernels, parameters: Mapping[str, Tensor], points: Sequence[Float[Tensor, "_ _"]]
    ) -> Float[Tensor, ""]:
        """`collapsed_bound` of the same with these inducing points (prepared features) of every latent.

        Where k rows count as one, densities N(a | f, R) are taken to the power of 1/k: N(a | f, k R) times
        |2 pi k R|^(1/2) / |2 pi R|^(1 / (2 k)), so that learned noise stays that of a row.
        """
        terms, k = self.terms(parameters), self.training.correlated_rows
        bound = collapsed_bound(terms, kernels, parameters, points)
        if k == 1.0:
            return bound
        spread = 2.0 * math.pi * terms.noise  # of k R
        logs = spread.log().sum(-1) if spread.ndim == 2 else torch.linalg.slogdet(spread).logabsdet
        rows, outputs = terms.residual.shape
        return bound - 0.5 * ((1.0 - 1.0 / k) * logs.expand(rows).sum() + rows * outputs * math.log(k) / k)

    def condition(
        self,
        kernels: LatentKernels,
        parameters: Mapping[str, Tensor],
        engine: Engine | None = None,
        *,
        start: Tensor | None = None,
        at_parameters: bool = False,
    ) -> LatentPosterior:
        """The posterior of the latent functions at fixed parameters; `start` as for `Engine.condition`.

        Kernels that are `at_parameters` hold them already, and are not copied.
        """
        kernels = kernels if at_parameters else kernels.at(parameters)
        with torch.no_grad():
            terms = self.terms(parameters)
            if self.training.weights is not None:
                return FunctionalPosterior.condition(kernels, self.training.weights, terms)
            return (engine or Exact()).condition(kernels, terms, start=start)

    @property
    def noise(self) -> Noise:
        """The noise of a model that a fit has resolved."""
        assert self.model.noise is not None, "a fitted model has its noise"
        return self.model.noise

    @property
    def split_noise(self) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Noise parameters that are learned, and those that stay."""
        parameters = self.noise.parameters(self.model.robot.nv, self.model.robot.device)
        return (parameters, {}) if self.noise.learn else ({}, parameters)

    @property
    def parameter_shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the parameters that a posterior on these rows needs."""
        named = self.kernels.initial_parameters() | self.noise.parameters(self.model.robot.nv)
        return {name: tuple(value.shape) for name, value in named.items()}


def problem_size(model: Model, rows: int) -> ProblemSize:
    """Of the posterior of so many rows, computing nothing; contacts count as independent and leave some motion."""
    nv, latents = model.robot.nv, len(model.unknown.latent_names(model.robot))
    return ProblemSize(rows, nv, min(latents, max(1, nv - len(model.contacts))), latents, 0)
