"""Coordinates for the inertial parameters of bodies: free ones, and ones that always belong to a body.

Both are relative to a reference ``P_0 = V V^T`` (V upper triangular) of each body, its pseudo-inertia in the URDF, so
that one unit is one unit of the affine-invariant metric (Lee, Wensing & Park, "Geometric robot dynamic identification:
a convex programming approach", T-RO 2020), whatever the mass, size and frame:

    free          P = V (1 + Z) V^T       Z symmetric, linear in the coordinates; to first order |Z|_F is the distance
    consistent    P = V F F^T V^T         F upper triangular, the log-Cholesky factor (Rucker & Wensing, RA-L 2022);
                                          the distance is |log F F^T|_F

The distance is a vector norm, so that it can stand among the residuals of non-linear least squares.

A body is often several links. With the factors of its old and new pseudo-inertia, ``P = V V^T`` and ``P' = U U^T``
(upper triangular), every link gets ``C P_k C^T`` with ``C = U V^-1``: they add up to P', each stays physically
possible, and links that were equal stay equal. Motions show nothing but their sum.
"""

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from typing_extensions import override

from forcegp.analytical.identifiability import body_names, body_pseudo_inertias, carrying
from forcegp.errors import NonPhysicalInertia
from forcegp.robots import Robot
from forcegp.robots.inertia import pseudo_inertia, standard_basis
from forcegp.robots.urdf_file import replace_dynamics, replace_inertial

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

    def moved(self, x: Float[np.ndarray, " n"], step: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """x + step to first order; x are these coordinates, then any others, which change by the step.

        Parameters change by exactly their derivatives times the step, if a body can. Torque is linear in them: with
        many rows of little noise, straight lines in x leave its narrow valley.
        """
        return np.concatenate([self._moved(x[: self.size], step[: self.size]), x[self.size :] + step[self.size :]])

    def _moved(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        return x + step

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
        return self._congruent(_log_cholesky(x)[0])

    @override
    def _moved(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        inner, derivatives = _log_cholesky(x)
        inner = inner + np.einsum("nk,nkab->nab", step.reshape(-1, 10), derivatives)
        there, values = (x + step).reshape(-1, 10), np.linalg.eigvalsh(inner)
        possible = values[:, 0] > DEFINITE * values[:, -1]
        F = upper_cholesky(inner[possible])
        scale, inside = F[:, 3, 3:], F[:, *np.transpose(_PLACES)] / F[:, 3, 3:]
        there[possible] = np.concatenate([np.log(scale), np.log(inside[:, :3]), inside[:, 3:]], axis=1)
        return there.ravel()

    @override
    def distance(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        inner, change = _log_cholesky(x)
        values, vectors = np.linalg.eigh(inner)
        values = np.maximum(values, np.finfo(np.float64).tiny)
        logs = np.log(values)
        turned = np.swapaxes(vectors, -1, -2)
        logarithm = vectors @ (logs[..., None] * turned)
        # derivative of a matrix function (Daleckii & Krein): divided differences in the axes of the argument
        gap = values[:, :, None] - values[:, None, :]
        equal = abs(gap) <= 1e-7 * (values[:, :, None] + values[:, None, :])
        mean = 0.5 * (values[:, :, None] + values[:, None, :])
        divided = np.where(equal, 1.0 / mean, (logs[:, :, None] - logs[:, None, :]) / np.where(equal, 1.0, gap))
        inside = turned[:, None] @ change @ vectors[:, None] * divided[:, None]
        moved = vectors[:, None] @ inside @ turned[:, None]
        jacobian = block_diag(*np.einsum("kab,niab->nki", _SYMMETRIC, moved))
        return np.einsum("kab,nab->nk", _SYMMETRIC, logarithm).ravel(), jacobian

    @override
    def _pseudo_inertia_derivatives(self, x: np.ndarray) -> np.ndarray:
        return self._congruent(_log_cholesky(x)[1])


DEFINITE = 1e-9
"""Matrices whose smallest eigenvalue is this fraction of the largest have factors in spite of rounding."""


def upper_cholesky(matrices: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
    """Upper triangular V with V V^T equal to each matrix. Raises numpy.linalg.LinAlgError where one is not definite."""
    return np.linalg.cholesky(matrices[:, ::-1, ::-1])[:, ::-1, ::-1]


def _log_cholesky(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """F F^T (n, 4, 4) and its derivatives (n, 10, 4, 4)."""
    x = x.reshape(-1, 10)
    scale = np.exp(x[:, 0])
    F = np.zeros((len(x), 4, 4))
    derivatives = np.zeros((len(x), 10, 4, 4))
    F[:, 3, 3] = scale
    for k, (i, j) in enumerate(_PLACES, start=1):
        F[:, i, j] = scale * (np.exp(x[:, k]) if i == j else x[:, k])
        derivatives[:, k, i, j] = F[:, i, j] if i == j else scale
    derivatives[:, 0] = F
    half = derivatives @ F.swapaxes(-1, -2)[:, None]
    return F @ F.swapaxes(-1, -2), half + half.swapaxes(-1, -2)


THIN = 1e-5
"""Bodies with a second moment about the centre of mass below this fraction of that about the origin are thickened."""
THICKNESS = 0.05
"""Standard deviation of the mass that thickening adds, as a fraction of the body's size."""


def thickened(robot: Robot) -> tuple[Robot, tuple[str, ...]]:
    """The robot with bodies of some thickness, since only they have coordinates; and the links that were changed.

    Points, rods and plates (ideal ones, as simple URDFs have them) get an isotropic second moment.
    """
    text, changed = robot.urdf_text, []
    for body, pseudo in zip(carrying(robot), body_pseudo_inertias(robot).numpy(), strict=True):
        joint = robot.layout.bodies[body]
        mass, center = pseudo[3, 3], pseudo[:3, 3] / pseudo[3, 3]
        about_center = pseudo[:3, :3] - mass * np.outer(center, center)
        size = max(np.trace(pseudo[:3, :3]), 1e-8 * mass)
        if np.linalg.eigvalsh(about_center)[0] > THIN * size:
            continue
        links = [name for name, place in robot.layout.links.items() if place.body == body]
        heaviest = max(links, key=lambda name: robot.link(name).mass)
        link = robot.link(heaviest)
        inertia = np.array(link.inertia) + 2.0 * THICKNESS**2 * size * np.eye(3)  # of the isotropic second moment
        center = np.array(link.center_of_mass)
        text = replace_inertial(text, heaviest, link.mass, center, inertia, source=robot.source)
        changed.append(heaviest if heaviest == joint.child else f"{heaviest} (of {joint.child})")
    return (robot.with_text(text) if changed else robot), tuple(changed)


def with_bodies(robot: Robot, wanted: Float[np.ndarray, "bodies 4 4"]) -> Robot:
    """A robot whose bodies have these pseudo-inertias, in the frames of their joints' child links.

    Raises NonPhysicalInertia, naming the bodies, where no body has them.
    """
    impossible = [name for name, pseudo in zip(body_names(robot), wanted, strict=True) if not _definite(pseudo)]
    if impossible:
        raise NonPhysicalInertia(
            f"no body has the inertia that least squares found for {', '.join(impossible)}, so there is no such robot; "
            "its torques and accelerations can be predicted all the same. For a robot use inertias='consistent'."
        )
    change = upper_cholesky(wanted) @ np.linalg.inv(upper_cholesky(body_pseudo_inertias(robot).numpy()))
    place, text = {body: k for k, body in enumerate(carrying(robot))}, robot.urdf_text
    for name, placement in robot.layout.links.items():
        link = robot.link(name)
        if link.joint is None or link.mass == 0.0:
            continue
        body = placement.body
        offset = np.linalg.inv(robot.layout.child_frames[body]) @ placement.offset
        there = np.linalg.inv(offset) @ change[place[body]] @ offset
        # a congruence by [[A, t], [0, s]] moves the moments about the centre of mass by A alone: no cancellation
        own = pseudo_inertia(link.mass, np.zeros(3), np.array(link.inertia))[:3, :3]
        A, shift, scale = there[:3, :3], there[:3, 3], there[3, 3]
        center = (A @ np.array(link.center_of_mass) + shift) / scale
        second = A @ own @ A.T
        inertia = np.trace(second) * np.eye(3) - second
        text = replace_inertial(text, name, link.mass * scale**2, center, inertia, source=robot.source)
    return robot.with_text(text)


def with_joint_dynamics(robot: Robot, damping: np.ndarray | None, friction: np.ndarray | None) -> Robot:
    """The robot whose URDF has <dynamics damping friction> (nv,) of every joint; None leaves what is there.

    That of a joint that others mimic includes theirs, which become 0.
    """
    text = robot.urdf_text
    free = {body for group in robot.layout.groups for body in range(group.bodies.start, group.bodies.stop)}
    for body, (joint, drive) in enumerate(zip(robot.layout.bodies, robot.layout.drives, strict=True)):
        if body in free:
            continue
        own = float(joint.name == robot.joint_names[drive.joint])
        values = {"damping": damping, "friction": friction}
        given = {name: own * float(value[drive.joint]) for name, value in values.items() if value is not None}
        text = replace_dynamics(text, joint.name, given, source=robot.source) if given else text
    return robot.with_text(text)


def _definite(pseudo: np.ndarray) -> bool:
    try:
        np.linalg.cholesky(pseudo)
    except np.linalg.LinAlgError:
        return False
    return True
