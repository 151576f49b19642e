"""Where a robot goes according to a fitted model: `Rollout`, and one step x+ = f(x, u) with its derivatives."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from forcegp.codegen.library import RowFunction
from forcegp.errors import CompilerError, InvalidInput, NumericalError, NumericalWarning
from forcegp.inference.pathwise import draw_functions
from forcegp.integration import Feedback, Integrator, Trajectory, integrate
from forcegp.integration.integrators import NO_ROOT, check_start, rows_jacobian, steps_by, warn_of_divergence
from forcegp.model import Model
from forcegp.posterior.fitted import MotionIntervals
from forcegp.posterior.prediction import state_tensor
from forcegp.posterior.programs import steps_of
from forcegp.robots.arguments import broadcast_batch
from forcegp.robots.manifold import ConfigurationSpace

STEPS_TO_COMPILE = 400
"""Steps of some milliseconds each, and as many for every contact; fewer are done before a program is compiled."""
TOGETHER, FUNCTIONS = 10, 3  # motions, and unknown functions, that cost as much as one step again
STIFF, CHANGE, TINY = 2.5, 1e-3, 1e-6  # rate of decay times dt that rk4 cannot take (2.785); rad/s (m/s), and s
ROWS_PER_BLOCK = 4096  # states whose constraint is evaluated at once

Inputs = Float[Tensor, "T n nu"]
States = Float[Tensor, "n rows"]
AccelerationFunction = Callable[[Tensor, Tensor, Tensor], Tensor]
"""(q, v, u) -> a, all of one shape."""


def accelerations(posterior: Any, model: Model, samples: int = 0, seed: int = 0) -> AccelerationFunction:
    """The mean acceleration of a `Posterior` at states (n, nv), or of `samples` functions, each at its part."""
    prior, standardize = posterior.trained.unknown, posterior.likelihood.standardization
    samples = samples if len(posterior.kernels.kernels) else 0  # without unknown forces all functions are the same
    latent, functions = posterior.latent, posterior.latent.mean
    if samples:
        functions = draw_functions(latent, samples, seed, posterior.widening)

    def acceleration(q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        shape = v.shape
        if samples:  # not -1: u may have no columns
            q, v, u = (x.reshape(samples, len(x) // samples, x.shape[-1]) for x in (q, v, u))
        dynamics = model.dynamics(q, v, u)
        affine, mixing = dynamics.acceleration_map(), prior.direction(dynamics)
        if not mixing.shape[-1]:
            return affine.offset.reshape(shape)
        return affine((mixing @ functions(standardize(prior.features(dynamics)))[..., None])[..., 0]).reshape(shape)

    return acceleration


def moved(
    batch: Sequence[int],
    loops: Sequence[RowFunction] | None,
    method: Integrator,
    acceleration: AccelerationFunction,
    model: Model,
    q: Float[Tensor, "n nq"],
    v: Float[Tensor, "n nv"],
    u: Inputs,
    dt: float,
    *,
    feedback: Feedback | None = None,
    threads: int | None = None,
    what: str = "motions",
) -> Trajectory:
    """`integrate` with these batch dimensions, by compiled loops where there are some; laws of the model remember.

    Each loop takes as many motions as the others, one after the other. Those that a loop cannot carry to the end (they
    diverge, Newton's method fails) are integrated again by torch, with those of the other loops from the same place.
    """

    def shaped(q: Tensor, v: Tensor, a: Tensor, *ended: Tensor) -> Trajectory:
        return Trajectory(*(x.reshape([*batch, *x.shape[1:]]) for x in (q, v, a, *ended)))

    if loops is None:
        u, feedback = remembering(model, u, dt, feedback)
        found = integrate(method, acceleration, q, v, u, dt, feedback=feedback, what=what)
        return shaped(*(x.movedim(0, 1) for x in found[:3]), *found[3:])
    check_start(v, dt)
    own, (steps, count, _) = len(q) // len(loops), u.shape
    kept = ((q, steps + 1), (v, steps + 1), (v, steps))
    Q, V, A = (torch.empty(count, rows, x.shape[-1], dtype=torch.float64) for x, rows in kept)
    ended = torch.empty(count, dtype=torch.float64)
    given = [x.flatten(1).contiguous() for x in (q, v, u.movedim(0, 1))]
    seconds = torch.tensor([[dt]], dtype=torch.float64)
    for k, loop in enumerate(loops):
        at = slice(own * k, own * (k + 1))
        made = [x[at].view(own, -1) for x in (Q, V, A, ended)]
        loop.rows([*(x[at] for x in given), seconds], made, threads, least=8)
    ended, not_found = ended.long(), torch.zeros(count, dtype=torch.bool)
    left = torch.nonzero((ended < -1).view(-1, own).any(0))[:, 0]
    if len(left):
        rows = (own * torch.arange(len(loops))[:, None] + left).flatten()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericalWarning)  # given below, of all motions
            some, feedback = remembering(model, u[:, rows], dt, None)
            again = integrate(method, acceleration, q[rows], v[rows], some, dt, feedback=feedback)
        for kept, found in ((Q, again.q), (V, again.v), (A, again.a)):
            kept[rows] = found.movedim(0, 1)
        ended[rows], not_found[rows] = again.diverged_at, again.not_found
    warn_of_divergence(ended, not_found, dt, what)
    return shaped(Q, V, A, ended, not_found)


@dataclass(frozen=True, eq=False)
class Rollout:
    """Motions of T steps from one or more initial states; batch dimensions are those of q0.

    `time` (T+1,) in s; `q`, `v` (..., T+1, nv) in rad and rad/s (m and m/s), of a base that moves q (..., T+1, nq),
    angles not wrapped; `a` (..., T, nv) in rad/s^2 (m/s^2) at row k under u[k] and what feedback adds to it.
    `diverged_at` (...) is the row from which on a motion is NaN because it diverged, -1 if it lasted to the end.
    `samples` (S, ...) are the same under S functions drawn from the posterior, one function each; None without.
    `intervals` are the calibrated widths of the posterior's. Where a base moves, deviations of q are steps (nv,) from
    the q here, in the axes of the base: `robot.difference(rollout.q, other)`.
    """

    time: Float[Tensor, " rows"]
    q: Float[Tensor, "*batch rows nq"]
    v: Float[Tensor, "*batch rows nv"]
    a: Float[Tensor, "*batch steps nv"]
    diverged_at: Int[Tensor, "*batch"]
    integrator: str
    model: Model
    samples: "Rollout | None" = None
    intervals: MotionIntervals | None = None

    @property
    def space(self) -> ConfigurationSpace:
        """Of the positions."""
        return self.model.robot.space

    @cached_property
    def constraint(self) -> Float[Tensor, "*batch rows m"]:
        """c(q) (..., T+1, m) in m, the distance of every contact point from its surface, where that is signed."""
        lost = torch.isnan(self.q).any(-1, keepdim=True)
        q = torch.where(lost, self.space.neutral().to(self.q), self.q)  # no quaternion is made of NaN
        c = q.new_zeros(*q.shape[:-1], len(self.model.contacts))
        for own, rows in zip(*(x.flatten(0, -2).split(ROWS_PER_BLOCK) for x in (c, q)), strict=True):
            kinematics = self.model.robot.kinematics(rows)
            for k, contact in enumerate(self.model.contacts):
                own[:, k] = contact.distance(kinematics)
        return c.masked_fill(lost, torch.nan)

    def interval(self, quantity: Literal["q", "v"] = "q") -> tuple[Tensor, Tensor]:
        """Lower and upper ends (..., T+1, nv) of the 95 % interval: calibrated, or quantiles of the samples.

        Of q where a base moves, as steps: `low <= robot.difference(rollout.q, other) <= high`. InvalidInput without.
        """
        if self.intervals is None:
            low, high = self._sampled(quantity, least=1).quantile(self.time.new_tensor([0.025, 0.975]), dim=0)
            return low, high
        center, enough = getattr(self, quantity), self.samples is not None and len(self.samples.q) > 1
        if quantity == "q" and not self.space.is_vector_space:
            center = torch.where(center.isnan().any(-1, keepdim=True), torch.nan, 0.0)
        half = self.intervals.half_width(quantity, self.time, self.std(quantity) if enough else None)
        return center - half, center + half

    def std(self, quantity: Literal["q", "v"] = "q") -> Tensor:
        """Standard deviation over two samples or more, NaN from where one diverged; of steps where a base moves."""
        return self._sampled(quantity, least=2).std(0)

    def _sampled(self, quantity: Literal["q", "v"], least: int) -> Tensor:
        count = 0 if self.samples is None else self.samples.q.shape[0]
        if count < least:
            seen = f"this rollout has {count} samples, {least} are needed"
            raise InvalidInput(f"{seen}; ask for rollout(..., samples=20).")
        values: Tensor = getattr(self.samples, quantity)
        return values if quantity != "q" or self.space.is_vector_space else self.steps_to(values)

    def steps_to(self, q: Tensor) -> Tensor:
        """From the q here to others (..., T+1, nq), as steps (..., T+1, nv); NaN where one of them has diverged."""
        if self.space.is_vector_space:
            return q - self.q
        lost = (torch.isnan(q).any(-1) | torch.isnan(self.q).any(-1))[..., None]
        here, there = (torch.where(lost, self.space.neutral().to(q), x) for x in (self.q, q))
        return torch.where(lost, torch.nan, self.space.difference(here, there))

    def contains(self, q: Tensor) -> Tensor:
        """Whether positions (..., T+1, nq) lie in the 95 % interval (..., T+1, nv), 1 or 0; NaN after a divergence."""
        low, high = self.interval()
        off = q if self.space.is_vector_space else self.steps_to(q)
        return torch.where(torch.isnan(high - low), torch.nan, ((low <= off) & (off <= high)).to(off))


def predicted(posterior: Any, q0: Any, v0: Any, u: Any, dt: float, integrator: str, **how: Any) -> Rollout:
    """As `Posterior.rollout`, but by implicit midpoints where motions of rk4 end since friction is too stiff for it."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = posterior.rollout(q0, v0, u, dt, integrator=integrator, **how)
    if integrator == "rk4" and bool((found.diverged_at >= 0).any()):
        q, v, u_0 = (torch.as_tensor(x).to(found.q) for x in (q0, v0, u[:, :1]))
        unit = CHANGE * torch.eye(v.shape[-1]).to(v)  # what a change of v does to a, (nv, n, nv)
        steps = posterior.rollout(q, v + torch.stack([0.0 * unit[0], *unit])[:, None], u_0, TINY).v[..., 1, :]
        rates = torch.linalg.eigvals((steps[1:] - steps[0] - unit[:, None]).nan_to_num().movedim(0, -1)).abs().amax(-1)
        if float(rates.median()) * dt > STIFF * CHANGE * TINY:
            return posterior.rollout(q0, v0, u, dt, integrator="implicit-midpoint", **how)
    for each in told:
        warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    return found


def remembering(model: Model, u: Inputs, dt: float, feedback: Feedback | None) -> tuple[Inputs, Feedback | None]:
    """u without memory but in its first row, and feedback that adds what laws remember of the motion since then."""
    memory, first = model.memory, model.memory_column
    if not memory.names:
        return u, feedback
    columns = slice(first, first + len(memory.names))
    begin, u = u[0, :, columns].clone(), u.clone()
    u[..., columns] = 0.0
    last: list[tuple[Tensor, Tensor]] = []

    def added(k: int, q: Tensor, v: Tensor) -> Tensor:
        now = begin
        if k == 0:
            last.clear()
        else:
            before, was = last.pop()
            now = memory.after(was, model.robot.difference(before, q), dt)
        last.append((q, now))
        other = v.new_zeros(len(v), u.shape[-1]) if feedback is None else feedback(k, q, v).clone()
        return torch.cat([other[..., : columns.start], now, other[..., columns.stop :]], dim=-1)

    return u, added


def loops_for(
    posterior: Any, model: Model, integrator: str, motions: Sequence[int], samples: int, seed: int
) -> list[RowFunction] | None:
    """Compiled loops, where steps and number of `motions` are worth compiling them."""
    work = motions[0] * (1.0 + motions[1] / TOGETHER) * (1.0 + len(posterior.latent_names) / FUNCTIONS)
    work *= max(1, samples) * (1 + len(model.contacts))
    if integrator not in steps_of(model.robot.space) or work < STEPS_TO_COMPILE:
        return None
    try:
        return posterior.programs(model).loops(integrator, samples, seed)
    except CompilerError as error:
        warnings.warn(f"motions are computed by torch, some 50 times slower: {error}", NumericalWarning, stacklevel=4)
    except InvalidInput:  # an operation that no program holds, another device
        pass
    return None


def flat_feedback(feedback: Feedback, batch: Sequence[int], size: int) -> Feedback:
    """Feedback that sees the caller's batch dimensions as one of (n, nv). Raises InvalidInput for other shapes."""

    def flat(k: int, q: Tensor, v: Tensor) -> Tensor:
        shape = (*batch, size)
        added = feedback(k, q.reshape(*batch, -1), v.reshape(*batch, -1))
        if not isinstance(added, Tensor) or added.shape != shape:
            given = tuple(added.shape) if isinstance(added, Tensor) else type(added).__name__
            raise InvalidInput(f"feedback gave {given} at step {k}; it must give a tensor {shape}, as u.")
        return added.reshape(-1, size)

    return flat


def checked_start(
    sizes: tuple[int, int, int], device: torch.device, q0: Any, v0: Any, u: Any
) -> tuple[Tensor, Tensor, Tensor, torch.Size]:
    """q0, v0 (n, size), u (T, n, size), and the batch; InvalidInput also for tensors with gradients."""
    given = {}
    for size, (name, values) in zip(sizes, (("q0", q0), ("v0", v0), ("u", u)), strict=True):
        tensor = given[name] = state_tensor(name, values, size, device).to(device)
        if tensor.requires_grad and torch.is_grad_enabled():
            seen = f"{name} requires a gradient, which a rollout drops"
            advice = f"multiply the A and B of steps, predictor.linearize_step, and give {name}.detach()."
            raise InvalidInput(f"{seen}; {advice}")
        if name == "u" and tensor.dim() < 2:
            raise InvalidInput(f"u has shape {tuple(tensor.shape)}; it must be (..., T, {size}), one row per step.")
    q, v, forces = given.values()
    if not forces.shape[-2]:
        raise InvalidInput("u has no rows; a rollout has at least one step.")
    batch = broadcast_batch({"q0": q.shape[:-1], "v0": v.shape[:-1], "u": forces.shape[:-2]})
    if not batch.numel():
        raise InvalidInput(f"q0 has shape {tuple(q.shape)}: no motion at all; give at least one initial state.")
    q, v = (x.expand(*batch, -1).reshape(-1, x.shape[-1]) for x in (q, v))
    forces = forces.expand(*batch, -1, -1).reshape(batch.numel(), *forces.shape[-2:]).movedim(1, 0).contiguous()
    return q, v, forces, batch


class StepLinearization(NamedTuple):
    """The state (q, v) after a step from x = (q, v) under u, and the affine model of the step: x+ = A x + B u + c.

    `A` (2 nv, 2 nv), `B` (2 nv, nu), `c` (2 nv,), all with the leading dimension of states. Where a base moves, q in x
    and x+ is a step (nv,) from the given q and from the `q` (nq,) here, at which both are 0.
    """

    q: Tensor
    v: Tensor
    A: Tensor
    B: Tensor
    c: Tensor


def stepped(mean: AccelerationFunction, model: Model, x: States, dt: Any, integrator: Any) -> Float[Tensor, "n state"]:
    """[q, v] one step after the rows x = [q, v, u], as `Predictor.step` documents it."""
    q, v, u = x.split(model.sizes, dim=-1)
    step = steps_by(integrator, model, dt)(lambda q, v: mean(q, v, u), q, v, dt)
    if not bool(step.found.all()):
        row = int((~step.found).nonzero()[0])
        raise NumericalError(f"{NO_ROOT} from state {row}; give a dt below {dt:g} s, or check that state.")
    return torch.cat([step.q, step.v], dim=-1)


def linearized_step(predictor: Any, x: States, dt: Any, integrator: Any) -> StepLinearization:
    """The step of a `Predictor` with its derivatives, by the chain rule; of an implicit one by implicit functions."""
    model = predictor.posterior.model
    if not model.robot.space.is_vector_space:
        return _on_manifold(predictor.mean, model, x, dt, integrator)
    method, (q, v, u) = steps_by(integrator, model, dt), x.detach().split(model.sizes, dim=-1)
    nv, unit = q.shape[-1], torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)

    def joined(value: Tensor, slopes: Tensor) -> Tensor:
        """A value and its derivatives in q, v, u as one row, for explicit steps are linear in these."""
        return torch.cat([value[..., None], slopes.expand(*value.shape, -1)], dim=-1).flatten(1)

    def acceleration(at_q: Tensor, at_v: Tensor) -> Tensor:
        at_q, at_v = (part.unflatten(1, (nv, -1)) for part in (at_q, at_v))
        a, da_dq, da_dv, da_du = predictor.linearize(at_q[..., 0], at_v[..., 0], u)
        return joined(a, da_dq @ at_q[..., 1:] + da_dv @ at_v[..., 1:] + da_du @ unit[2 * nv :])

    start_q, start_v = joined(q, unit[:nv]), joined(v, unit[nv : 2 * nv])
    if integrator == "implicit-midpoint":
        middle = 0.5 * (v + predictor.stepped(x.detach(), dt, integrator)[:, nv:])
        _, da_dq, da_dv, da_du = predictor.linearize(q + 0.5 * dt * middle, middle, u)
        J = unit[:nv, :nv] - 0.5 * dt * (da_dv + 0.5 * dt * da_dq)
        right = torch.cat([0.5 * dt * da_dq, unit[:nv, :nv].expand_as(J), 0.5 * dt * da_du], dim=-1)
        at_middle = joined(middle, torch.linalg.solve(J, right))
        end = start_q + dt * at_middle, 2.0 * at_middle - start_v
    else:
        found = method(acceleration, start_q, start_v, dt)
        end = found.q, found.v
    there, slopes = torch.cat([part.unflatten(1, (nv, -1)) for part in end], dim=1).split([1, len(unit)], dim=-1)
    c = there[..., 0] - (slopes @ x.detach()[..., None])[..., 0]
    (q, v), (A, B) = there[..., 0].split(nv, dim=-1), slopes.split([2 * nv, u.shape[-1]], dim=-1)
    return StepLinearization(q, v, A, B, c)


def _on_manifold(mean: AccelerationFunction, model: Model, x: States, dt: Any, integrator: Any) -> StepLinearization:
    """The same where positions do not add up, in steps from q and from the q after it; by backward passes of `mean`."""
    space, (nq, nv, _) = model.robot.space, model.sizes
    q, rest = x.detach().split([nq, x.shape[-1] - nq], dim=-1)
    there = stepped(mean, model, x.detach(), dt, integrator)[:, :nq]

    def moved(z: Tensor) -> Tensor:
        end = stepped(mean, model, torch.cat([space.integrate(q, z[:, :nv]), z[:, nv:]], dim=-1), dt, integrator)
        return torch.cat([space.difference(there, end[:, :nq]), end[:, nq:]], dim=-1)

    end, slopes = rows_jacobian(moved, torch.cat([torch.zeros_like(rest[:, :nv]), rest], dim=-1))
    A, B = slopes.split([2 * nv, slopes.shape[-1] - 2 * nv], dim=-1)
    c = end - (A[..., nv:] @ rest[:, :nv, None] + B @ rest[:, nv:, None])[..., 0]
    return StepLinearization(there, end[:, nv:], A, B, c)
