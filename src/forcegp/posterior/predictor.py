"""`Predictor`: a posterior as C programs, for control rates, where a prediction is due every millisecond."""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from forcegp.codegen.library import NOT_FINITE, RowFunction, are_plain, as_plain, require_plain
from forcegp.errors import CompilerError, InvalidInput, NumericalError, NumericalWarning
from forcegp.inference.prepared_kernels import CompressedCovariance
from forcegp.integration.integrators import Trajectory, rows_jacobian, steps_by
from forcegp.posterior.prediction import Gaussian, JointForces, Linearization, inverse_dynamics, joint_force
from forcegp.posterior.programs import Programs, steps_of
from forcegp.posterior.rollout import StepLinearization, accelerations, checked_start, linearized_step, moved, stepped
from forcegp.robots.arguments import real_tensor, require_finite, whole_number
from forcegp.robots.manifold import ConfigurationSpace
from forcegp.summary import Summary

INSTEAD_OF_TRANSFORMS = (
    "take derivatives by linearize or a backward pass, give many states as rows (n, nv), or make the predictor with "
    "compile=False"
)
BY_TORCH = "predictions are computed by torch, some hundred times slower"
BLOCK = 256  # states that torch works on at once, so that their kernel values stay in the processor's cache


@dataclass(frozen=True, eq=False, repr=False)
class Predictor(Summary):
    """The acceleration that a posterior predicts, fast; made by `posterior.predictor()`.

    States are float64 tensors or arrays (size,) or (n, size), in the units of `predict`, with the `sizes` of q, v and
    u. Results are those of `predict`: means to rounding, covariances exactly or never below, as `kind` says
    ("compressed", "exact", "none"; `rank`, `inflation`). Differentiable once in tensors that require gradients; with
    `compile=False` any number of times, and by `torch.func`, but for `vmap`. `prepare_seconds` include the compiler.

    Raises InvalidInput for wrong shapes, values that are not finite and where derivatives would be lost, NumericalError
    where the result is not finite. Where nothing can be compiled, torch computes the same, with one NumericalWarning.
    """

    posterior: Any
    space: ConfigurationSpace
    sizes: tuple[int, int, int]  # of q, v and u
    device: torch.device
    code: Programs | None
    kind: str
    compressed: CompressedCovariance | None
    prepare_seconds: float = 0.0
    _made: dict[Any, Any] = field(default_factory=dict)
    """Programs by their kind, and loops by integrator, functions and seed."""

    def __getstate__(self) -> dict[str, Any]:
        kept = {name: value for name, value in vars(self).items() if name != "by_torch"}
        return kept | {"_made": {}}  # loaded code means nothing in another process

    @cached_property
    def by_torch(self) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
        """The mean acceleration of rows."""
        return accelerations(self.posterior, self.posterior.model)

    @override
    def facts(self) -> dict[str, object]:
        """What it predicts, and how long preparing took."""
        covariance = {"joints": self.nv, "covariance": self.kind, "device": self.device}
        return {**covariance, "prepared in": f"{self.prepare_seconds:.2g} s"}

    @property
    def nv(self) -> int:
        """Number of degrees of freedom."""
        return self.sizes[1]

    @property
    def rank(self) -> int | None:
        """How many combinations of the data the covariance uses; None unless it is compressed."""
        return None if self.compressed is None else self.compressed.rank

    @property
    def inflation(self) -> Tensor | None:
        """Standard deviations over the exact ones, minus 1, at states that did not choose the compression."""
        return None if self.compressed is None else self.compressed.inflation

    def mean(self, q: Any, v: Any, u: Any) -> Tensor:
        """The mean acceleration (nv,) or (n, nv) in rad/s^2 or m/s^2."""
        compiled = self.compiled("mean")
        if compiled and (one := self._one_state(q, v, u)):
            return self._at_one("mean", compiled, one)[0]
        states, single = self._states(q, v, u)
        if not compiled:
            return _finished([self.by_torch(*part) for part in _blocks(states)], single)
        if torch.is_grad_enabled() and any(x.requires_grad for x in states):
            return _finished([MeanWithGradient.apply(self, *states)], single)  # type: ignore[list-item]  # torch does not type `apply`
        return _single(self.run("mean", states)[0], single)

    def __call__(self, q: Any, v: Any, u: Any) -> tuple[Tensor, Tensor]:
        """Mean (nv,) and covariance (nv, nv) of the acceleration, or of rows, without noise."""
        if self.kind == "none":
            raise InvalidInput("this predictor has no covariance; make it with covariance='compressed' or 'exact'.")
        nv, compiled = self.nv, self.compiled("covariance") if self.compressed is not None else None
        if compiled and (one := self._one_state(q, v, u)):
            a, covariance = self._at_one("covariance", compiled, one)
            return a, covariance.view(nv, nv)
        states, single = self._states(q, v, u)
        if compiled and not (torch.is_grad_enabled() and any(x.requires_grad for x in states)):
            a, covariance = self.run("covariance", states)
            return _single(a, single), _single(covariance.view(-1, nv, nv), single)
        means, covariances = zip(*(self._with_covariance(*part) for part in _blocks(states)), strict=True)
        return _finished(means, single), _finished(covariances, single)

    def linearize(self, q: Any, v: Any, u: Any) -> Linearization:
        """The mean and its Jacobians in q, or where a base moves in a step from q (nv,), v and u; without a graph."""
        (_, nv, nu), compiled = self.sizes, self.compiled("linearize")
        if compiled and (one := self._one_state(q, v, u)):
            a, jacobian = self._at_one("linearize", compiled, one)
            return Linearization(a, *jacobian.view(nv, -1).split([nv, nv, nu], dim=-1))
        states, single = self._states(q, v, u)
        require_plain(states, "linearize", "take derivatives of `mean` instead, of a predictor with compile=False")
        a, jacobian = self.run("linearize", states)
        jacobian = _single(jacobian.view(-1, nv, 2 * nv + nu), single)
        return Linearization(_single(a, single), *jacobian.split([nv, nv, nu], dim=-1))

    def step(self, q: Any, v: Any, u: Any, dt: float, integrator: str = "symplectic-euler") -> tuple[Tensor, Tensor]:
        """The state (q, v) `dt` seconds later under constant u, (size,) or (n, size); differentiable as `mean`.

        `integrator` is "symplectic-euler", "rk4" or "implicit-midpoint", which is differentiable once. InvalidInput for
        other names and a dt that is no positive number, NumericalError where an implicit step is not found.
        """
        states, single = self._states(q, v, u)
        state = self.stepped(torch.cat(states, dim=-1), dt, integrator)
        q, v = (state[0] if single else state).split(self.sizes[:2], dim=-1)
        return q, v

    def stepped(self, x: Tensor, dt: float, integrator: str) -> Tensor:
        """[q, v] after a step from the rows x = [q, v, u]; implicit ones by the compiled loop where that finds it."""
        implicit = integrator == "implicit-midpoint" and integrator in steps_of(self.space)
        if implicit and self.code is not None and not x.requires_grad and len(x):
            q, v, u = x.split(self.sizes, dim=-1)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NumericalWarning)  # of a step that is not found, which is an error here
                motion = self.rollouts(q, v, u[:, None], dt, integrator=integrator)
            if bool(motion.v.isfinite().all()):
                return torch.cat([motion.q[:, 1], motion.v[:, 1]], dim=-1)
        return stepped(self.mean, self.posterior.model, x, dt, integrator)

    def linearize_step(
        self, q: Any, v: Any, u: Any, dt: float, integrator: str = "symplectic-euler"
    ) -> StepLinearization:
        """That state and the affine model x+ = A x + B u + c, x = (q, v) or (step from q, v), without a graph."""
        states, single = self._states(q, v, u)
        linear = linearized_step(self, torch.cat(states, dim=-1), dt, integrator)
        return StepLinearization(*(part[0] for part in linear)) if single else linear

    def rollouts(
        self,
        q0: Any,
        v0: Any,
        u: Any,
        dt: float,
        *,
        integrator: str = "symplectic-euler",
        functions: int = 0,
        seed: int = 0,
        threads: int | None = None,
    ) -> Trajectory:
        """Motions from q0 (..., nq), v0 (..., nv) under u (..., T, nu), with batches that broadcast, without a graph.

        As `posterior.rollout`, where of what laws remember the first row of u counts, under the mean, or with
        `functions` under each of so many drawn ones, which are the first dimension. Compiled, many steps are done at
        once on `threads` threads (None: as torch has). Raises InvalidInput for arguments that do not fit.
        """
        threads = None if threads is None else whole_number("threads", threads, 1)
        functions, seed = whole_number("functions", functions, 0), whole_number("seed", seed, 0)
        start, v, forces, batch = checked_start(self.sizes, self.device, q0, v0, u)
        model = self.posterior.model
        method, loops, acceleration = steps_by(integrator, model, dt), None, self.mean
        if integrator in steps_of(self.space):
            loops = self._of_code((integrator, functions, seed), lambda code: code.loops(integrator, functions, seed))
        if functions:

            def acceleration(q: Tensor, v: Tensor, u: Tensor) -> Tensor:  # drawn when a motion is left to torch
                return accelerations(self.posterior, model, functions, seed)(q, v, u)

            start, v, forces = start.repeat(functions, 1), v.repeat(functions, 1), forces.repeat(1, functions, 1)
            batch = (functions, *batch)
        with torch.no_grad():
            return moved(batch, loops, method, acceleration, model, start, v, forces, dt, threads=threads)

    def joint_forces(self, q: Any, v: Any, u: Any) -> JointForces:
        """Known and learned forces at a state (nv,) or states (n, nv) and what they act on, without a graph."""
        program, (_, nv, nu), m = self.compiled("forces"), self.sizes, len(self.posterior.model.contacts)
        if program and (one := self._one_state(q, v, u)):
            Q, around = self._at_one("forces", program, one)
        else:
            states, single = self._states(q, v, u)
            Q, around = (_single(x, single) for x in self.run("forces", states))
        dQ, M, A, b, off = around.split([nv * nu, nv**2, m * nv, m, m], dim=-1)
        return JointForces(Q, dQ.unflatten(-1, (nv, nu)), M.unflatten(-1, (nv, nv)), A.unflatten(-1, (m, nv)), b, off)

    def inverse_dynamics(self, q: Any, v: Any, a: Any, normal_force: Any = None, memory: Any = None) -> Gaussian:
        """The actuator forces u (nv,) or (n, nv) in Nm or N that make the acceleration a (rad/s^2 or m/s^2).

        u = M a + h - A^T lambda - Q_U; friction under load is that of `normal_force` lambda (m,) or (n, m) in N,
        positive where the surface pushes the robot off; `memory` (m,) or (n, m) what laws remember. The covariance is
        that of Q_U at u, to first order. `a` has to obey A a = b, else contacts change it. Raises InvalidInput for
        models without bodies or actuation, or without a memory that they need; NumericalError where no u is found.
        """
        states, single = self._states(q, v, a, "qva")
        found = inverse_dynamics(self.posterior, states, normal_force, self.kind != "none", memory)
        if not single:
            return found
        return Gaussian(found.mean[0], None if found.covariance is None else found.covariance[0])

    def run(self, kind: str, states: Sequence[Tensor]) -> list[Tensor]:
        """The outputs (n, size) of a program at states (n, nv) that were checked, without a graph."""
        states, count = [x.detach().contiguous() for x in states], len(states[0])
        if (compiled := self.compiled(kind)) is None:
            return self._by_torch(kind, states)
        outputs = [torch.empty(count, size, dtype=torch.float64) for size in compiled.outputs]
        if compiled.rows(states, outputs):
            self._repair(kind, states, outputs)
        return outputs

    def _repair(self, kind: str, states: Sequence[Tensor], outputs: Sequence[Tensor]) -> None:
        """By torch what a program leaves NaN, with its errors."""
        bad = torch.nonzero(~torch.isfinite(outputs[-1]).all(1))[:, 0]
        for output, rows in zip(outputs, self._by_torch(kind, [x[bad] for x in states]), strict=True):
            output[bad] = rows

    def _by_torch(self, kind: str, states: Sequence[Tensor]) -> list[Tensor]:  # what the program gives
        with torch.no_grad():
            parts = [self._block_by_torch(kind, part) for part in _blocks(states)]
        return [_finished(rows, False).flatten(1) for rows in zip(*parts, strict=True)]

    def _block_by_torch(self, kind: str, states: Sequence[Tensor]) -> tuple[Tensor, ...]:
        match kind:
            case "mean":
                return (self.by_torch(*states),)
            case "covariance":
                return self._with_covariance(*states)
            case "forces":
                q, v, u = states
                Q, slope = rows_jacobian(lambda u: joint_force(self.posterior, self.posterior.dynamics(q, v, u)), u)
                at = self.posterior.dynamics(q, v, u)
                around = [slope.flatten(1), at.M.flatten(1), at.A.flatten(1), at.b, at.off()]
                return Q, torch.cat(around, dim=-1).detach()
        nq, nv, nu = self.sizes
        a, slopes = rows_jacobian(lambda x: self.by_torch(*x.split(self.sizes, dim=-1)), torch.cat([*states], dim=-1))
        if self.space.is_vector_space:
            return a, slopes
        in_q, rest = slopes.split([nq, nv + nu], dim=-1)
        return a, torch.cat([in_q @ self.space.tangent(states[0]), rest], dim=-1)

    def _with_covariance(self, q: Tensor, v: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        posterior, prior = self.posterior, self.posterior.trained.unknown
        dynamics = posterior.dynamics(q, v, u)
        latents = posterior.latents(dynamics, self.compressed is None)
        if self.compressed is not None:
            features = posterior.likelihood.standardization(prior.features(dynamics))
            latents = Gaussian(latents.mean, posterior.widening**2 * self.compressed.at(posterior.latent, features))
        affine = dynamics.acceleration_map()
        found = latents.through(affine.matrix @ prior.direction(dynamics), affine.offset)
        return found.mean, found.covariance  # type: ignore[return-value]  # it was asked for

    def _at_one(self, kind: str, program: RowFunction, state: Sequence[Tensor]) -> list[Tensor]:
        """The same at what `_one_state` gave, whose numbers are checked on the way."""
        require_plain(state, "a compiled predictor", INSTEAD_OF_TRANSFORMS)
        bits, outputs = program.single(*state)
        if bits & NOT_FINITE:
            raise InvalidInput("q, v or u has values that are not finite; drop or repair those rows.")
        if bits:
            self._repair(kind, [x[None] for x in state], [x[None] for x in outputs])
        return outputs

    def compiled(self, kind: str) -> RowFunction | None:
        """The program "mean", "linearize", "covariance" or "forces", made now if it is not there; None without."""
        return self._of_code(kind, lambda code: code.function(kind))

    def _of_code(self, how: Any, make: Callable[[Programs], Any]) -> Any:
        """What is made of the code once, None where torch computes; one warning says why."""
        if self.code is None or how in self._made:
            return self._made.get(how)
        require_plain((), "a compiled predictor", INSTEAD_OF_TRANSFORMS)  # no code can be made or loaded under them
        found = None
        if not self._made.get(CompilerError):
            try:
                found = make(self.code)
            except CompilerError as error:
                self._made[CompilerError] = True  # a compiler that hangs is not waited for again
                warnings.warn(f"{BY_TORCH}: {error}", NumericalWarning, stacklevel=5)
        self._made[how] = found
        return found

    def _states(self, q: Any, v: Any, u: Any, names: str = "qvu") -> tuple[list[Tensor], bool]:
        """q, v and u, or a, as rows (n, size), and whether it was a single state."""
        states = [real_tensor(name, x, self.device) for name, x in zip(names, (q, v, u), strict=True)]
        shape, named = states[0].shape, f"q, v or {names[2]}"
        sizes = self.sizes if names[2] == "u" else (*self.sizes[:2], self.nv)
        fit = all(x.shape == (*shape[:-1], size) for x, size in zip(states, sizes, strict=True))
        if len(shape) not in (1, 2) or not fit:
            shapes = ", ".join(f"{name} {tuple(x.shape)}" for name, x in zip(names, states, strict=True))
            wanted = ", ".join(f"{name} (..., {size})" for name, size in zip(names, sizes, strict=True))
            raise InvalidInput(f"a predictor was given {shapes}; give {wanted}, one state or rows.")
        if any(x.device.type != self.device.type for x in states):
            raise InvalidInput(f"{named} is on another device than the predictor; move all three to {self.device}.")
        if self.code is not None:
            require_plain(states, "a compiled predictor", INSTEAD_OF_TRANSFORMS)
        for x in states:
            require_finite(named, x)
        self.space.check(states[0])
        single = len(shape) == 1
        return [x[None] if single else x for x in states], single

    def _one_state(self, *given: Any) -> Sequence[Tensor] | None:
        """Tensors or arrays (size,) as tensors, else None. Raises InvalidInput for quaternions of other lengths."""
        state = [as_plain(x) for x in given] if type(given[0]) is np.ndarray else given
        nq, nv, nu = self.sizes
        if nq == nv == nu:
            return state if are_plain(state, nv) and state[0].dim() == 1 else None
        if not all(are_plain((x,), size) and x.dim() == 1 for x, size in zip(state, self.sizes, strict=True)):
            return None
        self.space.check(state[0])
        return state


NO_RESULT = (
    "the predicted acceleration is not finite: the mass matrix is singular there, or a surface has no normal; "
    "Model.check_states names the row and the contact."
)


def _single(values: Tensor, single: bool) -> Tensor:
    return values[0] if single else values


def _blocks(states: Sequence[Tensor]) -> list[tuple[Tensor, ...]]:
    return list(zip(*(x.split(BLOCK) if len(x) else (x,) for x in states), strict=True))


def _finished(blocks: Sequence[Tensor], single: bool) -> Tensor:
    values = blocks[0] if len(blocks) == 1 else torch.cat([*blocks])
    if not math.isfinite(float(values.detach().sum())):
        raise NumericalError(NO_RESULT)
    return _single(values, single)


class MeanWithGradient(torch.autograd.Function):
    """The mean of a compiled predictor, whose backward pass takes the Jacobians of its linearisation."""

    @staticmethod
    @override
    def forward(ctx: Any, predictor: Any, *states: Tensor) -> Tensor:
        ctx.predictor = predictor
        ctx.save_for_backward(*states)
        return predictor.run("mean", states)[0]

    @staticmethod
    @override
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # create_graph=True: the gradients would pass for constants
            raise InvalidInput("a compiled predictor has first derivatives only; for more make it with compile=False.")
        (_, nv, nu), space = ctx.predictor.sizes, ctx.predictor.space
        jacobian = ctx.predictor.run("linearize", ctx.saved_tensors)[1].view(-1, nv, 2 * nv + nu)
        in_q, in_v, in_u = (grad_outputs[0][:, None] @ jacobian)[:, 0].split([nv, nv, nu], dim=-1)
        return None, in_q if space.is_vector_space else space.cotangent(ctx.saved_tensors[0], in_q), in_v, in_u
