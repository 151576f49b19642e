"""A structured posterior made ready for control rates: tape of its terms, kernels, compressed covariance."""

import math
import time
import warnings
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput, NumericalWarning
from forcegp.evidence.training_data import Standardization, TrainingData
from forcegp.forces import Actuation, ObservedWrench, RigidBodies, UnknownForces, force_to_dict
from forcegp.inference.posterior import ExactPosterior, LatentPosterior
from forcegp.inference.prepared_kernels import CompressedCovariance, Sample, compress
from forcegp.mechanics import ConstrainedDynamics
from forcegp.model import Model
from forcegp.posterior.kept_code import KeptCode, kept_covariance, record_key
from forcegp.posterior.predictor import Predictor
from forcegp.posterior.predictor_code import PredictorCode
from forcegp.robots.manifold import ConfigurationSpace

COVARIANCES = ("auto", "compressed", "exact", "none")
SAMPLES, CHECKS = 300, 150
"""States that choose the compressed covariance, and others that show how good it is."""
UNCHANGED = 1e-7
"""Relative difference from torch that rounding and tables explain."""
STEP = 0.3
"""Length of a step away from a training state, in differences of two others."""


@dataclass(frozen=True, eq=False)
class PredictorPhysics:
    """The physics of a predictor, differentiable, by the same code as `predict`."""

    model: Model
    forces: UnknownForces
    standardization: Standardization

    def description(self) -> list[Any]:
        """Its parts as JSON values. Raises ForceGPError where they hold code."""
        return [self.model.to_dict(), *map(force_to_dict, self.forces.terms)]

    def terms(self, q: Tensor, v: Tensor, u: Tensor) -> list[Tensor]:
        """[offset, W, features of every process ...] with a = offset + W f."""
        dynamics = self.model.dynamics(q, v, u)
        affine = dynamics.acceleration_map()
        return [affine.offset, affine.matrix @ self.forces.direction(dynamics), *self._features(dynamics)]

    def traced(self, q: Tensor, v: Tensor, u: Tensor, f: Tensor) -> list[Tensor]:
        """[a, W, Q_K + Q_U, passive forces, M, A, b, features ...]: what programs are written from."""
        dynamics = self.model.dynamics(q, v, u)
        B = self.forces.direction(dynamics)
        passive = Q_U = (B @ f[..., None])[..., 0]
        for force in self.model.laws:
            if not isinstance(force, Actuation | RigidBodies):
                passive = passive + force.force(dynamics.state)
        Q = Q_U + dynamics.Q_K
        around = passive, dynamics.M, dynamics.A, dynamics.b
        return [dynamics.acceleration_under(Q), dynamics.H @ B, Q, *around, *self._features(dynamics)]

    def held(
        self, q: Tensor, v: Tensor, u: Tensor, f: Tensor, a: Tensor, multiplier: Tensor, left: Tensor
    ) -> list[Tensor]:
        """[lambda, b - A a, r, s, t, H, G], by which derivatives do not go through factors and pseudo-inverses.

        With the acceleration, the multiplier and what is `left` of b - A a (redundant contacts) held,

            r = Q - M a + A^T lambda,  s = b - A a,  t = A^T left,
            da = H dr + G (ds + G^T dt),  G = M^-1 A^T (A M^-1 A^T)^+

        which is implicit differentiation, and for `left` the derivative of a pseudo-inverse of constant rank (Golub &
        Pereyra, SIAM J. Numer. Anal. 10, 1973, eq. 4.12).
        """
        dynamics = self.model.dynamics(q, v, u)
        A, lower, inverse = dynamics.A, dynamics.inverse_lower, dynamics.pseudo_inverse
        Q = (self.forces.direction(dynamics) @ f[..., None])[..., 0] + dynamics.Q_K
        change = inverse @ (dynamics.b[..., None] - A @ (lower.mT @ (lower @ Q[..., None])))
        found = [(inverse.mT @ change)[..., 0], dynamics.b - (A @ dynamics.acceleration_under(Q)[..., None])[..., 0]]
        kinematics = dynamics.state.kinematics
        inertial = kinematics.inverse_dynamics(a) - kinematics.bias_forces()
        for force in self.model.laws:
            added = force.added_inertia(self.model.robot)
            if added is not None:
                inertial = inertial + (added @ a[..., None])[..., 0]
        r = Q - inertial + (A.mT @ multiplier[..., None])[..., 0]
        s, t = dynamics.b - (A @ a[..., None])[..., 0], (A.mT @ left[..., None])[..., 0]
        return [*found, r, s, t, dynamics.H, lower.mT @ inverse]

    def _features(self, dynamics: ConstrainedDynamics) -> list[Tensor]:
        return list(self.standardization(self.forces.features(dynamics)))


