"""`Predictor`: a posterior prepared for control rates, where a prediction is due every millisecond.

Rigid-body terms, constraints, prior, features and processes become one C program (`predictor_code`), and the covariance
uses few combinations of the data (`inference.prepared_kernels`). `structured.predictor_preparation` makes one.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from forcegp.codegen.library import NOT_FINITE, RowFunction, are_plain, as_plain, require_plain
from forcegp.errors import CompilerError, InvalidInput, NumericalError, NumericalWarning
from forcegp.inference.posterior import LatentPosterior
from forcegp.inference.prepared_kernels import CompressedCovariance
from forcegp.integration import integrate
from forcegp.integration.integrators import check_time_step, integrator_named, rows_jacobian
from forcegp.posterior.components import Components, forces_around, inverse_dynamics
from forcegp.posterior.fused_rollouts import FusedLoop, Motions, fused, steps_of
from forcegp.posterior.kept_code import KeptCode
from forcegp.posterior.prediction import Gaussian, JointForces, Linearization
from forcegp.posterior.predictor_code import MeanWithGradient, TermsFunction
from forcegp.posterior.rollout import (
    StepLinearization,
    by_sample,
    checked_start,
    linearized_on_manifold,
    linearized_step,
    stepped,
)
from forcegp.robots.arguments import real_tensor, require_finite, whole_number
from forcegp.robots.manifold import ConfigurationSpace
from forcegp.summary import Summary

INSTEAD_OF_TRANSFORMS = (
    "take derivatives by linearize or a backward pass, give many states as rows (n, nv), or make the predictor with "
    "compile=False"
)
BY_TORCH = "predictions are computed by torch, some hundred times slower"
BLOCK_NUMBERS = 2**18
"""Kernel values that torch works on at once: 2 MiB, so that they stay in the processor's cache."""


