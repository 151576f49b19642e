"""Measured torques against inverse dynamics: how much of each the robot explains, by what factor, with which numbers.

`u = s tau(q, v, a) + I a + d v + c tanh(v / w) + o` with s, I, d, c >= 0 (Lawson & Hanson 1974): friction always
brakes.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.optimize import nnls

from forcegp.checks.check_input import DEGREE
from forcegp.data import Dataset
from forcegp.doubts import Doubt, look
from forcegp.forces import JointLaw
from forcegp.forces.joint_laws import law_columns, usual_columns
from forcegp.robots import Robot

CONSTANT = 1e-24  # variance relative to the square below which a torque is constant: rounding
RESTS_ON_ROBOT = 0.5
POOR = 0.2
SLOW = 0.1  # of the root mean square velocity: where dry friction turns over

Change = Callable[[Dataset], Dataset]


@dataclass(frozen=True, kw_only=True, eq=False)
class TorqueFit:
    """What the robot explains of the torque of each joint, all (nv,).

    `unexplained` is the share of the torque's variance that is left, NaN for a torque that never changes; `friction`
    that without inverse dynamics and armature, `plain` that without armature, whose s is `factor`: where tau is nearly
    proportional to a, s and I cannot be separated. `coefficients` (nv, 5) are s, I, d, c, o.
    """

    unexplained: Float[np.ndarray, " nv"]
    friction: Float[np.ndarray, " nv"]
    plain: Float[np.ndarray, " nv"]
    factor: Float[np.ndarray, " nv"]
    coefficients: Float[np.ndarray, "nv 5"]

    @property
    def rests_on_robot(self) -> Bool[np.ndarray, " nv"]:
        """Whether `factor` means something: inverse dynamics explains half of the torque's variance beyond friction.

        And little is left: noise in tau makes the factor of a poor fit too small.
        """
        with np.errstate(invalid="ignore"):
            return (self.friction - self.plain > RESTS_ON_ROBOT) & (self.plain < POOR) & (self.factor > 0.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """Rows of a log after some `changes`, and the torques that a robot with known laws of joints needs for them."""

    robot: Robot
    laws: tuple[JointLaw, ...]
    rows: Dataset
    changes: tuple[Change, ...] = ()

    def after(self, change: Change, robot: Robot | None = None) -> "Comparison":
        """With one more change, or under another robot."""
        changes = (*self.changes, change)
        return replace(self, robot=robot or self.robot, rows=change(self.rows), changes=changes)

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
        return needed_torques(self.robot, self.rows) + _torques_of_laws(self, self.rows)

    @cached_property
    def columns(self) -> Float[np.ndarray, "rows nv 4"]:
        """tau, and the torques of a rotor, viscous and dry friction."""
        return np.stack([self.tau, *columns_of(self.robot, self.rows)[:-1]], axis=-1)

    @cached_property
    def fit(self) -> TorqueFit:
        """Of the measured torques."""
        return self.fit_of(self.rows.u)

    def fit_of(self, u: Float[np.ndarray, "rows nu"]) -> TorqueFit:
        """Of other torques of the same motion."""
        every, plain, friction = np.array(
            [_fitted(self.columns[:, k], u[:, k], (0, 1, 2, 3), (0, 2, 3), (2, 3)) for k in range(self.rows.nv)]
        ).transpose(1, 2, 0)
        shares = {"unexplained": every[0], "friction": friction[0], "plain": plain[0]}
        return TorqueFit(**shares, factor=plain[1], coefficients=every[1:].T)

    def at(self, dataset: Dataset) -> tuple["Comparison", Float[np.ndarray, "rows nv"]]:
        """Of other rows after the same changes, and their torques as fitted here."""
        other = replace(self, rows=self._changed(dataset))
        return other, (other.columns * self.fit.coefficients[:, :4]).sum(-1) + self.fit.coefficients[:, 4]

    def shares(self) -> Float[np.ndarray, "nv nv"]:
        """Share of each torque (column) that tau, v and a of each joint (row) leave; NaN if constant."""
        joints = range(self.rows.nv)
        each = [[_fitted(self.columns[:, j], self.rows.u[:, k], (0, 1, 2, 3)) for k in joints] for j in joints]
        return np.array(each)[:, :, 0, 0]


def columns_of(robot: Robot, rows: Dataset, widths: Sequence[float] = (SLOW,)) -> list[np.ndarray]:
    """Torques (rows, nv) of a rotor, viscous and dry friction, and an offset."""
    return usual_columns(robot, rows.q, rows.v, rows.u, rows.a, widths)


def needed_torques(robot: Robot, rows: Dataset) -> Float[np.ndarray, "rows nv"]:
    """What the rigid bodies need at these rows [Nm or N]."""
    with torch.no_grad():
        q, v, a = (torch.tensor(x, device=robot.device) for x in (rows.q, rows.v, rows.a))
        return robot.inverse_dynamics(q, v, a).cpu().numpy()


def _torques_of_laws(log: Comparison, rows: Dataset) -> Float[np.ndarray, "rows nv"]:
    return sum(law_columns(log.laws, log.robot, rows.q, rows.v, rows.u, rows.a), np.zeros_like(rows.v))


def _fitted(
    columns: Float[np.ndarray, "rows 4"], u: Float[np.ndarray, " rows"], *choices: tuple[int, ...]
) -> list[np.ndarray]:
    """For each choice of columns (6,): the unexplained share, their coefficients, and the free constant."""
    centered, target = columns - columns.mean(axis=0), u - u.mean()
    size, spread, found = np.linalg.norm(centered, axis=0), float(np.square(target).sum()), []
    for chosen in choices:
        solution, share = np.append(np.zeros(4), u.mean()), 1.0
        used = [column for column in chosen if size[column] > 1e-9 * max(float(size.max()), 1e-300)]
        if not spread > CONSTANT * max(float(np.square(u).sum()), 1e-300):
            share = np.nan
        elif used:
            basis, triangle = np.linalg.qr(centered[:, used] / size[used])
            right = basis.T @ target
            factors, left = nnls(triangle, right)
            solution[used] = factors / size[used]
            solution[4] -= float(columns.mean(axis=0) @ solution[:4])
            share = float((left**2 + np.square(target - basis @ right).sum()) / spread)
        found.append(np.append(share, solution))
    return found


UNSEEN = 1e-3  # singular values below this fraction of the largest belong to directions that no torque shows


def estimated_gravity(log: Comparison) -> Float[np.ndarray, "3"] | None:
    """Gravity [m/s^2] that leaves least of the torques unexplained, by least squares over all joints.

    Every joint has its friction, armature, constant and factor of inertial torques free, and counts by the spread of
    its torque. Directions that no torque shows stay those of the robot. None where nothing is left to fit.
    """
    robot, rows = log.robot, log.rows
    nominal = robot.gravity.cpu().numpy()
    q = torch.tensor(rows.q, device=robot.device)
    with torch.no_grad():
        axes = [with_gravity(robot, axis).gravity_forces(q).cpu().numpy() for axis in np.eye(3)]
    pulls = np.stack(axes, axis=-1)  # (rows, nv, 3): torque per m/s^2
    of_laws, matrices, targets = columns_of(robot, rows), [np.zeros((0, 3))], [np.zeros(0)]
    for joint in np.flatnonzero(np.isfinite(log.fit.unexplained)):
        u, pull = rows.u[:, joint], pulls[:, joint]
        free = np.stack([log.tau[:, joint] - pull @ nominal, *(each[:, joint] for each in of_laws)], axis=1)
        basis = np.linalg.qr(free)[0]
        weight = 1.0 / max(float(np.std(u)), 1e-12)
        matrices.append(weight * (log.fit.factor[joint] or 1.0) * (pull - basis @ (basis.T @ pull)))
        targets.append(weight * (u - basis @ (basis.T @ u)))
    matrix, target = np.concatenate(matrices), np.concatenate(targets)
    estimated = nominal + np.linalg.lstsq(matrix, target - matrix @ nominal, rcond=UNSEEN)[0]
    return estimated if len(target) and np.linalg.norm(estimated) > 0.0 else None


def with_gravity(robot: Robot, gravity: Float[np.ndarray, "3"]) -> Robot:
    """The same robot under other gravity [m/s^2]."""
    along = torch.as_tensor(gravity, dtype=robot.tree.gravity.dtype, device=robot.device)
    fall = torch.zeros_like(robot.tree.fall)
    fall[:, 3, 0] = along
    return replace(robot, tree=replace(robot.tree, gravity=along, fall=fall))


GAIN = np.log(2.5)  # by which the product over the joints of what remains unexplained must fall
FLOOR = 1e-5  # share of a torque's power below which everything is explained
NOISE = 3.0  # how much of the power of the noise is left to every explanation
FEWEST_ROWS = 30
STANDARD_GRAVITY = 9.81  # m/s^2
FACTORS = np.exp(np.linspace(-3.5, 3.5, 351))  # values that are tried for a factor
REMEDY = "Correct the URDF, or the unit of the signal; or let forcegp fit --forces bodies estimate it from this log."


@dataclass(frozen=True, kw_only=True, eq=False)
class Variation:
    """One number x of the robot, of which `values` are tried.

    Torques at them are `weights` times `taus` (samples, rows, nv). `stated` is the value that the robot has and `least`
    the least change of it that is reported; `text` says what a value x means, which is x times `unit` of something, and
    `cost` is subtracted from what it explains.
    """

    about: str
    text: str
    taus: Sequence[Float[np.ndarray, "rows nv"]]
    values: Float[np.ndarray, " values"]
    weights: Float[np.ndarray, "values samples"]
    stated: float = 1.0
    least: float = 0.1
    cost: float = 0.0
    joints: tuple[str, ...] = ()
    unit: float = 1.0

    def what(self, x: float) -> str:
        """What the value x means."""
        return self.text.format(x=x, of=x * self.unit)


def _waves(x: np.ndarray) -> np.ndarray:
    return np.stack([x**0, np.cos(x), np.sin(x), np.cos(2 * x), np.sin(2 * x)], axis=1)


class Unexplained:
    """Power of each joint's torque that friction, a rotor and a constant leave, for many torques tau(x) at once.

    `noise` (nv,) is that of the acceleration, which tau has times M: a factor below 1 makes it smaller, no merit.
    """

    def __init__(self, robot: Robot, rows: Dataset, noise: Float[np.ndarray, " nv"]) -> None:
        self.u, self.bases, self.rotors = rows.u, [], []
        _, *of_laws = columns_of(robot, rows, (SLOW, 5.0 * SLOW))
        for joint in range(rows.nv):
            basis = np.linalg.qr(np.stack([each[:, joint] for each in of_laws], axis=1))[0]
            rotor = rows.a[:, joint] - basis @ (basis.T @ rows.a[:, joint])
            self.bases.append(basis)
            self.rotors.append(rotor / max(float(np.linalg.norm(rotor)), 1e-300))
        self.noise = NOISE * len(rows) * np.square(torque_noise(robot, rows, noise))
        self.power = np.maximum(np.square(rows.u - rows.u.mean(axis=0)).sum(axis=0), 1e-300)

    def logarithms(
        self, taus: Sequence[np.ndarray] | np.ndarray, weights: np.ndarray
    ) -> Float[np.ndarray, "values nv"]:
        """Logarithm of the share of each torque that remains, for `weights` (values, k) of `taus` (k, rows, nv)."""
        shares, taus = [], np.asarray(taus)
        factors = np.concatenate([np.ones((len(weights), 1)), weights], axis=1)
        for joint, (basis, rotor) in enumerate(zip(self.bases, self.rotors, strict=True)):
            parts = np.concatenate([self.u[:, [joint]], -taus[:, :, joint].T], axis=1)
            parts = parts - basis @ (basis.T @ parts)
            left = np.einsum("xi,ij,xj->x", factors, parts.T @ parts, factors)
            left = left - np.square(np.maximum(factors @ (parts.T @ rotor), 0.0))  # a rotor's inertia is positive
            left = np.maximum(left, 0.0) + self.noise[joint]
            shares.append(np.log(np.maximum(left / self.power[joint], FLOOR)))
        return np.stack(shares, axis=1)


def torque_noise(robot: Robot, rows: Dataset, noise: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
    """Standard deviation of M times noise of a [Nm or N]."""
    with torch.no_grad():
        M = robot.mass_matrix(torch.tensor(rows.q, device=robot.device)).cpu().numpy()
    return np.sqrt(np.square(M).mean(axis=0) @ np.square(noise))


def parameter_doubts(robot: Robot, rows: Dataset, noise: Float[np.ndarray, " nv"]) -> list[Doubt]:
    """The number of the robot that, if it were another, would explain the torques of `rows` far better; or none.

    `noise` (nv,) is the standard deviation of the noise of their accelerations.
    """
    if len(rows) < FEWEST_ROWS or not (np.std(rows.u, axis=0) > 0.0).all():
        return []
    left, tau = Unexplained(robot, rows, noise), needed_torques(robot, rows)
    now = left.logarithms([tau], np.ones((1, 1)))[0]
    if np.exp(now).max() < 100.0 * FLOOR:
        return []
    options = []
    for variation in _variations(robot, rows, tau):
        gains = (now - left.logarithms(variation.taus, variation.weights)).sum(axis=1) - variation.cost
        place = int(np.argmax(gains))
        options.append((float(gains[place]), float(variation.values[place]), variation))
    options.sort(key=lambda option: -option[0])
    gain, value, best = options[0]
    if gain < GAIN or abs(value - best.stated) < best.least:
        return []
    others = {
        other.what(1.0): other.what(x)
        for g, x, other in options[1:3]
        if g > gain - np.log(1.5) and abs(x - other.stated) >= other.least
    }
    others.pop(best.what(1.0), None)  # a mass with and without its inertia reads the same
    also = f" Nearly as well: {'; '.join(others.values())}." if others else ""
    remains = f"then {100.0 * np.exp(-gain / rows.nv):.2g} % of what was unexplained remains.{also}"
    what, numbers = f"{best.what(value)}; {remains}", {"value": value, "gain": gain}
    return [look(about=best.about, what=what, do=REMEDY, joints=best.joints, numbers=numbers)]


def _variations(robot: Robot, rows: Dataset, tau: np.ndarray) -> Iterator[Variation]:
    names, tree, layout = robot.joint_names, robot.tree, robot.layout
    bodies = [(names[drive.joint], joint.child) for joint, drive in zip(layout.bodies, layout.drives, strict=True)]
    between = np.stack([1.0 - FACTORS, FACTORS], axis=1)
    factor = partial(Variation, values=FACTORS, weights=between)

    def with_tree(**changes: torch.Tensor) -> np.ndarray:
        return needed_torques(replace(robot, tree=replace(tree, **changes)), rows)

    for joint, name in enumerate(names):
        text = (
            f"the torque of {name} is {{x:.3g}} times what the motion needs, that of the others is not (its torque "
            "constant, gear ratio or unit)"
        )
        kept = np.where(np.arange(len(names)) == joint, 0.0, tau)
        yield factor(about="torque constant", text=text, taus=(kept, tau), joints=(name,))
    if len(names) > 1:
        text = "all torques fit {x:.3g} times the masses of the URDF (or the torque unit is another)"
        yield factor(about="masses", text=text, taus=(0.0 * tau, tau), cost=-0.1)
    for body, (name, link) in enumerate(bodies):
        J = tree.inertias[body, :, :, 0]
        if float(J[3, 3]) <= 0.0:
            continue
        center = J[:, 3] / J[3, 3]
        text = f"the torques fit a mass of {link} of {{x:.3g}} times that of the URDF"
        for part in (J, J[3, 3] * torch.outer(center, center)):  # with its inertia, and the mass alone
            inertias = tree.inertias.clone()
            inertias[body, :, :, 0] -= part
            yield factor(about="masses", text=text, taus=(with_tree(inertias=inertias), tau), joints=(name,))
    samples = np.array([0.5, 1.0, 2.0])
    parabolas = np.vander(FACTORS, 3) @ np.linalg.inv(np.vander(samples, 3))
    for body, (name, _) in enumerate(bodies):
        length = float(torch.linalg.vector_norm(tree.rest[body, :3, 3, 0]))
        if length == 0.0 or layout.parents[body] < 0:
            continue  # where the whole robot stands changes nothing
        scaled = [tree.rest.clone() for _ in samples]
        for x, rest in zip(samples, scaled, strict=True):
            rest[body, :3, 3] *= x
        yield Variation(
            about="lengths",
            text=f"the torques fit {{x:.3g}} times the length from {name} to the joint before ({{of:.3g}} instead of "
            f"{length:.3g} m)",
            taus=[with_tree(rest=rest) for rest in scaled],
            values=FACTORS,
            weights=parabolas,
            cost=0.2,
            joints=(name,),
            unit=length,
        )
    samples, turns = 2.0 * np.pi * np.arange(5) / 5.0, np.linspace(-np.pi, np.pi, 181)
    waves = _waves(turns) @ np.linalg.inv(_waves(samples))
    for joint, name in enumerate(names):
        if robot.joints[joint].type == "prismatic":
            continue
        one = np.eye(rows.nv)[joint]
        yield Variation(
            about="joint zero",
            text=f"the torques fit positions of {name} that are {{x:+.3g}} rad ({{of:+.0f}} degrees) from the logged "
            "ones: its zero is elsewhere",
            taus=[needed_torques(robot, replace(rows, q=rows.q + x * one)) for x in samples],
            values=turns,
            weights=waves,
            stated=0.0,
            least=0.06,
            cost=0.3,
            joints=(name,),
            unit=1.0 / DEGREE,
        )
    # more or less gravity; none; or any where the robot has none
    nominal = robot.gravity.cpu().numpy()
    size = float(np.linalg.norm(nominal))
    values = np.linspace(-1.5, 3.0, 226) if size else np.linspace(0.0, 1.5, 76)  # with 0 and 1
    for axis in [nominal / size] if size else [sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)]:
        along = (size or STANDARD_GRAVITY) * axis
        text = ",".join(f"{value + 0.0:.3g}" for value in along)
        stated = " (`gravity=0,0,0` is none)" if size else f", but the robot states none (`gravity={text}`)"
        yield Variation(
            about="gravity",
            text=f"the torques fit {{x:.3g}} times gravity along ({text}) m/s²{stated}",
            taus=[needed_torques(with_gravity(robot, x * along), rows) for x in (0.0, 1.0)],
            values=values,
            weights=np.stack([1.0 - values, values], axis=1),
            stated=1.0 if size else 0.0,
            cost=0.1,
        )
