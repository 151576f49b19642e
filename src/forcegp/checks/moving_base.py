"""Robots whose base moves: do positions, velocities and accelerations belong together, in which axes, in which order.

Each reading predicts how positions change over a tenth of a second, in which noise of poses is small.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from forcegp.data import Dataset, estimate_stance, thruster_columns
from forcegp.data.configurations import in_base
from forcegp.data.views import consecutive, whole_windows
from forcegp.doubts import Doubt, look, ok, wrong
from forcegp.errors import ContactError
from forcegp.mechanics.gauss_principle import OPEN
from forcegp.model import Model
from forcegp.robots.manifold import TURN, Group, difference, pose

CLEARLY = 0.3
"""Another reading is right where its error is below this share of the error as recorded, and
itself below this share of the speed; and by how much the share that it explains may differ from 1."""
SURE = 20.0
"""Standard errors of independent rows by which other axes have to fit better: successive rows are not independent."""
TINY = 1e-24
MOST_ROWS = 2000
MOST_WINDOW_ROWS, MOST_FORCES = 20_000, 4_000
WINDOW, MOST_TURN = 0.1, 0.5  # seconds over which motion is averaged, and rad, since rates are averaged as vectors
CARRIED = 0.5  # of the weight: a larger force in half of the rows carries the robot
LEAST = 0.01  # of the speed: a smaller error is that of rounding
THOUSANDS = 10.0  # times the weight: a larger force is one of lengths in mm
GAP = 1.5  # times the usual time of so many rows: a longer one has a gap
RPM = 2.0 * np.pi / 60.0
READINGS = ("imu", "body"), ("world", "world")
"""Axes of linear and angular accelerations in which logs have them beside those of the body."""


@dataclass(frozen=True)
class _Windows:
    """Rows (windows, rows of one) of stretches of time, evenly over the log, and the weights of a mean over time."""

    rows: np.ndarray
    weights: Tensor
    step: Tensor

    @classmethod
    def of(cls, dataset: Dataset, turning: np.ndarray, most_rows: int = MOST_WINDOW_ROWS) -> "_Windows":
        """`turning`: columns of v that are rates."""
        after = np.flatnonzero(consecutive(dataset)[:-1])
        rate = float(np.linalg.norm(dataset.v[:, turning], axis=1).mean()) if len(turning) else 0.0
        seconds, steps = min(WINDOW, MOST_TURN / max(rate, 1e-9)), np.diff(dataset.time)[after]
        most = min(len(dataset) // 10, most_rows // 100)
        length = int(np.clip(seconds / np.median(steps), 1, max(1, most))) + 1 if len(steps) else 2
        length = length if dataset.time_ordered else 1
        first = whole_windows(dataset, length)
        if length > 1:  # rows that were left out leave gaps
            lasts = dataset.time[first + length - 1] - dataset.time[first]
            first = first[lasts < GAP * (length - 1) * np.median(steps)]
        first = first[:: max(1, -(-len(first) // min(MOST_ROWS, most_rows // length)))]
        rows = first[:, None] + np.arange(length)
        steps = np.diff(dataset.time[rows])
        weights = 0.5 * (np.pad(steps, ((0, 0), (0, 1))) + np.pad(steps, ((0, 0), (1, 0))))
        whole = steps.sum(1, keepdims=True)
        weights = weights / whole if length > 1 else np.ones(rows.shape)
        return cls(rows, torch.tensor(weights)[..., None], torch.tensor(whole))

    def mean(self, values: Tensor) -> Tensor:
        """Over each window (windows, k), of values (windows * rows of one, k)."""
        return (self.weights * values.unflatten(0, self.rows.shape)).sum(1)

    def of_signal(self, values: np.ndarray) -> Tensor:
        return torch.tensor(values[self.rows.ravel()])


def base_doubts(dataset: Dataset, model: Model) -> Iterator[Doubt]:
    """What is seen of the bases of a log."""
    if not dataset.time_ordered or consecutive(dataset).sum() < 10:
        yield look(about="base", what="too few successive rows to compare positions and velocities of the base.")
        return
    for group in model.robot.layout.groups:
        windows = _Windows.of(dataset, np.arange(dataset.nv)[group.rows][3:])
        q, v, a = (windows.of_signal(getattr(dataset, name)) for name in ("q", "v", "a"))
        at, v, a = q[:, group.places], v[:, group.rows], a[:, group.rows]
        yield from _of_velocity(windows, group, at, v, *_stated(dataset))
        each = v.unflatten(0, windows.rows.shape)
        change = (each[:, -1] - each[:, 0]) / windows.step
        error, size = _rms(change - windows.mean(a)), _rms(change)
        readings = {axes: in_base(at, a, (axes, linear), v, model.robot.gravity) for axes, linear in READINGS}
        errors = {axes: _rms(change - windows.mean(measured)) for axes, measured in readings.items()}
        axes = min(errors, key=errors.__getitem__)
        other = errors[axes] < CLEARLY * error
        if error <= 2.0 * size and not other:  # noise of the velocities alone makes both large
            continue
        kind, correction = look, {}
        remedy = "Differentiate v: a is its derivative in body axes, without gravity and w x v."
        seen = (
            f"the acceleration of {group.name!r} is off from the change of its velocity by {error:.2g}, which itself "
            f"is {size:.2g}."
        )
        if other:
            kind, remedy, correction = wrong, "Differentiate v.", {"axes": {"a": (axes,)}}
            words = {"imu": "what an accelerometer measures", "world": "given in world axes"}[axes]
            seen = (
                f"the acceleration of {group.name!r} is {words}: as the change of its velocity it is off by "
                f"{error:.2g}, read so by {errors[axes]:.2g}."
            )
        numbers = {"error": error, "specific": errors["imu"], "size": size}
        yield kind(about="base acceleration", what=seen, do=remedy, correction=correction, numbers=numbers)


def carried_doubts(dataset: Dataset, model: Model) -> Iterator[Doubt]:
    """A base that no foot, thruster or known force of the model carries, although it does not fall."""
    robot, groups = model.robot, model.robot.layout.groups
    weight = float(torch.linalg.vector_norm(robot.gravity)) * robot.mass
    if not groups or not weight:
        return
    complete, feet = dataset.u.shape[1] == len(model.inputs), {contact.switch for contact in model.contacts}
    if None in feet or (feet and not complete):
        return
    flags = dataset.u[:, [column for column, name in enumerate(model.inputs) if name in feet]] > 0.5
    if flags.any(1).mean() > 0.5:  # the median window shows less of flight
        return
    group = groups[0]
    windows = _Windows.of(dataset, np.arange(dataset.nv)[group.rows][3:], MOST_FORCES)
    inputs = dataset.u if complete else np.zeros((len(dataset), len(model.inputs)))
    q, v, u, a = (windows.of_signal(x).to(robot.device) for x in (dataset.q, dataset.v, inputs, dataset.a))

    def missing(inputs: Tensor) -> Tensor:
        """The linear part of M a less what the model knows of, in the axes of the base, in N."""
        dynamics = model.dynamics(q, v, inputs)
        return ((dynamics.M @ a[..., None])[..., 0] - dynamics.Q_K)[:, group.rows][:, :3].cpu()

    def size(force: Tensor) -> float:
        return float(torch.linalg.vector_norm(windows.mean(force), dim=-1).median())

    found, thrusters = size(missing(u)), sorted(thruster_columns(model)) if complete else []
    if found <= CARRIED * weight:
        return
    numbers, weighs = {"force": found, "weight": weight}, f"(the robot weighs {weight:.3g} N)"
    kind, correction = wrong, dict[str, dict[str, tuple[str, ...]]]()
    if not thrusters:
        remedy = (
            "Describe them in Python (docs/how-to/moving-bases.md), write model.to_json() into a file, and take it in "
            "the place of the robot: forcegp import LOG --identified FILE, and so with forcegp auto."
        )
        if found > THOUSANDS * weight:
            remedy = "Are positions of the base in mm? Then give their unit, as in forcegp import --unit q=mm,v=mm/s."
        elif feet:
            named = ", ".join(sorted(map(str, feet)))
            remedy = f"Let forcegp import --feet name what stands, and compare {named} with heights."
        seen = (
            f"{group.name!r} does not fall: it moves under {found:.3g} N that nothing in the model explains, no foot "
            f"that stands and no thruster {weighs}"
        )
    else:
        seen = f"{group.name!r} moves under {found:.3g} N that its thrusters do not explain {weighs}"
        still, slower, at = u.clone(), u.clone(), q[:, group.places].cpu()
        still[:, thrusters], slower[:, thrusters] = 0.0, RPM * u[:, thrusters]
        needed, upright = missing(still), torch.eye(3, dtype=at.dtype)
        turned = pose(_reordered(at))[0].mT @ pose(at)[0]
        order, unit = {"orientation": {"q": ("wxyz",)}}, {"unit": {"u": ("rpm",)}}
        kind, remedy = look, "Check the unit of u, the mass, coefficients of thrust and the axes of a."
        for what, rotation, speeds, stated in (
            ("rotor speeds in rpm", upright, slower, unit),
            ("a quaternion w, x, y, z", turned, u, order),
            ("a quaternion w, x, y, z and rotor speeds in rpm", turned, slower, order | unit),
        ):
            left = size((rotation @ needed[..., None])[..., 0] + missing(speeds) - needed)
            if left < CLEARLY * min(found, weight):
                kind, correction, remedy = wrong, stated, ""
                numbers[what], seen = left, f"{seen}; with {what} {left:.3g} N"
                break
    yield kind(about="base force", what=f"{seen}.", do=remedy, correction=correction, numbers=numbers)


def _stated(dataset: Dataset) -> tuple[tuple[str, str], str]:
    """Axes of linear and angular velocities, and the order of quaternions, in the log file, as its import was told."""
    axes, order = ("body", "body"), "xyzw"
    with contextlib.suppress(AttributeError, TypeError, KeyError):  # somebody else's metadata
        mapping = dataset.metadata["import"]["mapping"]
        order = str(mapping.get("orientation", order))
        given = mapping["axes"]["v"]  # one word, or one for each part
        linear, angular = ("world" if name == "world" else "body" for name in (given[0], given[-1]))
        axes = linear, angular
    return axes, order


def _of_velocity(
    windows: _Windows, group: Group, q: Tensor, v: Tensor, stated: tuple[str, str], order: str
) -> Iterator[Doubt]:
    parts, angular = {"linear ": [0, 1, 2], "angular ": [3, 4, 5]}, [False] * 3 + [True] * 3

    def mistaken(recorded: float, other: float, speed: float) -> bool:
        return recorded > CLEARLY * speed and other < CLEARLY * min(recorded, speed)

    raw = torch.where(torch.tensor([stated[part] == "world" for part in angular]), _in_world(q, v), v)

    def best_axes(at: Tensor) -> tuple[dict[str, str], float, float]:
        """Parts of v that fit in other axes than stated, the error that is left with them, and that as stated."""
        first, last = (at.unflatten(0, windows.rows.shape)[:, k] for k in (0, -1))
        moved = _in_world(first, difference(first, last))
        linear = parts["linear "]  # a difference of poses has those of a screw
        moved[:, linear] = pose(last)[1] - pose(first)[1]
        moved, read = moved / windows.step, {"world": windows.mean(raw), "body": windows.mean(_in_world(at, raw))}
        found, best, own = dict[str, str](), moved.clone(), moved.clone()
        for (name, part), axes in zip(parts.items(), stated, strict=True):
            other = "body" if axes == "world" else "world"
            own[:, part] = best[:, part] = read[axes][:, part]
            if part and _explained((moved - own)[:, part], (read[other] - own)[:, part]):
                best[:, part], found[name] = read[other][:, part], other
        return found, _rms(moved - best), _rms(moved - own)

    found, other, recorded = best_axes(q)
    speed, meant, correction = _rms(windows.mean(raw)), list[str](), dict[str, dict[str, tuple[str, ...]]]()
    axes, reordered, _ = best_axes(_reordered(q, order))
    # of a robot that hardly turns, rates are a small part of the speed, and other axes may hide a wrong order
    hidden = recorded > LEAST * speed and reordered < CLEARLY * other
    if hidden or (mistaken(recorded, reordered, speed) and reordered < other):
        found, other, actual = axes, reordered, "xyzw" if order == "wxyz" else "wxyz"
        meant, correction["orientation"] = [f"a quaternion {', '.join(actual)}"], {"q": (actual,)}
    if found:
        named = {"": next(iter(found.values()))} if len(found) == 2 and len({*found.values()}) == 1 else found
        meant += [f"{name}velocities in the axes of the {axes.replace('body', 'base')}" for name, axes in named.items()]
        axes = tuple(found.get(name, now) for name, now in zip(parts, stated, strict=True))
        correction["axes"] = {"v": axes[:1] if len(set(axes)) == 1 else axes}
    reading = " and ".join(meant)
    numbers = {"as recorded": recorded, "speed": speed} | ({reading: other} if reading else {})
    kind, remedy, seen = ok, "", f"positions and velocities of {group.name!r} agree."
    if reading:
        kind, seen = wrong, f"positions of {group.name!r} change as if it had {reading}: off by {other:.2g}, as"
        seen += f" recorded by {recorded:.2g}, of a speed of {speed:.2g}."
    elif recorded > CLEARLY * speed and speed > 0.0:
        remedy = "Check units and time stamps, and that v is linear, then angular velocity in the axes of the base."
        kind, seen = look, f"positions of {group.name!r} do not change as its velocities say: off by {recorded:.2g} of"
        seen += f" {speed:.2g}."
    yield kind(about="base", what=seen, do=remedy, correction=correction, numbers=numbers)


def _in_world(q: Tensor, v: Tensor) -> Tensor:
    """Velocities in the axes of the base, at its positions, in those of the world."""
    return (pose(q)[0][:, None] @ v.unflatten(-1, (2, 3))[..., None]).flatten(1)


def _reordered(q: Tensor, order: str = "xyzw") -> Tensor:
    """Positions of a log whose quaternions begin with w; or end with it, where they were read in the order wxyz."""
    turned = q.clone()
    turned[:, TURN] = q[:, TURN].roll(1 if order == "wxyz" else -1, -1)
    return turned


def _explained(error: Tensor, difference: Tensor) -> bool:
    """Whether `difference` (rows, k), of another reading, is what the `error` consists of; noise has half of it."""
    variance = torch.minimum(error.square().mean(0), (error - difference).square().mean(0)).clamp_min(TINY)
    weight = float((difference.square() / variance).sum())
    share = float((error * difference / variance).sum()) / weight if weight > 0.0 else 0.0
    return abs(share - 1.0) < CLEARLY and (share - 0.5) * weight**0.5 > SURE


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())


MOST_FLAGS = 4000
FEW, RARE, RESTING = 0.05, 0.002, 0.02
"""Shares of rows of stance that the motion contradicts and that are wrong, or worth a look; the same of swing."""


def stance_doubts(dataset: Dataset, model: Model) -> Iterator[Doubt]:
    """Contacts that contradict each other; flags that are no flags, or that `estimate_stance` contradicts."""
    if not model.contacts:
        return
    every = -(-len(dataset) // MOST_FLAGS)
    dataset = dataset.rows(slice(None, None, every))
    try:
        model.check_states(*(torch.tensor(x, device=model.robot.device) for x in (dataset.q, dataset.v, dataset.u)))
    except ContactError as error:
        counted = f" (rows are counted in every {every}. one)" if every > 1 else ""
        yield wrong(about="contacts", what=f"{error}{counted}")
    if not model.switches:
        return
    found = estimate_stance(dataset, model)
    for k, name in enumerate(found.names):
        logged, shown, speed = dataset.u[:, model.inputs.index(name)], found.flags[:, k], found.speed[:, k]
        frame = next(contact.frame for contact in model.contacts if contact.switch == name)
        stands, odd = logged > OPEN, int((~np.isin(logged, [0.0, OPEN, 1.0])).sum())
        if odd:
            what = f"{name!r} is neither 0 nor 1 in {odd} of {len(logged)} rows; above .5 it counts as 1."
            do = "Write 1 where the contact holds and 0 elsewhere, for example force > threshold."
            yield wrong(about="contact flag", what=what, do=do, numbers={"rows": odd})
        lifted, resting = stands & ((shown == 0.0) | found.moves[:, k]), (logged == 0.0) & (shown == 1.0)
        sliding, rests = (float(x.sum() / max(y.sum(), 1)) for x, y in ((lifted, stands), (resting, ~stands)))
        numbers = {"standing": float(stands.mean()), "moving while standing": sliding, "resting while free": rests}
        numbers |= {"limit": float(found.slow[k]), "open": float(np.isnan(shown).mean())}
        kind, seen, remedy = ok, f"{name!r} agrees with motion and forces.", ""
        if sliding > RARE:
            row = int(np.flatnonzero(lifted)[speed[lifted].argmax()])
            kind = wrong if sliding > FEW else look
            seen = (
                f"{name!r} holds {frame!r} in rows in which it moves or bears nothing: {sliding:.1%} of them, row "
                f"{every * row} with {speed[row]:.2g} m/s and {found.force[row, k]:.2g} N."
            )
            remedy = (
                "Set the flag to 0 where the foot slides or is lifted (forcegp import --stance auto finds such rows), "
                "and compare its time with that of the joints; a wrong foot point or joint offset shows the same."
            )
        elif rests > RESTING:
            row = every * int(np.flatnonzero(resting)[0])
            kind, remedy = look, "A foot at rest may stand: compare the flag with contact forces or heights."
            seen = f"{name!r} is 0 in rows of which {rests:.0%} show {frame!r} at rest, row {row} for example."
        if kind is not ok or not odd:
            yield kind(about="contact flag", what=seen, do=remedy, numbers=numbers)


def unmeasured_base_doubts(dataset: Dataset, model: Model) -> Iterator[Doubt]:
    """A base whose columns hold one number while joints move: nobody measured it."""
    for group in model.robot.layout.groups:
        others = np.delete(np.arange(dataset.nv), np.arange(group.rows.start, group.rows.stop))
        still = not np.ptp(dataset.q[:, group.places], axis=0).any() and not dataset.v[:, group.rows].any()
        moves = not len(others) or np.ptp(dataset.v[:, others], axis=0).any()
        if still and moves and len(dataset) > 1:
            what = f"{group.name!r} stands still in all {len(dataset)} rows to the last digit: it was not measured."
            do = "Record its pose by motion capture or a state estimator (position and quaternion), and its "
            do += "velocity. Without, learn joint friction on a stand: base='fixed'."
            yield wrong(about="base", what=what, do=do)
