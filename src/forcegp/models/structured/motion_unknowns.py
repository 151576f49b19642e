"""What a fit to motions may change: joint terms, bodies and the weights of latent functions, as one vector."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.analytical.bodies import ConsistentBodies, thickened, with_bodies
from forcegp.analytical.identifiability import body_pseudo_inertias, carrying
from forcegp.analytical.identification import joint_terms
from forcegp.analytical.joint_terms import INERTIAS, LAWS
from forcegp.data import Dataset
from forcegp.inference import InducingPosterior
from forcegp.inference.engines import InducingWeights
from forcegp.inference.inducing import WeightSpace, pivoted_cholesky
from forcegp.integration.integrators import rows_jacobian
from forcegp.integration.midpoint_sensitivities import Accelerations, Linear
from forcegp.mechanics import MechanicalSystem

Structured = Any
"""A `StructuredPosterior`, whose module imports this one."""
POINTS = {1: 48, 2: 64}
"""Inducing points of a latent with so many features; `MORE` of others. What too few cannot be is small beside forces
and large beside the noise of positions: laws and scales bend to make up for it."""
MORE = 96
SCALES = 1e-3, 30.0
"""Least and largest scale: accelerations may show less of a force than motions, and more than there is. With the least
a function is none: where laws of friction are all there is, it would cost motions what it adds to their freedom."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Coordinates x of joint terms, bodies and latent weights, in this order, and what they make of a posterior."""

    start: Structured
    space: WeightSpace
    terms: Any
    bodies: ConsistentBodies | None
    scales: Float[Tensor, " C"]
    """Standard deviation of the weights of each latent a priori, over that of its kernel."""

    @classmethod
    def of(cls, posterior: Structured, dataset: Dataset, inertias: bool) -> "Unknowns":
        """Laws of friction and rotors that the system lists, bodies where asked for, inducing points of the prior."""
        robot, _ = thickened(posterior.system.robot)
        system = posterior.system.with_robot(robot) if inertias else posterior.system
        listed = [type(force) for force in system.known_forces]
        laws = [name for name, law in LAWS.items() if law.kind in listed]
        rotors = next((name for name, kind in INERTIAS.items() if kind in listed), None)
        terms = joint_terms(system, laws, rotors, dataset.q, dataset.v, dataset.u, dataset.a)
        bodies = ConsistentBodies(body_pseudo_inertias(robot).cpu().numpy()) if inertias else None
        space = _space(posterior)
        scales = torch.ones(len(space.points), dtype=torch.float64)
        return cls(replace(posterior, target=system), space, terms, bodies, scales)

    @cached_property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of terms, bodies and weights."""
        return self.terms.size, 0 if self.bodies is None else self.bodies.size, self.space.count

    def split(self, x: Tensor) -> tuple[np.ndarray, np.ndarray, Tensor]:
        """Coordinates of terms, bodies and weights."""
        terms, bodies, weights = x.split(self.sizes)
        return terms.numpy(), bodies.numpy(), weights

    @property
    def first(self) -> Float[Tensor, " P"]:
        """What the posterior that was given has."""
        return torch.cat([torch.as_tensor(self.terms.start(unlisted=0.0)), torch.zeros(self.sizes[1]), self.space.mean])

    @cached_property
    def limits(self) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"], Float[Tensor, " P"]]:
        """Least and largest values, and the most that one step should change."""
        free = np.full(sum(self.sizes[1:]), np.inf)
        low, high = self.terms.bounds
        longest = np.concatenate([self.terms.longest_steps, np.full(self.sizes[1], 1.0), free[self.sizes[1] :]])
        return tuple(torch.as_tensor(x) for x in (np.append(low, -free), np.append(high, free), longest))  # type: ignore[return-value]

    def prior(self, x: Tensor) -> tuple[Float[Tensor, " P"], Float[Tensor, "P P"]]:
        """Standardised distance from the prior, and its Jacobian."""
        in_terms, in_bodies, weights = self.split(x)
        center, spread = self.terms.prior()
        values, blocks = [torch.as_tensor((in_terms - center) / spread)], [torch.diag(torch.as_tensor(1.0 / spread))]
        if self.bodies is not None:
            distance, jacobian = self.bodies.distance(in_bodies)
            values, blocks = [*values, torch.as_tensor(distance)], [*blocks, torch.as_tensor(jacobian)]
        each = self.each_scale
        return torch.cat([*values, weights / each]), torch.block_diag(*blocks, torch.diag(1.0 / each))

    @property
    def each_scale(self) -> Float[Tensor, " m"]:
        """The scale of every weight."""
        return self.scales.repeat_interleave(torch.tensor([len(z) for z in self.space.points], dtype=torch.long))

    def rescaled(self, x: Tensor, N: Tensor) -> "Unknowns":
        """With the scales that make these weights likely, given the curvature N of the objective at them.

        s^2 = |w|^2 / gamma with gamma the number of weights that the data determine (MacKay, "Bayesian interpolation",
        Neural Computation 1992, section 4.4). Steps down are twice as long on the log scale: where the motions do
        not tell a function, s falls to nothing by the same factor each time.
        """
        spread, weights = torch.linalg.inv(N).diagonal()[-self.space.count :], self.split(x)[2]
        scales = self.scales.clone()
        for c, part in enumerate(self.space.slices):
            told = (part.stop - part.start) - float(spread[part].sum() / scales[c] ** 2)
            found = (weights[part].square().sum() / max(told, 1e-3)).sqrt()
            scales[c] = min(found, found.square() / scales[c]).clamp(*SCALES)
        return replace(self, scales=scales)

    def support(self, x: Tensor, N: Tensor) -> Float[Tensor, " C"]:
        """Log evidence of each latent over none in its place, in nats, given the curvature N of the objective at x.

        With N that of its weights w, all else marginalised, and s its scale: 1/2 w^T N w - 1/2 log|s^2 N|
        (Laplace; MacKay 1992, section 2.3).
        """
        covariance, weights = torch.linalg.inv(N), self.split(x)[2]
        first, out = sum(self.sizes[:2]), []
        for c, part in enumerate(self.space.slices):
            rows = slice(first + part.start, first + part.stop)
            curvature, w = torch.linalg.inv(covariance[rows, rows]), weights[part]
            out.append(0.5 * (w @ curvature @ w - torch.linalg.slogdet(self.scales[c] ** 2 * curvature).logabsdet))
        return torch.stack(out)

    def system(self, x: Tensor) -> MechanicalSystem:
        """The system with these terms and bodies."""
        in_terms, in_bodies, _ = self.split(x)
        system = self.start.system
        kept = [force for force in system.known_forces if type(force) not in self.terms.kinds]
        robot = system.robot
        if self.bodies is not None:
            robot = with_bodies(robot, self.bodies.pseudo_inertias(in_bodies))
        return replace(system, robot=robot, known_forces=(*kept, *self.terms.known_forces(in_terms)))

    def posterior(self, x: Tensor, space: WeightSpace | None = None) -> Structured:
        """The posterior with that system and these weights."""
        space = replace(self.space, mean=self.split(x)[2]) if space is None else space
        latent = InducingPosterior(space.kernels, space) if self.space.count else self.start.latent
        return replace(self.start, target=self.system(x), latent=latent)

    def accelerations(self, x: Tensor) -> Accelerations:
        """The mean acceleration and its derivatives, in x as well."""
        posterior, (in_terms, in_bodies, _) = self.posterior(x), self.split(x)
        mean, nv = posterior.accelerations(None).mean(), posterior.system.robot.nv
        space, own = posterior.system.robot.space, carrying(posterior.system.robot)
        prior, standardize = posterior.model.prior, posterior.likelihood.standardization

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
                load = dynamics.state.delivered.abs().numpy()
                _, added = self.terms.torque(in_terms, v.numpy(), a.numpy(), load)
                columns = [-torch.as_tensor(added)]
                if self.bodies is not None:
                    Y = dynamics.state.kinematics.torque_regressor(a)[:, :, own]
                    of_bodies = torch.einsum("nibp,bpk->nibk", Y, torch.as_tensor(self.bodies.derivatives(in_bodies)))
                    columns.append(-of_bodies.flatten(2))
                if self.space.count:
                    phi = self.space.columns(standardize(prior.features(dynamics)))
                    mixing = prior.mixing(dynamics)
                    columns += [mixing[..., c : c + 1] * f.mT[:, None] for c, f in enumerate(phi)]
                return Linear(a, a_q, a_v, dynamics.H @ torch.cat(columns, dim=-1))

        return Accelerations(mean, at, space)


def _space(posterior: Structured) -> WeightSpace:
    """Weights of as many inducing points as the latents' features need; of a refined model, those that it has."""
    if isinstance(posterior.engine, InducingWeights):
        return posterior.latent.space
    with torch.no_grad():
        terms = posterior.likelihood.terms(posterior.parameters)
        deflation, kernels = terms.deflated(), posterior.kernels.at(posterior.parameters)
        points = []
        for c, z in enumerate(terms.features):
            relevance = deflation.C[..., c].square().sum(1)
            most = POINTS.get(z.shape[-1], MORE)
            points.append(z[pivoted_cholesky(kernels.dense[c], z, relevance, most)])
        return WeightSpace.of(kernels, terms.features, points, deflation.C, deflation.t)
