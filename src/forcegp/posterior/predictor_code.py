"""A posterior's predictions as C: physics, features and processes of one state in one program.

The Python code that `predict` runs is traced once (`codegen.tracing`); processes are C functions that the graph calls
(`inference.kernel_sums`). From the one graph come the mean, its Jacobians and the covariance, each compiled when it is
first asked for.
"""

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from forcegp.codegen.c_text import c_text, filled
from forcegp.codegen.c_writer import Program, head, write_entry, write_function
from forcegp.codegen.derivatives import jacobian
from forcegp.codegen.graph import ONE, ZERO, Copier, Expression, Graph
from forcegp.codegen.library import Purpose, VectorUnit, aligned, default_folder, load_library
from forcegp.codegen.tracing import trace
from forcegp.errors import InvalidInput
from forcegp.inference.kernel_sums import PADDING
from forcegp.inference.one_input_calls import LatentCall, drawn_calls, latent_calls
from forcegp.inference.posterior import LatentPosterior
from forcegp.inference.prepared_kernels import CompressedCovariance
from forcegp.posterior.fused_rollouts import FusedLoop, loop_source, steps_of
from forcegp.robots.manifold import ConfigurationSpace

TermsFunction = Callable[[Tensor, Tensor, Tensor], list[Tensor]]
"""States (n, size) -> [offset (n, nv), W (n, nv, C), features of every process (n, d)], where a = offset + W f."""

PURPOSE = Purpose("a compiled predictor", "the environment variable XDG_CACHE_HOME", "give compile=False")

WITH_SLOPES = ("linearize", "forces")


