"""`check`: one log against itself and its robot, as a list of doubts that a person acts on."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from forcegp.checks.check_input import CheckInput
from forcegp.checks.excitation import excitation_doubts, noise_doubts, stated_noise_doubts
from forcegp.checks.moving_base import (
    base_doubts,
    carried_doubts,
    stance_doubts,
    unmeasured_base_doubts,
)
from forcegp.checks.signals import motion_doubts, sampling_doubts, signal_doubts
from forcegp.checks.torque_doubts import corrected, not_compared, torque_doubts
from forcegp.checks.torques import Comparison, parameter_doubts, torque_noise
from forcegp.data import Dataset, Preparation, contact_doubts
from forcegp.data.configurations import as_vectors
from forcegp.data.dataset import require_rows
from forcegp.doubts import LEVELS, Doubt, Doubts
from forcegp.errors import InvalidInput, require_type
from forcegp.model import Model
from forcegp.robots import Robot
from forcegp.summary import Summary, plain

BEFORE_A_FIT = frozenset(
    ("contact", "noise_std", "velocity", "acceleration", "delay", "torque unit", "torque constant", "masses", "lengths",
     "joint zero", "gravity", "dead torque")
)  # fmt: skip
"""Subjects that a fit reports also where a person should judge."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class CheckReport(Summary):
    """The doubts, worst first, and what they rest on.

    `inputs` holds the log at even times and after the filter; `comparison` measured torques and inverse dynamics
    with the errors corrected that were found (None without a robot, or with contacts).
    """

    doubts: Doubts
    inputs: CheckInput
    comparison: Comparison | None

    def facts(self) -> dict[str, object]:
        """The subjects of the doubts, by level."""
        return {level: self.doubts.at(level).subjects or "none" for level in reversed(LEVELS)}

    def per_joint(self) -> list[dict[str, Any]]:
        """What was measured of every joint; None where it is not known.

        "unexplained" share of the torque's variance, "residual" in Nm or N and "factor" of the fit to inverse dynamics
        (see `forcegp.checks.torques`), the factor only where the torque rests on it; "noise_before" and "noise_after"
        the filter of the acceleration in rad/s^2 or m/s^2, and "noise_torque", the latter times M in Nm or N.
        """
        nothing: list[Any] = [None] * self.inputs.log.nv
        names = ("unexplained", "residual", "factor", "noise_before", "noise_after", "noise_torque")
        columns = {"joint": list(self.inputs.names), **dict.fromkeys(names, nothing)}
        if self.comparison is not None:
            fit, spread = self.comparison.fit, np.std(self.comparison.rows.u, axis=0)
            columns["unexplained"] = plain(fit.unexplained)
            columns["residual"] = plain(np.sqrt(fit.unexplained) * spread)
            columns["factor"] = plain(np.where(fit.rests_on_robot, fit.factor, np.nan))
        if (noise := self.inputs.price.get("acceleration_noise")) is not None:
            columns["noise_before"], columns["noise_after"] = noise["before"], noise["after"]
            if (robot := self.inputs.robot) is not None:
                after = np.array(noise["after"], float)
                columns["noise_torque"] = plain(torque_noise(robot, self.inputs.rows(), after))
        return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON: level, counts, numbers of every joint, doubts."""
        counts = {level: len(self.doubts.at(level)) for level in LEVELS}
        return {
            "level": self.doubts.level,
            "counts": counts,
            "cutoff": self.inputs.price.get("cutoff"),
            "joints": self.per_joint(),
            "doubts": [doubt.to_dict() for doubt in self.doubts],
        }


def check(dataset: Dataset, model: Model | None = None, *, preparation: Preparation | None = None) -> CheckReport:
    """Look for what would spoil a model: wrong units, signs, joints, delays; dead channels; motion that shows nothing.

    `model` is the robot that was recorded (default: that of the dataset); without one, torques are not compared.
    `preparation` sets how to filter for the comparison (default: cut-off from the spectrum); its `delay`, `every` and
    `trim` are not used. Nothing is changed.

    Raises InvalidInput for rows out of order, fewer than 64 rows in a stretch, and a robot with other joints.
    """
    require_type("dataset", dataset, Dataset)
    preparation = Preparation(cutoff="auto") if preparation is None else preparation
    require_type("preparation", preparation, Preparation)
    model = dataset.model if model is None else model
    if model is not None:
        robot = require_type("model", model, Model).robot
        require_rows("dataset", dataset, robot.joint_names, robot.name)
        if robot.layout.groups:  # torques and filters are not looked at
            inputs = CheckInput.as_recorded(dataset, model)
            return CheckReport(doubts=_of_base(dataset, model, preparation), inputs=inputs, comparison=None)
    inputs = CheckInput.of(dataset, model, preparation)
    doubts, comparison = _doubts(inputs, model)
    if inputs.prepared is not None:
        doubts += [*excitation_doubts(inputs), *noise_doubts(inputs)]
    return CheckReport(doubts=Doubts(doubts), inputs=inputs, comparison=comparison)


def quick_check(dataset: Dataset, model: Model | None = None) -> Doubts:
    """What of `check` is cheap enough before every fit, worst first: only what would make the fit wrong.

    From a few stretches of the log and without a filter, so that it takes a tenth of a second; rows out of order and
    short logs are taken, of which less can be checked. Raises InvalidInput for a robot with other joints.
    """
    model = dataset.model if model is None else model
    if model is not None:
        require_rows("dataset", dataset, model.robot.joint_names, model.robot.name)
        if model.robot.layout.groups:
            return Doubts(each for each in _of_base(dataset, model) if each.level != "ok")
    doubts, _ = _doubts(CheckInput.quick(dataset, model), model)
    said = [each for each in doubts if each.level == "look" and each.about in BEFORE_A_FIT]
    if dataset.nv == 1:  # friction of one joint can look like a delay
        said = [each for each in said if each.about != "delay"]
    return Doubts([*said, *(each for each in doubts if each.level == "wrong")])


def _doubts(inputs: CheckInput, model: Model | None) -> tuple[list[Doubt], Comparison | None]:
    """What is looked for in every log, and the comparison of torques, where there is one."""
    doubts = [*signal_doubts(inputs), *stated_noise_doubts(inputs)]
    if inputs.log.time_ordered:
        doubts = [*sampling_doubts(inputs), *doubts, *motion_doubts(inputs)]
    contacts = contact_doubts(inputs.mended, model)
    doubts += [*contacts, *(stance_doubts(inputs.log, model) if model is not None else ())]
    comparison = None
    if inputs.compared is None:
        return doubts, None
    if inputs.robot is None or inputs.contacts:
        return [*doubts, not_compared(inputs)], None
    if inputs.log.u.any() and not contacts:
        comparison, corrections = corrected(inputs)
        compared = torque_doubts(inputs, comparison)
        noise = inputs.compared_noise
        if noise is not None and ("torque unit", "wrong") not in {(each.about, each.level) for each in compared}:
            numbers = parameter_doubts(comparison.robot, comparison.changed(inputs.rows()), noise)
            compared = [each for each in compared if not numbers or each.about != "torque unit"] + numbers
        doubts += [*corrections, *compared]
    return doubts, comparison


def _of_base(dataset: Dataset, model: Model, preparation: Preparation | None = None) -> Doubts:
    """What is seen of a base that moves, of the joints and of what holds it; torques are not looked at."""
    unmeasured = list(unmeasured_base_doubts(dataset, model))
    of_joints = list(_of_single_joints(dataset, model.robot, preparation))
    of_base = unmeasured or list(base_doubts(dataset, model))
    if not unmeasured and Doubts(of_base).level != "wrong":  # forces in wrong axes show nothing
        of_base += carried_doubts(dataset, model)
    flags = stance_doubts(dataset, model) if Doubts(of_joints).level != "wrong" else ()  # wrong v contradict any flag
    return Doubts([*of_base, *of_joints, *flags])


def _of_single_joints(dataset: Dataset, robot: Robot, preparation: Preparation | None) -> Iterator[Doubt]:
    """Whether q, v and a of the joints of one degree of freedom belong together; quick where there is no filter."""
    if not robot.space.single_rows or not dataset.time_ordered:
        return
    alone = replace(dataset, model=None, q=as_vectors(dataset), u=np.zeros_like(dataset.v), truth={}, noise_std=None)
    with contextlib.suppress(InvalidInput):  # too short
        inputs = CheckInput.quick(alone, None) if preparation is None else CheckInput.of(alone, None, preparation)
        yield from motion_doubts(inputs, robot.space.single_rows)  # gaps may be rows whose feet are not known
