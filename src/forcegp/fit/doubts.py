"""What a log cannot teach a model, before a fit; and what speaks against what was found, after it."""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from forcegp.data import Dataset, contact_doubts
from forcegp.data.strokes import motor_positions
from forcegp.data.views import at_rest
from forcegp.doubts import Doubt, Doubts, look
from forcegp.errors import ContactWarning, InvalidInput
from forcegp.evidence.likelihood import CONSTANT, FAR_FROM_SURFACE, MarginalLikelihood, checked_values
from forcegp.evidence.parameter_space import ParameterSpace, force_title
from forcegp.forces import Force, Normal, Offset
from forcegp.model import Model
from forcegp.summary import listed

MISLEADING = 0.1  # share of the rows in which the past of friction is not known
INVISIBLE = 1e-9  # |H B_c| over |M^-1 B_c| below which accelerations show nothing of a latent: rounding, measured 1e-15
ROUNDING = 1e-12  # |M^-1 B_c| relative to the largest of them below which a latent moves nothing


def check_forces(likelihood: MarginalLikelihood) -> None:
    """Refuse what cannot be learned at all, and warn (DataWarning) of latents that the contacts hide.

    Raises InvalidInput for wrong shapes, forces that change no acceleration, and constant features.
    """
    dynamics, robot, unknown = likelihood.dynamics, likelihood.model.robot, likelihood.model.unknown
    B, features = checked_values(unknown, dynamics)
    if not (names := unknown.latent_names(robot)):
        return
    labels = unknown.feature_names(robot)
    for index, (name, z) in enumerate(zip(names, features, strict=True)):
        if z.shape[-1] and bool((z.var(0, correction=0).sqrt() <= CONSTANT * (1.0 + z.mean(0).abs())).all()):
            which = [f"feature {k}" for k in range(z.shape[-1])] if labels is None else labels[index]
            values = ", ".join(f"{value:.4g}" for value in z[0].tolist()[:4])
            raise InvalidInput(
                f"latent {name!r} depends on {', '.join(which)}, which is the same in all {len(z)} training rows "
                f"({values}), so its function cannot be learned; give data in which it changes, or leave this "
                "prior (or this joint) out"
            )
    terms = [number for number, which in enumerate(unknown.slices(robot)) for _ in range(which.stop - which.start)]
    free = dynamics.inverse_lower.mT @ (dynamics.inverse_lower @ B)
    Doubts(_hidden(names, terms, free, likelihood.observed.matrix @ B)).warn(stacklevel=5)


def _hidden(names: Sequence[str], terms: Sequence[int], free: Tensor, effect: Tensor) -> Iterator[Doubt]:
    """`free` is what each latent would do without the contacts, `effect` what it does."""
    size, shown = (part.square().sum(-2).mean(0).sqrt() for part in (free, effect))
    absent = (size <= ROUNDING * size.max()).tolist()
    for term in set(terms):
        own = [index for index, number in enumerate(terms) if number == term]
        if all(absent[index] for index in own):
            idle = listed(repr(names[index]) for index in own)
            remedy = "check frame, point and contact of the prior, or leave it out"
            raise InvalidInput(f"{idle} exerts no force at any training row; {remedy}")
    hidden = [not nothing and flat for nothing, flat in zip(absent, (shown <= INVISIBLE * size).tolist(), strict=True)]
    blind = listed(repr(name) for name, flat in zip(names, hidden, strict=True) if flat)
    remedy = "learn a force along the surface, such as gp:tool-friction, or leave that prior out"
    if all(nothing or flat for nothing, flat in zip(absent, hidden, strict=True)):
        seen = f"no data can identify {blind}: the contacts take the whole force, and the acceleration shows none of it"
        raise InvalidInput(f"{seen}; {remedy}")
    if any(hidden):
        what = f"no data can identify {blind}: the contacts take that force, the acceleration shows none of it, "
        what += "and its posterior and that of the normal force are the prior;"
        yield look(about="effects", what=what, do=remedy)


