"""What a log cannot teach a model, before a fit; and what speaks against what was found, after it."""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from forcegp.data import Dataset, contact_doubts, evenly, thruster_columns
from forcegp.doubts import Doubt, Doubts, look
from forcegp.errors import ContactWarning, InvalidInput
from forcegp.evidence.identifiability import carrying
from forcegp.evidence.least_squares import Fit
from forcegp.evidence.likelihood import MarginalLikelihood, checked_values
from forcegp.evidence.parameter_space import force_title
from forcegp.evidence.recorded_rows import RecordedRows
from forcegp.evidence.training_data import CONSTANT, FAR_FROM_SURFACE
from forcegp.fit.equations import CLEARLY, left_by_least_squares
from forcegp.forces import JointLaw, Law, Normal, Offset, RigidBodies
from forcegp.mechanics import State
from forcegp.model import Model
from forcegp.summary import listed

INVISIBLE = 1e-9  # |H B_c| over |M^-1 B_c| below which accelerations show nothing of a latent: rounding, measured 1e-15
ROUNDING = 1e-12  # |M^-1 B_c| relative to the largest of them below which a latent moves nothing
EQUAL = 1e-9  # relative difference of two latents' effects and features below which they are the same
ROWS_LOOKED_AT = 500


def check_forces(likelihood: MarginalLikelihood) -> None:
    """Refuse what cannot be learned at all, and warn of what cannot be learned in part.

    Raises InvalidInput if the prior gives other shapes or types than it should, if no latent changes the acceleration
    at any training point, if all of one term do nothing at all, if all features of a latent are constant (a tool or
    joint that never moves), and if latents of two terms do the same in every row. Warns (DataWarning) of single
    features that are constant, and of latents that move nothing or that the constraint hides while others show.
    """
    dynamics, robot, unknown = likelihood.dynamics, likelihood.model.robot, likelihood.model.unknown
    B, features = checked_values(unknown, dynamics)
    names = unknown.latent_names(robot)
    if not names:
        return
    doubts = [*_of_features(likelihood, names, features)]
    effect = dynamics.H @ B
    terms = [number for number, which in enumerate(unknown.slices(robot)) for _ in range(which.stop - which.start)]
    shows, unseen = _of_effects(names, terms, dynamics.inverse_lower.mT @ (dynamics.inverse_lower @ B), effect)
    _refuse_equal(names, terms, shows, effect, likelihood.standardization(features))
    doubts += unseen
    Doubts(doubts).warn(stacklevel=5)


def _of_features(likelihood: MarginalLikelihood, names: Sequence[str], features: Sequence[Tensor]) -> Iterator[Doubt]:
    robot, unknown = likelihood.model.robot, likelihood.model.unknown
    labels, scalings = unknown.feature_names(robot), unknown.scalings(robot)
    idle: dict[tuple[str, ...], list[str]] = {}
    for index, (name, z) in enumerate(zip(names, features, strict=True)):
        if not z.shape[-1]:
            continue
        spread = z.var(0, correction=0).sqrt()
        constant = spread <= CONSTANT * (1.0 + z.mean(0).abs())
        known = tuple(f"feature {k}" for k in range(z.shape[-1])) if labels is None else labels[index]
        which = tuple(label for label, flat in zip(known, constant.tolist(), strict=True) if flat)
        if bool(constant.all()):
            values = ", ".join(f"{value:.4g}" for value in z[0].tolist()[:4])
            raise InvalidInput(
                f"latent {name!r} depends on {', '.join(which)}, which is the same in all {len(z)} training rows "
                f"({values}), so its function cannot be learned; give data in which it changes, or leave this "
                "prior (or this joint) out"
            )
        ways = scalings[index]
        if which and any(way != "none" for way in ((ways,) if isinstance(ways, str) else ways)):
            idle.setdefault(which, []).append(name)
    for which, latents in idle.items():
        yield look(
            about="features",
            what=f"{listed(which)} never changes in the training rows, so nothing is learned of how {_few(latents)} "
            "depends on it;",
            do="leave that input out (inputs=...), or give data in which it changes",
        )


