"""Controllers: tracking of a reference, with and without a model of the forces, along a surface, and MPPI."""

import math
import warnings
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from typing_extensions import override

from forcegp import errors
from forcegp.errors import InvalidInput, NumericalError, require_known, require_number, require_type
from forcegp.evidence.likelihood import FAR_FROM_SURFACE
from forcegp.integration.integrators import check_time_step
from forcegp.model import Model
from forcegp.posterior.prediction import JointForces, require_actuated
from forcegp.posterior.predictor import Predictor
from forcegp.posterior.preparation import rows_for
from forcegp.robots import Robot
from forcegp.robots.arguments import finite_vector, real_tensor, whole_number

LOOKED_AT, SLOPE, SLOW = 50, 1e-4, 1.0
"""Training states at which rates are looked at, the change of q and v for them, and the largest rate times a step for
which rk4 is taken: it diverges beyond 2.8."""


class Controller:
    """Limits the torques of a call, and raises where it cannot compute any.

    `last` (nv,) are those of the last call that had some, 0 at first, `saturated` (nv,) the joints limited in it.
    """

    def __init__(self, robot: Robot, torque_limits: Any) -> None:
        robot.require_vectors("controllers")
        self.robot = robot
        stated = [joint.effort_limit for joint in robot.joints]
        self.torque_limits = per_joint("torque_limits", stated if torque_limits is None else torque_limits, robot.nv)
        if not bool(self.torque_limits.any()):
            seen = "torque_limits are zero in every joint, so nothing can be controlled"
            why = ": the URDF states an effort of 0." if torque_limits is None else "."
            raise InvalidInput(f"{seen}; give Nm or N{why}")
        self.restart()

    def restart(self) -> None:
        """Forget earlier calls."""
        if past := vars(self).get("past"):
            past.forget()
        self.last = torch.zeros(self.robot.nv, dtype=torch.float64)
        self.saturated: Bool[Tensor, " nv"] = torch.zeros(self.robot.nv, dtype=torch.bool)

    def vectors(self, **given: Any) -> list[Tensor]:
        """Finite vectors (nv,). Raises InvalidInput for others."""
        return [torch.as_tensor(finite_vector(name, x, self.robot.nv)) for name, x in given.items()]

    def limited(self, asked: Float[Tensor, " nv"]) -> Float[Tensor, " nv"]:
        """These torques (nv,) within limits. Raises NumericalError where one is not finite."""
        if not bool(asked.isfinite().all()):
            raise NumericalError("the torques of this controller are not finite; check its gains and the state.")
        self.last = asked.clamp(-self.torque_limits, self.torque_limits)
        self.saturated = self.last != asked
        return self.last.clone()


def per_joint(name: str, given: Any, nv: int) -> Float[Tensor, " nv"]:
    """One number that is not negative per joint, of one for all or one each; infinite ones are allowed."""
    values = real_tensor(name, given, torch.device("cpu"))
    if values.shape not in ((), (nv,)) or values.is_meta:
        raise InvalidInput(f"{name} has shape {tuple(values.shape)} on {values.device}; give one number, or {nv}.")
    if not bool((values >= 0.0).all()):
        raise InvalidInput(f"{name} is {given!r}; give numbers of at least 0.")
    return values.expand(nv).clone()


Moving = Model | Predictor
ROUNDS = 20  # of Newton's method; one where no force depends on u
CLOSE = 1e-9  # relative to the forces
NO_TORQUES = (
    "no torques give the wanted acceleration: it is not finite, friction takes as much as they add, or a joint is not "
    "actuated; check the reference, the gains and the model's friction."
)