def warn_of_contacts(model: Model, dataset: Dataset) -> None:
    """Warn where rows contradict the contacts, which a model would learn away as a force (`contact_doubts`)."""
    if ("ignore", None, ContactWarning, None, 0) in warnings.filters:
        return  # whoever wants none, as the command line after its own look, need not pay for it
    doubts = contact_doubts(dataset, model)  # check_distance refuses rows that are far, or warns
    Doubts(each for each in doubts if each.numbers.get("distance", 0.0) <= FAR_FROM_SURFACE).warn(ContactWarning, 3)


def refuse_what_has_no_answer(model: Model) -> None:
    """Raise InvalidInput for a law that is listed twice. What else no log shows is in `Estimate.why`."""
    titles = [force_title(law) for law in model.laws if law.learned]
    if twice := [title for title in dict.fromkeys(titles) if titles.count(title) > 1]:
        raise InvalidInput(f"forces hold {twice[0]!r} twice, which no log tells apart; leave one of them out.")


def without_idle_offsets(model: Model, dataset: Dataset) -> Model:
    """The model without offsets at idle joints in contact: there one can carry the weight, with any sign."""
    if not model.contacts or not any(isinstance(law, Offset) and law.learned for law in model.laws):
        return model
    states = [torch.as_tensor(np.array(x), device=model.robot.device) for x in (dataset.q, dataset.v, dataset.u)]
    idle = model.state(*states).delivered.abs().amax(0) == 0.0

    def kept(law: Force) -> Force:
        if not isinstance(law, Offset) or not law.learned:
            return law
        prior = law.value if isinstance(law.value, Normal) else Normal()
        std = torch.as_tensor(torch.nan if prior.std is None else prior.std, dtype=torch.float64, device=idle.device)
        return replace(law, value=Normal(prior.mean, torch.where(idle, 0.0, std.expand(len(idle)))))

    return model if bool(idle.all()) else replace(model, forces=tuple(map(kept, model.forces)))


def doubts_of_past(model: Model, log: Dataset, known: Bool[np.ndarray, " rows"]) -> Iterator[Doubt]:
    """That many rows do not know the past of friction that is estimated."""
    share, estimated = 1.0 - known.mean(), any(law.learned and law.memory_names(model.robot) for law in model.laws)
    if estimated and share > MISLEADING and not at_rest(log):
        what = "until a joint has moved a little, a log does not tell which way its gear was turned last: "
        what += f"{share:.0%} of the rows come before that, and levels of dry friction may be too small by as much."
        yield look(about="friction that remembers", what=what, do="Give longer episodes, or leave memory out.")


def doubts_of_reversals(model: Model, log: Dataset) -> Iterator[Doubt]:
    """That friction turns over less than the step of an encoder, so that this is what is learned."""
    for law in model.laws:
        if (joints := law.memory_joints(model.robot)) and log.time_ordered:
            steps = motor_positions(log, log.transmission)[1]
            turns = steps * law.values["sigma"].expand(model.robot.nv).cpu().numpy()
            if names := [f"{log.joint_names[j]} ({1e3 * steps[j]:.2g})" for j in joints if turns[j] > 1.0]:
                what = "steps of encoders [mrad or mm] are larger than the ways over which it turns: "
                what += f"{', '.join(names)}."
                do = "Do not rely on sigma there, or record finer positions."
                yield look(about="friction that remembers", what=what, do=do)


def doubts_of_memory(space: ParameterSpace, x: np.ndarray) -> Iterator[Doubt]:
    """Where its stiffness ended at a bound."""
    for own, term in zip(space.split(x)[1], space.terms, strict=True):
        joints = np.array(space.model.robot.joint_names)[list(term.joints or ())]
        for ends, when in ((term.high, "sooner"), (term.low, "later")) if term.name == "sigma" else ():
            if (own == ends).any():
                what = f"friction of {listed(joints[own == ends])} turns {when} after a reversal than the log can "
                what += "tell (its sigma is at a bound)."
                do = "Give a log of slower reversals; predictions between reversals do not depend on it."
                yield look(about="friction that remembers", what=what, do=do)
