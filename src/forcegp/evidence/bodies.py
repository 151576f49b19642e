"""Inertial parameters: the torque regressor, the combinations that show, and bodies as coordinates.

Base parameters: Atkeson, An & Hollerbach (IJRR 1986); Gautier (J. Robotic Systems 1991), by QR with column pivoting.
Coordinates: P = V F F^T V^T about a reference V V^T, F a log-Cholesky factor (Rucker & Wensing, RA-L 2022), of which
every body has a positive density; |log F F^T| is the affine-invariant distance (Lee, Wensing & Park, T-RO 2020).
"""

from collections.abc import Mapping, Sequence

import numpy as np
import scipy.linalg
import torch
from jaxtyping import Float
from scipy.linalg import block_diag
from torch import Tensor

from forcegp.errors import NonPhysicalInertia
from forcegp.forces import Body
from forcegp.inference import require_memory
from forcegp.robots import Robot
from forcegp.robots.inertia import physical_of_pseudo_inertia, standard_basis, standard_of_pseudo_inertia
from forcegp.robots.urdf_file import replace_inertial


def torque_regressor(
    robot: Robot, q: Float[Tensor, "*#rows nq"], v: Float[Tensor, "*#rows nv"], a: Float[Tensor, "*#rows nv"]
) -> Float[Tensor, "... nv columns"]:
    """Y (..., nv, 10 bodies) with ``Y @ standard_parameters(robot)`` the joint forces in Nm or N, without armature.

    Columns of a body are m, m c, Ixx, Ixy, Iyy, Ixz, Iyz, Izz. Raises InvalidInput for wrong shapes, dtypes or devices.
    """
    return robot.kinematics(q, v).torque_regressor(a)[..., carrying(robot), :].flatten(-2)


def carrying(robot: Robot) -> list[int]:
    """Numbers of the bodies with mass: what lies between the joints of a universal joint has no parameters."""
    return robot.tree.inertias[:, 3, 3, 0].nonzero()[:, 0].tolist()


def standard_parameters(robot: Robot) -> Float[Tensor, "columns"]:
    """The parameters pi (10 bodies,) that the robot's URDF gives, links fixed to one another merged."""
    return standard_of_pseudo_inertia(body_pseudo_inertias(robot)).flatten()


def body_pseudo_inertias(robot: Robot) -> Float[Tensor, "bodies 4 4"]:
    """Pseudo-inertia of every body in the frame of its child link."""
    own = carrying(robot)
    inverse = torch.linalg.inv(torch.as_tensor(robot.layout.child_frames[own], device=robot.device))
    return inverse @ robot.tree.inertias[own, ..., 0] @ inverse.mT


def body_names(robot: Robot) -> tuple[str, ...]:
    """What the bodies are called: by the child link of their joint."""
    return tuple(robot.layout.bodies[body].child for body in carrying(robot))


RANK_TOLERANCE = 1e-9  # diagonal entries of R below this fraction of the largest are 0, for columns of norm 1
RANDOM_ROWS, FEWEST = 50, 20  # random states per joint, and of all, that stand for every motion
ENTRIES, COPIES = 2**23, 6  # of a regressor at once; what more rows would need, and the steps of its decomposition


