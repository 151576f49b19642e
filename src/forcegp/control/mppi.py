"""Model-predictive path integral control on the compiled rollouts of a predictor."""

import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.control.tracking import Controller, OnFailure, per_joint
from forcegp.errors import InvalidInput, NumericalError, NumericalWarning, require_type
from forcegp.integration.integrators import check_time_step
from forcegp.posterior.predictor import Predictor
from forcegp.robots.arguments import whole_number

Cost = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Costs (...) of whole motions q, v (..., T+1, nv) in rad, rad/s (m, m/s) under torques u (..., T, nv) in Nm (N)."""

SHARE_OF_MEDIAN = 0.02
"""The temperature over the distance from the least to the median cost, where none is given."""
SMALLEST_SCALE = 0.05
"""Of the noise: sequences far from the plan find another way, those near to it refine the one that it has."""


class MPPI(Controller):
    """Torques that lower the expected cost of the next `steps` steps of `dt` seconds, found by random shooting.

    A call draws `samples` sequences around the plan, rolls them out and moves the plan to their mean with the weights
    exp(-cost / temperature) (Williams, Aldrich, Theodorou 2017); the best one takes part in the next call (Pinneri et
    al. 2020). Call it once in `dt` seconds, after some rounds of `improved`.

    * predictor: `posterior.predictor()`. functions: 0 plans with the mean of the learned forces, k with the mean cost
    under k functions drawn from the posterior. * cost: costs (...) of whole motions q, v (..., T+1, nv) under u (...,
    T, nv), the last state included. * torque_limits: largest absolute torques in Nm (N), a number or one per joint;
    None takes the efforts of the URDF. * noise: largest standard deviation around the plan, None for half the limits;
    it falls to a twentieth from sequence to sequence. correlation: of two successive torques, in [0, 1). temperature:
    None takes 2 % of the distance from the least to the median cost. on_failure: "raise", or "hold" for the last
    torque.

    Raises InvalidInput for arguments that do not fit, NumericalError where no sequence has a finite cost.
    """

    def __init__(
        self,
        predictor: Predictor,
        cost: Cost,
        *,
        dt: float,
        steps: int,
        torque_limits: Any = None,
        samples: int = 128,
        noise: Any = None,
        correlation: float = 0.95,
        temperature: float | None = None,
        functions: int = 0,
        integrator: str = "implicit-midpoint",
        seed: int = 0,
        threads: int | None = 1,
        on_failure: OnFailure = "raise",
    ) -> None:
        require_type("predictor", predictor, Predictor)
        if not callable(cost):
            raise InvalidInput(f"cost is {cost!r}; give a function of motions q, v (..., T+1, nv) and u (..., T, nv).")
        self.predictor, self.cost, nv = predictor, cost, predictor.nv
        check_time_step(dt)
        self.dt, self.steps = float(dt), whole_number("steps", steps, 1)
        self.samples, self.functions = whole_number("samples", samples, 2), whole_number("functions", functions, 0)
        self._seed = whole_number("seed", seed, 0)
        super().__init__(predictor.posterior.model.robot, torque_limits, on_failure)
        self.noise = per_joint("noise", 0.5 * self.torque_limits if noise is None else noise, nv)
        if not bool(self.noise.isfinite().all()):
            raise InvalidInput("noise is infinite where torque_limits are; give noise in Nm or N, or finite limits.")
        self.temperature = temperature
        if temperature is not None and not (isinstance(temperature, int | float) and 0.0 < temperature < math.inf):
            raise InvalidInput(f"temperature is {temperature!r}; give a positive number in units of the cost, or None.")
        if not (isinstance(correlation, int | float) and 0.0 <= correlation < 1.0):
            raise InvalidInput(f"correlation is {correlation!r}; give a number of at least 0 and below 1.")
        apart = torch.arange(self.steps, dtype=torch.float64)
        self._colour = torch.linalg.cholesky(correlation ** (apart[:, None] - apart).abs())
        self._scales = torch.logspace(math.log10(SMALLEST_SCALE), 0.0, self.samples, dtype=torch.float64)
        self._how: dict[str, Any] = {"integrator": integrator, "functions": functions, "seed": seed, "threads": threads}

    @override
    def facts(self) -> Mapping[str, object]:
        """The horizon, and how it is searched."""
        horizon = f"{self.steps} steps of {self.dt:g} s"
        return {**super().facts(), "horizon": horizon, "sequences": self.samples, "functions": self.functions}

    @override
    def restart(self) -> None:
        """Forget the plan: no torque at all, and the random numbers of the seed again."""
        super().restart()
        self.plan = self._best = torch.zeros(self.steps, self.robot.nv, dtype=torch.float64)
        self._generator = torch.Generator().manual_seed(self._seed)

    def __call__(self, q: Any, v: Any) -> Float[Tensor, " nv"]:
        """The torques (nv,) in Nm (N) for the next `dt` seconds from the state q, v (nv,) in rad, rad/s (m, m/s)."""

        def first() -> Tensor:
            plan = self.improved(self.plan, *self.vectors(q=q, v=v))
            self.plan, self._best = (torch.cat([x[1:], x[-1:]]) for x in (plan, self._best))
            return plan[0]

        return self.limited(first)

    def improved(self, plan: Tensor, q: Tensor, v: Tensor) -> Float[Tensor, "steps nv"]:
        """The plan (steps, nv) after one round of random sequences from the state q, v (nv,)."""
        normal = torch.randn(self.samples, *plan.shape, generator=self._generator, dtype=plan.dtype)
        noise = self._colour @ normal * self._scales[:, None, None] * self.noise
        noise[0] = 0.0  # the plan itself takes part, and the best sequence of the last call
        noise[1] = self._best - plan
        torques = plan + noise
        torques = torch.minimum(torch.maximum(torques, -self.torque_limits), self.torque_limits)
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericalWarning)  # of sequences that diverge: they cost infinitely much
            motions = self.predictor.rollouts(q, v, torques, self.dt, **self._how)
            costs = torch.as_tensor(self.cost(motions.q, motions.v, torques.expand_as(motions.a)))
        if costs.shape != motions.diverged_at.shape:
            raise InvalidInput(
                f"cost returned shape {tuple(costs.shape)} for motions {tuple(motions.q.shape)}; return one number per "
                f"motion, {tuple(motions.diverged_at.shape)}."
            )
        costs = costs.double().masked_fill((motions.diverged_at >= 0) | costs.isnan(), math.inf)
        costs = costs.mean(0) if self.functions else costs
        best = float(costs.min())
        if not math.isfinite(best):
            raise NumericalError(
                f"none of {self.samples} sequences of torques has a finite cost from here; check cost(q, v, u), give a "
                "smaller dt, less noise or fewer steps, or on_failure='hold'."
            )
        self._best = torques[costs.argmin()]
        temperature = self.temperature
        if temperature is None:
            temperature = max(SHARE_OF_MEDIAN * float(costs[costs.isfinite()].median() - best), 1e-12)
        return torch.einsum("s,stj->tj", torch.softmax((best - costs) / temperature, dim=0), torques)
