"""What may be wrong between a log and its robot: every cause as the log and robot that it would leave.

Causes of the torques alone (signs, factors) are found joint by joint in `search`; those here change what is needed.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations, permutations, product
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from forcegp.checks.causes import NUMBER, SIGN, Candidate, Cause, changed, like_units, number
from forcegp.checks.check_input import DEGREE, CheckInput
from forcegp.checks.couplings import coupled_joints
from forcegp.checks.residuals import cogging, loads
from forcegp.checks.torques import Change, Comparison, inverse_dynamics, left_of, needed_torques, solved
from forcegp.data import Dataset
from forcegp.doubts import listed
from forcegp.fit.payloads import with_gravity, with_length
from forcegp.robots import Robot
from forcegp.robots.inertia import standard_of_pseudo_inertia

MOST_ORDERS = 24  # of legs
SCANNED = 3  # best of the numbers that are scanned, which are looked at in full
TILTED = np.deg2rad(6.0)  # angle from which a direction of gravity is another
HEAVIEST = 1.3  # times the assumed gravity, beyond which it is something else
FACTORS = np.exp(np.linspace(-2.5, 2.5, 251))  # of lengths, its ends left out
RATIOS = np.exp(np.linspace(-1.2, 1.2, 25))  # of gears: the steps are then divided by ten
MOST_ENDS = 4  # links that may hold something beside a tilt
ALL_TRIED = 8  # joints up to which every pair is exchanged; of more, those that fit badly


ASIDE = np.deg2rad(20.0)  # of gravity: up to which a force is that of a payload
PULLED = "Take it off, or have it estimated beside masses, by forcegp fit --forces pull, as forcegp auto does."


def candidates(
    now: Comparison, inputs: CheckInput, bad: np.ndarray, factors: np.ndarray, first: bool
) -> Iterator[Candidate]:
    """All causes, on top of those that were corrected; `bad` (nv,) are joints that fit badly, `factors` of their u.

    Of many joints, orders and directions are tried as the `first` cause alone.
    """
    alive = np.ptp(now.rows.u, axis=0) > 0.0
    yield from _units(now, inputs, factors)
    yield from _delays(now, inputs)
    if not np.ndim(now.more):
        if first or now.rows.nv <= ALL_TRIED:
            yield from _orders(now, inputs, alive)
            yield from _motions(now, inputs, bad & alive)
            yield from coupled_joints(now, inputs, bad & alive, first)
        yield from _scanned(now, inputs)
    yield from _linear(now, inputs)
    yield from cogging(now, inputs, bad & alive)


def _units(now: Comparison, inputs: CheckInput, factors: np.ndarray) -> Iterator[Candidate]:
    """One factor of all torques; positions in degrees or turns; time in other units."""
    known = factors[np.isfinite(factors) & (factors > 0.0)]
    if len(known) and known.max() < 2.0 * known.min():
        common = float(np.exp(np.log(known).mean()))
        unit, size = like_units(common, inputs.unit_of_each("u"))
        looks = f": it looks like {listed(unit)}" if unit else " (or all masses are)"
        cause = Cause(
            about="torque unit",
            what=f"the measured torque of all joints is {common:.4g} times what the motion needs{looks}",
            do="Correct the unit of u, or masses and torque constants.",
            joints=tuple(range(now.rows.nv)),
            numbers={"factor": common},
            correction={"unit": {"u": unit}} if unit else {},
            cost=SIGN if unit else NUMBER,
            number=not unit,
            level="wrong" if unit else "look",
        )  # fmt: skip
        if unit or not 0.8 < common < 1.25:
            yield cause, now.with_torques(changed("u", factor=1.0 / size))
    largest, turns = np.abs(now.rows.q * inputs.rotates).max(), inputs.rotates
    each = [np.arange(len(turns)) == k for k in np.flatnonzero(turns & (np.abs(now.rows.q).max(axis=0) > 7.0))]
    for own in [turns, *(one for one in each if turns.sum() > 1)] if largest > 1.0 else []:
        if own.any() and _limits_allow(now, own):
            what = f"positions reach {largest:.4g}; they fit the torques far better as degrees than as radians"
            unit = {
                name: tuple(x.replace("rad", "deg") if own[k] else x for k, x in enumerate(inputs.stated_units(name)))
                for name in "qv"
            }
            told = {"joints": _places(own), "correction": {"unit": unit}}
            cause = Cause(about="degrees", what=what, do="Use np.deg2rad.", cost=SIGN, **told)
            yield cause, now.after(changed("qva", factor=np.where(own, DEGREE, 1.0)))
    if turns.any() and _limits_allow(now, turns):
        what = "positions fit the torques far better taken for turns than for radians"
        cause = Cause(about="turns", what=what, do="Multiply q and v by 2 pi.", joints=_places(turns), cost=SIGN)
        yield cause, now.after(changed("qva", factor=np.where(turns, 2.0 * np.pi, 1.0)))
    steps = np.diff(inputs.log.time)[np.diff(inputs.log.episode) == 0]
    rate = 1.0 / float(np.median(steps)) if inputs.log.time_ordered and len(steps) else SLOWEST
    for unit, factor in (("ms", 1e3), ("us", 1e6), ("min", 1.0 / 60.0)):
        if SLOWEST <= rate <= FASTEST or not SLOWEST <= rate * factor <= FASTEST:
            continue  # slow enough, any motion needs no more than gravity
        what = f"the motion fits the torques far better if time is in {unit}"

        def change(rows: Dataset, factor: float = factor) -> Dataset:
            return replace(changed()(rows), v=rows.v * factor, a=rows.a * factor**2)

        cause = Cause(about="time unit", what=what, do="Convert the time.", correction={"unit": {"time": (unit,)}})
        yield cause, now.after(change)


def _limits_allow(now: Comparison, own: np.ndarray) -> bool:
    """Whether positions of these joints may be others: the log breaks limits, or one of these has ten turns."""
    low, high = np.array([(x.lower, x.upper) for x in map(now.robot.joint, now.robot.joint_names)]).T
    return not ((now.rows.q >= low) & (now.rows.q <= high)).all() or bool((high - low > 40.0 * np.pi)[own].any())


SLOWEST, FASTEST = 1.0, 5500.0  # rates of logs [Hz] that need no other unit of time


def _delays(now: Comparison, inputs: CheckInput) -> Iterator[Candidate]:
    """Torques that are logged later or earlier, so that others need not explain it; `estimate_delay` measures it."""
    dense = inputs.compared
    if dense is None or not dense.time_ordered or now.shift:
        return
    for seconds in (-0.05, -0.03, -0.015, 0.01, 0.02, 0.03, 0.045, 0.07):
        yield Cause(about="delay", what="", numbers={"delay": seconds}), now.shifted(dense, seconds)


def _orders(now: Comparison, inputs: CheckInput, alive: np.ndarray) -> Iterator[Candidate]:
    """Torques under other joints; motions or all signals in an order that files have."""
    places = np.arange(now.rows.nv)
    live = places[alive]
    friction = [np.linalg.qr(np.c_[now.tau[:, [k]] - now.tau[:, k].mean(), now.friction[:, k]])[0] for k in live]
    u = now.rows.u[:, live] - now.rows.u[:, live].mean(axis=0)
    power = np.square(u).sum(axis=0)
    left = np.array([(power - np.square(basis.T @ u).sum(axis=0)) / power for basis in friction])
    order = places.copy()
    order[live] = live[linear_sum_assignment(np.log(np.maximum(left, 1e-4)))[1]]
    tried = [("u", order)]
    tried += [(signals, other) for other in _usual_orders(now.robot) for signals in ("qv", "qvu", "u")]
    for signals, other in tried:
        moved = other != places
        if moved.any() and alive[moved].all():
            yield _ordered(now, inputs, signals, other)


def _ordered(now: Comparison, inputs: CheckInput, signals: str, order: np.ndarray) -> Candidate:
    moved = order != np.arange(len(order))
    joints, owners = inputs.named(np.flatnonzero(moved)), inputs.named(order[moved])
    kind = {"u": "torques", "qv": "positions and velocities", "qvu": "all signals"}[signals]
    pairs = ", ".join(f"that of {one} stands under {other}" for one, other in zip(joints, owners, strict=True))
    cause = Cause(
        about="joints exchanged", what=f"{kind} stand under wrong joints: {pairs}",
        do="Correct the order of the columns, or the joint names of the log.", joints=_places(moved),
        numbers={"order": list(inputs.named(order))},
        correction={"order": dict.fromkeys(signals, tuple(order.tolist()))}, cost=NUMBER + SIGN * (signals != "u"),
    )  # fmt: skip
    if signals == "u":
        return cause, now.with_torques(changed("u", order))
    return cause, now.after(changed(signals.replace("v", "va"), order))


def _usual_orders(robot: Robot) -> list[np.ndarray]:
    """Reversed, by name, breadth first, and legs in other orders; each and its inverse, once."""
    parents, names, n = robot.layout.parents, robot.joint_names, len(robot.joint_names)
    depth, leg = np.zeros(n, int), np.zeros(n, int)
    if len(parents) == n:
        for k, parent in enumerate(parents):
            depth[k], leg[k] = (depth[parent] + 1, leg[parent]) if parent >= 0 else (0, leg.max() + 1)
    wide, found = np.argsort(depth, kind="stable"), [np.arange(n)[::-1], np.argsort(names)]
    for legs in list(permutations(np.unique(leg)))[:MOST_ORDERS] if len(np.unique(leg)) > 1 else []:
        by_leg = np.concatenate([np.flatnonzero(leg == one) for one in legs])
        found += [by_leg, by_leg[np.argsort(depth[by_leg], kind="stable")]]
    every = [order for one in (*found, wide) for order in (one, np.argsort(one))]
    return [np.array(order) for order in dict.fromkeys(tuple(order.tolist()) for order in every)]


def _motions(now: Comparison, inputs: CheckInput, bad: np.ndarray) -> Iterator[Candidate]:
    nv, remedy = len(inputs.names), "Turn the joint's axis in the URDF."
    joints = [k for k in range(nv) if nv <= ALL_TRIED or bad[k]]
    for joint in joints:
        name, factor = inputs.names[joint], np.where(np.arange(nv) == joint, -1.0, 1.0)
        for what, signals in (
            (f"positions and velocities of {name} have", "qv"),
            (f"the whole joint {name} (motion and torque) has", "qvu"),
        ):
            cause = Cause(
                about="motion sign", what=f"{what} the opposite sign of the URDF's", do=remedy, joints=(joint,),
                correction={"sign": dict.fromkeys(signals, tuple(factor))},
            )  # fmt: skip
            yield cause, now.after(changed(f"{signals}a", factor=factor))
    for pair in combinations([k for k in joints if bad[k]], 2):
        order = np.arange(nv)
        order[[*pair]] = order[[*pair[::-1]]]
        for signals in ("qv", "qvu"):
            yield _ordered(now, inputs, signals, order)


def _waves(x: np.ndarray) -> np.ndarray:
    return np.stack([x**0, np.cos(x), np.sin(x), np.cos(2 * x), np.sin(2 * x)], axis=1)


def _scanned(now: Comparison, inputs: CheckInput) -> Iterator[Candidate]:
    """A joint zero, a gear ratio or a length that leaves least; the best of all."""
    robot, rows, names = now.robot, now.rows, now.robot.joint_names
    zeros, turns = 2.0 * np.pi * np.arange(5) / 5.0, np.linspace(-np.pi, np.pi, 721)
    waves, parts = _waves(turns) @ np.linalg.inv(_waves(zeros)), np.array([0.5, 1.0, 2.0])
    parabolas = np.vander(FACTORS, 3) @ np.linalg.inv(np.vander(parts, 3))
    laws, found = now.tau - needed_torques(robot, rows), list[tuple[float, Cause, Callable[[], Comparison]]]()

    def best(taus: Sequence[np.ndarray] | np.ndarray, weights: np.ndarray, values: np.ndarray) -> tuple[float, float]:
        left = left_of(now, np.stack([now.rows.u, *(laws + tau for tau in taus)]), weights)
        at = int(np.argmin(left))
        return (float(left[at]), float(values[at])) if 0 < at < len(values) - 1 else (np.inf, 0.0)

    def moved(joint: int, x: float) -> Change:
        return lambda rows: replace(changed()(rows), q=rows.q + x * np.eye(rows.nv)[joint])

    def geared(joint: int, x: float, power: float = 0.0) -> Change:
        """Motion times x, and torque times x^power: a ratio through which both were computed keeps their product."""
        moved, turned = changed("qva", factor=scaled(joint, x)), changed("u", factor=scaled(joint, x**power))
        return lambda rows: turned(moved(rows))

    def scaled(joint: int, factors: np.ndarray | float) -> Float[np.ndarray, "*ratios nv"]:
        return np.where(np.arange(rows.nv) == joint, factors, 1.0)

    @cache
    def geared_torques(joint: int, middle: float, step: float) -> Float[np.ndarray, "ratios rows nv"]:
        factors = scaled(joint, middle * RATIOS[:, None, None] ** step)
        return inverse_dynamics(robot, *(factors * x for x in (rows.q, rows.v, rows.a)))

    for joint in _places(inputs.rotates):
        there = rows.q + zeros[:, None, None] * np.eye(rows.nv)[joint]
        left, x = best(inverse_dynamics(robot, there, rows.v, rows.a), waves, turns)
        what = (
            f"the torques fit positions of {names[joint]} that are {x:+.3g} rad ({x / DEGREE:+.0f} degrees) from the "
            "logged ones: its zero is elsewhere"
        )
        do = f"Add it to the column, as in forcegp import --q 'COLUMN {x:+.3g}', or correct the URDF; "
        do += "about the axis of a first joint it may be the base that is turned."
        if abs(x) > 0.05:
            cause = number("joint zero", what, joint, x, NUMBER + 0.3, do=do)
            found.append((left, cause, lambda joint=joint, x=x: now.after(moved(joint, x))))
    for joint, power in product(np.flatnonzero(np.ptp(rows.q, axis=0) > 0.0).tolist(), (0.0, -1.0)):
        left, x = np.inf, 1.0
        for step in (1.0, 0.1):
            middle, every = x or 1.0, (x or 1.0) * RATIOS**step
            turned = scaled(joint, every[:, None, None] ** -power)  # so that it is what u would have to be
            left, x = best(geared_torques(joint, middle, step) * turned, np.eye(len(every)), every)
        beside = f", and {1.0 / x:.4g} times its torques" if power and x else ""
        what = f"the torques fit positions and velocities of {names[joint]} that are {x:.4g} times the logged ones"
        do = f"Correct its gear ratio, or the columns, as in forcegp import --q 'COLUMN * {x:.4g}'."
        if beside:
            do = f"{do[:-1]}, and forcegp import --u 'COLUMN * {1.0 / x:.4g}'."
        if x > 0.0 and abs(np.log(x)) > 0.05:
            cause = number("gear ratio", what + beside, joint, x, NUMBER + (0.1 if power else 0.4), do=do)
            found.append((left, cause, lambda joint=joint, x=x, power=power: now.after(geared(joint, x, power))))
    for body, drive in enumerate(robot.layout.drives):
        length = float(torch.linalg.vector_norm(robot.tree.rest[body, :3, 3, 0]))
        if length == 0.0 or robot.layout.parents[body] < 0:
            continue  # where the whole robot stands changes nothing
        left, x = best([needed_torques(with_length(robot, body, y), rows) for y in parts], parabolas, FACTORS)
        what = f"the torques fit {x:.3g} times the length from {names[drive.joint]} to the joint before "
        what += f"({x * length:.3g} instead of {length:.3g} m)"
        if abs(np.log(max(x, 1e-9))) > 0.05:
            cause = number("lengths", what, drive.joint, x, NUMBER + 0.2)
            found.append((left, cause, lambda x=x, b=body: now.after(changed(), with_length(robot, b, x))))
    for _, cause, made in sorted(found, key=lambda each: each[0])[:SCANNED]:
        yield cause, made()


def _linear(now: Comparison, inputs: CheckInput) -> Iterator[Candidate]:
    """Numbers of which torques are linear: gravity, a payload, masses, springs."""
    robot, rows, names, layout = now.robot, now.rows, now.robot.joint_names, now.robot.layout
    q, v, a = (torch.tensor(x, device=robot.device) for x in (rows.q, rows.v, rows.a))

    def per_parameter(robot: Robot) -> Float[np.ndarray, "rows nv bodies 10"]:
        """Torques per unit of the standard parameters of each body."""
        with torch.no_grad():
            return replace(kinematics, robot=robot).torque_regressor(a).cpu().numpy()

    with torch.no_grad():
        kinematics = robot.kinematics(q, v)
        along = (replace(kinematics, robot=with_gravity(robot, axis)) for axis in np.eye(3))
        pulls = np.stack([each.gravity_forces().cpu().numpy() for each in along], axis=-1)
        frames = torch.tensor(np.linalg.inv(layout.child_frames), device=robot.device)
        bodies = frames @ robot.tree.inertias[..., 0] @ frames.mT
    columns_of = per_parameter(robot)
    ends = [body for body in range(len(layout.bodies)) if body not in layout.parents]
    yield from _gravities(now, pulls, ends[:MOST_ENDS], lambda robot: per_parameter(robot)[..., :4])
    for body, (joint, drive) in enumerate(zip(layout.bodies, layout.drives, strict=True)):
        P = bodies[body]
        size = float(P[3, 3])
        if body in ends:  # in kg and kg m, or in masses of the link
            unit = size or 1.0
            for when, part, cost, told in loads(now, inputs, unit * columns_of[:, :, body, :4]):
                held = solved(now, part)
                if held is None or held[0] <= 0.0:
                    continue
                center = held[1:] / held[0]
                at = ", ".join(f"{1e3 * x:.3g}" for x in center)
                text = f"the torques fit {unit * held[0]:.3g} kg more at ({at}) mm of {joint.child}{when}"
                numbers = {"mass": unit * float(held[0]), "center_of_mass": center.tolist()}
                if told:
                    numbers["seconds"] = list(told.pop("seconds"))
                cause = number("load" if told else "payload", text, drive.joint, 0.0, cost, numbers=numbers, **told)
                yield cause, replace(now, more=now.more + part @ held)
        if size <= 0.0:
            continue
        for part in (P, torch.outer(P[:, 3], P[:, 3]) / size):  # with its inertia, and the mass alone
            column = columns_of[:, :, body] @ standard_of_pseudo_inertia(part).cpu().numpy()
            one = solved(now, column[..., None])
            if one is not None and abs(one[0]) > 0.1 and -0.9 < one[0] < 9.0:
                text = f"the torques fit a mass of {joint.child} of {1.0 + one[0]:.3g} times that of the URDF"
                cause = number("masses", text, drive.joint, 1.0 + float(one[0]))
                yield cause, replace(now, more=now.more + one[0] * column)
    for joint, drive in zip(layout.bodies, layout.drives, strict=True):  # what hangs at a hose or a cable
        R = kinematics.frame_pose(joint.child)[:, :3, :3].cpu().numpy()
        pull, at, columns = np.zeros(3), np.zeros(3), np.zeros((len(rows), rows.nv, 0))
        for _ in range(4):  # Gauss-Newton: the force at the point of before, and how far the point moves
            J = kinematics.frame_jacobian(joint.child, tuple(at)).cpu().numpy()
            turning = np.einsum("nkj,nik->nji", J[:, 3:], np.cross(R.swapaxes(1, 2), pull))
            columns = -np.concatenate([J[:, :3].swapaxes(1, 2), turning], axis=-1)
            if (found := solved(now, columns)) is None:
                break
            pull, at = found[:3], at + found[3:]
        size, down = float(np.linalg.norm(pull)), robot.gravity.cpu().numpy()
        if not 0.0 < size < np.inf or pull @ down > np.cos(ASIDE) * size * np.linalg.norm(down):
            continue  # the latter is a payload
        force, place = (", ".join(f"{x:.3g}" for x in values) for values in (pull, 1e3 * at))
        text = f"torques fit a constant force of ({force}) N at ({place}) mm of {joint.child}, as of a hose or a cable"
        told = {"do": PULLED, "numbers": {"force": pull.tolist(), "point": at.tolist(), "link": joint.child}}
        added = columns[..., :3] @ pull
        if np.diff(left_of(now, np.stack([now.rows.u, now.tau, now.tau + added]), np.eye(2)))[0] < 0.0:  # not astray
            yield number("pull", text, drive.joint, 0.0, 3.0 * NUMBER, **told), replace(now, more=now.more + added)
    for joint in range(rows.nv):
        only = (rows.q - rows.q.mean(axis=0)) * (np.arange(rows.nv) == joint)
        found = solved(now, only[..., None])
        if found is not None and found[0] > 0.0:
            unit = "Nm/rad" if inputs.rotates[joint] else "N/m"
            text = f"the torque of {names[joint]} rises with its position by {found[0]:.3g} {unit}, as a spring's"
            do = "Describe it as `spring` (forcegp fit --forces spring estimates it)."
            cause = number("spring", text, joint, float(found[0]), NUMBER + 0.2, do=do)
            yield cause, replace(now, more=now.more + found[0] * only)


def _gravities(
    now: Comparison,
    pulls: Float[np.ndarray, "rows nv 3"],
    ends: Sequence[int],
    of_loads: Callable[[Robot], Float[np.ndarray, "rows nv bodies 4"]],
) -> Iterator[Candidate]:
    """The gravity that the torques show: its direction, its size, or both, also beside a load, which would bend it."""
    nominal = now.robot.gravity.cpu().numpy()
    size, found = float(np.linalg.norm(nominal)), solved(now, pulls)
    if found is None:
        return
    estimate = nominal + found
    norm = float(np.linalg.norm(estimate))
    tried: list[tuple[np.ndarray, float, Any]] = [(estimate, 2.0 * NUMBER, 0.0)]
    if norm > 0.0 and size > 0.0:
        tried.append((size / norm * estimate, 1.5 * NUMBER, 0.0))
    for end in ends if norm > 0.0 and size > 0.0 else ():
        along, load = size / norm * estimate, None
        for _ in range(3):  # it weighs along the gravity that is sought
            columns = of_loads(with_gravity(now.robot, along))[:, :, end]
            both = solved(now, np.concatenate([pulls, columns], axis=-1))
            if both is None or both[3] <= 0.0:
                break
            along, load = nominal + both[:3], columns @ both[3:]
            along = size / float(np.linalg.norm(along)) * along
        else:
            tried.append((along, 4.0 * NUMBER, load))
    tried += [((size or 9.81) * sign * axis, NUMBER, 0.0) for axis in np.eye(3) for sign in (1.0, -1.0)]
    if size > 0.0:
        tried += [(0.0 * nominal, NUMBER, 0.0), (nominal * (estimate @ nominal) / size**2, NUMBER, 0.0)]
    for gravity, cost, load in tried:
        own = float(np.linalg.norm(gravity))
        angle = float(np.arccos(np.clip(gravity @ nominal / (own * size), -1.0, 1.0))) if own * size > 0.0 else 0.0
        usual = own / (size or 9.81)
        if (angle < TILTED and abs(own - size) < 0.1 * max(size, own)) or usual > HEAVIEST:
            continue
        text = ", ".join(f"{x + 0.0:.3g}" for x in gravity)
        beside = ", beside a load at the last link" if np.ndim(load) else ""
        away = f", {np.rad2deg(angle):.0f} degrees away: the base is mounted another way" if angle else ""
        cause = Cause(
            about="gravity", what=f"the torques fit gravity along ({text}) m/s² of the base far better{beside}{away}",
            do="Give it to `Robot.from_file`.",
            numbers={"gravity": gravity.tolist(), "degrees": float(np.rad2deg(angle))},
            correction={"gravity": {"base": tuple(round(float(x), 3) + 0.0 for x in gravity)}}, cost=cost, number=True,
        )  # fmt: skip
        there = now.after(changed(), with_gravity(now.robot, gravity))
        yield cause, replace(there, more=there.more + load)


def _places(chosen: np.ndarray) -> tuple[int, ...]:
    return tuple(np.flatnonzero(chosen).tolist())
