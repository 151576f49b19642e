"""What a fit to motions may change: numbers of laws and bodies, as one vector."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.data import Dataset
from forcegp.evidence.bodies import thickened
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.fit.physical import typical_sizes
from forcegp.forces import JointLaw, RigidBodies
from forcegp.integration.integrators import rows_jacobian
from forcegp.integration.midpoint_sensitivities import Accelerations, Linear
from forcegp.model import Model
from forcegp.posterior import Posterior


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Coordinates of the numbers of laws and bodies, and what they make of a posterior."""

    start: Posterior
    space: ParameterSpace

    @classmethod
    def of(cls, posterior: Posterior, dataset: Dataset, bodies: bool, stated: Model | None = None) -> "Unknowns":
        """Laws of the joints that the model lists, bodies where asked for.

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
        return cls(replace(posterior, target=model), ParameterSpace(opened, typical_sizes(opened, [dataset])))

    @property
    def first(self) -> Float[Tensor, " P"]:
        """What the posterior that was given has."""
        return torch.as_tensor(self.space.start)

    @cached_property
    def limits(self) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"], Float[Tensor, " P"]]:
        """Least and largest values, and the most that one step should change."""
        low, high = self.space.bounds
        least, most, step = (torch.as_tensor(x) for x in (low, high, self.space.longest_steps))
        return least, most, step

    def prior(self, x: Tensor) -> tuple[Float[Tensor, " P"], Float[Tensor, "P P"]]:
        """Standardised distance from the prior, and its Jacobian."""
        distance, jacobian = (torch.as_tensor(part) for part in self.space.prior(x.numpy()))
        return distance, jacobian

    def posterior(self, x: Tensor) -> Posterior:
        """That of the model with these numbers."""
        return replace(self.start, target=self.space.model_at(x.numpy()))

    def accelerations(self, x: Tensor) -> Accelerations:
        """The mean acceleration and its derivatives, in x as well."""
        posterior, numbers = self.posterior(x), x.numpy()
        mean, nv = posterior.accelerations(None), posterior.model.robot.nv
        space, bodies = posterior.model.robot.space, self.space.bodies
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
                return Linear(a, a_q, a_v, dynamics.H @ torch.cat(columns, dim=-1))

        return Accelerations(mean, at, space)
