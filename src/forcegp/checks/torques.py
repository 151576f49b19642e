"""Measured torques against inverse dynamics: how much of each the robot explains, by what factor, with which numbers.

For every joint, `u = s tau(q, v, a) + I a + d v + c tanh(v / w) + o` with tau the inverse dynamics of the URDF, the
laws of a rotor, viscous and dry friction (`forcegp.forces.columns`), and s, I, d, c >= 0, by non-negative least squares
(Lawson & Hanson 1974): friction always brakes, and a robot that needs a negative factor was logged with a wrong sign.

Inverse dynamics is a polynomial of each number of a robot, of degree 1 (masses, gravity, torque constants) or 2
(lengths), and a trigonometric one of degree 2 in the zero of a turning joint. So a few evaluations give the torques for
every value, and the value is found that leaves least of all torques unexplained, with s = 1.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.optimize import nnls

from forcegp.data import Dataset
from forcegp.doubts import Doubt, look
from forcegp.forces import Law
from forcegp.forces.columns import law_columns, usual_columns
from forcegp.robots import Robot

CONSTANT = 1e-24  # variance relative to the square below which a torque is constant: rounding
RESTS_ON_ROBOT = 0.5
POOR = 0.2
SLOW = 0.1  # of the root mean square velocity: where dry friction turns over


@dataclass(frozen=True, kw_only=True, eq=False)
class TorqueFit:
    """What the robot explains of the torque of each joint.

    `unexplained` (nv,) is the share of the torque's variance that is left, NaN for a torque that never changes;
    `coefficients` (nv, 5) are s, I, d, c, o.
    `friction` (nv,) is the share that is left without inverse dynamics and armature, `plain` (nv,) that without
    armature, whose s is `factor` (nv,): where tau is nearly proportional to a, s and I cannot be separated.
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

    def at(self, robot: Robot, tau: Float[np.ndarray, "rows nv"], rows: Dataset) -> Float[np.ndarray, "rows nv"]:
        """The fitted torque of other rows, whose inverse dynamics is `tau`."""
        parts = np.stack([tau, *columns_of(robot, rows)[:-1]], axis=-1)
        return (parts * self.coefficients[:, :4]).sum(-1) + self.coefficients[:, 4]


def columns_of(robot: Robot, rows: Dataset, widths: Sequence[float] = (SLOW,)) -> list[np.ndarray]:
    """Torques (rows, nv) of a rotor, viscous and dry friction, and an offset."""
    return usual_columns(robot, rows.q, rows.v, rows.u, rows.a, widths)


def needed_torques(robot: Robot, rows: Dataset, laws: Sequence[Law] = ()) -> Float[np.ndarray, "rows nv"]:
    """What the rigid bodies and these laws of joints need at these rows [Nm or N]."""
    with torch.no_grad():
        q, v, a = (torch.tensor(x, device=robot.device) for x in (rows.q, rows.v, rows.a))
        return robot.inverse_dynamics(q, v, a).cpu().numpy() + torques_of_laws(robot, rows, laws)


def torques_of_laws(robot: Robot, rows: Dataset, laws: Sequence[Law]) -> Float[np.ndarray, "rows nv"]:
    """What these known laws of joints need [Nm or N]."""
    return sum(law_columns(laws, robot, rows.q, rows.v, rows.u, rows.a), np.zeros_like(rows.v))


def fit_torques(
    robot: Robot, tau: Float[np.ndarray, "rows nv"], rows: Dataset, u: Float[np.ndarray, "rows nu"] | None = None
) -> TorqueFit:
    """Fit the torques of these rows, or others, to inverse dynamics tau of their motion."""
    u = rows.u if u is None else u
    parts = np.stack([tau, *columns_of(robot, rows)[:-1]], axis=-1)
    fits = [_fitted(parts[:, joint], u[:, joint], (0, 1, 2, 3), (0, 2, 3), (2, 3)) for joint in range(rows.nv)]
    return TorqueFit(
        unexplained=np.array([every[1] for every, _, _ in fits]),
        friction=np.array([friction[1] for _, _, friction in fits]),
        plain=np.array([plain[1] for _, plain, _ in fits]),
        factor=np.array([plain[0][0] for _, plain, _ in fits]),
        coefficients=np.stack([every[0] for every, _, _ in fits]),
    )


