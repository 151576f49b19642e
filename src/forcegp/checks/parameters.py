"""One number of the robot that is wrong: masses, lengths, torque constants, zeros of joints, gravity.

Inverse dynamics is a polynomial of each of these numbers, of degree 1 (masses, gravity, torque constants) or 2
(lengths), and a trigonometric one of degree 2 in the zero of a turning joint. So a few evaluations give the torques for
every value, and the value is found that leaves least of all torques unexplained, next to friction and rotors as in
`forcegp.checks.torques`, but with the torques of the URDF taken as they are.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from forcegp.checks.torques import SLOW, columns_of, inverse_dynamics, with_gravity
from forcegp.data import Dataset
from forcegp.doubts import Doubt, look
from forcegp.robots import Robot

GAIN = np.log(2.5)  # by which the product over the joints of what remains unexplained must fall
FLOOR = 1e-5  # share of a torque's power below which everything is explained
NOISE = 3.0  # how much of the power of the noise is left to every explanation
FEWEST_ROWS = 30
STANDARD_GRAVITY = 9.81  # m/s^2
NO_GRAVITY = 0.05
FACTORS = np.exp(np.linspace(-3.5, 3.5, 351))  # values that are tried for a factor
REMEDY = "Correct the URDF, or the unit of the signal; or let forcegp fit --forces bodies estimate it from this log."


@dataclass(frozen=True, kw_only=True, eq=False)
class Variation:
    """The torques tau(x) for every value x of one number: `weights` (values, k) times `taus` (k, rows, nv).

    `stated` is the value that the robot has and `least` the least change of it, on the scale of `values`, that is
    reported; `what` says what a value means and `cost` is subtracted from what it explains.
    """

    about: str
    what: Callable[[float], str]
    values: Float[np.ndarray, " values"]
    weights: Float[np.ndarray, "values k"]
    taus: Float[np.ndarray, "k rows nv"]
    stated: float = 1.0
    least: float = 0.1
    cost: float = 0.0
    joints: tuple[str, ...] = ()


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
        for joint, (basis, rotor) in enumerate(zip(self.bases, self.rotors, strict=True)):
            parts = np.concatenate([self.u[:, [joint]], -taus[:, :, joint].T], axis=1)
            parts = parts - basis @ (basis.T @ parts)
            factors = np.concatenate([np.ones((len(weights), 1)), weights], axis=1)
            left = np.einsum("xi,ij,xj->x", factors, parts.T @ parts, factors)
            inertia = factors @ (parts.T @ rotor)  # a rotor's inertia is positive
            left = left - np.square(np.maximum(inertia, 0.0))
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
    tau = inverse_dynamics(robot, rows)
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
    return [
        look(
            about=best.about,
            what=f"{best.what(value)}; then {100.0 * np.exp(-gain / rows.nv):.2g} % of what was unexplained remains."
            f"{also}",
            do=REMEDY,
            joints=best.joints,
            numbers={"value": value, "gain": gain},
        )
    ]


def _variations(robot: Robot, rows: Dataset, tau: np.ndarray) -> Iterator[Variation]:
    names, tree, layout = robot.joint_names, robot.tree, robot.layout
    bodies = [(names[drive.joint], joint.child) for joint, drive in zip(layout.bodies, layout.drives, strict=True)]
    linear = np.stack([1.0 - FACTORS, FACTORS], axis=1)  # of the torques at 0 and at 1

    def with_tree(**changes: torch.Tensor) -> np.ndarray:
        return inverse_dynamics(replace(robot, tree=replace(tree, **changes)), rows)

    def factor(subject: str, meaning: Callable[[float], str], at_zero: np.ndarray, **more: object) -> Variation:
        taus = np.stack([at_zero, tau])
        return Variation(about=subject, what=meaning, values=FACTORS, weights=linear, taus=taus, **more)  # type: ignore[arg-type]

    # torque constants and masses
    for joint, name in enumerate(names):
        text = (
            f"the torque of {name} is {{:.3g}} times what the motion needs, that of the others is not (its torque "
            "constant, gear ratio or unit)"
        )
        kept = np.where(np.arange(len(names)) == joint, 0.0, tau)
        yield factor("torque constant", text.format, kept, joints=(name,))
    if len(names) > 1:
        text = "all torques fit {:.3g} times the masses of the URDF (or the torque unit is another)"
        yield factor("masses", text.format, 0.0 * tau, cost=-0.1)
    for body, (name, link) in enumerate(bodies):
        J = tree.inertias[body, :, :, 0]
        if float(J[3, 3]) <= 0.0:
            continue
        center = J[:, 3] / J[3, 3]
        for part in (J, J[3, 3] * torch.outer(center, center)):  # with its inertia, and the mass alone
            inertias = tree.inertias.clone()
            inertias[body, :, :, 0] -= part
            text = f"the torques fit a mass of {link} of {{:.3g}} times that of the URDF"
            yield factor("masses", text.format, with_tree(inertias=inertias), joints=(name,))
    powers = np.array([0.5, 1.0, 2.0])
    quadratic = np.stack([FACTORS**0, FACTORS, FACTORS**2], axis=1) @ np.linalg.inv(
        np.stack([powers**0, powers, powers**2], axis=1)
    )
    for body, (name, _) in enumerate(bodies):
        length = float(torch.linalg.vector_norm(tree.rest[body, :3, 3, 0]))
        if length == 0.0 or layout.parents[body] < 0:
            continue  # where the whole robot stands changes nothing
        taus = []
        for x in powers:
            rest = tree.rest.clone()
            rest[body, :3, 3] *= x
            taus.append(with_tree(rest=rest))
        yield Variation(
            about="lengths",
            what=lambda x, name=name, length=length: (
                f"the torques fit {x:.3g} times the length from {name} to the joint before ({x * length:.3g} instead "
                f"of {length:.3g} m)"
            ),
            values=FACTORS,
            weights=quadratic,
            taus=np.stack(taus),
            cost=0.2,
            joints=(name,),
        )
    yield from _zeros(robot, rows)
    yield from _gravity(robot, rows, tau)


def _zeros(robot: Robot, rows: Dataset) -> Iterator[Variation]:
    """Positions that are counted from elsewhere."""
    angles, samples = np.linspace(-np.pi, np.pi, 181), 2.0 * np.pi * np.arange(5) / 5.0

    def waves(x: np.ndarray) -> np.ndarray:
        return np.stack([x**0, np.cos(x), np.sin(x), np.cos(2 * x), np.sin(2 * x)], axis=1)

    weights = waves(angles) @ np.linalg.inv(waves(samples))
    for joint, name in enumerate(robot.joint_names):
        if robot.joints[joint].type == "prismatic":
            continue
        one = np.eye(rows.nv)[joint]
        taus = [inverse_dynamics(robot, replace(rows, q=rows.q + x * one)) for x in samples]
        yield Variation(
            about="joint zero",
            what=lambda x, name=name: (
                f"the torques fit positions of {name} that are {x:+.3g} rad ({np.rad2deg(x):+.0f} "
                "degrees) from the logged ones: its zero is elsewhere"
            ),
            values=angles,
            weights=weights,
            taus=np.stack(taus),
            stated=0.0,
            least=0.06,
            cost=0.3,
            joints=(name,),
        )


def _gravity(robot: Robot, rows: Dataset, tau: np.ndarray) -> Iterator[Variation]:
    """More or less gravity; none; or any where the robot has none."""
    nominal = robot.gravity.cpu().numpy()
    size = float(np.linalg.norm(nominal))
    free = inverse_dynamics(with_gravity(robot, np.zeros(3)), rows) if size else tau
    values = np.linspace(-1.5, 3.0, 226) if size else np.linspace(0.0, 1.5, 76)  # with 0 and 1
    axes = [nominal / size] if size else [sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
    for axis in axes:
        along = (size or STANDARD_GRAVITY) * axis
        pulled = tau if size else inverse_dynamics(with_gravity(robot, along), rows)
        text = ",".join(f"{value + 0.0:.3g}" for value in along)
        stated = "" if size else f", but the robot states none (`gravity={text}`)"
        yield Variation(
            about="gravity",
            what=lambda x, text=text, stated=stated: (
                "the torques show no gravity, although the robot states one (`gravity=0,0,0`)"
                if abs(x) < NO_GRAVITY
                else f"the torques fit {x:.3g} times gravity along ({text}) m/s²{stated}"
            ),
            values=values,
            weights=np.stack([1.0 - values, values], axis=1),
            taus=np.stack([free, pulled]),
            stated=1.0 if size else 0.0,
            cost=0.1,
        )
