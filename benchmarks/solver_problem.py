"""The linear system T alpha = t that `benchmarks.solvers` solves: rows of `kuka-surface` with Coulomb friction.

The recording and the test rows are those of `large_data`, the prior on joint forces with the analytical mean; 2000 rows
that lie farthest apart, hyper-parameters from the first 250 of them, kept in runs/benchmarks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.large_data import COULOMB, RECORDINGS, TEST_SECONDS, TEST_STEP, recording
from forcegp import JointForces, StructuredGP, load_posterior, save_posterior
from forcegp.data import Dataset, farthest_rows
from forcegp.inference import LatentKernels, Terms
from forcegp.inference.likelihood import Deflation, deflate, whiten
from forcegp.models.structured.marginal_likelihood import MarginalLikelihood
from forcegp.models.structured.posterior import StructuredPosterior
from forcegp.models.training_data import TrainingData

SEED, SECONDS = 901, 220.0
ROWS, LEARNING_ROWS = 2000, 250


@dataclass(frozen=True, eq=False)
class Problem:
    """T alpha = t with T = sum_c (C_c C_c^T) K_c + I, in deflated coordinates."""

    kernels: LatentKernels
    features: tuple[Float[Tensor, "N _"], ...]
    C: Float[Tensor, "N r C"]
    t: Float[Tensor, "N r"]

    @classmethod
    def of(cls, kernels: LatentKernels, terms: Terms) -> Problem:
        with torch.no_grad():
            deflation = deflation_of(terms)
        return cls(kernels, tuple(z.detach() for z in terms.features), deflation.C, deflation.t)

    @cached_property
    def matrices(self) -> Float[Tensor, "C N N"]:
        """All kernel matrices, for measuring; methods make their own."""
        return self.new_matrices()

    def new_matrices(self) -> Float[Tensor, "C N N"]:
        """All kernel matrices, computed now."""
        crosses = [kernel.cross(z, z) for kernel, z in zip(self.kernels.dense, self.features, strict=True)]
        return torch.stack(crosses)

    def product(self, alpha: Float[Tensor, "N r"]) -> Float[Tensor, "N r"]:
        """T alpha."""
        latent = (self.matrices @ self.beta(alpha).mT[..., None])[..., 0]
        return torch.einsum("irc,ci->ir", self.C, latent) + alpha

    def beta(self, alpha: Float[Tensor, "N r"]) -> Float[Tensor, "N C"]:
        """C^T alpha, the weights of the kernel functions."""
        return torch.einsum("irc,ir->ic", self.C, alpha)

    def relative_residual(self, alpha: Float[Tensor, "N r"]) -> float:
        """|t - T alpha| / |t|."""
        return float((self.t - self.product(alpha)).norm() / self.t.norm())


def deflation_of(terms: Terms) -> Deflation:
    """Of whitened data."""
    W_white, y_white, _ = whiten(terms.W, terms.residual, terms.noise)
    return deflate(W_white, y_white)


@dataclass(frozen=True, eq=False)
class Task:
    """A fitted model and the rows farthest apart, in that order, with test rows to score solutions on."""

    fitted: StructuredPosterior
    rows: Dataset
    test: Dataset

    @classmethod
    def load(cls) -> Task:
        """From the kept recordings and hyper-parameters; makes what is missing."""
        data = recording(SEED, SECONDS, **COULOMB)
        rows = farthest_rows(data, ROWS)
        test = recording(SEED + 1, TEST_SECONDS, **COULOMB).rows(slice(0, None, TEST_STEP))
        fitted = load_posterior(_hyperparameters(rows))
        assert isinstance(fitted, StructuredPosterior)
        return cls(fitted, rows, test)

    def likelihood(self, rows: Dataset) -> MarginalLikelihood:
        """The model on other rows, features prepared as for those that it was fitted to."""
        reference = self.fitted.training
        training = replace(TrainingData.of(rows, reference.q.device), reference=reference)
        return replace(self.fitted.likelihood, training=training)

    @cached_property
    def problem(self) -> Problem:
        kernels = self.fitted.kernels.at(self.fitted.parameters)
        with torch.no_grad():
            return Problem.of(kernels, self.likelihood(self.rows).terms(self.fitted.parameters))

    @cached_property
    def _test_terms(self) -> tuple[Tensor, Tensor, Tensor]:
        """Kernel functions of the training rows at the test rows, mixing vectors, noise-free acceleration - mean."""
        with torch.no_grad():
            features, W, residual, _ = self.likelihood(self.test).terms(self.fitted.parameters)
            problem = self.problem
            pairs = zip(problem.kernels.dense, features, problem.features, strict=True)
            cross = torch.stack([kernel.cross(z, centers) for kernel, z, centers in pairs])
        return cross, W, residual + torch.as_tensor(self.test.truth["a"] - self.test.a)

    def mae_noise_free(self, alpha: Float[Tensor, "N r"]) -> float:
        """Mean absolute error of the mean acceleration that follows from alpha, against the noise-free one."""
        cross, W, missing = self._test_terms
        f = torch.einsum("cnj,jc->nc", cross, self.problem.beta(alpha))
        return float((missing - (W @ f[..., None])[..., 0]).abs().mean())


def _hyperparameters(rows: Dataset) -> Path:
    folder = RECORDINGS / "hyper-joint-forces-coulomb"
    if not folder.exists():
        assert rows.system is not None
        few = rows.rows(slice(LEARNING_ROWS))
        save_posterior(StructuredGP(rows.system, JointForces()).fit(few, restarts=1), folder)
    return folder
