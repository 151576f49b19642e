"""Friction as users state it: dry, near rest, and viscous, of the curve that a fit found."""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from forcegp.data import Dataset, with_memory
from forcegp.data.views import tensors
from forcegp.forces import DryFriction, Viscous
from forcegp.model import Model

SLIDES = 0.1  # of the root mean square speed: below it friction sticks, or turns
RISES = 1.01  # times dry friction, from which that near rest is another


def friction_in_words(model: Model, log: Dataset, unit: str, still: Sequence[str] = ()) -> tuple[str, dict[str, float]]:
    """Dry friction, that near rest, its memory; and the slope of each joint: of the line nearest to the fitted curve.

    A root of the speed shares slope and level with viscous and dry friction, whose own numbers are then neither. The
    line is that of the log's speeds beyond `SLIDES` of their root mean square, at that of the load, beside a breakaway.
    """
    [law] = [x for x in model.laws if isinstance(x, DryFriction)]
    [viscous] = [x for x in model.laws if isinstance(x, Viscous)]
    state = law.seen(model.state(*tensors(with_memory(log, model), model.robot.device)[:3]))
    v, load = state.v.abs(), state.delivered.square().mean(0).sqrt()
    level = law.level_at((v, load), {name: x for name, x in law.values.items() if name != "breakaway"})
    slides = v > SLIDES * v.square().mean(0).sqrt()
    count = slides.sum(0).clamp_min(1)
    mean = (slides * v).sum(0) / count
    from_mean = slides * (v - mean)
    slope = (from_mean * level).sum(0) / from_mean.square().sum(0).clamp_min(1e-300)
    dry = (slides * level).sum(0) / count - slope * mean
    names = model.robot.single_joint_names
    joints = [log.joint_names.index(name) for name in names]
    at_rest = law.level_at((0.0 * mean, load), law.values).expand(log.nv)
    moving, rest = (each[joints] for each in (dry, torch.maximum(dry, at_rest)))
    slopes = dict(zip(names, (slope + viscous.values["damping"])[joints].tolist(), strict=True))

    def listed(numbers: Tensor, names: Iterable[str] = names) -> str:
        each = zip(names, numbers.tolist(), strict=True)
        return ", ".join("–" if name in still else f"{number:.3g}" for name, number in each)

    text = f"{listed(moving)} {unit}"
    text += f", near rest {listed(rest)}" if bool((rest > RISES * moving).any()) else ""
    for name, row in zip(log.joint_names, law.turning(torch.eye(log.nv).to(v)).mT.tolist(), strict=True):
        terms = [f"{x:+.3g} {other}" for other, x in zip(log.joint_names, row, strict=True) if x]
        text += f"; the motor of {name} turns with {' '.join(terms)}" if len(terms) > 1 else ""
    if remember := law.memory_joints(model.robot):
        own = [log.joint_names[j] for j in remember]
        length = " or ".join(sorted({"mm" if model.robot.joint(x).type == "prismatic" else "mrad" for x in own})[::-1])
        who = "all joints" if len(own) == len(joints) else ", ".join(own)
        ways = 1e3 / law.values["sigma"].expand(log.nv)[remember]
        text += f"; {who} remember reversals, over {listed(ways, own)} {length}"
    return text, slopes