class TrackingController(Controller):
    """Feedback on a reference q_d, v_d, a_d (nv,), as an acceleration: a_d + Kd (v_d - v) + Kp (q_d - q).

    * stiffness Kp in 1/s^2 and damping Kd in 1/s, numbers or one per joint; None damps critically.
    * torque_limits: largest absolute torques in Nm (N); None takes the efforts of the URDF.

    Raises InvalidInput for arguments that do not fit and references out of range, NumericalError without a torque.
    """

    def __init__(self, robot: Robot, *, stiffness: Any, damping: Any = None, torque_limits: Any = None) -> None:
        super().__init__(robot, torque_limits)
        self.stiffness = per_joint("stiffness", stiffness, robot.nv)
        self.damping = 2.0 * self.stiffness.sqrt() if damping is None else per_joint("damping", damping, robot.nv)
        ends = [(joint.lower, joint.upper) for joint in robot.joints]
        self._range = torch.tensor(ends, dtype=torch.float64).unbind(1)

    def __call__(self, q: Any, v: Any, q_d: Any, v_d: Any, a_d: Any) -> Float[Tensor, " nv"]:
        """The torques (nv,) in Nm (N) at the state q, v under this reference, in rad, rad/s, rad/s^2 (m, ...)."""
        q, v, q_d, v_d, a_d = self.vectors(q=q, v=v, q_d=q_d, v_d=v_d, a_d=a_d)
        low, high = self._range
        if beyond := torch.nonzero((q_d < low) | (q_d > high))[:, 0].tolist():
            j = beyond[0]
            seen = f"the reference asks {self.robot.joint_names[j]} to be at {float(q_d[j]):.4g}"
            ends = f"it moves between {float(low[j]):.4g} and {float(high[j]):.4g}"
            raise InvalidInput(f"{seen}, and {ends}; change q_d, or the limits in the URDF.")
        return self.limited(self._torques(q, v, v_d, a_d, q_d - q, v_d - v))

    def feedback(self, e: Tensor, e_v: Tensor) -> Tensor:
        """The acceleration against errors of position and velocity."""
        return self.stiffness * e + self.damping * e_v

    @abstractmethod
    def _torques(self, q: Tensor, v: Tensor, v_d: Tensor, a_d: Tensor, e: Tensor, e_v: Tensor) -> Tensor:
        """Before limits."""


class ComputedTorque(TrackingController):
    """u = M (a_d + Kd (v_d - v) + Kp (q_d - q)) + h - Q_U: all forces compensated, also those learned.

    * model: `posterior.predictor()`, or a `Model` without anything learned, which takes longer.
    Forces are those at (q, v_d): at the measured velocity dry friction would follow noise and overshoot. Friction that
    remembers has the state of the positions that were seen (`past`); steps of at most `position_noise` (rad or m) are
    those of the encoder, which would wear it down.
    """

    def __init__(self, model: Moving, *, position_noise: float = 0.0, **settings: Any) -> None:
        known = model_of(model)
        require_number("position_noise", position_noise, "give rad (m) of at least 0", 0.0)
        if known.contacts:
            seen = "ComputedTorque moves a robot without contacts, and this model has one"
            raise InvalidInput(f"{seen}; use HybridForce, or posterior.with_contacts([]).")
        self.model, self.past = model, Past(known, position_noise)
        super().__init__(known.robot, **settings)

    @override
    def _torques(self, q: Tensor, v: Tensor, v_d: Tensor, a_d: Tensor, e: Tensor, e_v: Tensor) -> Tensor:
        self.past.see(q)
        at = joint_forces(self.model, q, v_d, self.last, self.past)  # at v dry friction would follow noise
        u = torques_for(self.model, q, v_d, at.M @ (a_d + self.feedback(e, e_v)), self.last, at, self.past)
        if u is None:
            raise NumericalError(NO_TORQUES)
        return u


def model_of(model: Moving) -> Model:
    """The robot and known forces of a model. Raises InvalidInput for what is none."""
    if isinstance(model, Model):
        return model
    if isinstance(model, Predictor):
        return model.posterior.model
    raise InvalidInput(f"model is a {type(model).__name__}; give posterior.predictor() or a Model.")