def _of_effects(
    names: Sequence[str], terms: Sequence[int], free: Tensor, effect: Tensor
) -> tuple[list[bool], list[Doubt]]:
    """Which latents show, and doubts; `free` is what each would do without the contacts, `effect` what it does."""
    size, shown = (part.square().sum(-2).mean(0).sqrt() for part in (free, effect))
    absent, doubts = (size <= ROUNDING * size.max()).tolist(), list[Doubt]()
    for term in set(terms):
        own = [index for index, number in enumerate(terms) if number == term]
        if all(absent[index] for index in own):
            raise InvalidInput(
                f"{_few([names[index] for index in own])} exerts no force at any training row; check frame, point and "
                "contact of the prior, or leave it out"
            )
    if any(absent):
        idle = _few([name for name, nothing in zip(names, absent, strict=True) if nothing])
        what = f"{idle} moves no joint at any training row, so its posterior is its prior;"
        remedy = "give data in other postures, or leave it out if the prior can do without"
        doubts.append(look(about="effects", what=what, do=remedy))
    hidden = [not nothing and flat for nothing, flat in zip(absent, (shown <= INVISIBLE * size).tolist(), strict=True)]
    blind = [name for name, flat in zip(names, hidden, strict=True) if flat]
    remedy = "use axes='surface', which leaves out the normal direction, or leave that prior out"
    shows = [not (nothing or flat) for nothing, flat in zip(absent, hidden, strict=True)]
    if not any(shows):
        raise InvalidInput(
            f"no data can identify {_few(blind)}: the contacts take the whole force, and the acceleration shows none "
            f"of it; {remedy}"
        )
    if blind:
        what = f"no data can identify {_few(blind)}: the contacts take that force, the acceleration shows none of it, "
        what += "and its posterior and that of the normal force are the prior;"
        doubts.append(look(about="effects", what=what, do=remedy))
    return shows, doubts


def _refuse_equal(
    names: Sequence[str], terms: Sequence[int], shows: Sequence[bool], effect: Tensor, features: Sequence[Tensor]
) -> None:
    """Latents of two terms with the same effect on the same features are one function; data see only their sum."""
    columns = effect.flatten(0, 1)
    norms = torch.linalg.vector_norm(columns, dim=0)
    cosines = (columns.mT @ columns) / torch.outer(norms, norms).clamp_min(torch.finfo(columns.dtype).tiny)
    for first, second in torch.nonzero(torch.triu(cosines.abs() > 1.0 - EQUAL, diagonal=1)).tolist():
        one, other = features[first], features[second]
        if terms[first] == terms[second] or not (shows[first] and shows[second]):
            continue  # joints that the constraint couples; one prior makes its own latents independent
        if one.shape == other.shape and bool(((one - other).abs() <= EQUAL * (1.0 + one.abs())).all()):
            raise InvalidInput(
                f"no data can separate {names[first]!r} and {names[second]!r}: both act in the same direction and "
                "depend on the same inputs; leave one of them out"
            )


def _few(names: Sequence[str]) -> str:
    return listed(map(repr, names))


def warn_of_contacts(model: Model, dataset: Dataset) -> None:
    """Warn where rows contradict the contacts, which a model would learn away as a force (`contact_doubts`)."""
    if ("ignore", None, ContactWarning, None, 0) in warnings.filters:
        return  # whoever wants none, as the command line after its own look, need not pay for it
    doubts = contact_doubts(dataset, model)  # check_distance refuses rows that are far, or warns
    Doubts(each for each in doubts if each.numbers.get("distance", 0.0) <= FAR_FROM_SURFACE).warn(ContactWarning, 3)


def refuse_what_looks_alike(model: Model, dataset: Dataset) -> None:
    """Name, before any search, forces that a log does not tell apart, and numbers that no row shows.

    Raises InvalidInput for what has no answer at all: a law that is listed twice, and a constant force on a joint that
    nothing drives while a contact may carry the same weight. Warns (DataWarning) of the rest, whose split the priors
    decide: laws with the same force in every row, a law that an unknown force beside it can imitate, and coefficients
    that change no force in any row.
    """
    titles = [force_title(law) for law in model.laws if law.learned]
    if twice := [title for title in dict.fromkeys(titles) if titles.count(title) > 1]:
        raise InvalidInput(f"forces hold {twice[0]!r} twice, which no log tells apart; leave one of them out.")
    few = dataset.rows(evenly(dataset, ROWS_LOOKED_AT))
    states = [torch.as_tensor(np.array(x), device=model.robot.device) for x in (few.q, few.v, few.u)]
    with torch.no_grad():
        state = model.state(*states)
        _refuse_offsets_of_idle_joints(model, state)
        pushes = [push for law in model.laws if law.learned for push in _pushes(law, state, model)]
        doubts = list[Doubt]()
        if idle := [push.name for push in pushes if push.share <= ROUNDING]:
            remedy = "leave it out, or give a log that does."
            doubts.append(
                look(about="forces", what=f"no row shows {listed(idle)}, so each stays at its prior;", do=remedy)
            )
        pushes = [push for push in pushes if push.share > ROUNDING]
        columns = [push.force.flatten() / torch.linalg.vector_norm(push.force) for push in pushes]
        same = [
            f"{one.name} and {other.name}"
            for (one, a), (other, b) in combinations(zip(pushes, columns, strict=True), 2)
            if one.law != other.law and float((a @ b).abs()) > 1.0 - EQUAL
        ]
        if same:
            what = f"{listed(same)} are the same force in every row, so the priors decide what is whose;"
            remedy = "leave one of them out, or give a log in which they differ."
            doubts.append(look(about="forces", what=what, do=remedy))
        for title, term, _ in model.unknown.named(model.robot):
            B, features = term.direction(model.dynamics(*states)), term.features(model.dynamics(*states))
            imitated = [push for push in pushes if any(_imitates(z, B[..., c], push) for c, z in enumerate(features))]
            if imitated:
                laws = listed(dict.fromkeys(push.law for push in imitated))
                what = f"gp:{title} can be what {laws} is: rows show only the sum, and the priors decide what is whose."
                remedy = f"Predictions are those of the sum; for numbers of {laws} by themselves leave gp:{title} out."
                doubts.append(look(about="forces", what=what, do=remedy))
    Doubts(doubts).warn(stacklevel=5)