def unexplained_shares(robot: Robot, tau: np.ndarray, rows: Dataset) -> Float[np.ndarray, "nv nv"]:
    """Share of the variance of each torque (column) that tau, v and a of each joint (row) leave; NaN if constant."""
    parts, joints = np.stack([tau, *columns_of(robot, rows)[:-1]], axis=-1), range(rows.nv)
    return np.array([[_fitted(parts[:, j], rows.u[:, k], (0, 1, 2, 3))[0][1] for k in joints] for j in joints])


def _fitted(
    columns: Float[np.ndarray, "rows 4"], u: Float[np.ndarray, " rows"], *choices: tuple[int, ...]
) -> list[tuple[np.ndarray, float]]:
    """For each choice of columns: coefficients (5,), the constant last, and the unexplained share.

    The free constant takes the means out of both sides.
    """
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
        found.append((solution, share))
    return found


UNSEEN = 1e-3  # singular values below this fraction of the largest belong to directions that no torque shows


def estimated_gravity(
    robot: Robot, rows: Dataset, tau: Float[np.ndarray, "rows nv"], fit: TorqueFit
) -> Float[np.ndarray, "3"] | None:
    """Gravity [m/s^2] that leaves least of the torques unexplained, by least squares over all joints.

    Every joint has its friction, armature, constant and factor of inertial torques free, and counts by the spread of
    its torque. Directions that no torque shows stay those of the robot. None where nothing is left to fit.
    """
    nominal = robot.gravity.cpu().numpy()
    q = torch.tensor(rows.q, device=robot.device)
    with torch.no_grad():
        axes = [with_gravity(robot, axis).gravity_forces(q).cpu().numpy() for axis in np.eye(3)]
    pulls = np.stack(axes, axis=-1)  # (rows, nv, 3): torque per m/s^2
    of_laws, matrices, targets = columns_of(robot, rows), [], []
    for joint in np.flatnonzero(np.isfinite(fit.unexplained)):
        u, pull = rows.u[:, joint], pulls[:, joint]
        free = np.stack([tau[:, joint] - pull @ nominal, *(each[:, joint] for each in of_laws)], axis=1)
        basis = np.linalg.qr(free)[0]
        factor = fit.factor[joint] if fit.factor[joint] > 0.0 else 1.0
        weight = 1.0 / max(float(np.std(u)), 1e-12)
        matrices.append(weight * factor * (pull - basis @ (basis.T @ pull)))
        targets.append(weight * (u - basis @ (basis.T @ u)))
    if not matrices:
        return None
    matrix, target = np.concatenate(matrices), np.concatenate(targets)
    estimated = nominal + np.linalg.lstsq(matrix, target - matrix @ nominal, rcond=UNSEEN)[0]
    return estimated if np.linalg.norm(estimated) > 0.0 else None


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
NO_GRAVITY = 0.05
FACTORS = np.exp(np.linspace(-3.5, 3.5, 351))  # values that are tried for a factor
REMEDY = "Correct the URDF, or the unit of the signal; or let forcegp fit --forces bodies estimate it from this log."


