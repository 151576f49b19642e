"""What moves is what is fitted: laws and inertias refined on recorded positions.

    1/2 sum_kij (q_kij - q_ij(x_k, p))^2 / (tau_j sigma_j^2) + 1/2 |prior(p)|^2 + 1/2 sum_k |x_k - x_k0|^2

over initial states x_k of windows and numbers p; tau_j is how many rows one independent residual is worth.
Gauss-Newton; initial states are eliminated window by window; the covariance is Laplace's.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.data import Dataset
from forcegp.data.views import RecordedMotions, all_motions
from forcegp.errors import NonPhysicalInertia, NumericalError
from forcegp.evidence.bodies import thickened
from forcegp.evidence.least_squares import correlation_time, step_within
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.fit.physical import typical_sizes
from forcegp.forces import JointLaw, RigidBodies
from forcegp.integration.integrators import rows_jacobian
from forcegp.integration.midpoint_sensitivities import Accelerations, Linear, WindowMotions, window_motions
from forcegp.model import Model
from forcegp.posterior import Posterior
from forcegp.posterior.fitted import Estimates
from forcegp.posterior.rollout import accelerations
from forcegp.progress import tell

STEP = 0.005  # longest step in s: shorter where the recording has shorter ones, of which several make a step
SPEED = 0.02
"""Standard deviation of a window's initial velocity, relative to that of all velocities: it comes from a filter."""
ITERATIONS, ROUNDS = 12, 8  # most steps for given noise, and times that the noise is estimated anew
CONTENT = 0.1  # nats by which a step must be expected to lower the objective for the search to go on
MOST_DAMPING = 1e6  # beyond it steps are too small to matter
SETTLED = 0.02  # relative change of the noise that ends the rounds


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Coordinates of the numbers of laws and bodies, and what they make of a posterior."""

    start: Posterior
    space: ParameterSpace

    @classmethod
    def of(cls, posterior: Posterior, dataset: Dataset, bodies: bool, stated: Model | None = None) -> "Unknowns":
        """Laws of the model's joints, bodies where asked for; numbers of `stated` without a deviation stay."""
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

    def prior(self, x: Tensor) -> tuple[Float[Tensor, " P"], Float[Tensor, "P P"]]:
        """Standardised distance from the prior, and its Jacobian."""
        distance, jacobian = (torch.as_tensor(part) for part in self.space.prior(x.numpy()))
        return distance, jacobian

    def posterior(self, x: Tensor) -> Posterior:
        """That of the model with these numbers."""
        return replace(self.start, target=self.space.model_at(x.numpy()))

    def accelerations(self, x: Tensor) -> Accelerations:
        """The mean acceleration and its derivatives, in x as well."""
        posterior, numbers, bodies = self.posterior(x), x.numpy(), self.space.bodies
        mean, nv = accelerations(posterior, replace(posterior.model, baumgarte=None)), posterior.model.robot.nv
        carriers = [each.body for each in self.space.carried]

        def at(q: Tensor, v: Tensor, u: Tensor, parameters: bool) -> Linear:
            a, slopes = rows_jacobian(lambda z: mean(z[:, :nv], z[:, nv:], u), torch.cat([q, v], dim=-1))
            a_q, a_v = slopes.split(nv, dim=-1)
            if not parameters:
                return Linear(a, a_q, a_v)
            with torch.no_grad():
                dynamics, columns = posterior.dynamics(q, v, u), []
                if bodies.size:
                    Y = dynamics.state.kinematics.torque_regressor(a)[:, :, carriers].cpu().numpy()
                    columns.append(-torch.as_tensor(bodies.chained(numbers[: bodies.size], Y)))
                _, [added] = self.space.torque(numbers, dynamics.state, a.cpu().numpy(), {})
                columns.append(-torch.as_tensor(added))
                return Linear(a, a_q, a_v, dynamics.H @ torch.cat(columns, dim=-1))

        return Accelerations(mean, at)


@dataclass(frozen=True, eq=False)
class _Point:
    """Unknowns x, initial states (K, 2 nv), the motions from there, and the objective."""

    x: Tensor
    states: Tensor
    motions: WindowMotions
    cost: float