def prepared_predictor(
    latent: LatentPosterior,
    widening: float,
    training: TrainingData,
    physics: PredictorPhysics,
    *,
    covariance: str,
    tolerance: float,
    largest_rank: int,
    compile: bool,
) -> Predictor:
    """What `Posterior.predictor` documents, from the posterior of the latents and the terms of a state."""
    if not isinstance(covariance, str) or covariance not in COVARIANCES:
        raise InvalidInput(f"covariance is {covariance!r}; give one of {', '.join(map(repr, COVARIANCES))}.")
    number = isinstance(tolerance, int | float)
    if not (number and 0.0 < tolerance < math.inf and isinstance(largest_rank, int) and largest_rank >= 1):
        raise InvalidInput(
            f"tolerance is {tolerance!r} and largest_rank is {largest_rank!r}; give a positive number, for example "
            "0.01, and an integer from 1."
        )
    begin = time.perf_counter()
    sizes, device, space = physics.model.sizes, training.q.device, physics.model.robot.space
    if covariance == "auto":
        covariance = "compressed" if isinstance(latent, ExactPosterior) else "exact"
    options = [covariance, tolerance, largest_rank, widening]
    key = record_key(lambda: [physics.description(), options], _numbers(latent, training, physics))
    compressed = None
    if covariance == "compressed" and len(latent.kernels.dense):
        if not isinstance(latent, ExactPosterior):
            raise InvalidInput(
                "covariance='compressed' needs the factorised covariance of all rows, which a model with a "
                f"{type(latent).__name__} does not have; give covariance='exact', which is the one that it has, "
                f"'none', or {latent.remedy}."
            )
        compressed = kept_covariance(key, lambda: _compressed(latent, training, physics, tolerance, largest_rank))
        reached = float(compressed.inflation.max()) if len(compressed.inflation) else 0.0
        if reached > tolerance:
            warnings.warn(
                f"rank {compressed.rank} makes standard deviations up to {reached:.2g} (relative) too large, more than "
                f"the tolerance {tolerance:.2g}; give a larger largest_rank or tolerance, or covariance='exact'.",
                NumericalWarning,
                stacklevel=3,
            )
    code = None
    if compile:
        example = [x[:1] for x in (training.q, training.v, training.u)]
        given = (physics, example, space, latent, compressed, widening)
        code = KeptCode(space, sizes, len(physics.model.contacts), partial(PredictorCode.of, *given), key)
    made = Predictor(space, sizes, device, latent, physics.terms, code, covariance, compressed, widening, 0.0)
    first = "mean" if compressed is None else "covariance"
    if made.compiled(first) and code is not None and not code.is_traced:
        some = [x[:: 1 + len(x) // 3] for x in (training.q, training.v, training.u)]
        found, expected = made.run(first, some)[0], replace(made, code=None, _functions={}).mean(*some)
        if float((found - expected).abs().max()) > UNCHANGED * float(expected.abs().max()):
            made = replace(made, code=replace(code, key=None), _functions={})  # a prior's code changed: no key shows it
            made.compiled(first)
    return replace(made, prepare_seconds=time.perf_counter() - begin)


def rows_for(training: TrainingData, trained: Model, model: Model) -> TrainingData:
    """The training rows with the inputs of another system, such as one without the switches of contacts.

    A wrench that an observer reports was 0 where nothing observed it. Raises InvalidInput for other inputs that they
    lack.
    """
    had = trained.inputs
    if model.inputs == had:
        return training
    reported = [name for force in model.forces if isinstance(force, ObservedWrench) for name in force.names]
    new = [name for name in model.inputs if name not in (*had, *reported)]
    if new:
        raise InvalidInput(
            f"the training rows lack inputs ({', '.join(new)}), so no predictor can be checked; call predict."
        )
    with_zero = torch.nn.functional.pad(training.u, (0, 1))
    return replace(training, u=with_zero[..., [had.index(name) if name in had else -1 for name in model.inputs]])


def _numbers(latent: LatentPosterior, training: TrainingData, physics: PredictorPhysics) -> list[Tensor]:
    """All that decide a predictor of a described system and prior."""
    found = [training.q, training.v, training.u, *latent.features, *latent.weights]
    found += [*latent.kernels.state_dict().values(), *physics.standardization.shift, *physics.standardization.scale]
    return [*found, latent.system.factor.lower.diagonal()] if isinstance(latent, ExactPosterior) else found


def _compressed(
    latent: ExactPosterior,
    training: TrainingData,
    physics: PredictorPhysics,
    tolerance: float,
    largest_rank: int,
) -> CompressedCovariance:
    # functions of one input are rough: between two training values, what is uncertain hangs on these two alone
    rough = any(z.shape[-1] == 1 for z in latent.features)

    def sample(count: int, seed: int, rows: int) -> Sample:
        with torch.no_grad():
            states = sample_states(training, physics.model.robot.space, count, seed, rows)
            _, W, *features = physics.terms(*states)
        usable = torch.isfinite(W).flatten(1).all(1)  # no state of its own has a surface without a normal
        return Sample([z[usable] for z in features], W[usable])

    chosen = sample(SAMPLES, 0, len(training.q) if rough else SAMPLES // 3)
    return compress(latent, chosen, sample(CHECKS, 1, CHECKS // 3), tolerance=tolerance, largest=largest_rank)


def sample_states(
    training: TrainingData, space: ConfigurationSpace, count: int, seed: int, rows: int
) -> list[Float[Tensor, "_ size"]]:
    """q, v and u of states of three kinds: `rows` training rows, or all, and a third of `count` of the others each.

    These are rows moved by a fraction of the difference of two others; and positions, velocities and forces of
    different rows together.
    """
    generator = torch.Generator().manual_seed(seed)
    states = [training.q, training.v, training.u]

    def some(number: int) -> Tensor:
        return torch.randint(len(training.q), (number,), generator=generator)

    own = torch.randperm(len(training.q), generator=generator)[:rows]
    third = count // 3
    i, j, k = some(third), some(third), some(third)
    mixed = [some(count - 2 * third) for _ in states]
    moved = [x[i] + STEP * (x[j] - x[k]) for x in states]
    if not space.is_vector_space:
        q = states[0]
        moved[0] = space.integrate(q[i], STEP * space.difference(q[k], q[j]))
    return [torch.cat([x[own], between, x[other]]) for x, between, other in zip(states, moved, mixed, strict=True)]


def physics_of(posterior: Any, model: Model) -> PredictorPhysics:
    """Of a `Posterior` in this model. Raises InvalidInput where u is a noisy measurement."""
    noise = posterior.trained.noise
    if noise is not None and noise.measured_torque:
        raise InvalidInput(
            "a predictor is for commanded torques, and in this model u comes from a noisy sensor; call "
            "predict, or fit with Noise(..., measured_torque=False)."
        )
    return PredictorPhysics(model, posterior.trained.unknown, posterior.likelihood.standardization)
