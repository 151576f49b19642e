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
        new = self.after(change)
        vars(new).update(tau=self.tau, friction=self.friction)
        return new

    def shifted(self, dense: Dataset, seconds: float) -> "Comparison":
        """With the torques that `dense`, which holds the rows, has some seconds later."""
        u = np.empty_like(self.rows.u)
        for number in dense.episodes:
            own, here = dense.episode == number, self.rows.episode == number
            for joint, values in enumerate(dense.u[own].T):
                u[here, joint] = np.interp(self.rows.time[here] + seconds, dense.time[own], values)
        new = replace(self, rows=self._changed(replace(self.given, u=u)), shift=seconds)
        vars(new).update(tau=self.tau, friction=self.friction)
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


def _torques_of_laws(log: Comparison, rows: Dataset) -> Float[np.ndarray, "rows nv"]:
    return sum(law_columns(log.laws, log.robot, rows.q, rows.v, rows.u, rows.a), np.zeros_like(rows.v))


def positive_fit(
    columns: Float[np.ndarray, "rows k"], target: Float[np.ndarray, " rows"]
) -> tuple[Float[np.ndarray, " k"], float]:
    """Factors of columns, none negative, and the square sum that they leave. Units of the columns do not matter."""
    both = np.c_[columns, target]
    return positive_solution(both.T @ both)


def positive_solution(products: Float[np.ndarray, "k1 k1"]) -> tuple[Float[np.ndarray, " k"], float]:
    """The same of the products of all columns, of which the last is the target."""
    size = np.sqrt(np.diag(products))
    size = np.where(size > 0.0, size, 1.0)
    scaled = products / np.outer(size, size)
    normal, right = scaled[:-1, :-1] + RIDGE * np.eye(len(size) - 1), scaled[:-1, -1]
    try:
        triangle = np.linalg.cholesky(normal)
    except np.linalg.LinAlgError:  # of differences of sums, where rounding is more than what is left
        values, vectors = np.linalg.eigh(normal)
        triangle = vectors * np.sqrt(np.maximum(values, RIDGE))
    factors, _ = nnls(triangle.T, np.linalg.solve(triangle, right))
    left = scaled[-1, -1] - 2.0 * factors @ right + factors @ scaled[:-1, :-1] @ factors
    return factors / size[:-1] * size[-1], max(float(left), 0.0) * float(size[-1]) ** 2


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
    count = len(signals)
    sums = np.cumsum(np.einsum("ri,rj->rij", signals, signals), axis=0)
    sums = np.concatenate([np.zeros_like(sums[:1]), sums])
    whole = positive_solution(sums[-1])[1]

    def told(first: int, last: int) -> tuple[float, float, int, int]:
        own, inside = last - first, sums[last] - sums[first]
        rest = sums[-1] - inside
        rest *= np.outer(*2 * (np.diag(rest) > UNSEEN * np.diag(sums[-1]),))  # else rounding is all there is
        number, left = positive_solution(rest)
        number = np.append(-number, 1.0)
        each = np.array([left / (count - own), number @ inside @ number / own]) / (whole / count + 1e-300)
        gain = float(-np.log(np.maximum(each, LEAST)) @ (count - own, own))
        return (gain if each[1] > each[0] else 0.0), each[1] * own / (each @ (count - own, own)), first, last

    edges = np.linspace(0, count, EDGES, dtype=int).tolist()
    best = max(told(a, b) for a in edges for b in edges if 0 < b - a <= count // 2)
    for _ in range(2):  # to the row
        best = max(told(a, best[3]) for a in range(max(best[3] - count // 2, 0), best[3]))
        best = max(told(best[2], b) for b in range(best[2] + 1, min(best[2] + count // 2, count) + 1))
    return best


def solved(now: Comparison, columns: Float[np.ndarray, "rows nv k"]) -> Float[np.ndarray, " k"] | None:
    """Numbers that leave least of u, every joint by the power that is left of it."""
    parts = []
    for joint in np.flatnonzero(np.ptp(now.rows.u, axis=0) > 0.0):
        basis = np.linalg.qr(now.friction[:, joint])[0]
        both = np.c_[columns[:, joint], now.rows.u[:, joint] - now.tau[:, joint]]
        both = both - both.mean(axis=0)
        both = both - basis @ (basis.T @ both)
        parts.append((both, np.square(now.rows.u[:, joint] - now.rows.u[:, joint].mean()).sum()))
    if not parts or not any(np.square(both[:, :-1]).sum() > 0.0 for both, _ in parts):
        return None
    weights = [1.0 / (np.square(b[:, -1]).sum() + 1e-9 * p) for b, p in parts]
    number = np.zeros(columns.shape[-1])
    for _ in range(4):
        normal = np.sum([w * b.T @ b for w, (b, _) in zip(weights, parts, strict=True)], axis=0)
        scale = np.sqrt(np.diag(normal)[:-1])
        scale[scale == 0.0] = 1.0
        inverse = np.linalg.pinv(normal[:-1, :-1] / np.outer(scale, scale), rcond=1e-8)
        number = inverse @ (normal[:-1, -1] / scale) / scale
        left = [np.square(b[:, -1] - b[:, :-1] @ number).sum() for b, _ in parts]
        weights = [1.0 / (x + 1e-6 * p) for x, (_, p) in zip(left, parts, strict=True)]
    return number


def left_of(now: Comparison, signals: np.ndarray, weights: np.ndarray) -> Float[np.ndarray, " values"]:
    """Logarithm of what is left of u, for `weights` (values, k) of torques behind u, over all joints."""
    factors, total = np.c_[np.ones(len(weights)), -weights], np.zeros(len(weights))
    for joint in np.flatnonzero(np.ptp(now.rows.u, axis=0) > 0.0):
        basis = np.linalg.qr(now.friction[:, joint])[0]
        parts = signals[:, :, joint].T - signals[:, :, joint].mean(axis=1)
        parts = parts - basis @ (basis.T @ parts)
        power = np.square(parts[:, 0]).sum() + 1e-300
        left = np.einsum("xi,ij,xj->x", factors, parts.T @ parts, factors)
        total += np.log(np.maximum(left / power, 1e-5))
    return total