def base_parameters(robot: Robot) -> tuple[int, ...]:
    """Columns of the regressor that are base parameters: independent whatever the motion, and all others follow.

    They are those of random states, the same ones every time.
    """
    entries = 10 * max(robot.nv, 1) ** 2  # of the regressor at one state
    states = min(RANDOM_ROWS * robot.nv, max(FEWEST, ENTRIES // entries))
    remedy = "give a robot with fewer joints, others locked."
    require_memory(8 * COPIES * states * entries, f"the regressor of {robot.nv} joints", remedy, robot.device)
    turns, v, a = torch.tensor(np.random.default_rng(0).normal(0.0, 2.0, (3, states, robot.nv)), device=robot.device)
    q = robot.space.integrate(robot.space.neutral(), turns)
    regressor = torque_regressor(robot, q, v, a).flatten(0, 1).cpu().numpy()
    norms = np.linalg.norm(regressor, axis=0)
    seen = np.flatnonzero(norms > RANK_TOLERANCE * norms.max())
    triangular, order = scipy.linalg.qr(regressor[:, seen] / norms[seen], mode="r", pivoting=True)
    diagonal = np.abs(triangular.diagonal())
    return tuple(seen[order[: (diagonal > RANK_TOLERANCE * diagonal[0]).sum()]].tolist())


# symmetric matrices Z = sum_k z_k E_k, orthonormal in the Frobenius norm
_ROWS, _COLUMNS = np.triu_indices(4)
_SYMMETRIC = np.zeros((10, 4, 4))
for _k, (_i, _j) in enumerate(zip(_ROWS, _COLUMNS, strict=True)):
    _SYMMETRIC[_k, _i, _j] = _SYMMETRIC[_k, _j, _i] = 1.0 if _i == _j else 0.5**0.5
# places of d1, d2, d3, s12, s23, s13, t1, t2, t3 in the log-Cholesky factor
_PLACES = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))


QUANTITIES = (
    ("mass", "kg"),
    *((f"center_of_mass.{x}", "m") for x in "xyz"),
    *((f"inertia.{x}", "kg m^2") for x in ("xx", "xy", "xz", "yy", "yz", "zz")),
)
"""What people read of a body: inertia about its centre of mass."""
_INERTIA = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
Coordinates = Float[np.ndarray, " k"]


