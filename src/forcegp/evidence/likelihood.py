"""Where physics and Gaussian processes meet: rows, from states and checked forces to (m, W), features, likelihood."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.data import Dataset
from forcegp.data.dataset import FORCE as OF_SENSOR
from forcegp.data.imu import specific_force
from forcegp.errors import ContactError, DataWarning, InvalidInput
from forcegp.forces import Scaling, Unknown, UnknownForces
from forcegp.inference import Engine, Exact, LatentKernels, LatentPosterior, ProblemSize, Terms, negative_log_likelihood
from forcegp.mechanics import AffineMap, ConstrainedDynamics
from forcegp.model import Model
from forcegp.noise import ACCELERATION, FORCE, STATED, Noise

CONSTANT = 1e-12  # spread of a feature, relative to 1 plus its size, below which it is constant
RESIDUAL_FLOOR = 1e-6
"""Smallest start variance of a latent over the largest: one that the start residual misses can still grow."""


@dataclass(frozen=True, eq=False)
class TrainingData:
    """States and measured accelerations (N, nv), float64, and what sensors measured (N, 3), as `Dataset.measured`.

    `reference` holds the rows that features are standardised by, where they are others. Where errors resemble each
    other over `correlated_rows`, as many rows count as one.
    """

    q: Float[Tensor, "N nq"]
    v: Float[Tensor, "N nv"]
    u: Float[Tensor, "N nu"]
    a: Float[Tensor, "N nv"]
    reference: "TrainingData | None" = None
    correlated_rows: float = 1.0
    strokes: Float[Tensor, "N nv strokes"] | None = None
    sensed: Mapping[str, Float[Tensor, "N 3"]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.q)

    @classmethod
    def of(cls, rows: Dataset, device: torch.device, names: Iterable[str] = ()) -> "TrainingData":
        """Copies of all rows, and of what sensors measured, where IMUs are mounted as `names` say. InvalidInput."""
        frames = [name.partition("@")[0] for name in rows.measured]
        alone = ((frame, x) for frame, x in zip(frames, rows.measured.values(), strict=True) if frames.count(frame) < 2)
        there = {**dict(alone), **rows.measured}
        own = {name: there.get(name, there.get(name.partition("@")[0])) for name in names}
        if lost := [name for name, values in own.items() if values is None]:
            raise InvalidInput(f"this model learns from the sensor {lost[0]!r}, which these rows do not have.")
        sensed = {name: torch.tensor(values, device=device) for name, values in own.items()}
        q, v, u, a = (torch.tensor(x, device=device) for x in (rows.q, rows.v, rows.u, rows.a))
        strokes = None if rows.strokes is None else torch.tensor(rows.strokes, device=device)
        return cls(q, v, u, a, strokes=strokes, sensed=sensed)

    def to(self, device: torch.device) -> "TrainingData":
        """The same rows on another device."""
        sensed = {name: x.to(device) for name, x in self.sensed.items()}
        return replace(self, sensed=sensed, **{n: x.to(device) for n, x in vars(self).items() if hasattr(x, "to")})


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


def observed(dynamics: ConstrainedDynamics, names: Iterable[str]) -> AffineMap:
    """Accelerations, then what these sensors measure, forces at contacts or of IMUs, as functions of joint forces."""
    parts = [a := dynamics.acceleration_map()]
    for name in names:
        if name.startswith(OF_SENSOR):
            parts.append(dynamics.force_at(name.removeprefix(OF_SENSOR)))
        else:
            felt = specific_force(dynamics.state.kinematics, name)
            parts.append(AffineMap(felt(a.offset), felt.matrix @ a.matrix))
    offset, matrix = (torch.cat([part[k] for part in parts], dim=-1 - k) for k in (0, 1))
    return AffineMap(offset, matrix)


def measured(dynamics: ConstrainedDynamics, training: TrainingData) -> Float[Tensor, "N D"]:
    """What `observed` predicts of these rows."""
    sensed = (dynamics.as_measured(name.removeprefix(OF_SENSOR), x) for name, x in training.sensed.items())
    return torch.cat([training.a, *sensed], dim=-1)


FAR_FROM_SURFACE = 0.01
"""Median distance of the training points from a contact's surface, in m, beyond which a warning is given."""


