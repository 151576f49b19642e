"""Coordinates for the inertial parameters of bodies: free ones, and ones that always belong to a body.

Both are relative to a reference ``P_0 = V V^T`` (V upper triangular) of each body, its pseudo-inertia in the URDF, so
that one unit is one unit of the affine-invariant metric (Lee, Wensing & Park, "Geometric robot dynamic identification:
a convex programming approach", T-RO 2020), whatever the mass, size and frame:

    free          P = V (1 + Z) V^T       Z symmetric, linear in the coordinates; to first order |Z|_F is the distance
    consistent    P = V F F^T V^T         F upper triangular, the log-Cholesky factor (Rucker & Wensing, RA-L 2022);
                                          the distance is |log F F^T|_F

The distance is a vector norm, so that it can stand among the residuals of non-linear least squares.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from typing_extensions import override

from forcegp.robots.inertia import standard_basis

# symmetric matrices Z = sum_k z_k E_k, orthonormal in the Frobenius norm
_ROWS, _COLUMNS = np.triu_indices(4)
_SYMMETRIC = np.zeros((10, 4, 4))
for _k, (_i, _j) in enumerate(zip(_ROWS, _COLUMNS, strict=True)):
    _SYMMETRIC[_k, _i, _j] = _SYMMETRIC[_k, _j, _i] = 1.0 if _i == _j else 0.5**0.5
# places of d1, d2, d3, s12, s23, s13, t1, t2, t3 in the log-Cholesky factor
_PLACES = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))


class BodyCoordinates(ABC):
    """Ten coordinates x of each of n bodies, 0 at the reference pseudo-inertias (n, 4, 4), which are definite."""

    longest_step: ClassVar[float] = np.inf
    """Most that a coordinate should change at once: infinite where parameters are linear in them."""

    def __init__(self, reference: Float[np.ndarray, "n 4 4"]):
        self.factors = upper_cholesky(reference)
        self._to_standard = np.linalg.pinv(standard_basis().numpy())

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return 10 * len(self.factors)

    def parameters(self, x: Float[np.ndarray, " k"]) -> Float[np.ndarray, "n 10"]:
        """Standard parameters."""
        return self._standard(self.pseudo_inertias(x))

    def derivatives(self, x: Float[np.ndarray, " k"]) -> Float[np.ndarray, "n 10 10"]:
        """Derivatives of each body's standard parameters (second axis) in its coordinates (third)."""
        return self._standard(self._pseudo_inertia_derivatives(x)).swapaxes(-1, -2)

    @abstractmethod
    def pseudo_inertias(self, x: Float[np.ndarray, " k"]) -> Float[np.ndarray, "n 4 4"]:
        """P of every body."""

    @abstractmethod
    def distance(self, x: Float[np.ndarray, " k"]) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
        """A vector whose norm is the distance from the reference, and its Jacobian."""

    @abstractmethod
    def _pseudo_inertia_derivatives(self, x: np.ndarray) -> np.ndarray:
        """(n, 10, 4, 4)."""

    def _standard(self, pseudo: np.ndarray) -> np.ndarray:
        return pseudo.reshape(*pseudo.shape[:-2], 16) @ self._to_standard.T

    def _congruent(self, inner: np.ndarray) -> np.ndarray:
        """V inner V^T for (n, ..., 4, 4)."""
        V = self.factors.reshape(len(self.factors), *(1 for _ in range(inner.ndim - 3)), 4, 4)
        return V @ inner @ V.swapaxes(-1, -2)


class FreeBodies(BodyCoordinates):
    """Any parameters, also those that no body has."""

    @override
    def pseudo_inertias(self, x: np.ndarray) -> np.ndarray:
        return self._congruent(np.eye(4) + np.tensordot(x.reshape(-1, 10), _SYMMETRIC, 1))

    @override
    def distance(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return x, np.eye(len(x))

    @override
    def _pseudo_inertia_derivatives(self, x: np.ndarray) -> np.ndarray:
        return self._congruent(np.broadcast_to(_SYMMETRIC, (len(self.factors), 10, 4, 4)))


class ConsistentBodies(BodyCoordinates):
    """Parameters of bodies of positive density: relative log-Cholesky coordinates alpha, d1-3, s12, s23, s13, t1-3."""

    longest_step: ClassVar[float] = 1.0  # a mass by a factor of e^2

    @override
    def pseudo_inertias(self, x: np.ndarray) -> np.ndarray:
        factor, _ = _log_cholesky(x)
        return self._congruent(factor @ factor.swapaxes(-1, -2))

    @override
    def distance(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        factor, derivatives = _log_cholesky(x)
        values, vectors = np.linalg.eigh(factor @ factor.swapaxes(-1, -2))
        values = np.maximum(values, np.finfo(np.float64).tiny)
        logs = np.log(values)
        turned = np.swapaxes(vectors, -1, -2)
        logarithm = vectors @ (logs[..., None] * turned)
        # derivative of a matrix function (Daleckii & Krein): divided differences in the axes of the argument
        gap = values[:, :, None] - values[:, None, :]
        equal = abs(gap) <= 1e-7 * (values[:, :, None] + values[:, None, :])
        mean = 0.5 * (values[:, :, None] + values[:, None, :])
        divided = np.where(equal, 1.0 / mean, (logs[:, :, None] - logs[:, None, :]) / np.where(equal, 1.0, gap))
        change = derivatives @ factor.swapaxes(-1, -2)[:, None]
        change = change + change.swapaxes(-1, -2)
        inside = turned[:, None] @ change @ vectors[:, None] * divided[:, None]
        moved = vectors[:, None] @ inside @ turned[:, None]
        blocks = np.einsum("kab,niab->nki", _SYMMETRIC, moved)
        jacobian = np.zeros((len(x), len(x)))
        for n, block in enumerate(blocks):
            jacobian[10 * n : 10 * n + 10, 10 * n : 10 * n + 10] = block
        return np.einsum("kab,nab->nk", _SYMMETRIC, logarithm).ravel(), jacobian

    @override
    def _pseudo_inertia_derivatives(self, x: np.ndarray) -> np.ndarray:
        factor, derivatives = _log_cholesky(x)
        half = derivatives @ factor.swapaxes(-1, -2)[:, None]
        return self._congruent(half + half.swapaxes(-1, -2))


def upper_cholesky(matrices: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
    """Upper triangular V with V V^T equal to each matrix. Raises numpy.linalg.LinAlgError where one is not definite."""
    return np.linalg.cholesky(matrices[:, ::-1, ::-1])[:, ::-1, ::-1]


def _log_cholesky(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """F (n, 4, 4) and its derivatives (n, 10, 4, 4)."""
    x = x.reshape(-1, 10)
    scale = np.exp(x[:, 0])
    F = np.zeros((len(x), 4, 4))
    derivatives = np.zeros((len(x), 10, 4, 4))
    F[:, 3, 3] = scale
    for k, (i, j) in enumerate(_PLACES, start=1):
        F[:, i, j] = scale * (np.exp(x[:, k]) if i == j else x[:, k])
        derivatives[:, k, i, j] = F[:, i, j] if i == j else scale
    derivatives[:, 0] = F
    return F, derivatives
