"""Friction as users state it: dry, near rest, and viscous, of the curve that a fit found."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.data import Dataset, with_memory
from forcegp.data.preparation import memory
from forcegp.data.views import tensors
from forcegp.evidence.parameter_space import coefficient_title
from forcegp.forces import DryFriction, Viscous
from forcegp.posterior.fitted import REACH, Fitted
from forcegp.summary import within

SLIDES = 0.1  # of the root mean square speed: below it friction sticks, or turns
RISES = 1.01  # times dry friction, from which that near rest is another
STEP = 1e-3  # deviations of a number over which words are differentiated
UNEVEN, SURELY = 0.1, 2.0  # share of dry friction, and 95 % intervals, beyond which it differs by direction


def friction_in_words(
    found: Fitted, log: Dataset, unit: str, still: Sequence[str] = ()
) -> tuple[str, dict[str, tuple[float, float]]]:
    """Dry friction, that near rest, its memory; and the slope of each joint: of the line nearest to the fitted curve.

    A root of the speed shares slope and level with viscous and dry friction, whose own numbers are then neither. The
    line is that of the log's speeds beyond `SLIDES` of their root mean square, at that of the load, beside a breakaway.
    Slopes come with half of their 95 % interval.
    """
    robot, names = found.model.robot, found.model.robot.single_joint_names
    [law] = [x for x in found.model.laws if isinstance(x, DryFriction)]
    [viscous] = [x for x in found.model.laws if isinstance(x, Viscous)]
    state = law.seen(found.model.state(*tensors(with_memory(log, found.model), robot.device)[:3]))
    v, load = state.v.abs(), state.delivered.square().mean(0).sqrt()
    slides = v > SLIDES * v.square().mean(0).sqrt()
    count = slides.sum(0).clamp_min(1)
    mean = (slides * v).sum(0) / count
    from_mean, joints = slides * (v - mean), [log.joint_names.index(name) for name in names]
    laws = (law, viscous)
    numbers = {coefficient_title(x, name): value.expand(log.nv) for x in laws for name, value in x.values.items()}

    def words(numbers: Mapping[str, Tensor]) -> Float[Tensor, "3 joints"]:
        """Dry friction, that near rest, and slopes."""
        own = {name: numbers[coefficient_title(law, name)] for name in law.values}
        level = law.level_at((v, load), {name: x for name, x in own.items() if name != "breakaway"})
        slope = (from_mean * level).sum(0) / from_mean.square().sum(0).clamp_min(1e-300)
        dry = (slides * level).sum(0) / count - slope * mean
        rest = torch.maximum(dry, law.level_at((0.0 * mean, load), own))
        return torch.stack([dry, rest, slope + numbers[coefficient_title(viscous, "damping")]])[:, joints]

    here, estimates, changes = words(numbers), found.estimates, np.zeros((3, len(names), len(found.estimates)))
    for k, (name, each) in enumerate(estimates.items()):
        title, _, joint = name.rpartition(".")
        if title in numbers and each.std > 0.0:
            step = STEP * each.std * (torch.arange(log.nv) == log.joint_names.index(joint))
            changes[..., k] = (words({**numbers, title: numbers[title] + step}) - here) / (STEP * each.std)
    assert estimates.covariance is not None, "the fit estimated them"
    errors = REACH * np.sqrt(np.einsum("wjk,kl,wjl->wj", changes, estimates.covariance, changes)).clip(0.0)
    told = [
        ["–" if name in still else within(*both) for name, *both in zip(names, x.tolist(), error, strict=True)]
        for x, error in zip(here, errors.tolist(), strict=True)
    ]
    text = f"{', '.join(told[0])} {unit}"
    least = "at least " if memory(log.metadata) else ""  # a filter smooths the peak at a reversal
    text += f", near rest {least}{', '.join(told[1])}" if bool((here[1] > RISES * here[0]).any()) else ""
    for name, level in zip(names, here[0].tolist(), strict=True):
        each = None if name in still else found.estimates.get(f"offset.{name}")  # a force: along it friction is less
        if each is not None and abs(each.value) > max(0.5 * UNEVEN * level, SURELY * REACH * each.std):
            way = "backwards" if each.value > 0.0 else "forwards"
            more = f"{2.0 * abs(each.value):.2g} {unit} more {way}"
            more = (
                more
                if abs(each.value) < level
                else f"pulled {way} by {within(abs(each.value), REACH * each.std)} {unit}"
            )
            text += f"; {name} {more}, or its torque has another zero"
    for name, row in zip(log.joint_names, law.turning(torch.eye(log.nv).to(v)).mT.tolist(), strict=True):
        terms = [f"{x:+.3g} {other}" for other, x in zip(log.joint_names, row, strict=True) if x]
        text += f"; the motor of {name} turns with {' '.join(terms)}" if len(terms) > 1 else ""
    if remember := [j for j in law.memory_joints(robot) if log.joint_names[j] not in still]:
        own = [log.joint_names[j] for j in remember]
        length = " or ".join(sorted({"mm" if robot.joint(x).type == "prismatic" else "mrad" for x in own})[::-1])
        who = "all joints" if len(own) == len(joints) else ", ".join(own)
        ways = ", ".join(f"{way:.3g}" for way in (1e3 / law.values["sigma"].expand(log.nv)[remember]).tolist())
        text += f"; {who} remember reversals, over {ways} {length}"
    return text, dict(zip(names, zip(here[2].tolist(), errors[2].tolist(), strict=True), strict=True))