@dataclass(frozen=True, eq=False)
class PredictorCode:
    """What is traced once of a posterior, and the programs made of it; see `of`."""

    space: ConfigurationSpace
    sizes: tuple[int, int, int]
    sums: tuple[LatentCall, ...]
    physics: Graph
    a: list[int]
    W: list[list[int]]
    features: list[list[int]]
    forces: list[int]
    around: list[int]
    passive: list[int]
    held: list[Any]  # what derivatives are made of where q does not add up
    compressed: CompressedCovariance | None
    widening: float

    @classmethod
    def of(
        cls,
        terms: Any,
        example: Sequence[Tensor],
        space: ConfigurationSpace,
        latent: LatentPosterior,
        compressed: CompressedCovariance | None,
        widening: float,
    ) -> "PredictorCode":
        """Trace `terms`, a PredictorPhysics, at an example (1, size) of q, v and u.

        Raises InvalidInput on another device, and for what no graph holds.
        """
        if example[0].device.type != "cpu":
            raise InvalidInput(
                f"a compiled predictor runs on the CPU, and the model is on {example[0].device}; give compile=False, "
                "or a model on the CPU."
            )
        sums = latent_calls(latent, compressed)
        latents = sum(len(part.latents) for part in sums)
        given = [*example, torch.ones(1, latents, dtype=torch.float64)]
        graph, found = trace(terms.traced, given)
        (a, W, Q, passive, *around), features = ([x[0].tolist() for x in part] for part in (found[:7], found[7:]))
        held: list[Any] = []
        if not space.is_vector_space:
            m = found[5].shape[-2]
            more = [torch.zeros(1, size, dtype=torch.float64) for size in (len(a), m, m)]
            graph.more_inputs(sum(x.numel() for x in more))
            inputs = [Expression(graph, node) for node in graph.inputs]
            held = [x[0].tolist() for x in trace(terms.held, [*given, *more], graph, inputs)[1]]
        flat = [int(node) for values in around for node in np.ravel(values)]
        nq, nv, nu = (x.shape[-1] for x in example)
        return cls(space, (nq, nv, nu), sums, graph, a, W, features, Q, flat, passive, held, compressed, widening)

    @property
    def _latents(self) -> list[int]:
        """All processes in the order of the sums."""
        return [c for part in self.sums for c in part.latents]

    def program(self, kind: str) -> Program:
        """The program "mean", "linearize", "covariance", "forces", or "passive" ones: all but actuation and bias."""
        given = dict(zip("qvu", self.sizes, strict=True))
        graph, f, slopes = Graph(sum(self.sizes)), {}, kind in WITH_SLOPES
        if kind == "linearize" and self.held:
            graph.more_inputs(len(self.physics.inputs) - sum(self.sizes) - len(self._latents))
        copied = Copier(graph, self.physics, dict(zip(self.physics.inputs, graph.inputs, strict=False)))
        features = [copied(self.features[part.latents[0]]) for part in self.sums]
        for part, z in zip(self.sums, features, strict=True):
            f |= dict(zip(part.latents, part.call(graph, z, slopes), strict=True))
        others = self.physics.inputs[sum(self.sizes) :]
        copied.known.update(zip(others, [*(f[c] for c in sorted(f)), *graph.inputs[sum(self.sizes) :]], strict=False))
        if kind == "forces":
            Q = copied(self.forces)
            slope = [node for row in jacobian(graph, Q, graph.inputs[-self.sizes[2] :]) for node in row]
            return Program(graph, given, {"Q": Q, "around": slope + copied(self.around)})
        if kind == "passive":
            return Program(graph, given, {"Q": copied(self.passive)})
        a = copied(self.a)
        if kind == "linearize" and self.held:
            return Program(*self._implicit(graph, copied, a))
        match kind:
            case "mean":
                outputs = {"a": a}
            case "linearize":
                rows = jacobian(graph, a, graph.inputs)
                outputs = {"a": a, "jacobian": [node for row in rows for node in row]}
            case _:
                terms = copied([row[c] for row in self.W for c in self._latents])
                for part, z in zip(self.sums, features, strict=True):
                    terms += part.variance(graph, z)
                for part, z in zip(self.sums, features, strict=True):
                    terms += part.given(graph, z)
                outputs = {"a": a, "covariance": terms}
        return Program(graph, given, outputs)

    def _implicit(self, graph: Graph, copied: Copier, a: list[int]) -> tuple[Graph, dict, dict]:
        """The acceleration and its derivatives in a step from q, in v and in u, by `PredictorPhysics.held`."""
        (nq, nv, nu), count = self.sizes, sum(self.sizes)
        multiplier, left, r, s, t = (copied(nodes) for nodes in self.held[:5])
        H, G = ([copied(row) for row in rows] for rows in self.held[5:])
        inputs = [Expression(graph, node) for node in graph.inputs[:nq]]
        tangent = trace(lambda q: [self.space.tangent(q)], [self.space.neutral()], graph, inputs)[1][0].tolist()
        rest = [[ONE if i == j else ZERO for j in range(nv + nu)] for i in range(nv + nu)]
        seeds = [row + [ZERO] * (nv + nu) for row in tangent] + [[ZERO] * nv + row for row in rest]
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
        jacobian_rows = [node for row in zip(*found, strict=True) for node in row]
        return made, dict(zip("qvu", self.sizes, strict=True)), {"a": there(a), "jacobian": jacobian_rows}

    def c_source(self, kind: str, lanes: int, entry: str = "") -> str:
        """The C text of a program, or of a loop over it by an integrator's name, with the function `evaluate`.

        `entry` is another text that calls `program(t, live, x, y)` instead.
        """
        integrator, loop = kind, kind in steps_of(self.space)
        if loop:
            kind = "linearize" if integrator == "implicit-midpoint" else "mean"
        program, slopes = self.program(kind), kind in WITH_SLOPES
        names = [part.name + ("_slopes" if slopes else "") for part in self.sums]
        text = [head(lanes), *(part.c_source(lanes, slopes) for part in self.sums)]
        finish = None
        if kind == "covariance":
            text += [*(part.roots_source(lanes, self.rank) for part in self.sums), self._covariance_source()]
            finish = {"covariance": ("covariance", self.sizes[1] ** 2)}
        text.append(write_function("program", program.graph, program.nodes, lanes, names))
        if loop:
            text += self.motion_source(lanes)
            entry = loop_source(integrator, "program", self.space, self.sizes)
        text.append(entry or write_entry(program, "program", finish))
        return "\n".join(text)

    def motion_source(self, lanes: int) -> list[str]:
        """C functions that steps on a manifold call: q after a step, and the rate of a step under a velocity."""
        if self.space.is_vector_space:
            return []
        q, step = self.space.neutral(), torch.zeros(self.sizes[1], dtype=torch.float64)
        made = {"moved": trace(lambda q, step: [self.space.integrate(q, step)], [q, step])}
        made["step_rate"] = trace(lambda step, v: [self.space.chart_velocity(step, v)], [step, step])
        return [write_function(name, graph, x.tolist(), lanes) for name, (graph, (x,)) in made.items()]

    def _covariance_source(self) -> str:
        calls, C = [], len(self._latents)
        first, place = 0, self.sizes[1] * C + C
        for k, part in enumerate(self.sums):
            calls.append(f"{part.name}_roots(t[{k}], t[{len(self.sums) + k}], y + {place}, P + {first} * K);")
            first, place = first + len(part.latents), place + len(part.operands)
        words = {"JOINTS": self.sizes[1], "LATENTS": C, "RANK": self.rank, "WIDENED": (self.widening**2).hex()}
        return filled(c_text(__name__, "covariance.c"), words | {"ROOTS": "\n  ".join(calls)})

    @property
    def rank(self) -> int:
        """Numbers per process of the compressed covariance, filled up to whole vectors."""
        assert self.compressed is not None, "asked for by programs of the covariance only"
        return self.compressed.rank + -self.compressed.rank % PADDING

    @cached_property
    def tables(self) -> list[Tensor]:
        """What the C functions of the sums take, then the roots of the covariance."""
        found = [part.table() for part in self.sums]
        if self.compressed is not None:
            found += [part.root_table() for part in self.sums]
        return [aligned(table) for table in found]

    def drawn(self, latent: LatentPosterior, samples: int, seed: int) -> "Sequence[PredictorCode] | None":
        """The code of each drawn function, whose texts are equal; None where one has no form in pieces."""
        if not samples or not self.sums:
            return [self] * max(1, samples)
        drawn = drawn_calls(latent, self.sums, samples, seed, self.widening)
        return None if drawn is None else [replace(self, sums=calls, compressed=None) for calls in drawn]

    def loops(
        self, integrator: str, latent: LatentPosterior, samples: int = 0, seed: int = 0
    ) -> list[FusedLoop] | None:
        """Over the mean or each drawn function; None where one has no form in pieces, or no such step is written in C.

        Raises CompilerError.
        """
        codes = self.drawn(latent, samples, seed) if integrator in steps_of(self.space) else None
        if codes is None:
            return None
        library = codes[0].library(integrator)
        return [FusedLoop(library, code.tables) for code in codes]

    def library(self, kind: str) -> ctypes.CDLL:
        """A program, compiled or found, or a loop by its integrator. Raises CompilerError where that cannot be."""
        text = self.c_source(kind, VectorUnit.of_this_processor().lanes)
        return load_library(f"predictor-{kind}", text, lambda _: text, default_folder(), PURPOSE)[0]


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
            raise InvalidInput(
                "a compiled predictor has first derivatives only; for second ones make it with compile=False."
            )
        (_, nv, nu), space = ctx.predictor.sizes, ctx.predictor.space
        jacobian = ctx.predictor.run("linearize", ctx.saved_tensors)[1].view(-1, nv, 2 * nv + nu)
        in_q, in_v, in_u = (grad_outputs[0][:, None] @ jacobian)[:, 0].split([nv, nv, nu], dim=-1)
        return None, in_q if space.is_vector_space else space.cotangent(ctx.saved_tensors[0], in_q), in_v, in_u