@dataclass(frozen=True, eq=False)
class MotionFit:
    """The recorded windows, the unknowns and the noise that residuals have: what is minimised, and how."""

    recorded: RecordedMotions
    stride: int
    unknowns: Unknowns

    @property
    def h(self) -> float:
        """The step in s."""
        return self.stride * self.recorded.dt

    @cached_property
    def q(self) -> Float[Tensor, "K rows nq"]:
        """Recorded positions at the ends of the steps."""
        return torch.as_tensor(self.recorded.q[:, :: self.stride].copy())

    @cached_property
    def u(self) -> Float[Tensor, "K T nv"]:
        """Actuator forces, their mean over each step."""
        return torch.as_tensor(self.recorded.u.copy()).unflatten(1, (-1, self.stride)).mean(2)

    @cached_property
    def start(self) -> Float[Tensor, "K state"]:
        """Recorded initial states."""
        return torch.as_tensor(np.concatenate([self.recorded.q[:, 0], self.recorded.v[:, 0]], axis=-1))

    def spread(self, sigma: Tensor) -> Float[Tensor, " state"]:
        """Standard deviations of initial states about the recorded ones."""
        speed = torch.as_tensor(self.recorded.v.copy()).square().mean((0, 1)).sqrt()
        return torch.cat([sigma, (SPEED * speed).clamp_min(1e-9)])

    def at(self, x: Tensor, states: Tensor, noise: Tensor, sigma: Tensor, near: WindowMotions | None) -> _Point:
        """The point, its motions sought from those of another; infinitely bad where there are none."""
        q, steps = self.q, self.q.diff(dim=1)
        guess = (q[:, :-1] + 0.5 * steps, steps / self.h) if near is None else (near.middle_q, near.middle_v)
        q0, v0 = states.split(steps.shape[-1], dim=-1)
        try:
            accelerations = self.unknowns.accelerations(x)
            # a trial step that leads to motions so far from these is too long, whatever they are
            motions = window_motions(accelerations, q0, v0, self.u, self.h, guess, patient=near is None)
        except (NumericalError, NonPhysicalInertia):  # a step that went too far
            nowhere = torch.full_like(q, math.nan)
            motions = WindowMotions(nowhere, nowhere, *guess, torch.zeros(len(q), dtype=torch.bool))
        residual, away = (motions.q - self.q) / noise, (states - self.start) / self.spread(sigma)
        from_prior, _ = self.unknowns.prior(x)
        cost = 0.5 * float(residual.square().sum() + away.square().sum() + from_prior.square().sum())
        return _Point(x, states, motions, cost if bool(motions.found.all()) and math.isfinite(cost) else math.inf)

    def whitened(self, here: _Point, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Residuals of the windows (K, n) and their Jacobians in states (K, n, 2 nv) and unknowns (K, n, P)."""
        motions = here.motions
        parts = (motions.q - self.q)[..., None], motions.in_start, motions.in_parameters
        r, A, B = ((part / noise[:, None]).flatten(1, 2) for part in parts if part is not None)
        return r[..., 0], A, B

    def curvature(
        self, here: _Point, noise: Tensor, sigma: Tensor, damping: float = 0.0
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gauss-Newton's matrix and right side for x, and (G, g) with the change of states g - G dx, (K, 2 nv, ...).

        Diagonals are 1 + `damping` times as large, those of states as well.
        """
        r, A, B = self.whitened(here, noise)
        weight = self.spread(sigma) ** -2
        of_states, mixed = A.mT @ A + torch.diag(weight), A.mT @ B
        of_states.diagonal(dim1=1, dim2=2).mul_(1.0 + damping)
        pull = (A.mT @ r[..., None]) + (weight * (here.states - self.start))[..., None]
        solved = torch.linalg.solve(of_states, torch.cat([mixed, -pull], dim=-1))
        G, g = solved[..., :-1], solved[..., -1]
        values, jacobian = self.unknowns.prior(here.x)
        N = (B.mT @ B).sum(0) + jacobian.mT @ jacobian
        N.diagonal().mul_(1.0 + damping)
        right = -(B.mT @ r[..., None] + mixed.mT @ g[..., None]).sum(0)[:, 0] - jacobian.mT @ values
        return N - (mixed.mT @ G).sum(0), right, G, g

    def expected(self, here: _Point, noise: Tensor, sigma: Tensor, dx: Tensor, change: Tensor) -> float:
        """The objective that linearised motions have after a step."""
        r, A, B = self.whitened(here, noise)
        r = r + (A @ change[..., None])[..., 0] + B @ dx
        away = (here.states + change - self.start) / self.spread(sigma)
        values, jacobian = self.unknowns.prior(here.x)
        return 0.5 * float(r.square().sum() + away.square().sum() + (values + jacobian @ dx).square().sum())

    def minimized(self, here: _Point, noise: Tensor, sigma: Tensor, damping: float) -> tuple[_Point, float]:
        """Levenberg-Marquardt for given noise, from that damping; the last damping as well."""
        here, space = self.at(here.x, here.states, noise, sigma, here.motions), self.unknowns.space
        for _ in range(ITERATIONS):
            N, right, G, g = self.curvature(here, noise, sigma, damping)
            step = step_within(-right.numpy(), N.numpy(), *(end - here.x.numpy() for end in space.bounds))
            dx = torch.as_tensor(step / (abs(step) / space.longest_steps(here.x.numpy())).max(initial=1.0))
            change = g - G @ dx
            foreseen = here.cost - self.expected(here, noise, sigma, dx, change)
            if not foreseen > CONTENT or damping > MOST_DAMPING:
                break
            there = self.at(here.x + dx, here.states + change, noise, sigma, here.motions)
            gain = (here.cost - there.cost) / foreseen
            # Marquardt's rule: trust the linear model more where it was right, less where it was wrong
            damping = max(0.2 * damping, 1e-9) if gain > 0.75 else damping if gain > 0.25 else 5.0 * damping
            if gain > 0.0:
                here = there
        return here, damping

    def solved(self, x: Tensor) -> tuple[_Point, Tensor, Tensor]:
        """The minimum reached from x, with noise and sigma there. Raises NumericalError where no motion is near."""
        one = torch.ones(self.q.shape[-1], dtype=x.dtype)
        here, damping = self.at(x, self.start, one, one, None), 1e-3
        if not math.isfinite(here.cost):
            raise NumericalError(
                f"no motion of {self.h * self.u.shape[1]:g} s is found near the recorded one; give fewer seconds, or a "
                "model that fits the accelerations better."
            )
        sigma, noise = self.noise(here.motions)
        for number in range(ROUNDS):
            tell(number, ROUNDS, f"all rows, rms of q {float(sigma.square().mean().sqrt()):.3g}")
            here, damping = self.minimized(here, noise, sigma, damping)
            before, (sigma, noise) = noise, self.noise(here.motions)
            if bool(((noise - before).abs() <= SETTLED * before).all()):
                break
        return here, noise, sigma

    def noise(self, motions: WindowMotions) -> tuple[Tensor, Tensor]:
        """sigma_j, and sigma_j sqrt(tau_j) with tau_j the rows that an independent residual is worth."""
        residual = motions.q - self.q
        sigma = residual.square().mean((0, 1)).sqrt().clamp_min(1e-12)
        window = np.repeat(np.arange(len(residual)), residual.shape[1])
        time = torch.as_tensor(correlation_time((residual / sigma).flatten(0, 1).cpu().numpy(), window))
        return sigma, sigma * time.clamp_min(1.0).sqrt()


@torch.no_grad()
def refine_on_motions(
    posterior: Posterior, dataset: Dataset, seconds: float, bodies: bool, stated: Model | None = None
) -> Posterior:
    """Known laws and bodies fitted to the recorded positions, beginning from this posterior.

    Numbers that the laws of `stated` know by a standard deviation of 0 stay.
    Raises InvalidInput for bases that move, windows beyond episodes or uneven steps, NumericalError for no motion near.
    """
    posterior.model.robot.require_vectors("refinements on motions")
    recorded, stride = all_motions(dataset, seconds, STEP)
    fit = MotionFit(recorded, stride, Unknowns.of(posterior, dataset, bodies, stated))
    here, noise, sigma = fit.solved(torch.as_tensor(fit.unknowns.space.start))
    found, estimates, space = fit.unknowns.posterior(here.x), posterior.estimates, fit.unknowns.space
    told = {"seconds": seconds, "bodies": bodies, "windows": len(recorded.rows), "step": fit.h, "rms": sigma.tolist()}
    if space.size:
        covariance = torch.linalg.inv(fit.curvature(here, noise, sigma)[0]).numpy()
        x, prior = here.x.numpy(), fit.unknowns.prior(here.x)[1].numpy()
        estimates = Estimates.of_covariance(
            space.parameters, space.numbers(x), space.number_slopes(x), covariance, prior,
            evidence=f"motions of {seconds:g} s", rows=recorded.q.shape[0] * recorded.q.shape[1],
        )  # fmt: skip
    return replace(found, estimates=estimates).with_settings(motions=told)
