"""Predictions of a posterior as programs: one graph, traced once, and what is compiled of it.

Processes are C functions that the graph calls (`inference.kernel_sums`). From it come the mean, its Jacobians, the
covariance and loops of steps, each compiled when it is first asked for.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial, reduce
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from forcegp.codegen.c_writer import ROWS, Program, c_text, filled, head, sections, write_entry, write_function
from forcegp.codegen.graph import ONE, ZERO, Copier, Graph, jacobian
from forcegp.codegen.library import RowFunction, aligned, load_library, vector_unit
from forcegp.codegen.tracing import trace
from forcegp.errors import InvalidInput
from forcegp.evidence.likelihood import Standardization
from forcegp.forces import Actuation, Law, RigidBodies, UnknownForces
from forcegp.inference.one_input import drawn_calls, latent_calls
from forcegp.inference.posterior import LatentPosterior
from forcegp.inference.prepared_kernels import PADDING, CompressedCovariance, KernelSum
from forcegp.integration.integrators import SPEED_LIMIT, steps_by
from forcegp.mechanics import ConstrainedDynamics
from forcegp.model import Model
from forcegp.robots.manifold import ConfigurationSpace

WITH_SLOPES = {"linearize", "forces"}
STEPS = sections(__name__, "rollout_steps.c")
"""One step in C: from x = [q, v, u] to q1, v1, with the acceleration a at its beginning."""
ON_A_MANIFOLD = "-on-a-manifold"


def steps_of(space: ConfigurationSpace) -> dict[str, str]:
    """The steps in C, by integrator, of a robot with these positions."""
    apart = {name: text for name, text in STEPS.items() if name.endswith(ON_A_MANIFOLD) != space.is_vector_space}
    return {name.removesuffix(ON_A_MANIFOLD): text for name, text in apart.items()}


def require_step(seconds: object, integrator: str, model: Model) -> None:
    """Raise InvalidInput for anything but a positive number of seconds, and an integrator that has no step in C."""
    steps_by(integrator, model, seconds)
    there = steps_of(model.robot.space)
    if integrator not in there:
        seen = f"an exported step is not {integrator!r}"
        raise InvalidInput(f"{seen}; give one of {', '.join(map(repr, there))} as `integrator`.")


@dataclass(frozen=True, eq=False)
class Physics:
    """The physics of a posterior in a model, differentiable, by the same code as `predict`."""

    model: Model
    forces: UnknownForces
    standardization: Standardization

    @classmethod
    def of(cls, posterior: Any, model: Model) -> "Physics":
        """Of a `Posterior` in this model."""
        return cls(model, posterior.trained.unknown, posterior.likelihood.standardization)

    def mixing(self, q: Tensor, v: Tensor, u: Tensor) -> tuple[Tensor, list[Tensor]]:
        """W (n, nv, C) of a = offset + W f, and the features of every process (n, d)."""
        dynamics = self.model.dynamics(q, v, u)
        return dynamics.H @ self.forces.direction(dynamics), [*self.standardization(self.forces.features(dynamics))]

    @property
    def passive(self) -> list[Law]:
        """Laws beside actuation and bodies: what resists, and what a user would see apart."""
        return [force for force in self.model.laws if not isinstance(force, Actuation | RigidBodies)]

    def parts(self, dynamics: ConstrainedDynamics, B: Tensor, f: Tensor) -> Tensor:
        """Joint forces (n, P, nv) of the passive laws, then of each unknown force: those of `names`."""
        each = [force.force(dynamics.state) for force in self.passive]
        each += [(B[..., which] @ f[..., which, None])[..., 0] for which in self.terms.values()]
        return torch.stack(each, dim=-2) if each else B[..., :0].mT

    @cached_property
    def terms(self) -> dict[str, slice]:
        """The latents of each unknown force."""
        return {name: which for name, _, which in self.forces.named(self.model.robot)}

    @property
    def names(self) -> list[str]:
        """Of `parts`."""
        return [*(force.title for force in self.passive), *self.terms]

    def traced(self, q: Tensor, v: Tensor, u: Tensor, f: Tensor) -> list[Tensor]:
        """[a, W, Q_K + Q_U, `parts`, B, M, A, b, off, features ...]: what programs are written from."""
        dynamics = self.model.dynamics(q, v, u)
        B = self.forces.direction(dynamics)
        Q = (B @ f[..., None])[..., 0] + dynamics.Q_K
        around = self.parts(dynamics, B, f), B, dynamics.M, dynamics.A, dynamics.b, dynamics.off()
        features = self.standardization(self.forces.features(dynamics))
        return [dynamics.acceleration_under(Q), dynamics.H @ B, Q, *around, *features]

    def held(
        self, q: Tensor, v: Tensor, u: Tensor, f: Tensor, a: Tensor, multiplier: Tensor, left: Tensor
    ) -> list[Tensor]:
        """[lambda, b - A a, r, s, t, H, G], by which derivatives do not go through factors and pseudo-inverses.

        With the acceleration, the multiplier and what is `left` of b - A a held, r = Q - M a + A^T lambda, s = b - A a
        and t = A^T left: da = H dr + G (ds + G^T dt), G = M^-1 A^T (A M^-1 A^T)^+ (implicit differentiation; for `left`
        Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973, eq. 4.12).
        """
        dynamics = self.model.dynamics(q, v, u)
        A, lower, inverse = dynamics.A, dynamics.inverse_lower, dynamics.pseudo_inverse
        Q = (self.forces.direction(dynamics) @ f[..., None])[..., 0] + dynamics.Q_K
        change = inverse @ (dynamics.b[..., None] - A @ (lower.mT @ (lower @ Q[..., None])))
        found = [(inverse.mT @ change)[..., 0], dynamics.b - (A @ dynamics.acceleration_under(Q)[..., None])[..., 0]]
        kinematics = dynamics.state.kinematics
        inertial = kinematics.inverse_dynamics(a) - kinematics.bias_forces()
        for force in self.model.laws:
            if (added := force.added_inertia(self.model.robot)) is not None:
                inertial = inertial + (added @ a[..., None])[..., 0]
        r = Q - inertial + (A.mT @ multiplier[..., None])[..., 0]
        s, t = dynamics.b - (A @ a[..., None])[..., 0], (A.mT @ left[..., None])[..., 0]
        return [*found, r, s, t, dynamics.H, lower.mT @ inverse]


class Traced(NamedTuple):
    """The graph of `Physics.traced`, and the nodes of what it gives."""

    graph: Graph
    a: list[int]
    W: list[list[int]]
    features: list[list[int]]
    forces: list[int]
    around: list[int]
    parts: list[list[int]]
    B: list[list[int]]
    held: list[Any]  # what derivatives are made of where q does not add up


@dataclass(eq=False)
class Programs:
    """The programs of a posterior in a model; `example`: one state (1, size). InvalidInput for what no graph holds."""

    physics: Physics
    example: Sequence[Tensor]
    latent: LatentPosterior
    widening: float
    compressed: CompressedCovariance | None = None
    given: tuple[Traced, tuple[KernelSum, ...]] | None = None
    """What was traced of another posterior, and the processes of this one."""

    def __post_init__(self) -> None:
        self.space: ConfigurationSpace = self.physics.model.robot.space
        self.sizes: tuple[int, int, int] = self.physics.model.sizes
        if self.example[0].device.type != "cpu":
            seen = f"compiled code runs on the CPU, and the model is on {self.example[0].device}"
            raise InvalidInput(f"{seen}; give compile=False, or a model on the CPU.")

    @cached_property
    def sums(self) -> tuple[KernelSum, ...]:
        """The processes as C functions."""
        return self.given[1] if self.given else latent_calls(self.latent, self.compressed)

    @cached_property
    def traced(self) -> Traced:
        """The physics as a graph."""
        if self.given:
            return self.given[0]
        inputs = [*self.example, torch.ones(1, len(self._latents), dtype=torch.float64)]
        graph, found = trace(self.physics.traced, inputs)
        (a, W, Q, parts, B, *around), features = ([x[0].tolist() for x in part] for part in (found[:9], found[9:]))
        held: list[Any] = []
        if not self.space.is_vector_space:
            m = found[6].shape[-2]
            more = [torch.zeros(1, size, dtype=torch.float64) for size in (len(a), m, m)]
            graph.more_inputs(sum(x.numel() for x in more))
            held = [x[0].tolist() for x in trace(self.physics.held, [*inputs, *more], graph)[1]]
        flat = [int(node) for values in around for node in np.ravel(values)]
        return Traced(graph, a, W, features, Q, flat, parts, B, held)

    @cached_property
    def _latents(self) -> list[int]:
        return [c for part in self.sums for c in part.latents]

    def program(self, kind: str) -> Program:
        """The program "mean", "linearize", "covariance", "forces", or "passive": all but actuation and bias.

        "components" are these one by one, "deviations" with standard deviations of the unknown ones.
        """
        at, given, count = self.traced, dict(zip("qvu", self.sizes, strict=True)), sum(self.sizes)
        graph, f, slopes = Graph(count), {}, kind in WITH_SLOPES
        if kind == "linearize" and at.held:
            graph.more_inputs(len(at.graph.inputs) - count - len(self._latents))
        copied = Copier(graph, at.graph, dict(zip(at.graph.inputs, graph.inputs, strict=False)))
        features = [copied(at.features[part.latents[0]]) for part in self.sums]
        for part, z in zip(self.sums, features, strict=True):
            f |= dict(zip(part.latents, part.call(graph, z, slopes), strict=True))
        more = [*(f[c] for c in sorted(f)), *graph.inputs[count:]]
        copied.known.update(zip(at.graph.inputs[count:], more, strict=False))
        match kind:
            case "forces":
                slope = jacobian(graph, Q := copied(at.forces), graph.inputs[-self.sizes[2] :])
                outputs = {"Q": Q, "around": [node for row in slope for node in row] + copied(at.around)}
            case "passive":
                zeros, add = [ZERO] * self.sizes[1], partial(graph.apply, "add")
                outputs = {"Q": reduce(lambda x, y: list(map(add, x, y)), map(copied, at.parts), zeros)}
            case "components" | "deviations":
                outputs = {"Q": [node for part in at.parts for node in copied(part)]}
                if kind == "deviations":
                    kept = [range(len(self._latents))[which] for which in self.physics.terms.values()]
                    rows = [[x if c in own else ZERO for c, x in enumerate(row)] for own in kept for row in at.B]
                    outputs["covariance"] = self._terms(graph, copied, features, rows)
            case "mean":
                outputs = {"a": copied(at.a)}
            case "linearize" if at.held:
                graph, outputs = self._implicit(graph, copied, copied(at.a))
            case "linearize":
                rows = jacobian(graph, a := copied(at.a), graph.inputs)
                outputs = {"a": a, "jacobian": [node for row in rows for node in row]}
            case _:
                outputs = {"a": copied(at.a), "covariance": self._terms(graph, copied, features, at.W)}
        return Program(graph, given, outputs)

    @cached_property
    def affine(self) -> bool:
        """Whether joint forces are affine in u: their slopes are numbers."""
        program = self.program("forces")
        slopes = program.outputs["around"][: self.sizes[1] * self.sizes[2]]
        return all(program.graph.value(node) is not None for node in slopes)

    def _terms(self, graph: Graph, copied: Copier, features: list[list[int]], rows: list[list[int]]) -> list[int]:
        terms = copied([row[c] for row in rows for c in self._latents])
        terms += [node for part, z in zip(self.sums, features, strict=True) for node in part.variance(graph, z)]
        return terms + [node for part, z in zip(self.sums, features, strict=True) for node in part.given(graph, z)]

    def _implicit(self, graph: Graph, copied: Copier, a: list[int]) -> tuple[Graph, dict[str, list[int]]]:
        """The acceleration and its derivatives in a step from q, in v and in u, by `Physics.held`."""
        (nq, nv, nu), count = self.sizes, sum(self.sizes)
        multiplier, left, r, s, t = (copied(nodes) for nodes in self.traced.held[:5])
        H, G = ([copied(row) for row in rows] for rows in self.traced.held[5:])
        _, (tangent,) = trace(lambda q: [self.space.tangent(q)], [self.space.neutral()], graph, graph.inputs[:nq])
        rest = [[ONE if i == j else ZERO for j in range(nv + nu)] for i in range(nv + nu)]
        seeds = [row + [ZERO] * (nv + nu) for row in tangent.tolist()] + [[ZERO] * nv + row for row in rest]
        slopes = jacobian(graph, [*r, *s, *t], graph.inputs[:count], seeds)
        made = Graph(count)  # where what was held is what it is
        there = Copier(made, graph, dict(zip(graph.inputs, made.inputs, strict=False)))
        there.known.update(zip(graph.inputs[count:], there([*a, *multiplier, *left]), strict=True))
        columns = [there(list(column)) for column in zip(*slopes, strict=True)]
        H, G = ([there(row) for row in rows] for rows in (H, G))
        found = []
        for column in columns:
            dr, ds, dt = column[:nv], column[nv : nv + len(s)], column[nv + len(s) :]
            change = [made.apply("add", d, made.dot(g, dt)) for d, g in zip(ds, zip(*G, strict=True), strict=False)]
            found.append([made.apply("add", made.dot(h, dr), made.dot(g, change)) for h, g in zip(H, G, strict=True)])
        return made, {"a": there(a), "jacobian": [node for row in zip(*found, strict=True) for node in row]}

    def c_source(self, kind: str, lanes: int, entry: str = "", numbers: dict[str, int] | None = None) -> str:
        """The C text of a program, or of a loop over it by an integrator's name, with the function `evaluate`.

        `entry` is another text that calls `program(t, live, x, y)`. `numbers`: of the last table, as `write_function`.
        """
        integrator = kind if kind in steps_of(self.space) else ""
        if integrator:
            kind = "linearize" if integrator == "implicit-midpoint" else "mean"
        program, slopes = self.program(kind), kind in WITH_SLOPES
        names = [part.name + ("_slopes" if slopes else "") for part in self.sums]
        text = [head(lanes), *(part.c_source(lanes, slopes) for part in self.sums)]
        text.append(f"#define NUMBERS {len(self.sums) * (1 + (kind == 'covariance'))}")
        finish = None
        if kind == "covariance":
            text += [*(part.roots_source(lanes, self.rank) for part in self.sums), self.covariance_source()]
            finish = {"covariance": ("covariance", self.sizes[1] ** 2)}
        text.append(write_function("program", program.graph, program.nodes, lanes, names, numbers=numbers))
        if integrator:
            words: dict[str, object] = dict(zip(("POSITIONS", "JOINTS", "GIVEN"), self.sizes, strict=True))
            words |= {"OUTPUTS": len(program.nodes), "LIMIT": SPEED_LIMIT}
            words["STEP"] = self.step_source(integrator, "program")
            memory = self.memory_source(lanes, numbers)
            words |= {"MEMORY": len(self.physics.model.memory.names), "COLUMN": self.physics.model.memory_column}
            words["REMEMBER"] = "remember(t, live, w, z);" if memory else ""
            text += [*self.motion_source(lanes), *memory, ROWS, filled(c_text(__name__, "rollout_loop.c"), words)]
        else:
            text.append(entry or write_entry(program, "program", finish))
        return "\n".join(text)

    def step_source(self, integrator: str, function: str) -> str:
        """The text of a step that calls `function`, whose slopes are those in a step from q, v and u."""
        columns = 2 * self.sizes[1] + self.sizes[2]
        return filled(steps_of(self.space)[integrator], {"PROGRAM": function, "COLUMNS": columns})

    def motion_source(self, lanes: int) -> list[str]:
        """C functions that steps on a manifold call: q after a step, and the rate of a step under a velocity."""
        if self.space.is_vector_space:
            return []
        q, step = self.space.neutral(), torch.zeros(self.sizes[1], dtype=torch.float64)
        made = {"moved": trace(lambda q, step: [self.space.integrate(q, step)], [q, step])}
        made["step_rate"] = trace(lambda step, v: [self.space.chart_velocity(step, v)], [step, step])
        return [write_function(name, graph, x.tolist(), lanes) for name, (graph, (x,)) in made.items()]

    @cached_property
    def remembered(self) -> tuple[Graph, list[int], list[int]] | None:
        """What laws remember after a step, as nodes of a graph of the memory, q, q after it, and dt: these sizes."""
        memory, space = self.physics.model.memory, self.space
        if not memory.names:
            return None
        q = space.neutral()
        given = [q.new_zeros(len(memory.names)), q, q, q.new_ones(1)]
        graph, (z,) = trace(lambda z, q, q1, dt: [memory.after(z, space.difference(q, q1), dt)], given)
        return graph, z.tolist(), [len(each) for each in given]

    def memory_source(self, lanes: int, numbers: dict[str, int] | None = None) -> list[str]:
        """The C function `remember`, where laws do."""
        if self.remembered is None:
            return []
        graph, nodes, _ = self.remembered
        return [write_function("remember", graph, nodes, lanes, numbers=numbers)]

    def covariance_source(self, name: str = "covariance", rows: int = 0) -> str:
        """The C function that makes the covariance of so many outputs of its program, by default the acceleration's."""
        calls, C, rows = [], len(self._latents), rows or self.sizes[1]
        first, place = 0, rows * C + C
        for k, part in enumerate(self.sums):
            calls.append(f"{part.name}_roots(t[{k}], t[{len(self.sums) + k}], y + {place}, P + {first} * K);")
            first, place = first + len(part.latents), place + part.width
        words = {"COVARIANCE": name, "ROWS": rows, "LATENTS": C, "RANK": self.rank, "WIDENED": (self.widening**2).hex()}
        return filled(c_text(__name__, "covariance.c"), words | {"ROOTS": "\n  ".join(calls)})

    @property
    def rank(self) -> int:
        """Numbers per process of the compressed covariance, filled up to whole vectors."""
        assert self.compressed is not None, "asked for by programs of the covariance only"
        return self.compressed.rank + -self.compressed.rank % PADDING

    def tables(self, kind: str = "mean") -> list[Tensor]:
        """What the C functions of the sums take, then for a covariance its roots."""
        found = [part.table() for part in self.sums]
        return [aligned(x) for x in found + [part.root_table() for part in self.sums if kind == "covariance"]]

    def function(self, kind: str) -> RowFunction:
        """A program, or the loop of an integrator: found or made. Raises CompilerError where that cannot be."""
        (_, nv, nu), m = self.sizes, len(self.physics.model.contacts)
        outputs = {
            "linearize": [nv, nv * (2 * nv + nu)],
            "covariance": [nv, nv**2],
            "forces": [nv, nv * nu + nv**2 + m * nv + 2 * m],
            "mean": [nv],
        }.get(kind, [0] * 4)  # a loop gives as much as it is asked for
        numbers: dict[str, int] = {}  # apart from the text: the program of other numbers is the same
        text = self.c_source(kind, vector_unit()[0], numbers=numbers)
        library = load_library(f"predictor-{kind}", text, lambda _: text)
        tables = [*self.tables(kind), aligned(np.array([*map(float.fromhex, numbers), 0.0]))]
        return RowFunction(library, 3 + (kind in steps_of(self.space)), outputs, tables)

    def loops(self, integrator: str, samples: int = 0, seed: int = 0) -> list[RowFunction] | None:
        """Over the mean or each drawn function; None without such a step or form. Raises CompilerError."""
        if integrator not in steps_of(self.space):
            return None
        codes = [self] * max(1, samples)
        if samples and self.sums:
            if (drawn := drawn_calls(self.latent, self.sums, samples, seed, self.widening)) is None:
                return None
            codes = [replace(self, compressed=None, given=(self.traced, calls)) for calls in drawn]
        first, *others = codes  # whose texts are equal
        loop = first.function(integrator)
        numbers = loop.tables[-1]
        own = [(loop.library, loop.inputs, loop.outputs, [*code.tables(), numbers]) for code in others]
        return [loop, *(RowFunction(*each) for each in own)]
