"""Doubts of the comparison of torques with inverse dynamics: wrong signs, joints, units; factor; delay; what is left.

Each hypothesis corrects one error in a log. That under which inverse dynamics fits the torques best is reported if it
leaves far less unexplained than the log as it is; then the next is sought, on top of it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, combinations
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from forcegp.checks.check_input import DEGREE, QUICK_ROWS, CheckInput
from forcegp.checks.torques import (
    TorqueFit,
    estimated_gravity,
    fit_torques,
    needed_torques,
    torques_of_laws,
    unexplained_shares,
    with_gravity,
)
from forcegp.data import Dataset, estimate_delay
from forcegp.data.dataset_fields import unit_of_each
from forcegp.doubts import Doubt, listed, look, ok, wrong
from forcegp.errors import DatasetError
from forcegp.forces import JointLaw
from forcegp.robots import Robot
from forcegp.summary import plain

SMALLEST = 1e-3  # unexplained shares below this are all the same: a log fits
GAIN = np.log(4.0)  # by which the product over all joints of what remains must fall at least
STILL_UNEXPLAINED = 0.6  # a joint of which more remains even then has not been explained
EXPLAINED = 0.1  # where no more than this remains in any joint there is nothing to explain
MAX_CORRECTIONS = 4
ALL_TRIED = 3  # joints up to which the motion of every one is tried in other directions and places
TILTED = np.deg2rad(15.0)  # angle from which a direction of gravity is reported


Change = Callable[[Dataset], Dataset]


def changed(signals: str = "", order: np.ndarray | None = None, factor: np.ndarray | float = 1.0) -> Change:
    """Every joint's signals from another column, times a factor.

    Without robot, truth and metadata, which belong to the log as it was.
    """

    def change(dataset: Dataset) -> Dataset:
        places = np.arange(dataset.nv) if order is None else order
        columns = {name: getattr(dataset, name)[:, places] * factor for name in signals}
        return replace(dataset, **columns, model=None, noise_std=None, truth={}, metadata={})

    return change


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypothesis:
    """A log with errors corrected: robot and laws, what was changed, rows compared, torques they need and the fit.

    `cost` is subtracted from what it explains: of two explanations the simpler one is reported. `concerns` are the
    joints that it must explain.
    """

    robot: Robot
    laws: tuple[JointLaw, ...]
    changes: tuple[Change, ...]
    rows: Dataset
    tau: Float[np.ndarray, "rows nv"]
    fit: TorqueFit
    doubt: Doubt | None = None
    cost: float = 0.0
    concerns: tuple[int, ...] = ()

    @classmethod
    def of(
        cls, robot: Robot, laws: tuple[JointLaw, ...], rows: Dataset, changes: tuple[Change, ...], **more: Any
    ) -> "Hypothesis":
        """The hypothesis whose last change is yet to be made in `rows`."""
        rows = changes[-1](rows)
        tau = needed_torques(robot, rows, laws)
        fit = fit_torques(robot, tau, rows)
        return cls(robot=robot, laws=laws, changes=changes, rows=rows, tau=tau, fit=fit, **more)

    def tried(
        self, change: Change, robot: Robot | None = None, cost: float = 0.0, concerns: tuple[int, ...] = (), **said: Any
    ) -> "Hypothesis":
        """With one more change, or under another robot, and the doubt that says so."""
        more = {"cost": cost, "concerns": concerns, "doubt": wrong(**said)}
        return Hypothesis.of(robot or self.robot, self.laws, self.rows, (*self.changes, change), **more)

    def applied(self, dataset: Dataset) -> Dataset:
        """The same changes of another dataset."""
        for change in self.changes:
            dataset = change(dataset)
        return dataset

    def without_laws(self, rows: Dataset) -> Dataset:
        """Rows whose u lacks what the known laws need."""
        return replace(rows, u=rows.u - torques_of_laws(self.robot, rows, self.laws)) if self.laws else rows

    @property
    def score(self) -> float:
        """Logarithm of what remains unexplained, over all joints."""
        known = self.fit.unexplained[np.isfinite(self.fit.unexplained)]
        return float(np.log(np.maximum(known, SMALLEST)).sum())


def best_hypothesis(inputs: CheckInput) -> tuple[Hypothesis, list[Doubt]]:
    """The corrected log and one doubt for each correction, chosen greedily. Needs a robot, without contacts."""
    assert inputs.robot is not None
    now = Hypothesis.of(inputs.robot, inputs.laws, inputs.rows(), (changed(),))
    found: list[Doubt] = []
    for _ in range(MAX_CORRECTIONS):
        if not np.nanmax(now.fit.unexplained, initial=0.0) > EXPLAINED:
            break
        candidates = chain(_of_torques(now, inputs), _of_motion(now, inputs), _of_gravity(now))
        best = max(candidates, key=lambda other: now.score - other.score - other.cost, default=None)
        if best is None or now.score - best.score - best.cost < GAIN or not _explains(now, best):
            break
        assert best.doubt is not None
        found.append(best.doubt)
        now = replace(best, doubt=None, cost=0.0, concerns=())
    return now, found


def _explains(now: Hypothesis, best: Hypothesis) -> bool:
    """Whether every joint that the correction concerns is explained now, and none much worse than before."""
    before, after = now.fit.unexplained, best.fit.unexplained
    concerned = [joint for joint in best.concerns if np.isfinite(after[joint])]
    better = all(after[joint] < STILL_UNEXPLAINED and after[joint] < before[joint] for joint in concerned)
    known = np.isfinite(after)
    return better and bool((after[known] < np.maximum(2.0 * before[known], 0.1)).all())


def _of_torques(now: Hypothesis, inputs: CheckInput) -> Iterator[Hypothesis]:
    """All joints whose torque fits with the other sign, together; the assignment of torques that leaves least."""
    other = fit_torques(now.robot, now.tau, now.rows, -now.rows.u)
    with np.errstate(invalid="ignore"):
        turned = (other.unexplained < 0.5 * now.fit.unexplained) & (other.unexplained < STILL_UNEXPLAINED)
        turned &= now.fit.unexplained > SMALLEST
    if turned.any():
        joints, factor = inputs.named(_places(turned)), np.where(turned, -1.0, 1.0)
        yield now.tried(
            changed("u", factor=factor),
            concerns=_places(turned),
            about="torque sign",
            what=f"the torque of {'all joints' if turned.all() else listed(joints)} has the opposite sign of what the "
            f"motion needs ({_remains(now.fit, other, turned)}).",
            do="Turn the joint's whole motion if its axis in the URDF points the other way.",
            joints=joints,
            correction={"sign": {"u": tuple(factor)}},
        )
    left = unexplained_shares(now.robot, now.tau, now.rows)
    _, order = linear_sum_assignment(np.where(np.isfinite(left), np.log(np.clip(left, SMALLEST, 1.0)), 0.0))
    moved = order != np.arange(len(order))
    if moved.any():
        joints, owners = inputs.named(_places(moved)), inputs.named(order[moved])
        places = ", ".join(f"that of {one} stands under {other}" for one, other in zip(joints, owners, strict=True))
        after = fit_torques(now.robot, now.tau, now.rows, now.rows.u[:, order])
        yield now.tried(
            changed("u", order),
            cost=0.5,
            concerns=_places(moved),
            about="joints exchanged",
            what=f"torques stand under wrong joints: {places} ({_remains(now.fit, after, moved)}).",
            do="Correct the order of the torque columns.",
            joints=joints,
            numbers={"order": list(inputs.named(order))},
            correction={"order": {"u": tuple(order.tolist())}},
        )


def _of_motion(now: Hypothesis, inputs: CheckInput) -> Iterator[Hypothesis]:
    """Angles in degrees; one joint in the other direction; two joints in each other's place.

    Of many joints only those that fit badly are tried: an error in their own motion is possible.
    """
    nv, largest = len(inputs.names), np.abs(now.rows.q * inputs.rotates).max()
    few, places = nv <= ALL_TRIED, np.arange(nv)
    of_one = [inputs.rotates & (places == joint) for joint in places] if few and inputs.rotates.sum() > 1 else []
    for turned in [inputs.rotates, *of_one] if largest > 1.0 else []:  # less than a degree is not worth the question
        if turned.any():
            yield now.tried(
                changed("qva", factor=np.where(turned, DEGREE, 1.0)),
                cost=0.0 if turned.all() else 0.5,
                about="degrees",
                what=f"positions reach {largest:.4g}; taken for degrees, they fit the torques far better than taken "
                "for radians.",
                do="Use np.deg2rad.",
                joints=inputs.named(_places(turned)),
                correction={"unit": {name: _degrees(inputs.log, name, turned) for name in "qv"}},
            )
    tried = [joint for joint in range(nv) if few or bool(now.fit.unexplained[joint] > EXPLAINED)]
    for joint in tried:
        name, factor = inputs.names[joint], np.where(places == joint, -1.0, 1.0)
        for what, signals in (
            (f"positions and velocities of {name} have", "qv"),
            (f"the whole joint {name} (motion and torque) has", "qvu"),
        ):
            yield now.tried(
                changed(f"{signals}a", factor=factor),
                cost=1.0,
                about="motion sign",
                what=f"{what} the opposite sign of the URDF's.",
                do="Turn the joint's axis in the URDF.",
                joints=(name,),
                correction={"sign": dict.fromkeys(signals, tuple(factor))},
            )
    for one, other in combinations(tried, 2):
        order = places.copy()
        order[[one, other]] = order[[other, one]]
        for what, signals in (("positions and velocities", "qv"), ("all signals", "qvu")):
            yield now.tried(
                changed(f"{signals}a", order),
                cost=1.0,
                about="joints exchanged",
                what=f"{what} of {listed(inputs.named((one, other)))} stand in each other's place.",
                do="Correct the order of the columns, or the joint names of the log.",
                joints=inputs.named((one, other)),
                correction={"order": dict.fromkeys(signals, tuple(order.tolist()))},
            )


def _of_gravity(now: Hypothesis) -> Iterator[Hypothesis]:
    """The direction of gravity that the torques show: along an axis of the base, or as estimated."""
    nominal = now.robot.gravity.cpu().numpy()
    size = float(np.linalg.norm(nominal))
    estimated = estimated_gravity(now.robot, now.rows, now.tau, now.fit)
    if estimated is None or size == 0.0:
        return
    directions = [(sign * axis, 1.0) for axis in np.eye(3) for sign in (1.0, -1.0)]
    directions.append((estimated / np.linalg.norm(estimated), 1.5))  # a base along its axes is the likelier one
    for direction, cost in directions:
        angle = float(np.arccos(np.clip(direction @ nominal / size, -1.0, 1.0)))
        if angle < TILTED:
            continue
        gravity = size * direction
        text = ", ".join(f"{value + 0.0:.3g}" for value in gravity)
        yield now.tried(
            changed(),
            with_gravity(now.robot, gravity),
            cost=cost,
            about="gravity",
            what=f"the torques fit gravity along ({text}) m/s² of the base far better than the assumed one, "
            f"{np.rad2deg(angle):.0f} degrees away: the base is mounted another way.",
            do=f"Give `gravity`={text.replace(' ', '')}.",
            numbers={"gravity": gravity.tolist(), "degrees": float(np.rad2deg(angle))},
        )


def _degrees(given: Dataset, signal: str, turned: np.ndarray) -> tuple[str, ...]:
    """The unit of the signal of every joint, with degrees where `turned`."""
    each = zip(unit_of_each(signal, given.units[signal], given.nv), turned, strict=True)
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


def torque_doubts(inputs: CheckInput, log: Hypothesis) -> Iterator[Doubt]:
    """Factor and unit, delay, and what remains unexplained, of a log with the errors corrected that were found."""
    for doubts in (_factors, _passive, _unexplained, _delays):
        yield from doubts(inputs, log)


def _factors(inputs: CheckInput, log: Hypothesis) -> Iterator[Doubt]:
    """Torques that are a multiple of what the motion needs."""
    fit = log.fit
    with np.errstate(invalid="ignore"):
        no_rotor = fit.plain < NO_WORSE * fit.unexplained + 0.02  # else a rotor inertia is missing, not a factor
        means = fit.rests_on_robot & no_rotor
        ratio = np.where(means, np.maximum(fit.factor, 1.0 / np.maximum(fit.factor, 1e-300)), 1.0)
    off = np.flatnonzero(ratio > ROUGHLY)
    if not len(off):
        return
    joints = inputs.named(off)
    factors = fit.factor[off]
    common = float(np.exp(np.log(factors).mean()))
    alike = len(off) == int(means.sum()) and len(off) > 1 and np.ptp(np.log(factors)) < SAME
    each = ", ".join(f"{name} {value:.4g}" for name, value in zip(joints, factors, strict=True))
    seen = f"the measured torque is a multiple of what the motion needs: {each}."
    remedy = (
        "One factor for all joints points to the unit of u or to wrong masses; compare with the data sheet."
        if alike
        else "A factor that differs between joints points to torque before the gears (multiply by the gear ratio), "
        "motor current (multiply by the torque constant), a rotor inertia that is missing, or wrong masses; "
        "compare with the data sheet."
    )
    correction: dict[str, dict[str, tuple[str, ...]]] = {}
    for unit, size in (("kNm", 1e-3), ("mNm", 1e3)):
        if np.abs(np.log(factors / size)).max() < np.log(ROUGHLY):
            what = f"the measured torque of {listed(joints)} is {common:.4g} times what the motion needs"
            seen = f"{what}: it looks like {unit}."
            remedy = "Use a factor." if alike else f"forcegp import --unit u={unit}, or a factor."
            correction = {"unit": {"u": (unit,)}} if alike else {}
    yield Doubt(
        level="wrong" if factors.min() < 1.0 / FAR or factors.max() > MUCH_MORE else "look",
        about="torque unit",
        what=seen,
        do=remedy,
        joints=joints,
        numbers={"factor": dict(zip(joints, factors.tolist(), strict=True))},
        correction=correction,
    )


def _passive(inputs: CheckInput, log: Hypothesis) -> Iterator[Doubt]:
    """Joints whose torque is zero throughout although the motion needs one."""
    for joint, name in enumerate(inputs.names):
        u, tau = log.rows.u[:, joint], log.tau[:, joint]
        if np.ptp(inputs.log.u[:, joint]) > 0.0 or not inputs.log.u.any():
            continue
        others = [np.std(log.tau[:, other]) for other in range(len(inputs.names)) if np.ptp(log.rows.u[:, other]) > 0]
        if np.std(tau) > 0.1 * max(others, default=np.inf):
            yield wrong(
                about="dead torque",
                what=f"the torque of {name} is {u[0]:.4g} in every row, but the motion needs one of "
                f"{np.std(tau):.3g} {'Nm' if inputs.rotates[joint] else 'N'} rms.",
                do="The channel is dead, unless the joint has no motor and the URDF is wrong.",
                joints=(name,),
                numbers={"needed": float(np.std(tau))},
            )


def _unexplained(inputs: CheckInput, log: Hypothesis) -> Iterator[Doubt]:
    """How well the torques fit at all."""
    left = log.fit.unexplained
    known = np.isfinite(left)
    if not known.any():
        return
    worst = int(np.nanargmax(left))
    bad = np.flatnonzero(known & (left > UNEXPLAINED))
    if not len(bad):
        seen = (
            f"inverse dynamics with a factor and friction leaves at most {100.0 * left[worst]:.2g} % of the variance "
        )
        yield ok(about="torque", what=f"{seen}of a torque unexplained ({inputs.names[worst]}).")
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


def _delays(inputs: CheckInput, log: Hypothesis) -> Iterator[Doubt]:
    assert inputs.compared is not None
    if inputs.prepared is None:
        return  # without an order
    data = log.without_laws(log.applied(inputs.even if inputs.most_rows == QUICK_ROWS else inputs.prepared))
    try:
        delay = estimate_delay(data, log.robot)
    except DatasetError:
        return  # too short
    step = float(np.median(np.diff(inputs.even.time)))
    seconds, remains = delay.significant, delay.remains
    if abs(seconds) > LEAST_DELAY * step:
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


def not_compared(inputs: CheckInput) -> Doubt:
    """The doubt where torques cannot be compared."""
    if inputs.contacts:
        return ok(
            about="torque",
            what="not compared with inverse dynamics: the robot touches something, and the forces of contacts are not "
            "known. Check a log of free motion, too.",
        )
    seen = "not compared with inverse dynamics: no robot was given."
    return look(about="torque", what=seen, do="Give the robot: `model`.")