class Past:
    """What friction of a model remembers of the positions that a controller has seen.

    Steps of at most `least` (rad or m) from the last position that counted are noise of the encoder.
    """

    def __init__(self, model: Model, least: float = 0.0) -> None:
        self.memory, self.column, self.least = model.memory, model.memory_column, least
        self.forget()

    def forget(self) -> None:
        """Nothing was seen: `open` (m,) is how much of what is remembered depends on what was before."""
        self.z = torch.zeros(len(self.memory.names), dtype=torch.float64)
        self.open = torch.ones_like(self.z)
        self._last: Tensor | None = None

    def see(self, q: Float[Tensor, " nq"]) -> Float[Tensor, " m"]:
        """The joints are at q now: what is remembered then."""
        if self.memory.names and self._last is not None:
            step = self.memory.robot.difference(self._last, q)
            moved = torch.where(step.abs() > self.least, step, 0.0)
            other, self.z = self.z + self.open, self.memory.after(self.z, moved, 0.0)
            self.open = self.memory.after(other, moved, 0.0) - self.z
            q = self.memory.robot.space.integrate(self._last, moved)
        self._last = q.clone()
        return self.z

    def over(self, q: Float[Tensor, "T nq"]) -> tuple[Float[Tensor, "T m"], Float[Tensor, "T m"]]:
        """What is remembered at these rows, one after the other, and `open` there; without an encoder's noise."""
        if not self.memory.names:
            return q[:, :0], q[:, :0]
        before = torch.cat([q[:1] if self._last is None else self._last[None], q[:-1]])
        step, each = self.memory.robot.difference(before, q), self.z.expand(len(q), -1)
        shift = self.memory.after(0.0 * each, step, 0.0)  # a step is linear in what was before
        share, found = self.memory.after(0.0 * each + 1.0, step, 0.0) - shift, [(self.z.numpy(), self.open.numpy())]
        for b, w in zip(shift.numpy(), share.numpy(), strict=True):
            found.append((b + w * found[-1][0], w * found[-1][1]))
        z, opened = (torch.from_numpy(np.stack(each[1:])) for each in zip(*found, strict=True))
        self.z, self.open, self._last = z[-1], opened[-1], q[-1].clone()
        return z, opened

    def beside(self, u: Float[Tensor, "*batch k"], z: Float[Tensor, "*#batch m"]) -> Float[Tensor, "*batch nu"]:
        """u of the actuators with the columns of the memory."""
        return torch.cat([u[..., : self.column], z.expand(*u.shape[:-1], -1), u[..., self.column :]], dim=-1)


def joint_forces(model: Moving, q: Tensor, v: Tensor, u: Tensor, past: Past | None = None) -> JointForces:
    """Known and learned forces at a state (nv,) or states (n, nv) and what they act on; u without its `past`."""
    if past is not None and past.memory.names:
        at = joint_forces(model, q, v, past.beside(u, past.z))
        kept = [j for j in range(at.dQ_du.shape[-1]) if not 0 <= j - past.column < len(past.z)]
        return at._replace(dQ_du=at.dQ_du[..., kept])
    if isinstance(model, Predictor):
        return model.joint_forces(q, v, u)
    at = model.dynamics(q, v, u)
    return JointForces(at.Q_K, torch.eye(len(q), u.shape[-1], dtype=u.dtype), at.M, at.A, at.b, at.off())


def torques_for(
    model: Moving, q: Tensor, v: Tensor, needed: Tensor, u: Tensor, at: JointForces, past: Past
) -> Float[Tensor, " nv"] | None:
    """The u (nv,) that gives the forces `needed` at q, v, by Newton's method from u, where they are `at`, or None."""
    if not bool(needed.isfinite().all()):
        raise NumericalError(NO_TORQUES)
    for _ in range(ROUNDS):
        missing = needed - at.Q
        if float(missing.abs().max()) <= CLOSE * (1.0 + float(needed.abs().max())):
            return u
        step, singular = torch.linalg.solve_ex(at.dQ_du, missing)
        if int(singular) or not bool(step.isfinite().all()):
            return None
        u = u + step
        at = joint_forces(model, q, v, u, past)
    return None


