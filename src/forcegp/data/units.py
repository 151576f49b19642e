"""Units of a Dataset: SI only, stated for every quantity, one per joint where joints differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import forcegp.robots
from forcegp.data.frozen_dict import FrozenDict
from forcegp.errors import DatasetError

ROTATION = {"q": "rad", "v": "rad/s", "u": "Nm", "a": "rad/s^2"}
"""Units of a revolute or continuous joint."""

TRANSLATION = {"q": "m", "v": "m/s", "u": "N", "a": "m/s^2"}
"""Units of a prismatic joint."""

REVOLUTE_UNITS = FrozenDict({**ROTATION, "time": "s"})
"""Units of a robot whose joints all rotate."""


def units_for(robot: forcegp.robots.Robot) -> FrozenDict:
    """The units that a Dataset of this robot has: one text where all joints agree, else one per joint."""
    return _per_quantity([TRANSLATION if joint.type == "prismatic" else ROTATION for joint in robot.joints])


def validated_units(units: Mapping[str, str | Sequence[str]], joint_names: Sequence[str]) -> FrozenDict:
    """Check that every quantity has a unit that forcegp computes in, and that each joint's four units fit each other.

    Raises DatasetError naming the quantity, the joint and the allowed units.
    """
    wanted = {*ROTATION, "time"}
    if not isinstance(units, Mapping) or set(units) != wanted:
        given = sorted(units) if isinstance(units, Mapping) else type(units).__name__
        raise DatasetError(
            f"units must name exactly {sorted(wanted)}; given: {given}. "
            f"For a robot whose joints all rotate: {dict(REVOLUTE_UNITS)}."
        )
    if units["time"] != "s":
        raise DatasetError(f"units['time'] is {units['time']!r}; only 's' is allowed. Convert the time stamps first.")
    per_quantity = {name: _per_joint(name, units[name], len(joint_names)) for name in ROTATION}
    per_joint: list[dict[str, str]] = []
    for column, joint in enumerate(joint_names):
        own = {name: per_quantity[name][column] for name in ROTATION}
        if own not in (ROTATION, TRANSLATION):
            raise DatasetError(
                f"joint {joint!r} has units {own}; allowed are {ROTATION} or, for a prismatic joint, {TRANSLATION}. "
                "Convert the columns first (np.deg2rad for degrees)."
            )
        per_joint.append(own)
    return _per_quantity(per_joint)


def _per_joint(name: str, unit: str | Sequence[str], nv: int) -> tuple[str, ...]:
    if isinstance(unit, str):
        return (unit,) * nv
    texts = tuple(unit)
    if len(texts) != nv or not all(isinstance(text, str) for text in texts):
        raise DatasetError(f"units[{name!r}] must be one text or {nv} of them, one per joint; given: {unit!r}.")
    return texts


def _per_quantity(per_joint: Sequence[Mapping[str, str]]) -> FrozenDict:
    columns = {name: tuple(own[name] for own in per_joint) for name in ROTATION}
    merged = {name: texts[0] if len(set(texts)) == 1 else texts for name, texts in columns.items()}
    return FrozenDict({**merged, "time": "s"})