@dataclass(frozen=True, eq=False)
class _Push:
    """What one coefficient of a law does: joint forces (rows, nv), and what they depend on, (rows, inputs)."""

    name: str
    law: str
    force: Tensor
    inputs: Tensor
    share: float
    """Size relative to the largest of its law."""


def _pushes(law: Law, state: State, model: Model) -> list[_Push]:
    """By entry of the first coefficient, which the force is linear in for the laws that forcegp brings."""
    name, title = next(iter(law.coefficients)), force_title(law)
    if law.inertia_basis(model.robot) is not None:
        return []  # rotors push against accelerations, which no force of (q, v, u) does
    joints = [model.robot.joint_names.index(joint) for joint in model.robot.single_joint_names]
    features = law.features(state)
    found = []
    given = getattr(law, name)
    known = given.std == 0.0 if isinstance(given, Normal) and given.std is not None else torch.tensor(False)
    for joint in joints if isinstance(law, JointLaw) else [0]:
        if bool(known.expand(model.robot.nv)[joint]):
            continue
        value = law.values[name].expand(model.robot.nv) if isinstance(law, JointLaw) else law.values[name]
        step = torch.zeros_like(value)
        step[..., joint if isinstance(law, JointLaw) else ()] = 1.0
        change = [law.force_at(state, {**law.values, name: value + sign * step}) for sign in (1.0, 0.0)]
        force = (change[0] - change[1]).expand_as(state.v)
        inputs = torch.stack([z[..., joint] if isinstance(law, JointLaw) else z[..., 0] for z in features], dim=-1)
        label = title if len(law.coefficients) == 1 else f"{title}.{name}"  # as its estimate is called
        own = label if not isinstance(law, JointLaw) else f"{label}.{model.robot.joint_names[joint]}"
        found.append(_Push(own, title, force, inputs, float(torch.linalg.vector_norm(force))))
    largest = max((push.share for push in found), default=0.0)
    return [replace(push, share=push.share / max(largest, 1e-300)) for push in found]


def _imitates(z: Tensor, B: Tensor, push: _Push) -> bool:
    """Whether a function of `z` (rows, d) along `B` (rows, nv) can be this force."""
    size = B.square().sum(-1)
    amplitude = (B * push.force).sum(-1) / size.clamp_min(1e-300)
    left = torch.linalg.vector_norm(push.force - amplitude[:, None] * B)
    if float(left) > EQUAL * float(torch.linalg.vector_norm(push.force)):
        return False
    if float(amplitude.std()) <= EQUAL * float(amplitude.abs().mean()):
        return True
    among = [bool((z - x[:, None]).abs().amin(-1).amax() <= EQUAL * (1.0 + x.abs().amax())) for x in push.inputs.T]
    return bool(z.shape[-1]) and all(among)


def _refuse_offsets_of_idle_joints(model: Model, state: State) -> None:
    """A constant on a joint that nothing drives is whatever a contact carries there: weight, with any sign."""
    if not model.contacts or not any(isinstance(law, Offset) and law.learned for law in model.laws):
        return
    idle = state.delivered.abs().amax(0) == 0.0
    names = [joint for joint in model.robot.single_joint_names if bool(idle[model.robot.joint_names.index(joint)])]
    if names and not bool(idle.all()):
        raise InvalidInput(
            f"nothing drives {listed(names)}, so an offset there can carry the weight that the contact carries, with "
            "any sign; leave 'offset' out, or give Offset(Normal(0.0, std)) a std of 0 at it."
        )


BRAKED = 0.4
"""Correlation of missing accelerations of a base with its velocity: below .2 in logs of feet, wheels and rotors without
drag, .45 to .83 with drag or ground friction."""
OTHER_ROBOT = 2.0  # factor between the masses of log and file, or of what holds the robot up, from which one is wrong


