"""`check`: one log against itself and its robot, as a list of doubts that a person acts on."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from forcegp.checks.check_input import QUICK_ROWS, STILL, CheckInput
from forcegp.checks.moving_base import base_doubts, carried_doubts, stance_doubts, unmeasured_base_doubts
from forcegp.checks.search import SHORT, UNKNOWN, Explanation, search
from forcegp.checks.signals import motion_doubts, sampling_doubts, signal_doubts, target_doubts, without_registers
from forcegp.checks.torque_doubts import TOUCHES, elastic_doubts, held_points, jump, push, torque_doubts, without_stops
from forcegp.checks.torques import in_motion
from forcegp.data import Dataset, contact_doubts
from forcegp.data.configurations import as_vectors
from forcegp.data.dataset import require_rows
from forcegp.data.imu import imu_doubts
from forcegp.doubts import LEVELS, Doubt, Doubts, listed, look
from forcegp.errors import DatasetError, InvalidInput, require_type
from forcegp.fit.force_sensors import force_sensor_doubts
from forcegp.fit.sensors import torque_sensor_doubts
from forcegp.model import Model
from forcegp.robots import Robot
from forcegp.summary import Summary, plain

BEFORE_A_FIT = frozenset(
    ("contact", "velocity", "clock", "acceleration", "delay", "torque unit", "torque constant", "masses", "lengths",
     "joint zero", "gear ratio", "gravity", "stop", "load")
)  # fmt: skip
"""Subjects that a fit reports also where a person should judge."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class CheckReport(Summary):
    """The doubts, worst first, and what they rest on.

    `inputs` holds the log at even times and after the filter; `comparison` measured torques and inverse dynamics
    with the errors corrected that were found (None with contacts).
    """

    doubts: Doubts
    inputs: CheckInput
    comparison: Explanation | None

    def facts(self) -> dict[str, object]:
        """The subjects of the doubts, by level."""
        return {level: self.doubts.at(level).subjects or "none" for level in reversed(LEVELS)}

    def per_joint(self) -> list[dict[str, Any]]:
        """What was measured of every joint; None where it is not known.

        "unexplained" share of the torque's variance, "residual" in Nm or N and "factor" of the fit to inverse dynamics.
        """
        nothing: list[Any] = [None] * self.inputs.log.nv
        columns = {"joint": list(self.inputs.names), "unexplained": nothing, "residual": nothing, "factor": nothing}
        if self.comparison is not None:
            left, spread = self.comparison.unexplained, np.std(self.comparison.log.rows.u, axis=0)
            columns["unexplained"], columns["residual"] = plain(left), plain(np.sqrt(left) * spread)
            columns["factor"] = plain(self.comparison.factors)
        return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON: level, counts, numbers of every joint, doubts."""
        counts = {level: len(self.doubts.at(level)) for level in LEVELS}
        found = {"level": self.doubts.level, "counts": counts, "joints": self.per_joint()}
        return {**found, "doubts": [doubt.to_dict() for doubt in self.doubts]}


def check(dataset: Dataset, model: Model | None = None) -> CheckReport:
    """Look for what would spoil a model: wrong units, signs, joints, delays; dead channels; motion that shows nothing.

    `model` is the robot that was recorded (default: that of the dataset). Nothing is changed.

    Raises InvalidInput for rows out of order, fewer than 64 rows in a stretch, and a robot with other joints.
    """
    require_type("dataset", dataset, Dataset)
    model = dataset.model if model is None else model
    robot = require_type("model", model, Model).robot
    require_rows("dataset", dataset, robot.joint_names, robot.name)
    if robot.layout.groups:  # torques and filters are not looked at
        inputs = CheckInput.as_recorded(dataset, model)
        return CheckReport(doubts=_of_base(dataset, model, CheckInput.of), inputs=inputs, comparison=None)
    dataset, stops = without_stops(dataset, model)
    dataset, registers = without_registers(dataset)
    inputs = CheckInput.of(dataset, model)
    doubts, comparison = _doubts(inputs, model, [*stops, *registers])
    doubts += excitation_doubts(inputs)
    return CheckReport(doubts=Doubts(doubts), inputs=inputs, comparison=comparison)


def quick_check(dataset: Dataset, model: Model | None = None) -> Doubts:
    """What of `check` is cheap enough before every fit, worst first: only what would make the fit wrong.

    From a few stretches of the log and without a filter, so that it takes a tenth of a second; rows out of order and
    short logs are taken, of which less can be checked. Raises InvalidInput for a robot with other joints.
    """
    model = dataset.model if model is None else model
    require_rows("dataset", dataset, model.robot.joint_names, model.robot.name)
    if model.robot.layout.groups:
        return Doubts(each for each in _of_base(dataset, model, CheckInput.quick) if each.level != "ok")
    dataset, stops = without_stops(dataset, model)
    dataset, registers = without_registers(dataset)
    doubts, _ = _doubts(CheckInput.quick(dataset, model), model, [*stops, *registers])
    said = [each for each in doubts if each.level == "look" and each.about in BEFORE_A_FIT]
    if dataset.nv == 1:  # friction of one joint can look like a delay
        said = [each for each in said if each.about != "delay"]
    return Doubts([*said, *(each for each in doubts if each.level == "wrong")])


def _doubts(inputs: CheckInput, model: Model, registers: list[Doubt]) -> tuple[list[Doubt], Explanation | None]:
    """What is looked for in every log, and the comparison of torques, where there is one."""
    doubts = [*registers, *signal_doubts(inputs)]
    if inputs.log.time_ordered:
        frozen = {name for doubt in doubts if doubt.about == "frozen channel" for name in doubt.joints}
        moving = (doubt for doubt in motion_doubts(inputs) if not frozen.issuperset(doubt.joints or {"all"}))
        doubts = [*sampling_doubts(inputs), *doubts, *moving]
    moved, contacts = Doubts(doubts).of("velocity").level != "wrong", contact_doubts(inputs.mended, model)
    if moved and inputs.prepared is not None:
        sensors = imu_doubts, torque_sensor_doubts, force_sensor_doubts
        doubts += [doubt for of_sensors in sensors for doubt in of_sensors(inputs.prepared, model)]
    doubts += [*contacts, *stance_doubts(inputs.log, model)]
    comparison = None
    if inputs.compared is None or any(each.numbers.get("quantity") == "q" for each in registers):
        return doubts, None
    if inputs.contacts:
        return [*doubts, TOUCHES], None
    if targets := target_doubts(inputs):
        return [*(each for each in doubts if each.about != "saturation"), *targets], None  # a target may stay
    if inputs.log.u.any() and not contacts:
        found, said = search(inputs)
        if said and moved and (held := held_points(inputs)):
            return [*doubts, *held], None
        if said and said[-1].about == UNKNOWN and inputs.sharper is not None:
            sharp, heard = search(replace(inputs, compared=inputs.sharper))
            if not heard or heard[-1].about != UNKNOWN:
                found, said = sharp, heard
        hidden = said[-1].about == UNKNOWN if said else inputs.sharper is not None  # a filter may hide a resonance
        thorough = inputs.most_rows != QUICK_ROWS
        if hidden and thorough:
            elastic = elastic_doubts(inputs, found.log)
            if said and elastic:  # below the resonance other causes are sought
                with contextlib.suppress(DatasetError):  # too short for that
                    inputs = inputs.below(elastic[0].numbers["cutoff"])
                    found, said = search(inputs)
            said = [*elastic, *said]
        thorough &= not {"jumps", "frozen channel"} & {each.about for each in doubts}  # torques are off there, too
        open_ = {x.about for x in said} <= {UNKNOWN, "dry friction"}
        if thorough and open_ and (jumps := list(jump(found, inputs))):
            said = [*(x for x in said if x.about != UNKNOWN or x.joints != jumps[0].joints), *jumps]
        elif thorough and not any(each.level == "wrong" for each in said):
            unknown = Doubts(said).of(UNKNOWN)
            within = unknown[0].numbers.get("where") if unknown else (-np.inf, np.inf)
            pushes = list(push(found, inputs, *within)) if within else []
            loads = np.array([s for x in Doubts(said).of("load") for s in x.numbers["seconds"]]).reshape(-1, 2)
            apart = (x for x in pushes if not any(a <= x.numbers["seconds"][0] <= b for a, b in loads))  # of a load
            said = [*(x for x in said if x.about != UNKNOWN or not pushes), *apart]
        if not moved or {"degrees", "turns", "time unit"} & {doubt.about for doubt in said}:  # torques follow
            said = [doubt for doubt in said if doubt.about not in ("torque unit", "torque constant")]
        more, early = torque_doubts(inputs, found), float(inputs.log.time.min()) + SHORT
        if Doubts(said).of("torque unit"):  # in which an offset is no force
            more = [each for each in more if each.about != "offset"]
        for drift in Doubts(more).of("drift"):  # of gears that are cold at first, or of one that is another since then
            of_one = {*drift.joints} if "seconds" in drift.numbers else set[str]()
            said = [x for x in said if x.about != "push" or x.numbers["seconds"][0] > early]
            said = [x for x in said if x.about != UNKNOWN or {*x.joints} - of_one]
        doubts, comparison = [*doubts, *said, *more], found
    return doubts, comparison


Inputs = Callable[[Dataset, Model], CheckInput]


def _of_base(dataset: Dataset, model: Model, inputs_of: Inputs) -> Doubts:
    """What is seen of a base that moves, of the joints and of what holds it; torques are not looked at."""
    unmeasured = list(unmeasured_base_doubts(dataset, model))
    of_joints = list(_of_single_joints(dataset, model.robot, inputs_of))
    of_base = unmeasured or list(base_doubts(dataset, model))
    if not unmeasured and Doubts(of_base).level != "wrong":  # forces in wrong axes show nothing
        of_base += carried_doubts(dataset, model)
    sensors = imu_doubts, force_sensor_doubts
    of_base += [x for of in sensors for x in of(dataset, model)] if Doubts(of_base).level != "wrong" else []
    flags = stance_doubts(dataset, model) if Doubts(of_joints).level != "wrong" else ()  # wrong v contradict any flag
    return Doubts([*of_base, *of_joints, *flags])


def _of_single_joints(dataset: Dataset, robot: Robot, inputs_of: Inputs) -> Iterator[Doubt]:
    """Whether q, v and a of the joints of one degree of freedom belong together."""
    if not robot.space.single_rows or not dataset.time_ordered:
        return
    own = _chain(robot.joint_names)
    bare: dict[str, Any] = {"measured": {}, "truth": {}, "noise_std": None}  # of frames that the chain lacks
    alone = replace(dataset, model=own, q=as_vectors(dataset), u=np.zeros_like(dataset.v), **bare)
    with contextlib.suppress(InvalidInput):  # too short
        inputs = replace(inputs_of(alone, own), rotates=dataset.turns)
        yield from motion_doubts(inputs, robot.space.single_rows)  # gaps may be rows whose feet are not known


def _chain(names: Sequence[str]) -> Model:
    """A fixed base and joints of these names, for checks of positions as vectors; its masses are looked at by none."""
    body = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    links = "".join(f'<link name="{k}">{body}</link>' for k in range(len(names) + 1))
    joints = "".join(
        f'<joint name={quoteattr(name)} type="continuous"><parent link="{k}"/><child link="{k + 1}"/></joint>'
        for k, name in enumerate(names)
    )
    return Model(Robot.from_urdf_text(f'<robot name="chain">{links}{joints}</robot>'))


HELD = 0.02  # range of a joint in one stretch, relative to its largest, below which it was held there
BRIEF = 0.25  # of the log, in which all of a joint's motion lies


def excitation_doubts(inputs: CheckInput) -> Iterator[Doubt]:
    """Joints that hardly move, or once."""
    if inputs.prepared is None:
        return
    spans = np.ptp(inputs.prepared.q, axis=0)
    still = [*inputs.named(np.flatnonzero(spans < np.where(inputs.rotates, *STILL)))]
    if still:
        whose = "its" if len(still) == 1 else "their"
        yield look(
            about="excitation",
            what=f"{listed(still)} moved less than 0.02 rad (2 mm): {whose} friction and inertia do not show.",
            do="Move every joint that is to be learned, or lock it in the robot (`locked`).",
            joints=tuple(still),
            numbers={"ranges": spans.tolist(), "still": still},
        )
    yield from _held(inputs, still)
    moves, count = in_motion(inputs.prepared), len(inputs.prepared)
    for name, own in zip(inputs.names, map(np.flatnonzero, moves.T), strict=True):
        if name not in still and len(own) and own[-1] - own[0] < BRIEF * count:
            begin, end = inputs.prepared.time[own[[0, -1]]].tolist()
            what = f"{name} moves only from {begin:.1f} to {end:.1f} s: no other time tells if its friction is right."
            do = "Move it in other parts of the log, too."
            yield look(about="excitation", what=what, do=do, joints=(name,), numbers={"seconds": [begin, end]})


def _held(inputs: CheckInput, still: list[str]) -> Iterator[Doubt]:
    """Joints that stand still in whole stretches although they move in others."""
    rows = inputs.prepared
    if rows is None or len(rows.episodes) < 2:
        return
    spans = np.stack([np.ptp(rows.q[rows.episode == number], axis=0) for number in rows.episodes])
    for joint in (joint for joint, name in enumerate(inputs.names) if name not in still):
        own, unit = spans[:, joint], "rad" if inputs.rotates[joint] else "m"
        held = np.flatnonzero((own < HELD * own.max()) & (spans.max(axis=1) > 5.0 * own))
        if 0 < len(held) <= len(spans) // 2:
            first = int(held[0])
            begin = float(rows.time[rows.episode == rows.episodes[first]][0])
            yield look(
                about="held joint",
                what=f"{inputs.names[joint]} stays within {own[first]:.2g} {unit} in {len(held)} of {len(spans)} "
                f"stretches while other joints move (the first: number {first}, counted from 0, at {begin:.3f} s); "
                f"elsewhere it moves {own.max():.2g}.",
                do="It was held, or sticks: leave the stretch out, or describe it as a constraint or another robot "
                "(`locked`).",
                joints=(inputs.names[joint],),
                numbers={"stretches": held.tolist(), "range": float(own[first])},
            )
