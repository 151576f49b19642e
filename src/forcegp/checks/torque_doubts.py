"""Doubts of the comparison of torques with inverse dynamics: wrong signs, joints, units; factor; delay; what is left.

The correction of one error that leaves far less unexplained is reported; then the next is sought, on top of it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, combinations
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from forcegp.checks.check_input import DEGREE, QUICK_ROWS, CheckInput
from forcegp.checks.torques import Change, Comparison, TorqueFit, estimated_gravity, with_gravity
from forcegp.data import Dataset, estimate_delay
from forcegp.doubts import Doubt, listed, look, ok, wrong
from forcegp.errors import DatasetError
from forcegp.model import Model
from forcegp.summary import plain

SMALLEST = 1e-3  # unexplained shares below this are all the same: a log fits
GAIN = np.log(4.0)  # by which the product over all joints of what remains must fall at least
STILL_UNEXPLAINED = 0.6  # a joint of which more remains even then has not been explained
EXPLAINED = 0.1  # where no more than this remains in any joint there is nothing to explain
MAX_CORRECTIONS = 4
ALL_TRIED = 3  # joints up to which the motion of every one is tried in other directions and places
TILTED = np.deg2rad(15.0)  # angle from which a direction of gravity is reported


@dataclass(frozen=True, eq=False)
class Explanation:
    """A log with one more error corrected, and the doubt that says so.

    `cost` is subtracted from what it explains: of two explanations the simpler one is reported. It must explain the
    joints that it `concerns`.
    """

    log: Comparison
    doubt: Doubt
    cost: float = 0.0
    concerns: tuple[int, ...] = ()

    def gain(self, now: Comparison) -> float:
        """By how much the logarithm of what remains unexplained falls, over all joints."""
        return _score(now.fit) - _score(self.log.fit) - self.cost

    def explains(self, now: Comparison) -> bool:
        """Whether every joint that it concerns is explained now, and none much worse than before."""
        before, after = now.fit.unexplained, self.log.fit.unexplained
        known = np.isfinite(after)
        better = all(after[k] < STILL_UNEXPLAINED and after[k] < before[k] for k in self.concerns if known[k])
        return better and bool((after[known] < np.maximum(2.0 * before[known], 0.1)).all())


def _score(fit: TorqueFit) -> float:
    known = fit.unexplained[np.isfinite(fit.unexplained)]
    return float(np.log(np.maximum(known, SMALLEST)).sum())


def changed(signals: str = "", order: np.ndarray | None = None, factor: np.ndarray | float = 1.0) -> Change:
    """Every joint's signals from another column, times a factor.

    Without forces, truth and metadata, which belong to the log as it was.
    """

    def change(dataset: Dataset) -> Dataset:
        places = np.arange(dataset.nv) if order is None else order
        columns = {name: getattr(dataset, name)[:, places] * factor for name in signals}
        return replace(dataset, **columns, model=Model(dataset.model.robot), noise_std=None, truth={}, metadata={})

    return change


def corrected(inputs: CheckInput) -> tuple[Comparison, list[Doubt]]:
    """The corrected log and one doubt for each correction, chosen greedily. Needs a robot, without contacts."""
    now = Comparison(robot=inputs.robot, laws=inputs.laws, rows=inputs.rows()).after(changed())
    found: list[Doubt] = []
    for _ in range(MAX_CORRECTIONS):
        if not np.nanmax(now.fit.unexplained, initial=0.0) > EXPLAINED:
            break
        explanations = chain(_of_torques(now, inputs), _of_motion(now, inputs), _of_gravity(now))
        best = max(explanations, key=lambda each: each.gain(now), default=None)
        if best is None or best.gain(now) < GAIN or not best.explains(now):
            break
        found.append(best.doubt)
        now = best.log
    return now, found


def _of_torques(now: Comparison, inputs: CheckInput) -> Iterator[Explanation]:
    """All joints whose torque fits with the other sign, together; the assignment of torques that leaves least."""
    other = now.fit_of(-now.rows.u)
    with np.errstate(invalid="ignore"):
        turned = (other.unexplained < 0.5 * now.fit.unexplained) & (other.unexplained < STILL_UNEXPLAINED)
        turned &= now.fit.unexplained > SMALLEST
    if turned.any():
        joints, factor = inputs.named(_places(turned)), np.where(turned, -1.0, 1.0)
        doubt = wrong(
            about="torque sign",
            what=f"the torque of {'all joints' if turned.all() else listed(joints)} has the opposite sign of what the "
            f"motion needs ({_remains(now.fit, other, turned)}).",
            do="Turn the joint's whole motion if its axis in the URDF points the other way.",
            joints=joints,
            correction={"sign": {"u": tuple(factor)}},
        )
        yield Explanation(now.after(changed("u", factor=factor)), doubt, concerns=_places(turned))
    left = now.shares()
    _, order = linear_sum_assignment(np.where(np.isfinite(left), np.log(np.clip(left, SMALLEST, 1.0)), 0.0))
    moved = order != np.arange(len(order))
    if moved.any():
        joints, owners = inputs.named(_places(moved)), inputs.named(order[moved])
        places = ", ".join(f"that of {one} stands under {other}" for one, other in zip(joints, owners, strict=True))
        log = now.after(changed("u", order))
        doubt = wrong(
            about="joints exchanged",
            what=f"torques stand under wrong joints: {places} ({_remains(now.fit, log.fit, moved)}).",
            do="Correct the order of the torque columns.",
            joints=joints,
            numbers={"order": list(inputs.named(order))},
            correction={"order": {"u": tuple(order.tolist())}},
        )
        yield Explanation(log, doubt, 0.5, _places(moved))


def _of_motion(now: Comparison, inputs: CheckInput) -> Iterator[Explanation]:
    """Angles in degrees; a joint in the other direction; two exchanged; of many joints those that fit badly."""
    nv, largest = len(inputs.names), np.abs(now.rows.q * inputs.rotates).max()
    few, places = nv <= ALL_TRIED, np.arange(nv)

    def tried(change: Change, cost: float, about: str, what: str, do: str, joints: Any, **correction: Any) -> Any:
        doubt = wrong(about=about, what=what, do=do, joints=inputs.named(joints), correction=correction)
        return Explanation(now.after(change), doubt, cost)

    of_one = [inputs.rotates & (places == joint) for joint in places] if few and inputs.rotates.sum() > 1 else []
    for turned in [inputs.rotates, *of_one] if largest > 1.0 else []:  # less than a degree is not worth the question
        if turned.any():
            change, cost = changed("qva", factor=np.where(turned, DEGREE, 1.0)), 0.0 if turned.all() else 0.5
            what = f"positions reach {largest:.4g}; taken for degrees, they fit the torques far better than taken "
            unit = {name: _degrees(inputs, name, turned) for name in "qv"}
            yield tried(change, cost, "degrees", f"{what}for radians.", "Use np.deg2rad.", _places(turned), unit=unit)
    joints = [joint for joint in range(nv) if few or bool(now.fit.unexplained[joint] > EXPLAINED)]
    for joint in joints:
        name, factor = inputs.names[joint], np.where(places == joint, -1.0, 1.0)
        for what, signals in (
            (f"positions and velocities of {name} have", "qv"),
            (f"the whole joint {name} (motion and torque) has", "qvu"),
        ):
            what, remedy = f"{what} the opposite sign of the URDF's.", "Turn the joint's axis in the URDF."
            sign = dict.fromkeys(signals, tuple(factor))
            yield tried(changed(f"{signals}a", factor=factor), 1.0, "motion sign", what, remedy, [joint], sign=sign)
    remedy = "Correct the order of the columns, or the joint names of the log."
    for pair in combinations(joints, 2):
        order = places.copy()
        order[[*pair]] = order[[*pair[::-1]]]
        for what, signals in (("positions and velocities", "qv"), ("all signals", "qvu")):
            what = f"{what} of {listed(inputs.named(pair))} stand in each other's place."
            places_of = dict.fromkeys(signals, tuple(order.tolist()))
            change = changed(f"{signals}a", order)
            yield tried(change, 1.0, "joints exchanged", what, remedy, pair, order=places_of)


def _of_gravity(now: Comparison) -> Iterator[Explanation]:
    """The direction of gravity that the torques show: along an axis of the base, or as estimated."""
    nominal = now.robot.gravity.cpu().numpy()
    size = float(np.linalg.norm(nominal))
    estimated = estimated_gravity(now)
    if estimated is None or size == 0.0:
        return
    directions = [(sign * axis, 1.0) for axis in np.eye(3) for sign in (1.0, -1.0)]
    directions.append((estimated / np.linalg.norm(estimated), 1.5))  # a base along its axes is the likelier one
    for direction, cost in directions:
        angle = float(np.arccos(np.clip(direction @ nominal / size, -1.0, 1.0)))
        if angle < TILTED:
            continue
        gravity, degrees = size * direction, float(np.rad2deg(angle))
        text = ", ".join(f"{value + 0.0:.3g}" for value in gravity)
        doubt = wrong(
            about="gravity",
            what=f"the torques fit gravity along ({text}) m/s² of the base far better than the assumed one, "
            f"{degrees:.0f} degrees away: the base is mounted another way.",
            do=f"Give `gravity`={text.replace(' ', '')}.",
            numbers={"gravity": gravity.tolist(), "degrees": degrees},
        )
        yield Explanation(now.after(changed(), with_gravity(now.robot, gravity)), doubt, cost)


def _degrees(given: CheckInput, signal: str, turned: np.ndarray) -> tuple[str, ...]:
    """The unit of the signal of every joint, with degrees where `turned`."""
    each = zip(given.unit_of_each(signal), turned, strict=True)
    return tuple(unit.replace("rad", "deg") if degrees else unit for unit, degrees in each)


def _places(chosen: np.ndarray) -> tuple[int, ...]:
    return tuple(np.flatnonzero(chosen).tolist())


def _remains(before: TorqueFit, after: TorqueFit, joints: np.ndarray) -> str:
    """`then at most 2 % of it remains unexplained, instead of 98 %`."""
    then, now = (float(np.nanmax(fit.unexplained[joints])) for fit in (after, before))
    return f"then at most {100.0 * then:.2g} % of it remains unexplained, instead of {100.0 * now:.3g} %"


NO_WORSE = 2.0  # factor by which more may remain without a rotor inertia
ROUGHLY = 1.5  # factor either way that wrong inertias explain
FAR, MUCH_MORE = 3.0, 30.0  # that they do not: less torque than bodies need cannot be; more may be a rotor's inertia
SAME = 0.1  # spread of factors of joints that share a unit
UNEXPLAINED = 0.5
LEAST_DELAY = 0.75  # time steps below which a delay is not reported
MUCH = 0.5  # a delay that leaves less of what was unexplained is wrong to leave in


def torque_doubts(inputs: CheckInput, log: Comparison) -> list[Doubt]:
    """Factor and unit, dead torques, what remains unexplained, and delay, of a log whose errors were corrected."""
    return [doubt for of in (_factors, _passive, _unexplained, _delays) for doubt in of(inputs, log)]


def _factors(inputs: CheckInput, log: Comparison) -> Iterator[Doubt]:
    """Torques that are a multiple of what the motion needs."""
    fit = log.fit
    with np.errstate(invalid="ignore"):
        no_rotor = fit.plain < NO_WORSE * fit.unexplained + 0.02  # else a rotor inertia is missing, not a factor
        means = fit.rests_on_robot & no_rotor
        ratio = np.where(means, np.maximum(fit.factor, 1.0 / np.maximum(fit.factor, 1e-300)), 1.0)
    off = np.flatnonzero(ratio > ROUGHLY)
    if not len(off):
        return
    joints, factors = inputs.named(off), fit.factor[off]
    alike = len(off) == int(means.sum()) and len(off) > 1 and np.ptp(np.log(factors)) < SAME
    each = ", ".join(f"{name} {value:.4g}" for name, value in zip(joints, factors, strict=True))
    seen = f"the measured torque is a multiple of what the motion needs: {each}."
    remedy = "One factor for all joints points to the unit of u or to wrong masses; compare with the data sheet."
    if not alike:
        remedy = (
            "A factor that differs between joints points to torque before the gears (multiply by the gear ratio), "
            "motor current (multiply by the torque constant), a rotor inertia that is missing, or wrong masses; "
            "compare with the data sheet."
        )
    correction: dict[str, dict[str, tuple[str, ...]]] = {}
    for unit, size in (("kNm", 1e-3), ("mNm", 1e3)):
        if np.abs(np.log(factors / size)).max() < np.log(ROUGHLY):
            common = float(np.exp(np.log(factors).mean()))
            seen = f"the measured torque of {listed(joints)} is {common:.4g} times what the motion needs"
            seen, remedy = f"{seen}: it looks like {unit}.", f"forcegp import --unit u={unit}, or a factor."
            if alike:
                remedy, correction = "Use a factor.", {"unit": {"u": (unit,)}}
    yield Doubt(
        level="wrong" if factors.min() < 1.0 / FAR or factors.max() > MUCH_MORE else "look",
        about="torque unit",
        what=seen,
        do=remedy,
        joints=joints,
        numbers={"factor": dict(zip(joints, factors.tolist(), strict=True))},
        correction=correction,
    )


def _passive(inputs: CheckInput, log: Comparison) -> Iterator[Doubt]:
    """Joints whose torque is zero throughout although the motion needs one."""
    moves, needed = np.ptp(log.rows.u, axis=0) > 0.0, np.std(log.tau, axis=0)
    dead = (np.ptp(inputs.log.u, axis=0) == 0.0) & (needed > 0.1 * needed[moves].max(initial=0.0))
    for joint in np.flatnonzero(dead) if moves.any() else ():
        yield wrong(
            about="dead torque",
            what=f"the torque of {inputs.names[joint]} is {log.rows.u[0, joint]:.4g} in every row, but the motion "
            f"needs one of {needed[joint]:.3g} {'Nm' if inputs.rotates[joint] else 'N'} rms.",
            do="The channel is dead, unless the joint has no motor and the URDF is wrong.",
            joints=(inputs.names[joint],),
            numbers={"needed": float(needed[joint])},
        )


def _unexplained(inputs: CheckInput, log: Comparison) -> Iterator[Doubt]:
    """How well the torques fit at all."""
    left = log.fit.unexplained
    if not np.isfinite(left).any():
        return
    worst = int(np.nanargmax(left))
    bad = np.flatnonzero(np.nan_to_num(left) > UNEXPLAINED)
    if not len(bad):
        seen = f"inverse dynamics with a factor and friction leaves at most {100.0 * left[worst]:.2g} % of the variance"
        yield ok(about="torque", what=f"{seen} of a torque unexplained ({inputs.names[worst]}).")
        return
    shares = ", ".join(f"{inputs.names[k]} {100.0 * left[k]:.0f} %" for k in bad)
    yield look(
        about="torque",
        what=f"most of some torques is not what inverse dynamics with a factor and friction gives: {shares} of "
        "their variance.",
        do="The channel, unit or zero may be wrong, the joint may be held or touch something, or its torque is "
        "nearly all friction or noise.",
        joints=inputs.named(bad),
        numbers={"unexplained": plain(left[bad])},
    )


def _delays(inputs: CheckInput, log: Comparison) -> Iterator[Doubt]:
    if inputs.prepared is None:
        return  # without an order
    data = log.changed(inputs.even if inputs.most_rows == QUICK_ROWS else inputs.prepared)
    try:
        delay = estimate_delay(replace(data, model=Model(log.robot)))
    except DatasetError:
        return  # too short
    seconds, remains = delay.significant, delay.remains
    if abs(seconds) > LEAST_DELAY * float(np.median(np.diff(inputs.even.time))):
        late = "later" if seconds > 0.0 else "earlier"
        yield Doubt(
            level="wrong" if remains < MUCH else "look",
            about="delay",
            what=f"the torque of all joints is logged {1e3 * abs(seconds):.1f} ms ± {1e3 * delay.common_std:.1f} ms "
            f"{late} than the motion needs it; shifted, {100.0 * remains:.0f} % of what was unexplained remains.",
            do="forcegp import --delay auto; a filter of the robot's own, of the torque or of the motion, does this.",
            joints=inputs.names,
            numbers={"delay": seconds, "std": delay.common_std, "remains": remains, "per_joint": plain(delay.seconds)},
        )


TOUCHES = ok(
    about="torque",
    what="not compared with inverse dynamics: the robot touches something, and the forces of contacts are not known. "
    "Check free motion, too.",
)
