"""Where physics and Gaussian processes meet: from states and a checked prior to (m, W), features, NLL; the model."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, get_args

import torch
from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, usable_arguments
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
from forcegp.mechanics import ConstrainedDynamics, MechanicalSystem
from forcegp.models.identification.physical_parameters import COEFFICIENTS, INERTIALS, coefficients_of, inertials_of
from forcegp.models.protocol import Model
from forcegp.models.search import check_system_and_noise
from forcegp.models.training_data import ACCELERATION, FORCE, RESIDUAL_FLOOR, Noise, Standardization, TrainingData
from forcegp.priors import ForcePrior, JointForces
from forcegp.priors.force_prior import Scaling


def checked_values(prior: ForcePrior, dynamics: ConstrainedDynamics) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Mixing (N, nv, C) and features (N, d) of every latent at N states. Raises InvalidInput for anything else."""
    robot, own = dynamics.state.robot, type(prior).__name__
    names = prior.latent_names(robot)
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise InvalidInput(f"{own}.latent_names gives {names!r}; it must give a tuple with a name per latent")
    rows, count = len(dynamics.state.q), len(names)
    B = _tensor(f"{own}.mixing", prior.mixing(dynamics), (rows, robot.nv, count), "(rows, nv, latents)")
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


Mean = Literal["analytical", "zero"]


@dataclass(frozen=True, eq=False)
class MarginalLikelihood:
    """-log p(a | q, v, u, parameters) of one model on one training set, as a function of unconstrained parameters.

    Parameters by name: those of the kernels, `noise.log_acceleration` (nv,), optionally `noise.log_force` (nv,), and
    optionally `inertials.<link>` (10,) log-Cholesky parameters of links and `coefficients.<known force>` (nv,). All of
    them receive gradients in one backward pass.
    """

    system: MechanicalSystem
    prior: ForcePrior
    mean: Mean
    training: TrainingData
    fixed_standardization: Standardization | None = None
    """That of the reference rows where it is known already; None computes it."""

    def dynamics(self, parameters: Mapping[str, Tensor] | None = None) -> ConstrainedDynamics:
        """The constrained dynamics of the training states, at the physical parameters among `parameters`."""
        inertials, coefficients = inertials_of(parameters or {}), coefficients_of(parameters or {})
        if not inertials and not coefficients and not self._known_forces_are_learned:
            return self._nominal_dynamics
        system = self.system.with_coefficients(coefficients) if coefficients else self.system
        return system.dynamics(self.training.q, self.training.v, self.training.u, inertials)

    @property
    def _known_forces_are_learned(self) -> bool:
        """Whether a tensor inside a known force wants a gradient; then nothing that depends on it may be kept."""
        forces = self.system.known_forces
        values = [getattr(force, name) for force in forces for name in force.per_joint]
        return any(isinstance(value, Tensor) and value.requires_grad for value in values)

    @cached_property
    def _nominal_dynamics(self) -> ConstrainedDynamics:
        with torch.no_grad():
            return self.system.dynamics(self.training.q, self.training.v, self.training.u)

    @cached_property
    def standardization(self) -> Standardization:
        """From the features of the reference states, at the nominal inertial parameters."""
        if self.fixed_standardization is not None:
            return self.fixed_standardization
        if self._reference is not None:
            return self._reference.standardization
        scalings = self.prior.scalings(self.system.robot)
        return Standardization.of(self.prior.features(self._nominal_dynamics), scalings)

    @cached_property
    def _reference(self) -> "MarginalLikelihood | None":
        """The same model on the rows that standardise features, where they are others than the training rows."""
        rows = self.training.reference
        return None if rows is None else replace(self, training=rows)

    @cached_property
    def _nominal_features(self) -> list[Tensor]:
        return self.standardization(self.prior.features(self._nominal_dynamics))

    @cached_property
    def _nominal_mixing(self) -> Tensor:
        return self._nominal_dynamics.H @ self.prior.mixing(self._nominal_dynamics)

    def terms(self, parameters: Mapping[str, Tensor]) -> Terms:
        """Standardised features, W (N, nv, C), residual a - m (N, nv) and the noise, at `parameters`.

        Of windows, those of all nodes; the residual of a window is repeated for all of its nodes.
        """
        dynamics = self.dynamics(parameters)
        residual = self.training.a - dynamics.acceleration_map(known=self.mean == "analytical").offset
        weights = self.training.weights
        if weights is not None:
            residual = weighted(weights, residual).repeat_interleave(weights.shape[1], dim=0)
        noise = Noise.covariance(parameters, dynamics.H, self.training.noise_factors) * self.training.correlated_rows
        if dynamics is self._nominal_dynamics:
            return Terms(self._nominal_features, self._nominal_mixing, residual, noise)
        # shifted and scaled at these parameters, as a posterior does that has them in its system
        given = self.prior.features(dynamics)
        rows = self if self._reference is None else self._reference
        by = given if rows is self else self.prior.features(rows.dynamics(parameters))
        features = Standardization.of(by, self.prior.scalings(self.system.robot))(given)
        return Terms(features, dynamics.H @ self.prior.mixing(dynamics), residual, noise)

    def kernels(self, parameters: Mapping[str, Tensor] | None = None) -> LatentKernels:
        """Kernels with moment-based start values, at the physical parameters among `parameters`.

        Each latent starts with the variance of its least-squares estimate W^+ (a - m), the pseudo-inverse force
        residual. Kernels that have the method `visit` take the range that the rows visit.
        """
        if self.training.reference is not None:  # on whose rows kernels were made
            return replace(self, training=self.training.reference).kernels(parameters)
        any_noise = {ACCELERATION: torch.zeros_like(self.training.a[0])}
        with torch.no_grad():
            features, W, residual, _ = self.terms({**any_noise, **(parameters or {})})
        estimate = (torch.linalg.pinv(W, rtol=1e-8) @ residual[..., None])[..., 0]
        variances = estimate.square().mean(0)
        largest = float(variances.max()) if variances.numel() else 0.0
        if variances.numel() and not largest > 0.0:
            raise InvalidInput(
                "the accelerations equal the mean exactly, so no unknown force can be learned; check that a was "
                "measured and not computed from the model itself"
            )
        variances = variances.clamp_min(RESIDUAL_FLOOR * largest)
        dimensions = tuple(z.shape[-1] for z in features)
        kernels = self.prior.kernels(self.system.robot, dimensions, variances)
        own = type(self.prior).__name__
        if not isinstance(kernels, list | tuple) or not all(isinstance(kernel, Kernel) for kernel in kernels):
            raise InvalidInput(f"{own}.kernels must give a tuple of GPyTorch kernels, one per latent")
        if len(kernels) != len(dimensions):
            raise InvalidInput(f"{own}.kernels gives {len(kernels)} kernels for {len(dimensions)} latents")
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
        known = {*kernels.initial_parameters(), ACCELERATION, FORCE}
        physical = (INERTIALS, COEFFICIENTS)
        unknown = next((name for name in parameters if name not in known and not name.startswith(physical)), None)
        if unknown is not None:
            raise InvalidInput(
                f"no parameter {unknown!r}; there are {', '.join(sorted(known))}, {INERTIALS}<link> and "
                f"{COEFFICIENTS}<known force>"
            )
        terms = self.terms(parameters)
        features, W, residual, noise = terms
        matrices = kernels.matrices(parameters, features)
        if self.training.weights is not None:
            return functional_negative_log_likelihood(self.training.weights, terms, matrices)
        return negative_log_likelihood(W, residual, noise, matrices)

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


