"""What a fit to motions may change: numbers of laws and bodies, and the weights of latent functions, as one vector."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.data import Dataset
from forcegp.evidence.bodies import thickened
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.fit.physical import typical_sizes
from forcegp.forces import JointLaw, RigidBodies
from forcegp.inference import InducingPosterior
from forcegp.inference.engines import InducingWeights
from forcegp.inference.inducing import WeightSpace, pivoted_cholesky
from forcegp.integration.integrators import rows_jacobian
from forcegp.integration.midpoint_sensitivities import Accelerations, Linear
from forcegp.model import Model
from forcegp.posterior import Posterior

POINTS = {1: 48, 2: 64}
"""Inducing points of a latent with so many features; `MORE` of others. What too few cannot be is small beside forces
and large beside the noise of positions: laws and scales bend to make up for it."""
MORE = 96
SCALES = 1e-3, 30.0
"""Least and largest scale: accelerations may show less of a force than motions, and more than there is. With the least
a function is none: where laws of friction are all there is, it would cost motions what it adds to their freedom."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Coordinates of the numbers of laws and bodies, then latent weights, and what they make of a posterior."""

    start: Posterior
    weights: WeightSpace
    space: ParameterSpace
    scales: Float[Tensor, " C"]
    """Standard deviation of the weights of each latent a priori, over that of its kernel."""

    @classmethod
    def of(cls, posterior: Posterior, dataset: Dataset, bodies: bool, stated: Model | None = None) -> "Unknowns":
        """Laws of the joints that the model lists, bodies where asked for, inducing points of its functions.

        Numbers that the laws of `stated` know by a standard deviation of 0 stay.
        """
        given = {} if stated is None else {type(law): law for law in stated.laws if isinstance(law, JointLaw)}
        robot, _ = thickened(posterior.model.robot)
        model = posterior.model.with_robot(robot) if bodies else posterior.model
        forces = [
            force.open(given.get(type(force))) if isinstance(force, JointLaw)
            else replace(force, learn="all" if bodies else ()) if isinstance(force, RigidBodies)
            else force
            for force in model.forces
        ]  # fmt: skip
        opened = replace(model, forces=tuple(forces))
        space = ParameterSpace(opened, typical_sizes(opened, [dataset]))
        weights = _space(posterior)
        scales = torch.ones(len(weights.points), dtype=torch.float64)
        return cls(replace(posterior, target=model), weights, space, scales)

    @cached_property
    def sizes(self) -> tuple[int, int]:
        """How many numbers and weights there are."""
        return self.space.size, self.weights.count

    def split(self, x: Tensor) -> tuple[np.ndarray, Tensor]:
        """Coordinates of numbers, and weights."""
        numbers, weights = x.split(self.sizes)
        return numbers.cpu().numpy(), weights

    @property
    def first(self) -> Float[Tensor, " P"]:
        """What the posterior that was given has."""
        return torch.cat([torch.as_tensor(self.space.start), self.weights.mean])

    @cached_property
    def limits(self) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"], Float[Tensor, " P"]]:
        """Least and largest values, and the most that one step should change."""
        free = np.full(self.weights.count, np.inf)
        low, high = self.space.bounds
        given = np.append(low, -free), np.append(high, free), np.append(self.space.longest_steps, free)
        least, most, step = (torch.as_tensor(x) for x in given)
        return least, most, step

    def prior(self, x: Tensor) -> tuple[Float[Tensor, " P"], Float[Tensor, "P P"]]:
        """Standardised distance from the prior, and its Jacobian."""
        numbers, weights = self.split(x)
        distance, jacobian = (torch.as_tensor(part) for part in self.space.prior(numbers))
        each = self.each_scale
        return torch.cat([distance, weights / each]), torch.block_diag(jacobian, torch.diag(1.0 / each))

    @property
    def each_scale(self) -> Float[Tensor, " m"]:
        """The scale of every weight."""
        return self.scales.repeat_interleave(torch.tensor([len(z) for z in self.weights.points], dtype=torch.long))

    def rescaled(self, x: Tensor, N: Tensor) -> "Unknowns":
        """With the scales that make these weights likely, given the curvature N of the objective at them.

        s^2 = |w|^2 / gamma (MacKay, "Bayesian interpolation", 1992, section 4.4); steps down are twice as long on the
        log scale.
        """
        spread, weights = torch.linalg.inv(N).diagonal()[self.sizes[0] :], self.split(x)[1]
        scales = self.scales.clone()
        for c, part in enumerate(self.weights.slices):
            told = (part.stop - part.start) - float(spread[part].sum() / scales[c] ** 2)
            found = (weights[part].square().sum() / max(told, 1e-3)).sqrt()
            scales[c] = min(found, found.square() / scales[c]).clamp(*SCALES)
        return replace(self, scales=scales)

    def support(self, x: Tensor, N: Tensor) -> Float[Tensor, " C"]:
        """Log evidence of each latent over none [nats]: 1/2 w^T N w - 1/2 log|s^2 N| (Laplace; MacKay 1992)."""
        covariance, weights = torch.linalg.inv(N), self.split(x)[1]
        first, out = self.sizes[0], []
        for c, part in enumerate(self.weights.slices):
            rows = slice(first + part.start, first + part.stop)
            curvature, w = torch.linalg.inv(covariance[rows, rows]), weights[part]
            out.append(0.5 * (w @ curvature @ w - torch.linalg.slogdet(self.scales[c] ** 2 * curvature).logabsdet))
        return torch.stack(out)

    def model(self, x: Tensor) -> Model:
        """The model with these numbers."""
        return self.space.model_at(self.split(x)[0])

    def posterior(self, x: Tensor, weights: WeightSpace | None = None) -> Posterior:
        """The posterior of that model with these weights."""
        weights = replace(self.weights, mean=self.split(x)[1]) if weights is None else weights
        latent = InducingPosterior(weights.kernels, weights) if self.weights.count else self.start.latent
        return replace(self.start, target=self.model(x), latent=latent)

    def accelerations(self, x: Tensor) -> Accelerations:
        """The mean acceleration and its derivatives, in x as well."""
        posterior, (numbers, _) = self.posterior(x), self.split(x)
        mean, nv = posterior.accelerations(None), posterior.model.robot.nv
        space, bodies = posterior.model.robot.space, self.space.bodies
        forces, standardize = posterior.trained.unknown, posterior.likelihood.standardization
        carriers = [each.body for each in self.space.carried]

        def at(q: Tensor, v: Tensor, u: Tensor, parameters: bool) -> Linear:
            def moved(z: Tensor) -> Tensor:
                step, speed = z.split(nv, dim=-1)
                return mean(step if space.is_vector_space else space.integrate(q, step), speed, u)

            origin = q if space.is_vector_space else torch.zeros_like(v)
            a, slopes = rows_jacobian(moved, torch.cat([origin, v], dim=-1))
            a_q, a_v = slopes.split(nv, dim=-1)
            if not parameters:
                return Linear(a, a_q, a_v)
            with torch.no_grad():
                dynamics = posterior.dynamics(q, v, u)
                columns = []
                if bodies.size:
                    Y = dynamics.state.kinematics.torque_regressor(a)[:, :, carriers].cpu().numpy()
                    columns.append(-torch.as_tensor(bodies.chained(numbers[: bodies.size], Y)))
                _, added = self.space.torque(numbers, dynamics.state, a.cpu().numpy(), {})
                columns.append(-torch.as_tensor(added))
                if self.weights.count:
                    phi = self.weights.columns(standardize(forces.features(dynamics)))
                    mixing = forces.direction(dynamics)
                    columns += [mixing[..., c : c + 1] * f.mT[:, None] for c, f in enumerate(phi)]
                return Linear(a, a_q, a_v, dynamics.H @ torch.cat(columns, dim=-1))

        return Accelerations(mean, at, space)


def _space(posterior: Posterior) -> WeightSpace:
    """Weights of as many inducing points as the latents' features need; of a refined model, those that it has."""
    if isinstance(posterior.engine, InducingWeights):
        assert isinstance(posterior.latent, InducingPosterior), "its engine is"
        return posterior.latent.space
    with torch.no_grad():
        terms = posterior.likelihood.terms(posterior.hyperparameters)
        deflation, kernels = terms.deflated(), posterior.kernels.at(posterior.hyperparameters)
        points = []
        for c, z in enumerate(terms.features):
            relevance = deflation.C[..., c].square().sum(1)
            most = POINTS.get(z.shape[-1], MORE)
            points.append(z[pivoted_cholesky(kernels.dense[c], z, relevance, most)])
        return WeightSpace.of(kernels, terms.features, points, deflation.C, deflation.t)