def check_distance(model: Model, training: TrainingData) -> None:
    """Refuse a surface that no training state touches, and warn where half of them are far from it."""
    kinematics = model.robot.kinematics(training.q)
    for index, contact in enumerate(model.contacts):
        distances = contact.off(kinematics).abs()
        distance, what = float(distances.median()), f"the surface of contact {index} (frame {contact.frame!r})"
        remedy = "check its surface, point and units (m), or leave the contact out"
        if float(distances.min()) > FAR_FROM_SURFACE:
            seen = f"no training point touches {what}: the nearest is {float(distances.min()):.3g} m away"
            raise ContactError(f"{seen}, half of them more than {distance:.3g} m; {remedy}")
        if distance > FAR_FROM_SURFACE:
            seen = f"half of the training points lie more than {distance:.3g} m from {what}"
            advice = f"{remedy}, or train on the rows in contact only (forcegp.data.rows_in_contact)"
            warnings.warn(f"{seen}; {advice}", DataWarning, stacklevel=5)


def checked_values(forces: UnknownForces, dynamics: ConstrainedDynamics) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Directions (N, nv, C) and features (N, d) of every latent at N states. Raises InvalidInput for anything else."""
    parts = [_checked(term, dynamics) for term in forces.terms]
    return torch.cat([dynamics.H[..., :0], *(B for B, _ in parts)], dim=-1), tuple(z for _, own in parts for z in own)


def _checked(prior: Unknown, dynamics: ConstrainedDynamics) -> tuple[Tensor, tuple[Tensor, ...]]:
    robot, own = dynamics.state.robot, type(prior).__name__
    names, features, scalings = prior.latent_names(robot), prior.features(dynamics), prior.scalings(robot)
    if isinstance(names, str) or not all(isinstance(name, str) for name in names):
        raise InvalidInput(f"{own}.latent_names gives {names!r}; it must give a tuple with a name per latent")
    for method, given in (("features", features), ("scalings", scalings)):
        if not isinstance(given, list | tuple) or len(given) != len(names):
            kind = f"{len(given)} entries" if isinstance(given, list | tuple) else f"a {type(given).__name__}"
            raise InvalidInput(f"{own}.{method} gives {kind}; it must give a tuple with one for each of {names}")
    rows, ways = len(dynamics.state.q), get_args(Scaling)
    B = _tensor(f"{own}.direction", prior.direction(dynamics), (rows, robot.nv, len(names)), "(rows, nv, latents)")
    for name, z, given in zip(names, features, scalings, strict=True):
        _tensor(f"{own}.features of {name!r}", z, (rows, None), "(rows, features); one feature is z[..., None]")
        each = (given,) * z.shape[-1] if isinstance(given, str) else tuple(given)
        if len(each) != z.shape[-1] or not set(each) <= set(ways):
            allowed = ", ".join(map(repr, ways))
            raise InvalidInput(f"{own}.scalings of {name!r} is {given!r}; give one of {allowed}, or one per feature")
    return B, tuple(features)


def _tensor(what: str, given: Any, shape: tuple[int | None, ...], wanted: str) -> Tensor:
    found = tuple(getattr(given, "shape", ()))
    fits = len(found) == len(shape) and all(n in (None, m) for n, m in zip(shape, found, strict=True))
    if not isinstance(given, Tensor) or not fits or given.dtype != torch.float64 or given.requires_grad:
        kind = f"a {getattr(given, 'dtype', type(given).__name__)} of shape {found}"
        sizes = ", ".join("any" if size is None else str(size) for size in shape)
        seen = f"{what} is {kind}"
        raise InvalidInput(f"{seen}; it must be a float64 tensor ({sizes}) without gradients, that is {wanted}")
    lost = ~torch.isfinite(given).flatten(1).all(1)
    if bool(lost.any()):
        raise InvalidInput(f"{what} is not finite at training row {int(lost.nonzero()[0])}; mend it there")
    return given


@dataclass(frozen=True, eq=False)
class MarginalLikelihood:
    """-log p(a | q, v, u, parameters) of one model on one training set, as a function of unconstrained parameters.

    By name: those of the kernels, `noise.log_acceleration` (nv,) and optionally `noise.log_force` (nv,).
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
    def observed(self) -> AffineMap:
        """What was measured as a function of the joint forces: accelerations, then what each sensor saw."""
        return observed(self.dynamics, self.training.sensed)

    @cached_property
    def mixing(self) -> Float[Tensor, "N D C"]:
        """W of the training states: H B, and its like for force sensors."""
        return self.observed.matrix @ self.model.unknown.direction(self.dynamics)

    @cached_property
    def residual(self) -> Float[Tensor, "N D"]:
        """y - m."""
        return measured(self.dynamics, self.training) - self.observed.offset

    def terms(self, parameters: Mapping[str, Tensor]) -> Terms:
        """Standardised features, W (N, D, C), residual y - m (N, D) and the noise, at `parameters`."""
        noise = Noise.covariance(parameters, self.observed.matrix) * self.training.correlated_rows
        return Terms(self.features, self.mixing, self.residual, noise)

    @cached_property
    def kernels(self) -> LatentKernels:
        """Kernels that start with the variance of W^+ (a - m); `visit` of a kernel takes the range of the rows."""
        if self.training.reference is not None:  # on whose rows kernels were made
            return replace(self, training=self.training.reference).kernels
        features = self.features
        variances = (torch.linalg.pinv(self.mixing, rtol=1e-8) @ self.residual[..., None])[..., 0].square().mean(0)
        largest = float(variances.max()) if variances.numel() else 0.0
        if variances.numel() and not largest > 0.0:
            seen = "the accelerations equal the mean exactly, so no unknown force can be learned"
            raise InvalidInput(f"{seen}; check that a was measured and not computed from the model itself")
        variances = variances.clamp_min(RESIDUAL_FLOOR * largest)
        kernels = self.model.unknown.kernels(self.model.robot, tuple(z.shape[-1] for z in features), variances)
        for kernel, z in zip(kernels, features, strict=True):
            for part in kernel.modules():
                visit: Any = getattr(part, "visit", None)
                if visit is not None:
                    visit(z)
        return LatentKernels(kernels).to(variances.device)

    def __call__(self, kernels: LatentKernels, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """The exact, differentiable negative log marginal likelihood. Raises InvalidInput for unknown names."""
        return self.of_terms(*self.checked_terms(kernels, parameters))

    def checked_terms(
        self, kernels: LatentKernels, parameters: Mapping[str, Tensor]
    ) -> tuple[Terms, list[Float[Tensor, "N N"]]]:
        """Terms and kernel matrices at `parameters`. Raises InvalidInput for a name that means nothing here."""
        known = {*kernels.initial_parameters(), ACCELERATION, FORCE, *STATED}
        unknown = next((name for name in parameters if name not in known), None)
        if unknown is not None:
            raise InvalidInput(f"no parameter {unknown!r}; there are {', '.join(sorted(known))}")
        terms = self.terms(parameters)
        return terms, kernels.matrices(parameters, terms.features)

    def of_terms(self, terms: Terms, matrices: Sequence[Float[Tensor, "N N"]]) -> Float[Tensor, ""]:
        """-log p of rows with these terms."""
        return negative_log_likelihood(terms.W, terms.residual, terms.noise, matrices)

    def condition(
        self,
        kernels: LatentKernels,
        parameters: Mapping[str, Tensor],
        engine: Engine | None = None,
        *,
        at_parameters: bool = False,
        near: LatentPosterior | None = None,
    ) -> LatentPosterior:
        """The posterior of latent functions at fixed parameters; kernels that are `at_parameters` are not copied."""
        kernels = kernels if at_parameters else kernels.at(parameters)
        with torch.no_grad():
            return (engine or Exact()).condition(kernels, self.terms(parameters), near)

    @property
    def noise(self) -> Noise:
        """The noise of a model that a fit has resolved."""
        assert self.model.noise is not None, "a fitted model has its noise"
        return self.model.noise

    @property
    def split_noise(self) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Noise parameters that are learned, and those that stay."""
        parameters = self.noise.parameters(self.model.robot.nv, self.model.robot.device)
        # what a model misses of a force sensor is noise of joint forces: learned, that of the sensor would hide it
        # and where one is, so is noise of joint forces: nobody can state what functions leave of them
        wanted = {ACCELERATION, FORCE} if self.noise.learn else {FORCE} if self.noise.sensor is not None else set()
        learned = {name: value for name, value in parameters.items() if name in wanted}
        return learned, {name: value for name, value in parameters.items() if name not in learned}


def problem_size(model: Model, rows: int) -> ProblemSize:
    """Of the posterior of so many rows, computing nothing; contacts count as independent and leave some motion."""
    nv, latents = model.robot.nv, len(model.unknown.latent_names(model.robot))
    return ProblemSize(rows, nv, min(latents, max(1, nv - len(model.contacts))), latents, 0)