def doubts_of_base(
    given: Model, found: Model, rows: RecordedRows, residual: Float[np.ndarray, "rows nv"]
) -> Iterator[Doubt]:
    """Log and file have different masses, the base lacks a force of the size of gravity, or something brakes it."""
    robot, missing = given.robot, 0.0
    own = carrying(robot)
    if not any(isinstance(law, RigidBodies) and len(law.bodies(own, robot)) == len(own) for law in given.laws):
        return
    masses = [sum(each.robot.tree.inertias[carrying(each.robot), 3, 3, 0].tolist()) for each in (given, found)]
    if robot.base == "floating":
        rotation = rows.kinematics.frame_pose(robot.layout.moving[0])[:, :3, :3].cpu().numpy()
        missing = float(np.linalg.norm((rotation @ residual[:, :3, None]).mean(0)))
    wrong = ""
    if not masses[0] / OTHER_ROBOT <= masses[1] <= masses[0] * OTHER_ROBOT:
        wrong = f"by this log the robot weighs {masses[1]:.3g} kg, by its file {masses[0]:.3g} kg"
    elif missing * OTHER_ROBOT > np.linalg.norm(robot.gravity.cpu().numpy()) > 0.0:
        wrong = f"accelerations of the base are wrong by {missing:.3g} m/s^2 on average"
    linear = 3 if robot.base == "floating" else 0
    missed, v = residual[:, :linear], rows.v[:, :linear]
    braked = -float((missed * v).sum()) / max(float(np.linalg.norm(missed) * np.linalg.norm(v)), 1e-300)
    if wrong:
        what, remedy = f"{wrong}: what holds it up is not what the log states.", "flags of stance, thrust coefficients"
        yield look(about="base", what=what, do=f"Check {remedy} and the unit of u.")
    elif braked > BRAKED:
        remedy = "Weigh it, since thrust and mass look alike, and let forcegp fit learn the forces."
        if not thruster_columns(given):
            remedy = "forcegp fit --forces rigid-bodies:LINK,gp:joint,gp:joint-friction learns both."
        what = f"what the model lacks brakes the base (correlation {braked:.2g} with its velocity): ground friction or "
        yield look(about="base", what=f"{what}drag, which this regression takes for mass.", do=remedy)


ALIKE = 5.0  # times the error of a mass without offsets
RIGHT = 0.01  # residuals over a payload's torques below which it is right as it is
LEAST = 0.05  # share of the squares that a payload leaves, which only numbers of no body explain


def doubts_of_offsets(
    fit: Fit, offsets: Bool[np.ndarray, " terms"], slope: Float[np.ndarray, " 10"], own: slice
) -> Iterator[Doubt]:
    """Constant torques of joints look like the weight, since postures differ little; `slope` is that of the mass.

    Small errors of a model are then large ones of the mass, of which intervals hold the random part only. `own` are the
    coordinates of the payload, and the last ones those of `offsets`.
    """
    whole, seen = fit.information + fit.prior_information, np.zeros(len(fit.x))
    seen[own] = slope
    held = np.append(np.ones(len(seen) - len(offsets), dtype=bool), ~offsets)
    known = whole[np.ix_(held, held)]
    with_offsets, without = seen @ np.linalg.solve(whole, seen), seen[held] @ np.linalg.solve(known, seen[held])
    if with_offsets > ALIKE**2 * without:
        yield look(
            about="payload",
            what="constant torques of the joints ('offset') look like the payload's weight in these postures: with "
            f"them its mass is {(with_offsets / without) ** 0.5:.0f} times as unsure, and small errors of the model "
            "change it.",
            do="Leave 'offset' out, or give a baseline, or a log of more postures.",
        )


def doubts_of_no_body(
    fit: Fit, parameters: Float[np.ndarray, "10"], slopes: Float[np.ndarray, "10 10"], own: slice, link: str
) -> Iterator[Doubt]:
    """Ten free numbers in place of the payload's `parameters` explain much more: no body there does.

    Inside of what bodies can have, the best numbers are those found, and free ones explain no more. `own` are the
    coordinates of the payload, `slopes` derivatives of its parameters in them.
    """
    payload = fit.jacobian[..., own] @ np.linalg.inv(slopes)
    white, others = fit.residual / fit.noise, np.delete(fit.jacobian, np.r_[own], axis=-1)
    left, _ = left_by_least_squares(np.concatenate([payload, others], axis=-1) / fit.noise[:, None], white)
    cost = 0.5 * float((white**2).sum())
    more = cost - 0.5 * float((left**2).sum())
    rough = np.linalg.norm(fit.residual) > RIGHT * np.linalg.norm(payload @ parameters)
    if rough and more > max(CLEARLY, LEAST * cost):
        yield look(
            about="payload",
            what=f"no body on {link} explains the log: free numbers in place of its mass, centre and inertia leave "
            f"{more / cost:.0%} less. The payload is on another link, or links weigh less or otherwise than the URDF "
            "states.",
            do="Give link, or a baseline (a log without the payload), or identify all links.",
        )