class HybridForce(TrackingController):
    """u = M a + h - A^T lambda_d - Q_U(lambda_d): a reference along the contacts, and wanted forces against them.

    a is the acceleration of the feedback nearest, in the kinetic metric, that satisfies A a = b (Gauss' principle);
    lambda_d presses the robot onto the surface. No sensor is read: the force is right where the model is.

    * predictor: `posterior.predictor()` of a model with contacts and analytical mean; forces are those at (q, v_d).
    * tolerance: m that a contact's point may be off its surface. Beyond it the force would push nothing: "raise" a
      ContactError, or "release", where the robot follows the reference in the air (`released` is True then).
    * position_noise: as `ComputedTorque` has it.
    """

    def __init__(
        self,
        predictor: Predictor,
        *,
        tolerance: float = FAR_FROM_SURFACE,
        off_surface: Literal["raise", "release"] = "raise",
        position_noise: float = 0.0,
        **settings: Any,
    ) -> None:
        self.predictor = require_type("predictor", predictor, Predictor, " : posterior.predictor()")
        self.model = predictor.posterior.model
        if not self.model.contacts:
            seen = "HybridForce wants a force against a contact, and this model has none"
            raise InvalidInput(f"{seen}; name it in posterior.with_contacts([...]), or use ComputedTorque.")
        require_actuated(predictor.posterior)
        require_number("tolerance", tolerance, "give m, more than 0")
        require_known("off_surface", off_surface, "HybridForce", ("raise", "release"))
        super().__init__(self.model.robot, **settings)
        self.tolerance, self.released = tolerance, False
        self.past = Past(self.model, position_noise)
        self._free: ComputedTorque | None = None
        if off_surface == "release":
            self._free = ComputedTorque(predictor.posterior.with_contacts([]).predictor(covariance="none"), **settings)
            self._free.past = self.past

    @override
    def __call__(self, q: Any, v: Any, q_d: Any, v_d: Any, a_d: Any, normal_force: Any = None) -> Float[Tensor, " nv"]:
        """The torques (nv,) in Nm (N) for this reference and `normal_force` (m,) >= 0 in N on the robot.

        Raises ContactError for a point farther off its surface than `tolerance`.
        """
        count = len(self.model.contacts)
        wanted = real_tensor("normal_force", 0.0 if normal_force is None else normal_force, torch.device("cpu"))
        if normal_force is None or wanted.shape not in ((), (count,)) or not bool((wanted >= 0.0).all()):
            seen = f"normal_force is {normal_force!r}"
            advice = f"give the force in N with which the surface pushes, at least 0, one per contact ({count})."
            raise InvalidInput(f"{seen}; {advice}")
        self.wanted = wanted.expand(count)
        return super().__call__(q, v, q_d, v_d, a_d)

    @override
    def _torques(self, q: Tensor, v: Tensor, v_d: Tensor, a_d: Tensor, e: Tensor, e_v: Tensor) -> Tensor:
        self.past.see(q)
        at = joint_forces(self.predictor, q, v_d, self.last, self.past)
        far = float(at.off.abs().max())
        self.released = far > self.tolerance
        if self.released and self._free is None:
            seen = f"a contact's point is {far:.3g} m off its surface, and at most {self.tolerance:g} m are allowed"
            advice = 'move it there by ComputedTorque first, or give off_surface="release".'
            raise errors.ContactError(f"{seen}: a force there would push nothing; {advice}")
        if self.released and self._free is not None:
            return self._free._torques(q, v, v_d, a_d, e, e_v)
        free = a_d + self.feedback(e, e_v)
        towards = torch.linalg.solve(at.M, at.A.mT)  # M^-1 A^T
        a = free + towards @ torch.linalg.lstsq(at.A @ towards, at.b - at.A @ free, driver="gelsd").solution
        u = torques_for(self.predictor, q, v_d, at.M @ a - at.A.mT @ self.wanted, self.last, at, self.past)
        # where that finds none with shorter steps, or its error
        return self.predictor.inverse_dynamics(q, v_d, a, self.wanted, self.past.z).mean if u is None else u