@dataclass(frozen=True, eq=False)
class StructuredModel(Model):
    """The fields of a `StructuredGP`, checked, and the likelihood that they define."""

    system: MechanicalSystem
    prior: ForcePrior = field(default_factory=JointForces)
    mean: Mean = "analytical"
    noise: Noise | None = None

    @usable_arguments("StructuredModel")
    def __post_init__(self) -> None:
        check_system_and_noise(self)
        if not isinstance(self.prior, ForcePrior):
            raise InvalidInput(f"prior is a {type(self.prior).__name__}; give a ForcePrior, for example JointForces()")
        if self.mean not in get_args(Mean):
            raise InvalidInput(f"mean is {self.mean!r}; allowed: {', '.join(map(repr, get_args(Mean)))}")
        self.prior.check(self.system)

    def likelihood(self, training: TrainingData) -> MarginalLikelihood:
        """That of these rows or windows."""
        return MarginalLikelihood(self.system, self.prior, self.mean, training)

    def problem_size(self, rows: int) -> ProblemSize:
        """Of the posterior of so many rows, computing nothing; contacts count as independent and leave some motion."""
        nv, latents = self.system.robot.nv, len(self.prior.latent_names(self.system.robot))
        return ProblemSize(rows, nv, min(latents, max(1, nv - len(self.system.contacts))), latents, 0)

    @property
    def known_noise(self) -> Noise:
        """The noise of a model that a fit has resolved."""
        assert self.noise is not None, "a fitted model has its noise"
        return self.noise

    @property
    def split_noise(self) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Noise parameters that are learned, and those that stay."""
        parameters = self.known_noise.parameters(self.system.robot.nv, self.system.robot.device)
        return (parameters, {}) if self.known_noise.learn else ({}, parameters)

    @override
    def parameter_shapes(self, training: TrainingData) -> dict[str, tuple[int, ...]]:
        noise = (self.noise or Noise()).parameters(self.system.robot.nv)
        named = self.likelihood(training).kernels().initial_parameters() | noise
        return {name: tuple(value.shape) for name, value in named.items()}