class Bodies:
    """Coordinates of n bodies, 0 at reference pseudo-inertias (4, 4): alpha, d1-3, s12, s23, s13, t1-3 of each."""

    def __init__(self, references: Sequence[Float[np.ndarray, "4 4"]], priors: Sequence[Body]) -> None:
        self.priors = tuple(priors)
        self.factors = upper_cholesky(np.array(references).reshape(-1, 4, 4))
        self._to_standard = np.linalg.pinv(standard_basis().numpy())
        self._weights = np.repeat([prior.strength**0.5 for prior in self.priors], 10)

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return 10 * len(self.priors)

    @property
    def slices(self) -> tuple[slice, ...]:
        """Which coordinates belong to each body."""
        return tuple(slice(10 * k, 10 * k + 10) for k in range(len(self.priors)))

    def pseudo_inertias(self, x: Coordinates) -> Float[np.ndarray, "n 4 4"]:
        """P of every body."""
        return self._congruent(_log_cholesky(x)[0])

    def parameters(self, x: Coordinates) -> Float[np.ndarray, "n 10"]:
        """Standard parameters."""
        return self._standard(self.pseudo_inertias(x))

    def chained(self, x: Coordinates, regressor: Float[np.ndarray, "rows nv n 10"]) -> Float[np.ndarray, "rows nv k"]:
        """Derivatives in the coordinates of what has these derivatives in the standard parameters of every body."""
        out, slopes = np.empty((*regressor.shape[:2], self.size)), self.slopes(x)
        for body, columns in enumerate(self.slices):  # matrix products, where `einsum` would loop by itself
            out[..., columns] = regressor[:, :, body] @ slopes[10 * body : 10 * body + 10, columns]
        return out

    def slopes(self, x: Coordinates) -> Float[np.ndarray, "standard k"]:
        """Derivatives of the standard parameters of all bodies, one after the other, in the coordinates."""
        return block_diag(np.zeros((0, 0)), *self._standard(self._congruent(_log_cholesky(x)[1])).swapaxes(-1, -2))

    def moved(self, x: Coordinates, step: Coordinates) -> Coordinates:
        """x + step to first order: parameters change by exactly their derivatives times the step, if a body can."""
        # torque is linear in them: with many rows of little noise, straight lines in x leave its narrow valley
        inner, derivatives = _log_cholesky(x)
        inner = inner + np.einsum("nk,nkab->nab", step.reshape(-1, 10), derivatives)
        values = np.linalg.eigvalsh(inner)
        possible = values[:, 0] > DEFINITE * values[:, -1]
        F = upper_cholesky(inner[possible])
        scale, inside = F[:, 3, 3:], F[:, *np.transpose(_PLACES)] / F[:, 3, 3:]
        there = (x + step).reshape(-1, 10)
        there[possible] = np.concatenate([np.log(scale), np.log(inside[:, :3]), inside[:, 3:]], axis=1)
        return there.ravel()

    def distance(self, x: Coordinates) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m k"]]:
        """A vector whose norm is the distance from the references times the root of its weight, and its Jacobian."""
        inner, change = _log_cholesky(x)
        values, vectors = np.linalg.eigh(inner)
        values = np.maximum(values, np.finfo(np.float64).tiny)
        logs, turned = np.log(values), np.swapaxes(vectors, -1, -2)
        logarithm = vectors @ (logs[..., None] * turned)
        # derivative of a matrix function (Daleckii & Krein): divided differences in the axes of the argument
        gap = values[:, :, None] - values[:, None, :]
        equal = abs(gap) <= 1e-7 * (values[:, :, None] + values[:, None, :])
        mean = 0.5 * (values[:, :, None] + values[:, None, :])
        divided = np.where(equal, 1.0 / mean, (logs[:, :, None] - logs[:, None, :]) / np.where(equal, 1.0, gap))
        inside = turned[:, None] @ change @ vectors[:, None] * divided[:, None]
        moved = vectors[:, None] @ inside @ turned[:, None]
        jacobian = block_diag(np.zeros((0, 0)), *np.einsum("kab,niab->nki", _SYMMETRIC, moved))
        distance = np.einsum("kab,nab->nk", _SYMMETRIC, logarithm).ravel()
        return self._weights * distance, self._weights[:, None] * jacobian

    def numbers(self, x: Coordinates, frames: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " m"]:
        """`QUANTITIES` of every body, in axes with these poses in its frame."""
        told = [physical_of_pseudo_inertia(pseudo) for pseudo in _in_frames(self.pseudo_inertias(x), frames)]
        return np.array([[mass, *center, *(inertia[at] for at in _INERTIA)] for mass, center, inertia in told]).ravel()

    def number_slopes(self, x: Coordinates, frames: Float[np.ndarray, "n 4 4"]) -> np.ndarray:
        """Derivatives of `numbers` in the coordinates."""
        changes, blocks = _in_frames(self._congruent(_log_cholesky(x)[1]), frames[:, None]), [np.zeros((0, 0))]
        for pseudo, change in zip(_in_frames(self.pseudo_inertias(x), frames), changes, strict=True):
            mass, center = pseudo[3, 3], pseudo[:3, 3] / pseudo[3, 3]
            about = np.column_stack([np.eye(3), -center])  # of second moments, to those about the centre of mass
            dm, dc, dS = change[:, 3, 3], change[:, 3] @ about.T / mass, about @ change @ about.T
            dI = np.trace(dS, axis1=1, axis2=2)[:, None, None] * np.eye(3) - dS
            blocks.append(np.concatenate([dm[None], dc.T, np.array([dI[:, *at] for at in _INERTIA])]))
        return block_diag(*blocks)

    def _standard(self, pseudo: np.ndarray) -> np.ndarray:
        return pseudo.reshape(*pseudo.shape[:-2], 16) @ self._to_standard.T

    def _congruent(self, inner: np.ndarray) -> np.ndarray:  # V inner V^T for (n, ..., 4, 4)
        V = self.factors.reshape(len(self.factors), *(1 for _ in range(inner.ndim - 3)), 4, 4)
        return V @ inner @ V.swapaxes(-1, -2)


def _in_frames(pseudo: np.ndarray, frames: np.ndarray) -> np.ndarray:
    there = np.linalg.inv(frames)
    return there @ pseudo @ there.swapaxes(-1, -2)


DEFINITE = 1e-9  # matrices whose smallest eigenvalue is this fraction of the largest have factors in spite of rounding