def _powers(degree: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda x: np.stack([x**k for k in range(degree + 1)], axis=1)


LINEAR = _powers(1)


def _waves(x: np.ndarray) -> np.ndarray:
    return np.stack([x**0, np.cos(x), np.sin(x), np.cos(2 * x), np.sin(2 * x)], axis=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Variation:
    """One number x of the robot: the torques that rows need at some `samples` of it, `taus` (samples, rows, nv).

    With `functions` of x, as many as samples, those of all `values` follow. `stated` is the value that the robot has
    and `least` the least change of it that is reported; `what` says what a value means and `cost` is subtracted from
    what it explains.
    """

    about: str
    what: Callable[[float], str]
    taus: Float[np.ndarray, "samples rows nv"]
    samples: tuple[float, ...] = (0.0, 1.0)
    functions: Callable[[np.ndarray], np.ndarray] = LINEAR
    values: Float[np.ndarray, " values"] = field(default_factory=lambda: FACTORS)
    stated: float = 1.0
    least: float = 0.1
    cost: float = 0.0
    joints: tuple[str, ...] = ()

    @property
    def weights(self) -> Float[np.ndarray, "values samples"]:
        """Of `taus`, at each of the values."""
        return self.functions(self.values) @ np.linalg.inv(self.functions(np.array(self.samples)))


class Unexplained:
    """Power of each joint's torque that friction, a rotor and a constant leave, for many torques tau(x) at once.

    `noise` (nv,) is that of tau [Nm or N], from the acceleration: a factor below 1 makes it smaller, which is no merit.
    """

    def __init__(self, robot: Robot, rows: Dataset, noise: Float[np.ndarray, " nv"]) -> None:
        self.u, self.bases, self.rotors = rows.u, [], []
        _, *of_laws = columns_of(robot, rows, (SLOW, 5.0 * SLOW))
        for joint in range(rows.nv):
            basis = np.linalg.qr(np.stack([each[:, joint] for each in of_laws], axis=1))[0]
            rotor = rows.a[:, joint] - basis @ (basis.T @ rows.a[:, joint])
            self.bases.append(basis)
            self.rotors.append(rotor / max(float(np.linalg.norm(rotor)), 1e-300))
        self.noise = NOISE * len(rows) * np.square(noise)
        self.power = np.maximum(np.square(rows.u - rows.u.mean(axis=0)).sum(axis=0), 1e-300)

    def logarithms(self, taus: np.ndarray, weights: np.ndarray) -> Float[np.ndarray, "values nv"]:
        """Logarithm of the share of each torque that remains, for `weights` (values, k) of `taus` (k, rows, nv)."""
        shares = []
        factors = np.concatenate([np.ones((len(weights), 1)), weights], axis=1)
        for joint, (basis, rotor) in enumerate(zip(self.bases, self.rotors, strict=True)):
            parts = np.concatenate([self.u[:, [joint]], -taus[:, :, joint].T], axis=1)
            parts = parts - basis @ (basis.T @ parts)
            left = np.einsum("xi,ij,xj->x", factors, parts.T @ parts, factors)
            left = left - np.square(np.maximum(factors @ (parts.T @ rotor), 0.0))  # a rotor's inertia is positive
            left = np.maximum(left, 0.0) + self.noise[joint]
            shares.append(np.log(np.maximum(left / self.power[joint], FLOOR)))
        return np.stack(shares, axis=1)


def parameter_doubts(robot: Robot, rows: Dataset, noise: Float[np.ndarray, " nv"]) -> list[Doubt]:
    """The number of the robot that, if it were another, would explain the torques of `rows` far better; or none.

    `noise` (nv,) is the standard deviation of the noise of their accelerations.
    """
    moving = np.std(rows.u, axis=0) > 0.0
    if len(rows) < FEWEST_ROWS or not moving.all():
        return []
    with torch.no_grad():
        M = robot.mass_matrix(torch.tensor(rows.q, device=robot.device)).cpu().numpy()
    left = Unexplained(robot, rows, np.sqrt(np.square(M).mean(axis=0) @ np.square(noise)))
    tau = needed_torques(robot, rows)
    now = left.logarithms(tau[None], np.ones((1, 1)))[0]
    if np.exp(now).max() < 100.0 * FLOOR:
        return []
    options = []
    for variation in _variations(robot, rows, tau):
        gains = (now - left.logarithms(variation.taus, variation.weights)).sum(axis=1) - variation.cost
        place = int(np.argmax(gains))
        options.append((float(gains[place]), float(variation.values[place]), variation))
    options.sort(key=lambda option: -option[0])
    if not options:
        return []
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
    numbers = {"value": value, "gain": gain}
    what = f"{best.what(value)}; {remains}"
    return [look(about=best.about, what=what, do=REMEDY, joints=best.joints, numbers=numbers)]


def _variations(robot: Robot, rows: Dataset, tau: np.ndarray) -> Iterator[Variation]:
    names, tree, layout = robot.joint_names, robot.tree, robot.layout
    bodies = [(names[drive.joint], joint.child) for joint, drive in zip(layout.bodies, layout.drives, strict=True)]

    def with_tree(**changes: torch.Tensor) -> np.ndarray:
        return needed_torques(replace(robot, tree=replace(tree, **changes)), rows)

    def factor(about: str, text: str, at_zero: np.ndarray, *joints: str, cost: float = 0.0) -> Variation:
        return Variation(about=about, what=text.format, taus=np.stack([at_zero, tau]), cost=cost, joints=joints)

    for joint, name in enumerate(names):
        text = (
            f"the torque of {name} is {{:.3g}} times what the motion needs, that of the others is not (its torque "
            "constant, gear ratio or unit)"
        )
        kept = np.where(np.arange(len(names)) == joint, 0.0, tau)
        yield factor("torque constant", text, kept, name)
    if len(names) > 1:
        text = "all torques fit {:.3g} times the masses of the URDF (or the torque unit is another)"
        yield factor("masses", text, 0.0 * tau, cost=-0.1)
    for body, (name, link) in enumerate(bodies):
        J = tree.inertias[body, :, :, 0]
        if float(J[3, 3]) <= 0.0:
            continue
        center = J[:, 3] / J[3, 3]
        for part in (J, J[3, 3] * torch.outer(center, center)):  # with its inertia, and the mass alone
            inertias = tree.inertias.clone()
            inertias[body, :, :, 0] -= part
            text = f"the torques fit a mass of {link} of {{:.3g}} times that of the URDF"
            yield factor("masses", text, with_tree(inertias=inertias), name)
    for body, (name, _) in enumerate(bodies):
        length = float(torch.linalg.vector_norm(tree.rest[body, :3, 3, 0]))
        if length == 0.0 or layout.parents[body] < 0:
            continue  # where the whole robot stands changes nothing
        scaled = [tree.rest.clone() for _ in range(3)]
        for x, rest in zip((0.5, 1.0, 2.0), scaled, strict=True):
            rest[body, :3, 3] *= x
        yield Variation(
            about="lengths",
            what=lambda x, name=name, length=length: (
                f"the torques fit {x:.3g} times the length from {name} to the joint before ({x * length:.3g} instead "
                f"of {length:.3g} m)"
            ),
            taus=np.stack([with_tree(rest=rest) for rest in scaled]),
            samples=(0.5, 1.0, 2.0),
            functions=_powers(2),
            cost=0.2,
            joints=(name,),
        )
    for joint, name in enumerate(names):
        if robot.joints[joint].type == "prismatic":
            continue
        samples, one = tuple(2.0 * np.pi * np.arange(5) / 5.0), np.eye(rows.nv)[joint]
        yield Variation(
            about="joint zero",
            what=lambda x, name=name: (
                f"the torques fit positions of {name} that are {x:+.3g} rad ({np.rad2deg(x):+.0f} "
                "degrees) from the logged ones: its zero is elsewhere"
            ),
            taus=np.stack([needed_torques(robot, replace(rows, q=rows.q + x * one)) for x in samples]),
            samples=samples,
            functions=_waves,
            values=np.linspace(-np.pi, np.pi, 181),
            stated=0.0,
            least=0.06,
            cost=0.3,
            joints=(name,),
        )
    # more or less gravity; none; or any where the robot has none
    nominal = robot.gravity.cpu().numpy()
    size = float(np.linalg.norm(nominal))
    for axis in [nominal / size] if size else [sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)]:
        along = (size or STANDARD_GRAVITY) * axis
        text = ",".join(f"{value + 0.0:.3g}" for value in along)
        stated = "" if size else f", but the robot states none (`gravity={text}`)"
        yield Variation(
            about="gravity",
            what=lambda x, text=text, stated=stated: (
                "the torques show no gravity, although the robot states one (`gravity=0,0,0`)"
                if abs(x) < NO_GRAVITY
                else f"the torques fit {x:.3g} times gravity along ({text}) m/s²{stated}"
            ),
            taus=np.stack([needed_torques(with_gravity(robot, x * along), rows) for x in (0.0, 1.0)]),
            values=np.linspace(-1.5, 3.0, 226) if size else np.linspace(0.0, 1.5, 76),  # with 0 and 1
            stated=1.0 if size else 0.0,
            cost=0.1,
        )
