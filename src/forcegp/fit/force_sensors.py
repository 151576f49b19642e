"""Force sensors beside torques and motion: sign, axes, unit, offset, drift, delay, and a weight that counts twice.

What the rows need less what drives deliver is J^T F, beside what friction, rotors and any masses explain. Of the axes
of F all orders and signs are tried, also as if F were along the axes of the frame, or had been along the world's.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import permutations, product

import numpy as np
import torch
from jaxtyping import Float

from forcegp.data import Dataset
from forcegp.data.imu import SECONDS, SHIFTS, late_doubts, short_means
from forcegp.data.views import tensors
from forcegp.doubts import Doubt, look, ok, wrong
from forcegp.evidence import torque_regressor
from forcegp.evidence.recorded_rows import arm, sensed_of
from forcegp.fit.unseen import rows_of_known_physics
from forcegp.model import Model

FOLLOWS, OTHER, OFF, NEAR, FELT, MOST_ROWS = 0.5, 0.3, 0.1, 0.15, 0.02, 6000
"""Share of what is needed that a sensor leaves where it follows; what another reading leaves of that at most; offset
over what it measures that is worth a word; logarithm by which a factor is off a unit; least share of torques; rows."""
_EVERY = [np.eye(3)[list(k)] * signs for k in permutations(range(3)) for signs in product((1.0, -1.0), repeat=3)]
Shown = Callable[[Float[np.ndarray, "rows nv k"]], Float[np.ndarray, "windows k"]]
UNITS = {"kN": 1e3, "mN": 1e-3, "kgf": 9.80665, "lbf": 4.4482216152605}  # N
AXES = sorted(_EVERY, key=lambda Q: (abs(np.trace(Q)) < 3.0, -np.trace(Q), -np.linalg.det(Q)))
"""As it is, turned altogether, other axes; then those that are no rotation."""


def force_sensor_doubts(dataset: Dataset, model: Model) -> Iterator[Doubt]:
    """Each force sensor beside what torques and motion need there; none where others push."""
    sensed, held = sensed_of(dataset), {(contact.frame, contact.point) for contact in model.contacts}
    alone = dict(held).keys() <= sensed.keys() and len(dict(held)) == len(held)
    if not sensed or not alone or not dataset.u.any() or model.carries_known_forces:
        return
    middle = max(0, (len(dataset) - MOST_ROWS) // 2)
    dataset = dataset.rows(slice(middle, middle + MOST_ROWS))
    if model.actuation.learned:  # as logged
        model = model.with_forces(replace(model.actuation, gain=1.0))
    rows, robot = rows_of_known_physics(model, dataset), model.robot
    missing = rows.in_torque(np.zeros(0), rows.moving(dataset.a))[0][:, : robot.nv]
    q, v, _, a = tensors(dataset)
    with torch.no_grad():
        regressor = torque_regressor(robot.to("cpu"), q, v, a).numpy()
    driven = np.isin(robot.joint_names, robot.single_joint_names)
    laws = np.stack([dataset.v, np.sign(dataset.v), np.ones(dataset.v.shape), dataset.a], axis=-1) * driven[:, None]
    laws = np.concatenate([laws, regressor], axis=-1)
    parts = [np.linalg.svd(each, full_matrices=False)[:2] for each in short_means(dataset, *laws.swapaxes(0, 1))]
    bases = [basis[:, values > 1e-9 * values[0]] for basis, values in parts]
    apart = min(1.0, float(np.median(np.diff(dataset.time))) / SECONDS) if dataset.time_ordered else 1.0
    if any(apart * len(basis) < 2 * basis.shape[1] for basis in bases):  # any masses would explain it
        yield ok(about="force sensor", what="the log is too short to compare force sensors with torques.")
        return
    size = np.sqrt(np.square(missing + rows.at_contacts).mean(axis=0)) + 1e-12
    idle = driven & (np.ptp(rows.delivered, axis=0) == 0.0)  # a hand may push it
    weight = np.where(idle, 0.0, 1.0 / np.maximum(size, 0.05 * size.max()))

    def unexplained(torques: Float[np.ndarray, "rows nv k"]) -> Float[np.ndarray, "windows k"]:
        """Torques over their size that no friction, rotor or mass explains, of each tenth of a second and joint."""
        means = short_means(dataset, *(torques * weight[:, None]).swapaxes(0, 1))
        return np.concatenate([each - basis @ (basis.T @ each) for each, basis in zip(means, bases, strict=True)])

    for frame, F in sensed_of(dataset).items():
        J = arm(rows.kinematics, model, frame).cpu().numpy()
        R = rows.kinematics.frame_pose(frame)[..., :3, :3].cpu().numpy()
        needed = missing + (J @ F[..., None])[..., 0]
        doubt = _beside(model, frame, F, J, R, needed, unexplained)
        yield doubt
        if doubt.numbers.get("left", 1.0) < FOLLOWS and len(dataset.episodes) == 1 and dataset.time_ordered:
            y, time = unexplained(needed[..., None])[:, 0], dataset.time
            moved = (np.stack([np.interp(time + s, time, x) for x in F.T], axis=1)[..., None] for s in SHIFTS)
            left = [_fitted(unexplained(J @ each)[:, 0], y)[0] ** 0.5 for each in moved]
            yield from late_doubts(f"force sensor at {frame}", left, float(np.median(np.diff(time))))


def _fitted(x: Float[np.ndarray, " rows"], y: Float[np.ndarray, " rows"]) -> tuple[float, float]:
    """What a positive multiple of x leaves of the power of y, and the factor of least squares."""
    power, shared = float(x @ x) + 1e-300, float(x @ y)
    return max(0.0, 1.0 - max(shared, 0.0) ** 2 / (power * float(y @ y) + 1e-300)), shared / power


def _beside(
    model: Model, frame: str, F: np.ndarray, J: np.ndarray, R: np.ndarray, needed: np.ndarray, unexplained: Shown
) -> Doubt:
    y, rms = unexplained(needed[..., None])[:, 0], float(np.sqrt(np.square(F).sum(1).mean()))
    found, told, sensor = [], f"it measures about {rms:.3g} N.", f"force sensor at {frame}"
    for along, values in {"": F[..., None], "body": R @ F[..., None], "world": R.mT @ F[..., None]}.items():
        X = unexplained((J[..., None] * values[:, None, None, :, 0]).reshape(*needed.shape, 9))
        for Q in AXES:
            found.append((*_fitted(X @ Q.ravel(), y), along, Q))
    left, factor, *_ = found[0]
    least = min(each[0] for each in found)
    _, _, along, Q = next(each for each in found if each[0] <= 1.1 * least + 1e-3)
    g, numbers = model.robot.gravity.cpu().numpy(), {"frame": frame, "left": left, "factor": factor}
    if left < FOLLOWS and least > OTHER * left:
        drift = R * np.linspace(-0.5, 0.5, len(F))[:, None, None]
        X = np.c_[unexplained(J @ F[..., None]), unexplained(J @ R), unexplained(J @ drift)]
        off = np.linalg.lstsq(X, y)[0]
        offset, drift = -off[1:4] / off[0], -off[4:] / off[0]
        far = np.square(y - X @ off).sum() < OTHER * left * (y @ y) and max(map(np.linalg.norm, (offset, drift)))
        numbers |= {"offset": offset.tolist(), "drift": drift.tolist()}
        unit = next((name for name, size in UNITS.items() if abs(np.log(factor / size)) < NEAR), "")
        kind, says, do = ok, f"leaves {100.0 * left:.2g} % of what torques and motion need there", ""
        if unit:
            kind, says = look, f"fits what is needed there in {unit}, or torques are off by that factor"
            do = f"State its unit: forcegp import --unit force={unit}."
        elif far > OFF * rms:
            parts = (f"({', '.join(f'{x:.3g}' for x in each)}) N" for each in (offset, drift))
            kind, says = look, "is off by {}, and drifts by {} over the log, along its own axes".format(*parts)
            do = f"Tare it; or take it off the columns, as in forcegp import --force '{frame}=FX-1.2,FY,FZ'."
        return kind(about="force sensor", what=f"the {sensor} {says}; {told}", do=do, numbers=numbers)
    if np.square(unexplained(J @ F[..., None])).sum() < FELT**2 * len(y):
        mass = float((F @ g).mean() / (g @ g + 1e-300))
        if rms < 1e-9 or np.square(F - mass * g).sum() > OTHER * np.square(F).sum():
            return ok(about="force sensor", what=f"torques would hardly notice what the {sensor} shows; {told}")
        beyond = _beyond(model, frame)
        what = f"the {sensor} shows nothing but a weight of {mass:.3g} kg; the file has {beyond:.3g} kg from there on"
        do = "Where both hold the same tool it counts twice: leave it out of one of them."
        do = do if mass > 0.0 else "It pulls upwards: give the columns with a minus, for the force on the robot."
        kind = ok if beyond < 0.5 * mass else look
        return kind(about="force sensor", what=f"{what}; {told}", do=do * (kind is look), numbers={"mass": mass})
    if least < OTHER * left:
        signs = ["-" * int(row.sum() < 0) + "xyz"[int(np.abs(row).argmax())] for row in Q]
        axes = {"": "", "body": " along the axes of the frame", "world": " along the axes of the world"}[along]
        what = f"the {sensor} fits what torques and motion need there as ({', '.join(signs)}){axes}; {told}"
        do = f"Give the columns in this order, with these signs: forcegp import --force {frame}=X,Y,Z"
        do = f"{do}, or turn all torques." if np.trace(Q) == -3.0 else f"{do}."
        do = f"Give the columns so: forcegp import --axes force={along} --force {frame}=X,Y,Z." if along else do
        return wrong(about="force sensor", what=what, do=do, numbers=numbers | {"axes": (Q @ [1.0, 2.0, 3.0]).tolist()})
    what = f"the {sensor} does not follow what torques and motion need there; {told}"
    return look(about="force sensor", what=what, do="Compare its frame and the robot.", numbers=numbers)


def _beyond(model: Model, frame: str) -> float:
    """Mass of the body of a frame and of all that it carries [kg]."""
    first, _ = model.robot.frame(frame)
    layout, inside = model.robot.layout, {first}
    for body, parent in enumerate(layout.parents):  # after its parent
        inside |= {body} if parent in inside else set()
    return float(model.robot.tree.inertias[sorted(inside), 3, 3, 0].sum())