def upper_cholesky(matrices: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 4 4"]:
    """Upper triangular V with V V^T equal to each matrix. Raises numpy.linalg.LinAlgError where one is not definite."""
    return np.linalg.cholesky(matrices[..., ::-1, ::-1])[..., ::-1, ::-1]


def _log_cholesky(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """F F^T (n, 4, 4) and its derivatives (n, 10, 4, 4)."""
    x = x.reshape(-1, 10)
    scale, F, derivatives = np.exp(x[:, 0]), np.zeros((len(x), 4, 4)), np.zeros((len(x), 10, 4, 4))
    F[:, 3, 3] = scale
    for k, (i, j) in enumerate(_PLACES, start=1):
        F[:, i, j] = scale * (np.exp(x[:, k]) if i == j else x[:, k])
        derivatives[:, k, i, j] = F[:, i, j] if i == j else scale
    derivatives[:, 0] = F
    half = derivatives @ F.swapaxes(-1, -2)[:, None]
    return F @ F.swapaxes(-1, -2), half + half.swapaxes(-1, -2)


THIN = 1e-5
"""Bodies with a second moment about the centre of mass below this fraction of that about the origin are thickened."""
THICKNESS = 0.05  # standard deviation of the mass that thickening adds, as a fraction of the body's size


def thickened(robot: Robot) -> tuple[Robot, tuple[str, ...]]:
    """The robot with bodies of some thickness, since only they have coordinates; and the links that were changed.

    Points, rods and plates (ideal ones, as simple URDFs have them) get an isotropic second moment.
    """
    text, changed = robot.urdf_text, []
    for body, pseudo in zip(carrying(robot), body_pseudo_inertias(robot).cpu().numpy(), strict=True):
        joint, mass, center = robot.layout.bodies[body], pseudo[3, 3], pseudo[:3, 3] / pseudo[3, 3]
        about_center = pseudo[:3, :3] - mass * np.outer(center, center)
        size = max(np.trace(pseudo[:3, :3]), 1e-8 * mass)
        if np.linalg.eigvalsh(about_center)[0] > THIN * size:
            continue
        links = [name for name, place in robot.layout.links.items() if place.body == body]
        heaviest = max(links, key=lambda name: robot.link(name).mass)
        link = robot.link(heaviest)
        inertia = link.inertia + 2.0 * THICKNESS**2 * size * np.eye(3)  # of the isotropic second moment
        text = replace_inertial(text, heaviest, link.mass, link.center_of_mass, inertia, source=robot.source)
        changed.append(heaviest if heaviest == joint.child else f"{heaviest} (of {joint.child})")
    return (robot.with_text(text) if changed else robot), tuple(changed)


def with_bodies(robot: Robot, wanted: Mapping[int, Float[np.ndarray, "4 4"]]) -> Robot:
    """A robot whose bodies of these numbers have these pseudo-inertias, in the frames of their joints' child links.

    Raises NonPhysicalInertia, naming the bodies, where no body has them.
    """
    own, names = carrying(robot), body_names(robot)
    indefinite = [body for body, pseudo in wanted.items() if torch.linalg.cholesky_ex(torch.as_tensor(pseudo)).info]
    if impossible := [names[own.index(body)] for body in indefinite]:
        seen = f"no body has the inertia that was found for {', '.join(impossible)}, so there is no such robot"
        raise NonPhysicalInertia(f"{seen}; give the log more motion, or a prior.")
    now = body_pseudo_inertias(robot).cpu().numpy()
    change = {k: upper_cholesky(P) @ np.linalg.inv(upper_cholesky(now[own.index(k)])) for k, P in wanted.items()}
    text = robot.urdf_text
    for name, placement in robot.layout.links.items():
        link, body = robot.link(name), placement.body
        if link.mass == 0.0 or body not in change:
            continue
        offset = np.linalg.inv(robot.layout.child_frames[body]) @ placement.offset
        there = np.linalg.inv(offset) @ change[body] @ offset
        # a congruence by [[A, t], [0, s]] moves the moments about the centre of mass by A alone: no cancellation
        own_moments = 0.5 * np.trace(link.inertia) * np.eye(3) - link.inertia
        A, shift, scale = there[:3, :3], there[:3, 3], there[3, 3]
        center, second = (A @ link.center_of_mass + shift) / scale, A @ own_moments @ A.T
        inertia = np.trace(second) * np.eye(3) - second
        text = replace_inertial(text, name, link.mass * scale**2, center, inertia, source=robot.source)
    return robot.with_text(text)
