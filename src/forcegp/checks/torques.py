"""Measured torques beside those that the robot needs.

`u = s tau(q, v, a) + I a + d v + sum c tanh(v / w) + o` with s, I, d, c >= 0 (Lawson & Hanson 1974): friction brakes.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.optimize import nnls

from forcegp.data import Dataset
from forcegp.forces import JointLaw
from forcegp.forces.joint_laws import law_columns
from forcegp.robots import Robot

RIDGE = 1e-10  # of a column's square sum, in equations that may be singular
WIDTHS = 0.03, 0.1, 0.3  # of the root mean square velocity: where dry friction turns over

AT_REST = 0.1  # of the root mean square velocity of a joint

Change = Callable[[Dataset], Dataset]


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """Rows of a log after some `changes`, and the torques that a robot with known laws of joints needs for them.

    `more` is torque that something else needs, a payload for instance; u is that of `shift` seconds later. Torques and
    friction are those of drives, whose positions are `drives` times those of the joints.
    """

    robot: Robot
    laws: tuple[JointLaw, ...]
    rows: Dataset
    changes: tuple[Change, ...] = ()
    more: np.ndarray | float = 0.0
    shift: float = 0.0
    drives: np.ndarray | None = None
    given: Dataset

    def after(self, change: Change, robot: Robot | None = None) -> "Comparison":
        """With one more change, or under another robot."""
        return replace(self, robot=robot or self.robot, rows=change(self.rows), changes=(*self.changes, change))

    def with_torques(self, change: Change) -> "Comparison":
        """With a change of u alone, which needs the same torques."""
        return self._at_the_same_motion(self.after(change))

    def shifted(self, dense: Dataset, seconds: float) -> "Comparison":
        """With the torques that `dense`, which holds the rows, has some seconds later."""
        u = np.empty_like(self.rows.u)
        for number in dense.episodes:
            own, here = dense.episode == number, self.rows.episode == number
            for joint, values in enumerate(dense.u[own].T):
                u[here, joint] = np.interp(self.rows.time[here] + seconds, dense.time[own], values)
        return self._at_the_same_motion(replace(self, rows=self._changed(replace(self.given, u=u)), shift=seconds))

    def _at_the_same_motion(self, new: "Comparison") -> "Comparison":
        vars(new).update(tau=self.tau, friction=self.friction, basis=self.basis)
        return new

    def changed(self, dataset: Dataset) -> Dataset:
        """Other rows after the same changes, whose u lacks what the known laws need."""
        dataset = self._changed(dataset)
        return replace(dataset, u=dataset.u - _torques_of_laws(self, dataset)) if self.laws else dataset

    def _changed(self, dataset: Dataset) -> Dataset:
        for change in self.changes:
            dataset = change(dataset)
        return dataset

    @cached_property
    def tau(self) -> Float[np.ndarray, "rows nv"]:
        """What bodies and laws need [Nm or N]."""
        needed = needed_torques(self.robot, self.rows) + _torques_of_laws(self, self.rows)
        return (needed if self.drives is None else needed @ np.linalg.inv(self.drives)) + self.more

    @cached_property
    def friction(self) -> Float[np.ndarray, "rows nv 5"]:
        """What a rotor, viscous friction and dry friction of three widths need, around their means."""
        a, v = (x if self.drives is None else x @ self.drives.T for x in (self.rows.a, self.rows.v))
        slow = np.sqrt(np.square(v).mean(axis=0)) + 1e-300
        columns = np.stack([a, v, *(np.tanh(v / (width * slow)) for width in WIDTHS)], axis=-1)
        return columns - columns.mean(axis=0)

    @cached_property
    def basis(self) -> Float[np.ndarray, "nv rows 5"]:
        """Orthonormal columns of the friction of each joint."""
        return np.linalg.qr(self.friction.swapaxes(0, 1))[0]

    def beside_friction(self, signals: Float[np.ndarray, "rows nv k"]) -> Float[np.ndarray, "nv rows k"]:
        """What friction and a constant of each joint leave of its signals."""
        parts = (signals - signals.mean(axis=0)).swapaxes(0, 1)
        return parts - self.basis @ (self.basis.mT @ parts)


def in_motion(rows: Dataset) -> Bool[np.ndarray, "rows nv"]:
    """In which rows each joint moves: at rest, stiction holds any torque."""
    return np.abs(rows.v) > AT_REST * np.sqrt(np.square(rows.v).mean(axis=0))


def needed_torques(robot: Robot, rows: Dataset) -> Float[np.ndarray, "rows nv"]:
    """What the rigid bodies need at these rows [Nm or N]."""
    return inverse_dynamics(robot, rows.q, rows.v, rows.a)


def inverse_dynamics(robot: Robot, *motion: Float[np.ndarray, "*batch n"]) -> Float[np.ndarray, "*batch nv"]:
    """What they need at these q, v and a."""
    with torch.no_grad():
        return robot.inverse_dynamics(*(torch.tensor(x, device=robot.device) for x in motion)).cpu().numpy()


def regressor(robot: Robot, rows: Dataset) -> Float[np.ndarray, "rows nv 10n"]:
    """What they need per unit of the standard parameters of each body."""
    q, v, a = (torch.tensor(x, device=robot.device) for x in (rows.q, rows.v, rows.a))
    with torch.no_grad():
        return robot.kinematics(q, v).torque_regressor(a).flatten(-2).cpu().numpy()


def _torques_of_laws(log: Comparison, rows: Dataset) -> Float[np.ndarray, "rows nv"]:
    return sum(law_columns(log.laws, log.robot, rows.q, rows.v, rows.u, rows.a), np.zeros_like(rows.v))


def positive_fit(
    columns: Float[np.ndarray, "*batch rows k"], target: Float[np.ndarray, "*batch rows"]
) -> tuple[Float[np.ndarray, "*batch k"], Float[np.ndarray, "*batch"]]:
    """Factors of columns, none negative, and the square sum that they leave. Units of the columns do not matter."""
    both = np.concatenate([columns, target[..., None]], axis=-1)
    return positive_solution(both.mT @ both)


def positive_solution(
    products: Float[np.ndarray, "*batch k1 k1"],
) -> tuple[Float[np.ndarray, "*batch k"], Float[np.ndarray, "*batch"]]:
    """The same of the products of all columns, of which the last is the target."""
    size = np.sqrt(np.maximum(np.diagonal(products, axis1=-2, axis2=-1), 0.0))  # rounding may be negative
    size = np.where(size > 0.0, size, 1.0)
    scaled = products / (size[..., None] * size[..., None, :])
    normal, right = scaled[..., :-1, :-1], scaled[..., :-1, -1]
    # of differences of sums, where rounding is more than what is left, there are negative ones
    values, vectors = np.linalg.eigh(normal)
    roots = np.sqrt(np.maximum(values + RIDGE, RIDGE))
    target = (right[..., None, :] @ vectors)[..., 0, :] / roots
    factors = (vectors @ (target / roots)[..., None])[..., 0]
    for at in map(tuple, np.argwhere((factors < 0.0).any(axis=-1))):
        factors[at] = nnls(roots[at][:, None] * vectors[at].T, target[at])[0]
    left = scaled[..., -1, -1] - np.sum(factors * (2.0 * right - (normal @ factors[..., None])[..., 0]), axis=-1)
    return factors / size[..., :-1] * size[..., -1:], np.maximum(left, 0.0) * np.square(size[..., -1])


def torque_noise(robot: Robot, rows: Dataset, noise: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
    """Standard deviation of M times noise of a [Nm or N]."""
    with torch.no_grad():
        M = robot.mass_matrix(torch.tensor(rows.q, device=robot.device)).cpu().numpy()
    return np.sqrt(np.square(M).mean(axis=0) @ np.square(noise))


UNSEEN = 1e-5  # of a power, which the other rows lack: what only moves in a stretch
EDGES = 25  # rows between which a stretch is sought first
LEAST = 1e-4  # shares of a power below this are all the same


def stretch(signals: Float[np.ndarray, "rows k"]) -> tuple[float, float, int, int]:
    """Successive rows, half of all at most, of whose last signal the others on the other rows tell less than there.

    What two levels of what is left explain [nats], the share in these rows, the first of them and the end.
    """
    count, sums = len(signals), np.cumsum(np.einsum("ri,rj->rij", signals, signals), axis=0)
    sums = np.concatenate([np.zeros_like(sums[:1]), sums])
    whole = positive_solution(sums[-1])[1]

    def best(*stretches: tuple[int, int]) -> tuple[float, float, int, int]:
        first, last = np.array(stretches).T
        own, inside = last - first, sums[last] - sums[first]
        rest = sums[-1] - inside
        seen = np.diagonal(rest, axis1=1, axis2=2) > UNSEEN * np.diag(sums[-1])  # else rounding is all there is
        number, left = positive_solution(rest * (seen[:, None] * seen[..., None]))
        number = np.append(-number, np.ones((len(own), 1)), axis=1)
        each = np.stack([left / (count - own), np.einsum("ni,nij,nj->n", number, inside, number) / own])
        each, weights = each / (whole / count + 1e-300), np.stack([count - own, own])
        gain = np.where(each[1] > each[0], -(np.log(np.maximum(each, LEAST)) * weights).sum(axis=0), 0.0)
        share = each[1] * own / (each * weights).sum(axis=0)
        return max(zip(gain.tolist(), share.tolist(), first.tolist(), last.tolist(), strict=True))

    edges = np.linspace(0, count, EDGES, dtype=int).tolist()
    found = best(*((a, b) for a in edges for b in edges if 0 < b - a <= count // 2))
    for _ in range(2):  # to the row
        last = found[-1]
        *_, first, last = best(*((a, last) for a in range(max(last - count // 2, 0), last)))
        found = best(*((first, b) for b in range(first + 1, min(first + count // 2, count) + 1)))
    return found


def solved(now: Comparison, columns: Float[np.ndarray, "rows nv k"]) -> Float[np.ndarray, " k"] | None:
    """Numbers that leave least of u, every joint by the power that is left of it."""
    moving = np.ptp(now.rows.u, axis=0) > 0.0
    both = now.beside_friction(np.append(columns, (now.rows.u - now.tau)[..., None], axis=-1))[moving]
    products = both.mT @ both
    if not (np.diagonal(products, axis1=1, axis2=2)[:, :-1] > 0.0).any():
        return None
    power = np.square(now.rows.u - now.rows.u.mean(axis=0)).sum(axis=0)[moving]
    weights, number = 1.0 / (products[:, -1, -1] + 1e-9 * power), np.zeros(columns.shape[-1])
    for _ in range(4):
        normal = np.tensordot(weights, products, 1)
        scale = np.sqrt(np.diag(normal)[:-1])
        scale[scale == 0.0] = 1.0
        inverse = np.linalg.pinv(normal[:-1, :-1] / np.outer(scale, scale), rcond=1e-8)
        number = inverse @ (normal[:-1, -1] / scale) / scale
        weights = 1.0 / (np.square(both @ np.append(-number, 1.0)).sum(axis=1) + 1e-6 * power)
    return number


def left_of(now: Comparison, signals: np.ndarray, weights: np.ndarray) -> Float[np.ndarray, " values"]:
    """Logarithm of what is left of u, for `weights` (values, k) of torques behind u, over all joints."""
    factors, moving = np.c_[np.ones(len(weights)), -weights], np.ptp(now.rows.u, axis=0) > 0.0
    parts = now.beside_friction(np.moveaxis(signals, 0, -1))[moving]
    left = np.einsum("xi,jik,xk->xj", factors, parts.mT @ parts, factors)
    return np.log(np.maximum(left / (np.square(parts[..., 0]).sum(axis=1) + 1e-300), 1e-5)).sum(axis=1)
