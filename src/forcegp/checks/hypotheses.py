"""Hypotheses about errors in a log: wrong signs, exchanged joints, wrong units, a wrong direction of gravity.

Each hypothesis corrects one error. The hypothesis under which inverse dynamics fits the torques best is reported if it
leaves far less unexplained than the log as it is; then the next is sought, on top of it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, combinations
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from forcegp.checks.check_input import DEGREE, CheckInput
from forcegp.checks.torques import (
    TorqueFit,
    estimated_gravity,
    fit_torques,
    needed_torques,
    torques_of_laws,
    unexplained_shares,
    with_gravity,
)
from forcegp.data import Dataset
from forcegp.data.dataset_fields import unit_of_each
from forcegp.doubts import Doubt, listed, wrong
from forcegp.forces import JointLaw
from forcegp.robots import Robot

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
        tried = (_torque_signs, _torque_places, _motion_units, _motion_signs, _motion_places, _gravity)
        candidates = chain.from_iterable(candidates(now, inputs) for candidates in tried)
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


def _torque_signs(now: Hypothesis, inputs: CheckInput) -> Iterator[Hypothesis]:
    """All joints whose torque fits with the other sign, together."""
    other = fit_torques(now.robot, now.tau, now.rows, -now.rows.u)
    with np.errstate(invalid="ignore"):
        turned = (other.unexplained < 0.5 * now.fit.unexplained) & (other.unexplained < STILL_UNEXPLAINED)
        turned &= now.fit.unexplained > SMALLEST
    if not turned.any():
        return
    joints, factor = inputs.named(_places(turned)), np.where(turned, -1.0, 1.0)
    signs = {"sign": {"u": tuple(factor)}}
    yield now.tried(
        changed("u", factor=factor),
        concerns=_places(turned),
        about="torque sign",
        what=f"the torque of {'all joints' if turned.all() else listed(joints)} has the opposite sign of what the "
        f"motion needs ({_remains(now.fit, other, turned)}).",
        do="Turn the joint's whole motion if its axis in the URDF points the other way.",
        joints=joints,
        correction=signs,
    )


def _torque_places(now: Hypothesis, inputs: CheckInput) -> Iterator[Hypothesis]:
    """Torques in the places of other joints: the assignment that leaves least unexplained."""
    left = unexplained_shares(now.robot, now.tau, now.rows)
    table = np.where(np.isfinite(left), np.log(np.clip(left, SMALLEST, 1.0)), 0.0)
    _, order = linear_sum_assignment(table)
    moved = order != np.arange(len(order))
    if not moved.any():
        return
    joints, owners = inputs.named(_places(moved)), inputs.named(order[moved])
    better = now.tried(
        changed("u", order),
        cost=0.5,
        concerns=_places(moved),
        about="joints exchanged",
        what="torques stand under wrong joints: "
        + ", ".join(f"that of {joint} stands under {owner}" for joint, owner in zip(joints, owners, strict=True)),
        do="Correct the order of the torque columns.",
        joints=joints,
        numbers={"order": list(inputs.named(order))},
        correction={"order": {"u": tuple(int(place) for place in order)}},
    )
    assert better.doubt is not None
    seen = f"{better.doubt.what} ({_remains(now.fit, better.fit, moved)})."
    yield replace(better, doubt=replace(better.doubt, what=seen))


def _motion_units(now: Hypothesis, inputs: CheckInput) -> Iterator[Hypothesis]:
    """Angles in degrees."""
    largest = np.abs(now.rows.q * inputs.rotates).max()
    places = np.arange(len(inputs.names))
    if largest > 1.0:  # less than a degree of motion is not worth the question
        for turned in [inputs.rotates, *(inputs.rotates & (places == joint) for joint in places)]:
            alone = turned is not inputs.rotates
            if not turned.any() or (alone and (inputs.rotates.sum() == 1 or len(places) > ALL_TRIED)):
                continue
            units = {"unit": {name: _degrees(inputs.log, name, turned) for name in "qv"}}
            yield now.tried(
                changed("qva", factor=np.where(turned, DEGREE, 1.0)),
                cost=0.0 if turned.all() else 0.5,
                about="degrees",
                what=f"positions reach {largest:.4g}; taken for degrees, they fit the torques far better than taken "
                "for radians.",
                do="Use np.deg2rad.",
                joints=inputs.named(_places(turned)),
                correction=units,
            )


def _motion_signs(now: Hypothesis, inputs: CheckInput) -> Iterator[Hypothesis]:
    """The motion of one joint, or all of that joint, in the other direction."""
    for joint, name in enumerate(inputs.names):
        if not _worth(now, joint):
            continue
        turned = np.where(np.arange(len(inputs.names)) == joint, -1.0, 1.0)
        for what, signals in (
            (f"positions and velocities of {name} have", "qv"),
            (f"the whole joint {name} (motion and torque) has", "qvu"),
        ):
            signs = {"sign": dict.fromkeys(signals, tuple(turned))}
            yield now.tried(
                changed(f"{signals}a", factor=turned),
                cost=1.0,
                about="motion sign",
                what=f"{what} the opposite sign of the URDF's.",
                do="Turn the joint's axis in the URDF.",
                joints=(name,),
                correction=signs,
            )


def _motion_places(now: Hypothesis, inputs: CheckInput) -> Iterator[Hypothesis]:
    """Two joints in each other's place: their motion, or all of them."""
    nv = len(inputs.names)
    for one, other in combinations([joint for joint in range(nv) if _worth(now, joint)], 2):
        order = np.arange(nv)
        order[[one, other]] = order[[other, one]]
        for what, signals in (("positions and velocities", "qv"), ("all signals", "qvu")):
            yield now.tried(
                changed(f"{signals}a", order),
                cost=1.0,
                about="joints exchanged",
                what=f"{what} of {listed(inputs.named((one, other)))} stand in each other's place.",
                do="Correct the order of the columns, or the joint names of the log.",
                joints=inputs.named((one, other)),
                correction={"order": dict.fromkeys(signals, tuple(int(place) for place in order))},
            )


def _gravity(now: Hypothesis, inputs: CheckInput) -> Iterator[Hypothesis]:
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


def _worth(now: Hypothesis, joint: int) -> bool:
    """Whether an error in this joint's own motion is possible: of many joints only those that fit badly are tried."""
    return len(now.fit.unexplained) <= ALL_TRIED or bool(now.fit.unexplained[joint] > EXPLAINED)


def _places(chosen: np.ndarray) -> tuple[int, ...]:
    return tuple(int(place) for place in np.flatnonzero(chosen))


def _remains(before: TorqueFit, after: TorqueFit, joints: np.ndarray) -> str:
    """`then at most 2 % of it remains unexplained, instead of 98 %`."""
    then, now = (float(np.nanmax(fit.unexplained[joints])) for fit in (after, before))
    return f"then at most {100.0 * then:.2g} % of it remains unexplained, instead of {100.0 * now:.3g} %"