def usual_integrator(predictor: Predictor, dt: float) -> str:
    """rk4 where forces change little within dt seconds, else the implicit midpoint rule, some ten times as slow."""
    # rates are the eigenvalues of da/dv and the square roots of those of da/dq, at training states and at rest there
    own = predictor.posterior
    rows = rows_for(own.training, own.trained, own.model)
    q, v, u = (x[:: max(1, len(x) // LOOKED_AT)] for x in (rows.q, rows.v, rows.u))
    q, v, u = torch.cat([q, q]), torch.cat([v, 0.0 * v]), torch.cat([u, u])

    def rate(change: Callable[[Tensor], tuple[Tensor, Tensor]]) -> float:
        steps = SLOPE * torch.eye(v.shape[1], dtype=v.dtype, device=v.device)
        ends = [[predictor.mean(*change(sign * step), u) for sign in (1.0, -1.0)] for step in steps]
        slopes = torch.stack([(high - low) / (2.0 * SLOPE) for high, low in ends], dim=-1)
        return float(torch.linalg.eigvals(slopes).abs().max())

    fastest = max(rate(lambda x: (q, v + x)), math.sqrt(rate(lambda x: (q + x, v))))
    return "rk4" if fastest * dt <= SLOW else "implicit-midpoint"


Cost = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Costs (...) of whole motions q, v (..., T+1, nv) in rad, rad/s (m, m/s) under torques u (..., T, nv) in Nm (N)."""

SHARE_OF_MEDIAN, CORRELATION = 0.02, 0.95
"""The temperature over the distance from the least to the median cost; the correlation of two successive torques."""
SMALLEST_SCALE = 0.05
"""Of the noise: sequences far from the plan find another way, those near to it refine the one that it has."""


class MPPI(Controller):
    """Torques that lower the expected cost of the next `steps` steps of `dt` seconds, found by random shooting.

    A call draws `samples` sequences around the plan, rolls them out and moves the plan to their mean with the weights
    exp(-cost / temperature) (Williams, Aldrich, Theodorou 2017); the best one takes part in the next call (Pinneri et
    al. 2020). Call it once in `dt` seconds, after some rounds of `improved`.

    * predictor: `posterior.predictor()`, with whose mean it plans.
    * cost: costs (...) of whole motions q, v (..., T+1, nv) under u (..., T, nv), the last state included.
    * torque_limits: largest absolute torques in Nm (N), a number or one per joint; None takes the efforts of the URDF.
    * noise: largest standard deviation around the plan, None for half the limits; it falls to a twentieth.
    * integrator: of the motions; None takes `usual_integrator`. The attribute `integrator` says which it is.

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
        integrator: str | None = None,
        seed: int = 0,
    ) -> None:
        require_type("predictor", predictor, Predictor)
        if not callable(cost):
            raise InvalidInput(f"cost is {cost!r}; give a function of motions q, v (..., T+1, nv) and u (..., T, nv).")
        self.predictor, self.cost, nv = predictor, cost, predictor.nv
        check_time_step(dt)
        self.dt, self.steps = float(dt), whole_number("steps", steps, 1)
        self.samples = whole_number("samples", samples, 2)
        self._seed = whole_number("seed", seed, 0)
        super().__init__(predictor.posterior.model.robot, torque_limits)
        self.noise = per_joint("noise", 0.5 * self.torque_limits if noise is None else noise, nv)
        if not bool(self.noise.isfinite().all()):
            raise InvalidInput("noise is infinite where torque_limits are; give noise in Nm or N, or finite limits.")
        apart = torch.arange(self.steps, dtype=torch.float64)
        self._colour = torch.linalg.cholesky(CORRELATION ** (apart[:, None] - apart).abs())
        self._scales = torch.logspace(math.log10(SMALLEST_SCALE), 0.0, self.samples, dtype=torch.float64)
        self.integrator = usual_integrator(predictor, self.dt) if integrator is None else integrator

    @override
    def restart(self) -> None:
        """Forget the plan: no torque at all, and the random numbers of the seed again."""
        super().restart()
        self.plan = self._best = torch.zeros(self.steps, self.robot.nv, dtype=torch.float64)
        self._generator = torch.Generator().manual_seed(self._seed)

    def __call__(self, q: Any, v: Any) -> Float[Tensor, " nv"]:
        """The torques (nv,) in Nm (N) for the next `dt` seconds from the state q, v (nv,) in rad, rad/s (m, m/s)."""
        plan = self.improved(self.plan, *self.vectors(q=q, v=v))
        self.plan, self._best = (torch.cat([x[1:], x[-1:]]) for x in (plan, self._best))
        return self.limited(plan[0])

    def improved(self, plan: Tensor, q: Tensor, v: Tensor) -> Float[Tensor, "steps nv"]:
        """The plan (steps, nv) after one round of random sequences from the state q, v (nv,)."""
        normal = torch.randn(self.samples, *plan.shape, generator=self._generator, dtype=plan.dtype)
        noise = self._colour @ normal * self._scales[:, None, None] * self.noise
        noise[0] = 0.0  # the plan itself takes part, and the best sequence of the last call
        noise[1] = self._best - plan
        torques = (plan + noise).clamp(-self.torque_limits, self.torque_limits)
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore", errors.NumericalWarning)  # motions that diverge cost infinitely much
            motions = self.predictor.rollouts(q, v, torques, self.dt, integrator=self.integrator, threads=1)
            costs = torch.as_tensor(self.cost(motions.q, motions.v, torques.expand_as(motions.a)))
        if costs.shape != motions.diverged_at.shape:
            seen = f"cost returned shape {tuple(costs.shape)} for motions {tuple(motions.q.shape)}"
            raise InvalidInput(f"{seen}; return one number per motion, {tuple(motions.diverged_at.shape)}.")
        costs = costs.double().masked_fill((motions.diverged_at >= 0) | costs.isnan(), math.inf)
        best = float(costs.min())
        if not math.isfinite(best):
            seen = f"none of {self.samples} sequences of torques has a finite cost from here"
            raise NumericalError(f"{seen}; check cost(q, v, u), give a smaller dt, less noise or fewer steps.")
        self._best = torques[costs.argmin()]
        temperature = max(SHARE_OF_MEDIAN * float(costs[costs.isfinite()].median() - best), 1e-12)
        return torch.einsum("s,stj->tj", torch.softmax((best - costs) / temperature, dim=0), torques)