@dataclass(frozen=True, eq=False, repr=False)
class Predictor(Summary):
    """The acceleration that a posterior predicts, fast; made by `posterior.predictor()`.

    States are float64 tensors or arrays (size,) or (n, size) in the units of `posterior.predict`, with the `sizes` of
    q, v and u; results are tensors with the same leading dimension. They are those of `predict`: means to rounding,
    covariances exactly or never below, as `kind` says. Differentiable once in q, v and u where these are tensors that
    require gradients; with `compile=False` any number of times, also forward and by `torch.func`, but for `vmap`: give
    it all states as rows.

    `kind` is that of the covariance, "compressed", "exact" or "none"; `rank` and `inflation` describe how it was
    compressed; `prepare_seconds` is what preparing took, the C compiler included where its work is not kept yet.

    Raises InvalidInput for wrong shapes, for values that are not finite and where derivatives would be lost,
    NumericalError where the result is not finite. Where nothing can be compiled, torch computes the same, and one
    NumericalWarning says how much slower that is.
    """

    space: ConfigurationSpace
    sizes: tuple[int, int, int]  # of q, v and u
    device: torch.device
    latent: LatentPosterior
    terms: TermsFunction
    code: KeptCode | None
    kind: str
    compressed: CompressedCovariance | None
    widening: float
    prepare_seconds: float
    posterior: Any = None  # what it was made of, by which forces and inverse dynamics are computed
    _functions: dict[str, RowFunction | None] = field(default_factory=dict)
    _failed: list[CompilerError] = field(default_factory=list)
    _loops: dict[tuple[str, int, int], list[FusedLoop] | None] = field(default_factory=dict)

    def __getstate__(self) -> dict[str, Any]:
        own = {"_functions": {}, "_failed": [], "_loops": {}}  # loaded code means nothing in another process
        return self.__dict__ | own

    def facts(self) -> dict[str, object]:
        """What it predicts, and how long preparing took."""
        covariance = {"joints": self.nv, "covariance": self.kind, "device": self.device}
        return {**covariance, "prepared in": f"{self.prepare_seconds:.2g} s"}

    def refreshed(self, posterior: Any) -> "Predictor":
        """That of `posterior.update(...)` in milliseconds: the same programs, traced at most once, with other tables.

        Raises InvalidInput for other posteriors, compressed covariances, and kernels with numbers in the programs.
        """
        latent: Any = getattr(posterior, "latent", None)
        same = latent and latent.kernels is self.latent.kernels and posterior.model is self.posterior.model
        if not same or self.compressed is not None:
            raise InvalidInput(
                "refreshed takes what posterior.update(...) gave of the predictor's own posterior, and no compressed "
                "covariance (covariance='none' or 'exact'); make a new one by posterior.predictor()."
            )
        code = self.code and self.code.refreshed(latent)
        tables = code.traced.tables if code else []
        functions = {k: f and RowFunction(f.library, f.inputs, f.outputs, tables) for k, f in self._functions.items()}
        of_mean = {how: loops for how, loops in self._loops.items() if not how[1]}
        loops = {how: x and [FusedLoop(loop.library, tables) for loop in x] for how, x in of_mean.items()}
        made = {"_functions": functions, "_loops": loops}
        return replace(self, latent=latent, code=code, posterior=posterior, **made)

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
            return _finished([self._mean(*part)[0] for part in self._blocks(states)], single)
        if torch.is_grad_enabled() and any(x.requires_grad for x in states):
            return _finished([MeanWithGradient.apply(self, *states)], single)  # type: ignore[list-item]  # torch does not type `apply`
        return _single(self.run("mean", states)[0], single)

    def __call__(self, q: Any, v: Any, u: Any) -> tuple[Tensor, Tensor]:
        """Mean (nv,) and covariance (nv, nv) of the acceleration, or (n, nv) and (n, nv, nv); without noise.

        Raises InvalidInput where the predictor was made with covariance="none".
        """
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
        means, covariances = [], []
        for part in self._blocks(states):
            mean, W, features = self._mean(*part)
            means.append(mean)
            covariances.append(W @ self._covariance(W, features) @ W.mT)
        return _finished(means, single), _finished(covariances, single)

    def linearize(self, q: Any, v: Any, u: Any) -> Linearization:
        """The mean acceleration and its Jacobians in q, v and u, without a graph.

        Where a base moves, da_dq (..., nv, nv) is that in a step d from q: q moves to `robot.integrate(q, d)`.
        """
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

        `integrator` is "symplectic-euler", "rk4" or "implicit-midpoint" (docs/how-to/rollouts.md), which is
        differentiable once. Raises InvalidInput for "projected", other names and a dt that is no positive number,
        NumericalError where an implicit step is not found.
        """
        states, single = self._states(q, v, u)
        state = self._stepped(torch.cat(states, dim=-1), dt, integrator)
        q, v = (state[0] if single else state).split(self.sizes[:2], dim=-1)
        return q, v

    def _stepped(self, x: Tensor, dt: float, integrator: str) -> Tensor:
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
        """That state and the affine model x+ = A x + B u + c of the step, x = (q, v), without a graph.

        Where a base moves, x = (d, v) and x+ = (d+, v+) with the steps d from q, and d+ from the q after the step.
        """
        states, single = self._states(q, v, u)
        model, rows = self.posterior.model, torch.cat(states, dim=-1)
        if self.space.is_vector_space:
            linear = linearized_step(self._stepped, self.linearize, model, rows, dt, integrator)
        else:
            linear = linearized_on_manifold(self.mean, model, rows, dt, integrator)
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
        divided: bool = False,
        seed: int = 0,
        threads: int | None = None,
    ) -> Motions:
        """Motions from q0 (..., nq), v0 (..., nv) under u (..., T, nu), with batches that broadcast.

        As `posterior.rollout` with the predictor's own system: rad, rad/s, Nm and s (m, m/s, N); what diverges is NaN
        from the row `diverged_at` on. Under the mean, or with `functions` once under each of so many functions drawn
        from the posterior, which then are the first dimension; `divided` takes motions (functions, ..., nv) instead,
        each under the function of its own. A compiled predictor steps many motions at once, without Python in between,
        on `threads` threads (None: as many as torch has). Without a graph.
        Raises InvalidInput for arguments that do not fit.
        """
        most = torch.get_num_threads() if threads is None else whole_number("threads", threads, 1)
        functions, seed = whole_number("functions", functions, 0), whole_number("seed", seed, 0)
        start, v, forces, batch = checked_start(
            self.sizes, self.device, q0, v0, u, "call posterior.rollout(..., grad=True)"
        )
        if titles := self.posterior.model.memory.titles:
            raise InvalidInput(
                f"{', '.join(titles)} remembers, and compiled motions carry no memory; call posterior.rollout."
            )
        method = integrator_named(integrator, self.posterior.model)
        check_time_step(dt)
        how = integrator, functions, seed
        loops, acceleration = self._loops.get(how), self.mean
        if loops is None and integrator in steps_of(self.space):
            loops = self._loops[how] = self._made(lambda code: code.loops(integrator, self.latent, functions, seed))
        if functions:
            model = self.posterior.accelerations(self.posterior.model.baumgarte)

            def acceleration(q: Tensor, v: Tensor, u: Tensor) -> Tensor:  # drawn when a motion is left to torch
                return by_sample(model.sampled(functions, seed), functions)(q, v, u)

            if not divided:
                start, v, forces = start.repeat(functions, 1), v.repeat(functions, 1), forces.repeat(1, functions, 1)
                batch = (functions, *batch)
            elif tuple(batch[:1]) != (functions,):
                raise InvalidInput(f"divided motions need a first dimension of {functions} functions; given: {batch}.")
        with torch.no_grad():
            if loops is None:
                motion = integrate(method, acceleration, start, v, forces, dt)
            else:
                motion = fused(loops, method, acceleration, start, v, forces, dt, most)
        q, v, a = (x.movedim(0, 1).reshape(*batch, len(x), x.shape[-1]) for x in (motion.q, motion.v, motion.a))
        return Motions(q, v, a, motion.diverged_at.reshape(batch))

    def forces(self, q: Any, v: Any, u: Any, *, covariance: bool = True) -> Components:
        """Unknown force, multipliers, contact force and every component of the prior, with exact covariances."""
        self._states(q, v, u)
        return self.posterior.components(q, v, u, covariance=covariance)

    def joint_forces(self, q: Any, v: Any, u: Any) -> JointForces:
        """Known and learned forces at a state (nv,) or states (n, nv) and what they act on, without a graph."""
        program, (_, nv, nu), m = self.compiled("forces"), self.sizes, len(self.posterior.model.contacts)
        if program and (one := self._one_state(q, v, u)):
            Q, around = self._at_one("forces", program, one)
        else:
            states, single = self._states(q, v, u)
            Q, around = (_single(x, single) for x in self.run("forces", states))
        slope, M, A, b = around.split([nv * nu, nv**2, m * nv, m], dim=-1)
        return JointForces(Q, slope.unflatten(-1, (nv, nu)), M.unflatten(-1, (nv, nv)), A.unflatten(-1, (m, nv)), b)

    def inverse_dynamics(self, q: Any, v: Any, a: Any, normal_force: Any = None) -> Gaussian:
        """The actuator forces u (nv,) or (n, nv) in Nm or N that make the acceleration a (rad/s^2 or m/s^2).

        u = M a + h - A^T lambda - Q_U with the known forces -h: friction under load is that of this lambda, which
        `normal_force` (m,) or (n, m) gives in N, positive where the surface pushes the robot off, as in
        `predict(...).multiplier`; None is 0. The covariance is that of Q_U at u, to first order, and None for a
        predictor without one. `a` has to obey A a = b, else the contacts change it. Results have no graph.
        Raises InvalidInput for models without analytical mean or actuation, NumericalError where no u is found.
        """
        states, single = self._states(q, v, a, "qva")
        found = inverse_dynamics(self.posterior, states, normal_force, self.kind != "none")
        return found[0] if single else found

    def run(self, kind: str, states: Sequence[Tensor]) -> list[Tensor]:
        """The outputs (n, size) of a program at states (n, nv) that were checked, without a graph."""
        states, count = [x.detach().contiguous() for x in states], len(states[0])
        compiled = self.compiled(kind)
        if compiled is None:
            return self._by_torch(kind, states)
        outputs = [torch.empty(count, size, dtype=torch.float64) for size in compiled.outputs]
        if compiled.rows(count, states, outputs):
            self._repair(kind, states, outputs)
        return outputs

    def _repair(self, kind: str, states: Sequence[Tensor], outputs: Sequence[Tensor]) -> None:
        """By torch what a program leaves NaN: states outside of a table."""
        bad = torch.nonzero(~torch.isfinite(outputs[-1]).all(1))[:, 0]
        for output, rows in zip(outputs, self._by_torch(kind, [x[bad] for x in states]), strict=True):
            output[bad] = rows

    def _by_torch(self, kind: str, states: Sequence[Tensor]) -> list[Tensor]:
        """What the program gives."""
        parts = []
        for part in self._blocks(states):
            if kind == "linearize":
                parts.append(self._linearize(part))
            elif kind == "forces":
                parts.append(forces_around(self.posterior, *part))
            else:
                mean, W, features = self._mean(*part)
                parts.append((mean, W @ self._covariance(W, features) @ W.mT) if kind == "covariance" else (mean,))
        return [_finished(list(rows), False).flatten(1) for rows in zip(*parts, strict=True)]

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
        """The program "mean", "linearize" or "covariance", made now if it is not there; None where torch computes."""
        if self.code is not None and kind not in self._functions:
            require_plain((), "a compiled predictor", INSTEAD_OF_TRANSFORMS)  # no code can be made or loaded under them
            self._functions[kind] = self._made(lambda code: code.function(kind))
        return self._functions.get(kind)

    def _made(self, make: Callable[[KeptCode], Any]) -> Any:
        """What is made of the code, None once that has failed; one warning says so."""
        if self.code is None or self._failed:
            return None
        try:
            return make(self.code)
        except CompilerError as error:
            self._failed.append(error)  # a compiler that hangs is not waited for again
            warnings.warn(f"{BY_TORCH}: {error}", NumericalWarning, stacklevel=4)
            return None

    def _mean(self, q: Tensor, v: Tensor, u: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """By torch: the mean, W and the features of all latents."""
        offset, W, *features = self.terms(q, v, u)
        if not W.shape[-1]:
            return offset, W, features
        return offset + (W @ self.latent.mean(features)[..., None])[..., 0], W, features

    def rounding(self, q: Tensor, v: Tensor, u: Tensor) -> float:
        """What rounding of the sums over all points may change in the mean, relative to its largest value there."""
        mean, W, features = self._mean(q, v, u)
        if not W.shape[-1]:
            return 0.0
        latent = self.latent
        parts = zip(latent.kernels.dense, features, latent.features, latent.weights, strict=True)
        terms = torch.stack([kernel.cross(z, centers).abs() @ w.abs() for kernel, z, centers, w in parts], dim=-1)
        return torch.finfo(mean.dtype).eps * float((W.abs() @ terms[..., None]).max() / mean.abs().max())

    def _covariance(self, W: Tensor, features: list[Tensor]) -> Tensor:
        """Of the latents, (n, C, C)."""
        if not W.shape[-1]:
            return W.new_zeros(len(W), 0, 0)
        compressed = self.compressed
        found = self.latent.covariance(features) if compressed is None else compressed.at(self.latent, features)
        return self.widening**2 * found

    def _linearize(self, states: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        nq, nv, nu = self.sizes
        a, jacobian = rows_jacobian(lambda x: self._mean(*x.split(self.sizes, dim=-1))[0], torch.cat([*states], dim=-1))
        if self.space.is_vector_space:
            return a, jacobian
        in_q, rest = jacobian.split([nq, nv + nu], dim=-1)
        return a, torch.cat([in_q @ self.space.tangent(states[0]), rest], dim=-1)

    def _states(self, q: Any, v: Any, u: Any, names: str = "qvu") -> tuple[list[Tensor], bool]:
        """q, v and u, or a, as rows (n, size), and whether it was a single state."""
        states = [real_tensor(name, x, self.device) for name, x in zip(names, (q, v, u), strict=True)]
        shape, named = states[0].shape, f"q, v or {names[2]}"
        sizes = self.sizes if names[2] == "u" else (*self.sizes[:2], self.nv)
        wanted_shapes = (shape if size == sizes[0] else (*shape[:-1], size) for size in sizes)
        fit = shape[-1:] == sizes[:1] and all(x.shape == each for x, each in zip(states, wanted_shapes, strict=True))
        if len(shape) > 2 or not fit:
            shapes = ", ".join(f"{name} {tuple(x.shape)}" for name, x in zip(names, states, strict=True))
            wanted = f"all three ({self.nv},) for one state or (n, {self.nv})"
            if len({*sizes}) > 1:
                wanted = ", ".join(f"{name} (..., {size})" for name, size in zip(names, sizes, strict=True))
            raise InvalidInput(f"a predictor was given {shapes}; give {wanted}.")
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

    def _blocks(self, states: Sequence[Tensor]) -> list[tuple[Tensor, ...]]:
        rows = max(1, BLOCK_NUMBERS // max(1, sum(len(centers) for centers in self.latent.features)))
        return list(zip(*(x.split(rows) if len(x) else (x,) for x in states), strict=True))


NO_RESULT = (
    "the predicted acceleration is not finite: the mass matrix is singular there, or a surface has no normal; "
    "Model.check_states names the row and the contact."
)


def _single(values: Tensor, single: bool) -> Tensor:
    return values[0] if single else values


def _finished(blocks: list[Tensor], single: bool) -> Tensor:
    values = blocks[0] if len(blocks) == 1 else torch.cat(blocks)
    if not math.isfinite(float(values.detach().sum())):
        raise NumericalError(NO_RESULT)
    return _single(values, single)
