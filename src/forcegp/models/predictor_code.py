"""A posterior's predictions as C: physics, features and processes of one state in one program.

The Python code that `predict` runs is traced once (`codegen.tracing`); processes are C functions that the graph calls
(`inference.kernel_sums`). From the one graph come the mean, its Jacobians and the covariance, each compiled when it is
first asked for.
"""

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from forcegp.codegen.c_text import c_text
from forcegp.codegen.c_writer import Program, head, write_entry, write_function
from forcegp.codegen.derivatives import jacobian
from forcegp.codegen.graph import Copier, Graph
from forcegp.codegen.library import Purpose, VectorUnit, aligned, default_folder, load_library
from forcegp.codegen.tracing import trace
from forcegp.errors import InvalidInput
from forcegp.inference.kernel_sums import PADDING
from forcegp.inference.one_input_calls import LatentCall, drawn_calls, latent_calls
from forcegp.inference.posterior import LatentPosterior
from forcegp.inference.prepared_kernels import CompressedCovariance
from forcegp.models.fused_rollouts import STEPS, FusedLoop, loop_source

TermsFunction = Callable[[Tensor, Tensor, Tensor], list[Tensor]]
"""States (n, nv) -> [offset (n, nv), W (n, nv, C), features of every process (n, d)], where a = offset + W f."""

PURPOSE = Purpose("a compiled predictor", "the environment variable XDG_CACHE_HOME", "give compile=False")

WITH_SLOPES = ("linearize", "forces")


@dataclass(frozen=True, eq=False)
class PredictorCode:
    """What is traced once of a posterior, and the programs made of it; see `of`."""

    nv: int
    sums: tuple[LatentCall, ...]
    physics: Graph
    a: list[int]
    W: list[list[int]]
    features: list[list[int]]
    forces: list[int]
    around: list[int]
    passive: list[int]
    compressed: CompressedCovariance | None
    widening: float

    @classmethod
    def of(
        cls,
        traced: Callable[..., list[Tensor]],
        example: Sequence[Tensor],
        latent: LatentPosterior,
        compressed: CompressedCovariance | None,
        widening: float,
    ) -> "PredictorCode":
        """Trace it at an example (1, nv). Raises InvalidInput on another device, and for what no graph holds."""
        if example[0].device.type != "cpu":
            raise InvalidInput(
                f"a compiled predictor runs on the CPU, and the model is on {example[0].device}; give compile=False, "
                "or a model on the CPU."
            )
        sums = latent_calls(latent, compressed)
        latents = sum(len(part.latents) for part in sums)
        graph, found = trace(traced, [*example, torch.ones(1, latents, dtype=torch.float64)])
        (a, W, Q, passive, *around), features = ([x[0].tolist() for x in part] for part in (found[:7], found[7:]))
        flat = [int(node) for values in around for node in np.ravel(values)]
        return cls(example[0].shape[-1], sums, graph, a, W, features, Q, flat, passive, compressed, widening)

    @property
    def _latents(self) -> list[int]:
        """All processes in the order of the sums."""
        return [c for part in self.sums for c in part.latents]

    def program(self, kind: str) -> Program:
        """The program "mean", "linearize", "covariance", "forces", or "passive" ones: all but actuation and bias."""
        graph, f, slopes = Graph(3 * self.nv), {}, kind in WITH_SLOPES
        copied = Copier(graph, self.physics, dict(zip(self.physics.inputs, graph.inputs, strict=False)))
        features = [copied(self.features[part.latents[0]]) for part in self.sums]
        for part, z in zip(self.sums, features, strict=True):
            f |= dict(zip(part.latents, part.call(graph, z, slopes), strict=True))
        copied.known.update(zip(self.physics.inputs[3 * self.nv :], (f[c] for c in sorted(f)), strict=True))
        if kind == "forces":
            Q = copied(self.forces)
            slope = [node for row in jacobian(graph, Q, graph.inputs[2 * self.nv :]) for node in row]
            return Program(graph, dict.fromkeys("qvu", self.nv), {"Q": Q, "around": slope + copied(self.around)})
        if kind == "passive":
            return Program(graph, dict.fromkeys("qvu", self.nv), {"Q": copied(self.passive)})
        a = copied(self.a)
        match kind:
            case "mean":
                outputs = {"a": a}
            case "linearize":
                outputs = {"a": a, "jacobian": [node for row in jacobian(graph, a, graph.inputs) for node in row]}
            case _:
                given = copied([row[c] for row in self.W for c in self._latents])
                for part, z in zip(self.sums, features, strict=True):
                    given += part.variance(graph, z)
                for part, z in zip(self.sums, features, strict=True):
                    given += part.given(graph, z)
                outputs = {"a": a, "covariance": given}
        return Program(graph, dict.fromkeys("qvu", self.nv), outputs)

    def c_source(self, kind: str, lanes: int, entry: str = "") -> str:
        """The C text of a program, or of a loop over it by an integrator's name, with the function `evaluate`.

        `entry` is another text that calls `program(t, live, x, y)` instead.
        """
        integrator, loop = kind, kind in STEPS
        if loop:
            kind = "linearize" if integrator == "implicit-midpoint" else "mean"
        program, slopes = self.program(kind), kind in WITH_SLOPES
        names = [part.name + ("_slopes" if slopes else "") for part in self.sums]
        text = [head(lanes), *(part.c_source(lanes, slopes) for part in self.sums)]
        finish = None
        if kind == "covariance":
            text += [*(part.roots_source(lanes, self.rank) for part in self.sums), self._covariance_source()]
            finish = {"covariance": ("covariance", self.nv**2)}
        text.append(write_function("program", program.graph, program.nodes, lanes, names))
        if loop:
            entry = loop_source(integrator, "program", self.nv)
        text.append(entry or write_entry(program, "program", finish))
        return "\n".join(text)

    def _covariance_source(self) -> str:
        calls, C = [], len(self._latents)
        first, place = 0, self.nv * C + C
        for k, part in enumerate(self.sums):
            calls.append(f"{part.name}_roots(t[{k}], t[{len(self.sums) + k}], y + {place}, P + {first} * K);")
            first, place = first + len(part.latents), place + len(part.operands)
        sizes = {"JOINTS": self.nv, "LATENTS": C, "RANK": self.rank, "WIDENED": (self.widening**2).hex()}
        text = c_text(__name__, "covariance.c").replace("  ROOTS", "  " + "\n  ".join(calls))
        for name, value in sizes.items():
            text = text.replace(name, str(value))
        return text

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
        """Over the mean or each drawn function; None where one has no form in pieces. Raises CompilerError."""
        codes = self.drawn(latent, samples, seed)
        if codes is None:
            return None
        library = codes[0].library(integrator)
        return [FusedLoop(library, code.tables) for code in codes]

    def library(self, kind: str) -> ctypes.CDLL:
        """A program, compiled or found, or a loop by its integrator. Raises CompilerError where that cannot be."""
        text = self.c_source(kind, VectorUnit.of_this_processor().lanes)
        return load_library(f"predictor-{kind}", text, lambda _: text, default_folder(), PURPOSE)[0]
