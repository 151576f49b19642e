"""A body that flies: the wind of a recording, which nobody measured, from forces on it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

import forcegp.forces
import forcegp.mechanics
from forcegp.data.dataset import Dataset
from forcegp.data.filters import episodes_in_order, sums_before
from forcegp.data.views import in_blocks
from forcegp.robots.manifold import TURN

SECONDS = 0.3  # s: rows that lie this far apart count 1/e for each other's wind
MOST_ROWS, FEWEST_ROWS = 3000, 400
STRONGEST, SURE = 40.0, 2.0  # m/s: a wind beyond, or a standard deviation beyond, is none that was found
APART = 0.5  # s, between rows that count as independent of each other
STEP = 0.05  # m/s, of derivatives
MOVING = 12  # causes that vanish with the velocity


@dataclass(frozen=True)
class AirLaw:
    """What air does to a base that flies: its force [N] and torque [Nm] are linear in what `_Forces.causes` lists.

    `coefficients[k]` belong to degree of freedom k of the base, `deviations[k]` is the spread of what they leave
    unexplained, `wind` the mean velocity of the air [m/s] in the recording that they were found from.
    """

    coefficients: Sequence[Sequence[float]]
    deviations: Sequence[float]
    wind: Sequence[float]

    def wind_before(self, dataset: Dataset, seconds: float = SECONDS) -> Float[np.ndarray, "rows 3"]:
        """The wind [m/s, world] that the rows before each one of its episode show; at the first, that of the law.

        Weighted least squares of the forces, linear about the last estimate, with weights that fall by e in `seconds`.
        """
        start = np.broadcast_to(self.wind, (len(dataset), 3))
        return self._smoothed(_Forces.of(dataset), dataset, start, seconds, after=False)

    def _smoothed(
        self, forces: "_Forces", dataset: Dataset, start: np.ndarray, seconds: float, *, after: bool, sweeps: int = 4
    ) -> Float[np.ndarray, "rows 3"]:
        weights, law, wind = 1.0 / np.square(self.deviations), np.array(self.coefficients), start.copy()
        for _ in range(sweeps):
            left, slope = forces.unexplained(law, wind)
            target = left + np.einsum("nij,nj->ni", slope, wind)
            normal = np.einsum("nki,k,nkj->nij", slope, weights, slope)
            right = np.einsum("nki,k,nk->ni", slope, weights, target)
            # a part of what the first row shows stays with the start, which is all there is where nothing was seen yet
            hold = (np.trace(normal[0]) / 3.0 * (0.5 if after else 0.01) + 1e-12) * np.eye(3)
            joined = np.concatenate([normal.reshape(-1, 9), right], axis=1)
            sums = np.zeros_like(joined)
            for number, rows, _ in episodes_in_order(dataset):
                own = np.flatnonzero(dataset.episode == number)
                sums[own] = sums_before(joined[own], rows.time, seconds)
                if after:
                    sums[own] += joined[own] + sums_before(joined[own][::-1], -rows.time[::-1], seconds)[::-1]
            normal, right = sums[:, :9].reshape(-1, 3, 3) + hold, sums[:, 9:] + start @ hold
            wind = np.clip(np.linalg.solve(normal, right[..., None])[..., 0], -STRONGEST, STRONGEST)
        return wind


def find_wind(dataset: Dataset) -> tuple[AirLaw, Float[np.ndarray, "rows 3"]] | None:
    """What air does to the base, and the velocity of the air [m/s, world] at each row; None where rows do not show it.

    Mean wind of every episode and law together, with the law projected out (Kaufman, BIT 1975); then the wind follows
    the rows nearby. Not for bases that do not fly freely, rows out of order, fewer than 400, drag that explains no more
    than its coefficients would of noise, winds beyond 40 m/s or deviations beyond 2 m/s.
    """
    if not dataset.model.robot.layout.groups or dataset.model.contacts or not dataset.time_ordered:
        return None
    numbers, episode = np.unique(dataset.episode, return_inverse=True)
    thin = np.arange(0, len(dataset), max(1, len(dataset) // MOST_ROWS))
    if len(thin) < FEWEST_ROWS or np.bincount(episode[thin]).min() < 20:
        return None
    some, own = _Forces.of(dataset.rows(thin)), episode[thin]
    means = _mean_winds(some, own, len(numbers), float(np.median(np.diff(dataset.time[thin]))))
    if means is None:
        return None
    forces, start = _Forces.of(dataset), means[episode]
    wind = forces.law(start)._smoothed(forces, dataset, start, SECONDS, after=True)
    wind = forces.law(wind)._smoothed(forces, dataset, start, SECONDS, after=True)
    return forces.law(wind), wind


def with_wind(dataset: Dataset, wind: Float[np.ndarray, "rows 3"]) -> Dataset:
    """The recording with an `ObservedWind` in its model, whose columns of u hold the wind [m/s, world]."""
    model = replace(dataset.model, forces=(*dataset.model.forces, forcegp.forces.ObservedWind()))
    first = model.inputs.index(forcegp.forces.ObservedWind.names[0])
    return replace(dataset, u=np.insert(dataset.u, [first] * 3, wind, axis=1), model=model)


@dataclass(frozen=True)
class _Forces:
    """Rows of what acts on the base beyond the known forces, and what the law may depend on."""

    wrench: np.ndarray  # N and Nm, in the axes of the base
    velocity: np.ndarray  # m/s and rad/s
    delivered: np.ndarray  # of the actuators, N and Nm
    rotation: np.ndarray
    height: np.ndarray

    @classmethod
    def of(cls, dataset: Dataset) -> "_Forces":
        robot = dataset.model.robot
        model, group = dataset.model, robot.layout.groups[0]

        def found(q: Tensor, v: Tensor, u: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
            dynamics = model.dynamics(q, v, u)
            missing = (dynamics.M @ a[..., None])[..., 0] - dynamics.Q_K
            return missing[:, group.rows], dynamics.state.delivered[:, group.rows]

        wrench, delivered = in_blocks(dataset, found, robot.device)
        places = dataset.q[:, group.places]
        rotation = Rotation.from_quat(places[:, TURN]).as_matrix()
        return cls(wrench, dataset.v[:, group.rows], delivered, rotation, places[:, 2:3])

    def causes(self, wind: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the law of all degrees of freedom may depend on, and how many of them hold along x and y."""
        air, push = self.velocity[:, :3] - np.einsum("nji,nj->ni", self.rotation, wind), self.delivered[:, 2:3]
        share = np.sqrt(np.abs(push))  # as the speed of rotors
        speed = np.linalg.norm(air, axis=1, keepdims=True)
        moving = [air, speed * air, share * air, self.velocity[:, 3:]]  # without any of these no force along x and y
        other = [self.delivered[:, 2:], self.height, np.ones_like(push), np.square(air[:, :2])]
        return np.concatenate(moving + other, axis=1), np.array([MOVING] * 2 + [20] * 4)

    def solved(self, wind: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        """Coefficients (6, causes) by least squares, what they leave (rows, 6), and an orthonormal basis of each."""
        X, counts = self.causes(wind)
        size = np.linalg.norm(X, axis=0) + 1e-300
        coefficients, left, bases = np.zeros((6, X.shape[1])), np.empty_like(self.wrench), []
        decomposed = {count: np.linalg.svd(X[:, :count] / size[:count], full_matrices=False) for count in set(counts)}
        for k, count in enumerate(counts):
            U, s, Vt = decomposed[count]
            keep = s > 1e-10 * s[0]
            shares = U[:, keep].T @ self.wrench[:, k]
            coefficients[k, :count] = Vt[keep].T @ (shares / s[keep]) / size[:count]
            left[:, k] = self.wrench[:, k] - U[:, keep] @ shares
            bases.append(U[:, keep])
        return coefficients, left, bases

    def law(self, wind: np.ndarray) -> AirLaw:
        coefficients, left, _ = self.solved(wind)
        x, y, z = wind.mean(0).tolist()
        return AirLaw(tuple(map(tuple, coefficients.tolist())), tuple(left.std(0).tolist()), (x, y, z))

    def unexplained(self, law: np.ndarray, wind: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the law leaves (rows, 6), and its derivative (rows, 6, 3) by the wind."""

        def explained(where: np.ndarray) -> np.ndarray:
            return self.causes(where)[0] @ law.T

        slope = [(explained(wind + step) - explained(wind - step)) / (2.0 * STEP) for step in (STEP * np.eye(3))[:2]]
        return self.wrench - explained(wind), np.stack([*slope, np.zeros_like(slope[0])], axis=-1)


def _mean_winds(forces: _Forces, own: np.ndarray, count: int, step: float) -> np.ndarray | None:  # (episodes, 3)
    wind = _first_winds(forces, own, count)
    damping, best, solution = 1e-3, np.inf, wind
    normal, right = np.zeros((3 * count, 3 * count)), np.zeros(3 * count)
    for _ in range(40):
        law, left, bases = forces.solved(wind[own])
        variances = np.square(left).mean(0)
        cost = float(np.log(variances + 1e-300).sum())
        if cost < best - 1e-9:
            gained, best, solution, damping = best - cost, cost, wind, max(damping / 5.0, 1e-9)
            _, slope = forces.unexplained(law, wind[own])
            wide = np.zeros((*slope.shape[:2], count, 3))
            wide[np.arange(len(own)), :, own] = slope
            normal, right = np.zeros((3 * count, 3 * count)), np.zeros(3 * count)
            for k, basis in enumerate(bases):
                J = wide[:, k].reshape(len(own), -1)
                J = J - basis @ (basis.T @ J)
                normal += J.T @ J / variances[k]
                right += J.T @ left[:, k] / variances[k]
        else:
            damping, gained = damping * 10.0, 0.0
        if damping > 1e6 or 0.0 < gained < 1e-7:
            break
        moved = np.linalg.lstsq(normal + damping * np.diag(np.diag(normal)), right, rcond=None)[0]
        wind = np.clip(solution + moved.reshape(count, 3), -STRONGEST, STRONGEST)
    repeated = max(1.0, APART / step)
    variance = repeated * np.diag(np.linalg.pinv(normal)).reshape(count, 3)
    left = forces.solved(solution[own])[1][:, :2]
    # drag has to explain more of the forces along x and y than its coefficients would of noise (Akaike 1974)
    gained = len(own) / repeated * np.log(np.square(forces.wrench[:, :2]).sum(0) / np.square(left).sum(0)).sum()
    shown = gained > 2.0 * 2 * MOVING and np.abs(solution).max() < STRONGEST
    return solution if shown and bool((variance[:, :2] < SURE**2).all()) else None


def _first_winds(forces: _Forces, own: np.ndarray, count: int) -> np.ndarray:
    """From a force along x and y that is linear in velocity and has a constant of the world in every episode."""
    constant = np.zeros((len(own), 3, count, 3))
    constant[np.arange(len(own)), :, own] = np.swapaxes(forces.rotation, 1, 2)
    slopes = np.zeros((len(own), 2, 2))
    slopes[:, [0, 1], [0, 1]] = -forces.velocity[:, :2]
    X = np.concatenate([slopes, constant[:, :2, :, :2].reshape(len(own), 2, -1)], axis=-1)
    found = np.linalg.lstsq(X.reshape(-1, X.shape[-1]), forces.wrench[:, :2].ravel(), rcond=1e-8)[0]
    drag, wind = max(float(found[:2].mean()), 1e-3), np.zeros((count, 3))
    wind[:, :2] = found[2:].reshape(count, 2) / drag
    return np.clip(wind, -0.5 * STRONGEST, 0.5 * STRONGEST)


def thruster_columns(model: forcegp.Model) -> dict[int, int]:
    """Columns of u that push a base that floats, and the powers in which they act: `Thrusters`, and such actuators."""
    if not (groups := model.robot.layout.groups):
        return {}
    matrix, kind = model.actuation.matrix, forcegp.forces.Thrusters
    pushes = [] if matrix is None else np.flatnonzero(torch.as_tensor(matrix)[groups[0].rows].cpu().numpy().any(0))
    thrusters = [force for force in model.forces if isinstance(force, kind)]
    named = {model.inputs.index(name): force.power for force in thrusters for name in force.names}
    return {**{int(column): 1 for column in pushes}, **named}
