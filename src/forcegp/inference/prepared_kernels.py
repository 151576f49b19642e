"""Posterior means of all latents as sums for C, and their covariance compressed, for many calls with few points.

The kernel of one pair is traced; what depends on the centre alone becomes a table, what depends on z alone is computed
once per state. The covariance k - (B^T V)^T (B^T V), V = L^-1 K(z), is that of a process which has seen only R
combinations of the data: never below the exact one. B holds leading left singular vectors of V at sample states.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import or_

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.codegen.c_writer import c_text, c_value, filled, sections
from forcegp.codegen.graph import FUNCTIONS, Copier, Graph, Slopes, interpreted, jacobian
from forcegp.codegen.tracing import trace
from forcegp.inference.dense_kernels import squared_exponential_parameters
from forcegp.inference.posterior import BLOCK_BYTES, ExactPosterior, LatentPosterior

PADDING = 8  # centres are filled up to a multiple of the most lanes, with weights of zero

BLOCK = 64  # centres whose kernels are held at once

Formulas = tuple[Callable[[Tensor, Tensor], Tensor], Callable[[Tensor], Tensor], tuple[float, ...]]
"""(z (1, d), z_j (1, d)) -> the kernels of all latents at that pair, less a level each; z -> k(z, z); the levels."""


@dataclass(frozen=True, eq=False)
class KernelSum:
    """The sums of G latents over the same N centres, with what their C function needs.

    `weights` (G, N) are those of the posterior mean, `name` is that of the C function. `pair` and `prior` are traced
    from kernels less a constant `level` each.
    """

    name: str
    latents: tuple[int, ...]
    centers: Float[Tensor, "N d"]
    weights: Float[Tensor, "G N"]
    pair: Graph
    kernels: tuple[int, ...]
    prior: Graph
    variances: tuple[int, ...]
    level: tuple[float, ...]
    roots: Float[Tensor, "G N R"] | None = None

    def call(self, graph: Graph, z: Sequence[int], slopes: bool) -> list[int]:
        """The nodes of E f_c at features z, as a call of the C function; with `slopes` it can be differentiated."""
        name = self.name + ("_slopes" if slopes else "")
        called = graph.call(name, self.given(graph, z), len(self.latents), self._slopes if slopes else None)
        constants = map(graph.constant, self.constants)
        return [graph.apply("add", f, constant) for f, constant in zip(called, constants, strict=True)]

    @property
    def constants(self) -> list[float]:
        """What the sums of `pair` lack."""
        totals = (math.fsum(weights.tolist()) for weights in self.weights)
        return [level * total for level, total in zip(self.level, totals, strict=True)]

    def _dependence(self) -> list[int]:
        """Of every node of the pair: 1 if it depends on z, 2 on the centre, 3 on both, 0 on none."""
        found: list[int] = []
        for node, (operation, *rest) in enumerate(self.pair.nodes):
            own = 0 if operation != "input" else 1 if rest[0] < self.centers.shape[-1] else 2
            found.append(reduce(or_, (found[operand] for operand in self.pair.operands(node)), own))
        return found

    def _frontier(self, kind: int) -> list[int]:
        """Nodes of one kind that those which depend on both, or the kernels themselves, are computed from."""
        needed, dependence = self.pair.needed(self.kernels), self._dependence()
        used = {x for node in needed if dependence[node] == 3 for x in self.pair.operands(node)}
        return [node for node in needed if dependence[node] == kind and (node in used or node in self.kernels)]

    @cached_property
    def operands(self) -> list[int]:
        """What a state gives: nodes of the pair."""
        return self._frontier(1)

    @property
    def width(self) -> int:
        """How many numbers `given` returns."""
        return len(self.operands)

    def given(self, graph: Graph, z: Sequence[int]) -> list[int]:
        """The operands at features z."""
        return Copier(graph, self.pair, dict(zip(self.pair.inputs, z, strict=False)))(self.operands)

    def variance(self, graph: Graph, z: Sequence[int]) -> list[int]:
        """Prior variances at features z."""
        return Copier(graph, self.prior, dict(zip(self.prior.inputs, z, strict=True)))(self.variances)

    @cached_property
    def rows(self) -> list[int]:
        """What a centre gives: nodes of the pair."""
        return self._frontier(2)

    @cached_property
    def _partials(self) -> dict[tuple[int, int], int]:
        """(latent, operand) -> the node of d k / d operand."""
        slopes = enumerate(jacobian(self.pair, self.kernels, self.operands))
        found = {(g, k): node for g, row in slopes for k, node in enumerate(row)}
        return {place: node for place, node in found.items() if self.pair.value(node) != 0.0}

    @cached_property
    def _slopes(self) -> Slopes:
        return {pair: len(self.latents) + k for k, pair in enumerate(self._partials)}

    def table(self) -> np.ndarray:
        """[number of centres filled up, true number, 0 ...], a row per quantity of the centres, a row of weights each.

        Eight numbers stand before the rows, so that these are aligned as the table is.
        """
        valid = len(self.centers)
        filled = -valid % PADDING
        rows = [np.pad(row, (0, filled), "edge") for row in self.row_values()]
        weights = np.pad(self.weights.numpy(), ((0, 0), (0, filled)))
        return np.concatenate([[valid + filled, valid, *[0.0] * 6], *rows, *weights])

    def row_values(self) -> list[np.ndarray]:
        """The numbers of every row, one per centre."""
        inputs = [*np.zeros((self.centers.shape[-1], 1)), *self.centers.numpy().T]
        with np.errstate(all="ignore"):
            found = interpreted(self.pair, self.rows, inputs, FUNCTIONS)
        return [np.broadcast_to(x, len(self.centers)) for x in found]

    def root_table(self) -> np.ndarray:
        """The roots of the compressed covariance, of as many centres as there are in the table."""
        assert self.roots is not None, "asked for with a compressed covariance only"
        return torch.nn.functional.pad(self.roots, (0, 0, 0, -len(self.centers) % PADDING)).numpy().ravel()

    def c_source(self, lanes: int, slopes: bool) -> str:
        """The C function `NAME(table, live, z, f)`, or NAME_slopes, whose derivatives follow the values."""
        name = self.name + ("_slopes" if slopes else "")
        made = list(self.kernels) + (list(self._partials.values()) if slopes else [])
        owner = list(range(len(self.latents))) + ([g for g, _ in self._partials] if slopes else [])
        if lanes == 1:
            return self._loop(name, made, owner, lanes, False)
        both = [self._loop(f"{name}_{'one' if one else 'many'}", made, owner, lanes, one) for one in (True, False)]
        choice = f"if (live == 1) {name}_one(t, live, z, f); else {name}_many(t, live, z, f);"
        both.append(f"static void {name}(const double *t, long live, const real *z, real *f) {{ {choice} }}")
        return "\n".join(both)

    def roots_source(self, lanes: int, rank: int) -> str:
        """`NAME_roots(t, F, z, P)`: P (G, rank) += k(z, Z) F for one state, F (G, N filled up, rank)."""
        kernels = self._loop(f"{self.name}_kernels", list(self.kernels), [], lanes, True)
        words = {"NAME": self.name, "RANK": rank, "LATENTS": len(self.latents), "BLOCK": BLOCK}
        return kernels + filled(c_text(__name__, "kernel_roots.c"), words)

    def _loop(self, name: str, made: list[int], owner: list[int], lanes: int, one: bool) -> str:
        """One state and several centres at a time with `one`, else several states."""
        graph, dependence, keep = self.pair, self._dependence(), not owner
        state, centre, step = ("double", "real", "LANES") if one else ("real", "double", "1")
        operands = {node: k for k, node in enumerate(self.operands)}
        rows = {node: k for k, node in enumerate(self.rows)}

        def operand(node: int) -> str:
            operation, *rest = graph.nodes[node]
            if operation == "constant":
                return f"({float(rest[0]).hex()})"
            return f"z{operands[node]}" if node in operands else f"c{rows[node]}" if node in rows else f"x{node}"

        def as_real(node: int) -> str:
            """Constants, and what is a double here, as the type of what depends on both."""
            narrow = dependence[node] == 0 or dependence[node] == (1 if one else 2)
            return f"R({operand(node)})" if narrow else operand(node)

        made_of_both = [node for node in graph.needed(made) if dependence[node] == 3]
        pick = "AT(z[{0}], 0)" if one and not keep else "z[{0}]"
        load = "LOAD(rows + {0} * n + j)" if one else "rows[{0} * n + j]"
        total = "R(TOTAL(s{0}))" if one else "s{0}"
        words: dict[str, object] = {"NAME": name, "STEP": step}
        words["OPERANDS"] = [f"const {state} z{k} = {pick.format(k)};" for k in range(len(operands))]
        words["ROWS"] = [f"const {centre} c{k} = {load.format(k)};" for k in range(len(rows))]
        words["NODES"] = [f"const real x{n} = {c_value(graph, n, operand, as_real, lanes)};" for n in made_of_both]
        words["STARTS"] = [f"real s{k} = R(0.0);" for k in range(len(made))]
        words["WEIGHTS"] = [f"const {centre} w{g} = {load.format(len(rows) + g)};" for g in range(len(self.latents))]
        words["SUMS"] = [f"s{k} += w{owner[k]} * {as_real(node)};" for k, node in enumerate(made) if owner]
        words["ENDS"] = [f"f[{k}] = {total.format(k)};" for k in range(len(made))]
        stored = enumerate(zip(made, self.level, strict=False))
        words["KEPT"] = [f"STORE(k + {g * BLOCK} + j - first, {as_real(x)} + {c.hex()});" for g, (x, c) in stored]
        words |= {word: "\n".join(lines) for word, lines in words.items() if isinstance(lines, list)}
        return filled(sections(__name__, "kernel_loop.c")["kept" if keep else "summed"], words)


ROUNDING = 1e-7  # standard deviations below this fraction of the prior's are rounding: nothing there can be uncertain
DIRECTIONS = 128  # of so many directions the leading ones are computed at once


@dataclass(frozen=True, eq=False)
class Sample:
    """States at which covariances are compared: features of all latents, and W (n, k, C) of what matters, y = W f."""

    features: Sequence[Float[Tensor, "n _"]]
    W: Float[Tensor, "n k C"]


@dataclass(frozen=True, eq=False)
class CompressedCovariance:
    """Cov(f(z)) = k(z, z) - P P^T with P_c = k_c(z, Z) F_c, F_c (N, R); `factors` has those of `kernel_groups`.

    `inflation` holds the standard deviations of y over the exact ones, minus 1, at states that did not choose B.
    """

    factors: tuple[Float[Tensor, "_ _ R"], ...]
    inflation: Float[Tensor, " _"]

    @property
    def rank(self) -> int:
        """R: how many combinations of the data are used."""
        return self.factors[0].shape[-1]

    def at(self, latent: LatentPosterior, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n C C"]:
        """The covariance at n points, by torch."""
        parts: dict[int, Tensor] = {}
        for group, F in zip(kernel_groups(latent), self.factors, strict=True):
            for c, own in zip(group, F, strict=True):
                parts[c] = latent.kernels.dense[c].cross(features[c], latent.features[c]) @ own
        P = torch.stack([parts[c] for c in sorted(parts)], dim=1)
        prior = torch.stack([k.diagonal(z) for k, z in zip(latent.kernels.dense, features, strict=True)], dim=-1)
        return torch.diag_embed(prior) - P @ P.mT


def compress(
    latent: ExactPosterior, sample: Sample, check: Sample, *, tolerance: float, largest: int
) -> CompressedCovariance:
    """The smallest rank at which standard deviations at the states of `check` are at most 1 + `tolerance` too large.

    It is `largest` where more would be needed. B is chosen at the states of `sample`.
    """
    with torch.no_grad():
        (D, left), (at, total) = _directions(latent, sample), _directions(latent, check)
        B, excess = D.new_zeros(0, D.shape[1]), total  # in units of the exact variance
        most, allowed = min(largest, *D.shape), (1.0 + tolerance) ** 2 - 1.0
        while len(B) < most and (not len(B) or float(excess.amax()) > allowed):  # one, where data add nothing
            # the leading half of the directions of which most is missing: what is small among them is better chosen
            # among all in the next round
            X = D[left.topk(min(DIRECTIONS, len(left))).indices]
            for _ in range(2):  # once leaves rounding
                X = X - (X @ B.mT) @ B
            U = torch.linalg.svd(X, full_matrices=False)[2][: min(DIRECTIONS // 2, most - len(B))]
            U = torch.linalg.qr((U - (U @ B.mT) @ B).mT)[0].mT
            left -= (U @ D.mT).square_().sum(0)
            excess, B = excess - (U @ at.mT).square_().sum(0), torch.cat([B, U])
        # in the order of what they explain at all states, fewer of the same are enough
        B = torch.linalg.svd(torch.linalg.qr(D @ B.mT, mode="r")[1])[2] @ B
        excess = (total - (B @ at.mT).square_().cumsum_(0)).clamp_min_(0.0)
        enough = torch.nonzero(excess.amax(1) <= allowed)
        B = B[: int(enough[0]) + 1] if len(enough) else B
        S, C = latent.system.factor.solve_upper(B.mT.contiguous()), latent.system.deflation.C
        factors = torch.einsum("jac,jar->cjr", C, S.reshape(*C.shape[:2], -1))
        chosen = tuple(factors[list(group)].contiguous() for group in kernel_groups(latent))
    return CompressedCovariance(chosen, (1.0 + excess[len(B) - 1]).sqrt() - 1.0)


def _directions(latent: ExactPosterior, sample: Sample) -> tuple[Float[Tensor, "_ n"], Float[Tensor, " _"]]:
    """W V^T over the exact standard deviations, one row per state and entry of y, and the rows' squared norms."""
    C = latent.system.deflation.C
    count, rank, latents = C.shape
    points, height, found = len(sample.W), max(1, BLOCK_BYTES // max(1, 8 * count * rank * latents)), []
    for start in range(0, points, height):
        features, W = [z[start : start + height] for z in sample.features], sample.W[start : start + height]
        places = zip(latent.kernels.dense, features, latent.features, strict=True)
        cross = torch.stack([k.cross(z, at) for k, z, at in places])
        # W = Y Z with as few rows Z as it has rank: contacts and few latents leave fewer columns to solve for
        Y, scales, Z = torch.linalg.svd(W, full_matrices=False)
        needed = max(1, int((scales > ROUNDING**2 * scales.amax()).sum(1).max()))
        Z = (scales[..., None] * Z)[:, :needed]
        weighted = cross.permute(2, 0, 1)[..., None] * Z.permute(2, 0, 1)  # (N, C, n, needed)
        K = torch.bmm(C, weighted.flatten(2)).flatten(0, 1)
        V = latent.system.factor.solve_lower(K).reshape(len(K), -1, needed)
        y = torch.bmm(Y[..., :needed], V.permute(1, 2, 0))
        prior = torch.stack([k.diagonal(z) for k, z in zip(latent.kernels.dense, features, strict=True)], dim=-1)
        variance, known = torch.einsum("nkc,nc->nk", W.square(), prior), torch.linalg.vector_norm(y, dim=-1)
        left = (variance - known.square()).sqrt()
        counts = left > ROUNDING * variance.sqrt()  # False where NaN
        y /= left[..., None]
        found.append((y.flatten(0, 1) if counts.all() else y[counts], (known / left)[counts]))
    D, known = zip(*found, strict=True)
    return torch.cat(D), torch.cat(known).square()


def kernel_sums(latent: LatentPosterior) -> tuple[KernelSum, ...]:
    """The groups as C functions of the posterior mean. Raises InvalidInput for a kernel that cannot be traced."""
    found = []
    for k, group in enumerate(kernel_groups(latent)):
        centers, kernel = latent.features[group[0]], latent.kernels.dense[group[0]]
        weights = torch.stack([latent.weights[c].detach() for c in group])
        scales = [each for c in group if (each := squared_exponential_parameters(latent.kernels[c])) is not None]
        alone: Formulas = kernel.cross, kernel.diagonal, (0.0,)
        cross, diagonal, level = _squared_exponentials(centers, scales) if scales else alone
        example = centers[:1]
        pair, (kernels,) = trace(lambda z, c, cross=cross: [cross(z, c)], [example, example.clone()])
        prior, (variances,) = trace(lambda z, diagonal=diagonal: [diagonal(z)], [example])
        nodes = (tuple(found.flatten().tolist()) for found in (kernels, variances))
        found.append(KernelSum(f"latents{k}", group, centers, weights, pair, next(nodes), prior, next(nodes), level))
    return tuple(found)


def _squared_exponentials(centers: Float[Tensor, "N d"], scales: Sequence[tuple[Tensor, Tensor]]) -> Formulas:
    """k_c(z, z_j) - s_c of latents with the same centres, k_c(z, z), and s_c: k is nearly s, and sums would cancel."""
    shift = centers.mean(0)
    precisions = torch.stack([length.detach().expand(centers.shape[-1]) ** -2 for length, _ in scales])
    variances = torch.stack([variance.detach().reshape(()) for _, variance in scales])

    def pair(z: Tensor, center: Tensor) -> Tensor:
        z, center = z - shift, center - shift  # or what cancels would be large
        scaled, own = z * precisions, -0.5 * (precisions * center.square()).sum(-1)
        return variances * (((scaled * center).sum(-1) + own) - 0.5 * (scaled * z).sum(-1)).expm1()

    return pair, lambda z: variances[None], tuple(variances.tolist())


def kernel_groups(latent: LatentPosterior) -> tuple[tuple[int, ...], ...]:
    """Numbers of the latents that are summed together: first those that are not squared exponentials, each alone."""
    alone: list[tuple[int, ...]] = []
    shared: list[list[int]] = []
    for index, (kernel, centers) in enumerate(zip(latent.kernels, latent.features, strict=True)):
        if squared_exponential_parameters(kernel) is None:
            alone.append((index,))
            continue
        same = next((group for group in shared if torch.equal(latent.features[group[0]], centers)), [])
        if not same:
            shared.append(same)
        same.append(index)
    return (*alone, *map(tuple, shared))
