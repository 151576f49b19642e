"""What data cannot teach a prior, and whether they bear out the contacts: checked before anything is fitted."""

import warnings
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.data import Dataset, contact_doubts
from forcegp.errors import ContactError, ContactWarning, DataWarning, InvalidInput
from forcegp.mechanics import MechanicalSystem
from forcegp.models.identification.physical_parameters import Learned, PhysicalParameters
from forcegp.models.structured.components import term_slices
from forcegp.models.structured.marginal_likelihood import MarginalLikelihood, checked_values
from forcegp.models.training_data import CONSTANT, TrainingData
from forcegp.robots.structure import LinkInertia
from forcegp.summary import listed

INVISIBLE = 1e-9
"""|H B_c| relative to |M^-1 B_c| below which accelerations show nothing of a latent: rounding, measured 1e-15."""
ROUNDING = 1e-12
"""|M^-1 B_c| relative to the largest of them below which a latent moves nothing."""
EQUAL = 1e-9
"""Relative difference of two latents' effects and features below which they are the same."""

LEFT_OUT = 0.1
"""Share of what the known forces do that may lie where no latent acts, without a word."""
SPAN = 1e-9
"""Singular values of unit effects relative to the largest below which they are one effect fewer."""
ROWS_LOOKED_AT = 500


def _warn(text: str) -> None:
    warnings.warn(text, DataWarning, stacklevel=6)


def check_prior(likelihood: MarginalLikelihood) -> None:
    """Refuse what cannot be learned at all, and warn of what cannot be learned in part.

    Raises InvalidInput if the prior gives other shapes or types than it should, if no latent changes the acceleration
    at any training point, if all of one term do nothing at all, if all features of a latent are constant (a tool or
    joint that never moves), and if latents of two terms do the same in every row. Warns (DataWarning) of single
    features that are constant, of latents that move nothing or that the constraint hides while others show, and, with
    the mean "zero", of known forces that no latent can take over.
    """
    dynamics = likelihood.dynamics()
    B, features = checked_values(likelihood.prior, dynamics)
    names = likelihood.prior.latent_names(likelihood.system.robot)
    if not names:
        return
    _check_features(likelihood, names, features)
    effect = dynamics.H @ B
    slices = [which for *_, which in term_slices(likelihood.prior, likelihood.system.robot)]
    terms = [number for number, which in enumerate(slices) for _ in range(which.stop - which.start)]
    shows = _check_visible(names, terms, dynamics.inverse_lower.mT @ (dynamics.inverse_lower @ B), effect)
    _check_distinct(names, terms, shows, effect, likelihood.standardization(features))
    if likelihood.mean == "zero":
        _check_known_forces(effect, (dynamics.H @ dynamics.Q_K[..., None])[..., 0])


def _check_features(likelihood: MarginalLikelihood, names: Sequence[str], features: Sequence[Tensor]) -> None:
    robot = likelihood.system.robot
    labels = likelihood.prior.feature_names(robot)
    scalings = likelihood.prior.scalings(robot)
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
        _warn(
            f"{listed(which)} never changes in the training rows, so nothing is learned of how {_few(latents)} depends "
            "on it; leave that input out (inputs=...), or give data in which it changes"
        )


def _check_visible(names: Sequence[str], terms: Sequence[int], free: Tensor, effect: Tensor) -> list[bool]:
    """Which latents show; `free` is what each would do without the contacts, `effect` what it does (N, nv, C)."""
    size, shown = (part.square().sum(-2).mean(0).sqrt() for part in (free, effect))
    absent = (size <= ROUNDING * size.max()).tolist()
    for term in set(terms):
        own = [index for index, number in enumerate(terms) if number == term]
        if all(absent[index] for index in own):
            raise InvalidInput(
                f"{_few([names[index] for index in own])} exerts no force at any training row; check frame, point and "
                "contact of the prior, or leave it out"
            )
    if any(absent):
        _warn(
            f"{_few([name for name, nothing in zip(names, absent, strict=True) if nothing])} moves no joint at any "
            "training row, so its posterior is its prior; give data in other postures, or leave it out "
            "if the prior can do without"
        )
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
        _warn(
            f"no data can identify {_few(blind)}: the contacts take that force, the acceleration shows none of it, and "
            f"its posterior and that of the normal force are the prior; {remedy}"
        )
    return shows


def _check_distinct(
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


def _check_known_forces(effect: Tensor, known: Tensor) -> None:
    """Whether the latents act where the known forces do: the part of `known` (N, nv) outside the span of `effect`."""
    step = -(-len(known) // ROWS_LOOKED_AT)
    effect, known = effect[::step], known[::step]
    columns = effect / torch.linalg.vector_norm(effect, dim=-2, keepdim=True).clamp_min(torch.finfo(effect.dtype).tiny)
    carried = (columns @ (torch.linalg.pinv(columns, rtol=SPAN) @ known[..., None]))[..., 0]
    size = float(known.square().sum().sqrt())
    share = float((known - carried).square().sum().sqrt()) / size if size > 0.0 else 0.0
    if share > LEFT_OUT:
        _warn(
            f"with the mean 'zero' the prior carries gravity, actuation and all known forces, but {share:.0%} of the "
            "acceleration that they cause lies where none of its forces acts; take `mean='analytical'`, or "
            "add a force on every joint to the `prior`, JointForces()"
        )


def _few(names: Sequence[str]) -> str:
    return listed(map(repr, names))


FAR_FROM_SURFACE = 0.01
"""Median distance of the training points from a contact's surface, in m, beyond which a warning is given."""


def check_distance(system: MechanicalSystem, training: TrainingData) -> None:
    """Refuse a surface that no training state touches, and warn where half of them are far from it."""
    kinematics = system.robot.kinematics(training.q)
    for index, contact in enumerate(system.contacts):
        # divided by |s_p|, which is 1 for signed distances, the value of any surface is a distance near it
        size = torch.linalg.vector_norm(contact.surface.gradient(contact.position(kinematics)), dim=-1)
        distances = (contact.distance(kinematics) / size).abs()
        distance = float(distances.median())
        what = f"the surface of contact {index} (frame {contact.frame!r})"
        remedy = "check its surface, point and units (m), or leave the contact out"
        if float(distances.min()) > FAR_FROM_SURFACE:
            raise ContactError(
                f"no training point touches {what}: the nearest is {float(distances.min()):.3g} m away, half of them "
                f"more than {distance:.3g} m; {remedy}"
            )
        if distance > FAR_FROM_SURFACE:
            _warn(
                f"half of the training points lie more than {distance:.3g} m from {what}; {remedy}, or train on the "
                "rows in contact only (forcegp.data.rows_in_contact)"
            )


def warn_of_contacts(system: MechanicalSystem, dataset: Dataset) -> None:
    """Warn where rows contradict the contacts, which a model would learn away as a force (`contact_doubts`)."""
    if ("ignore", None, ContactWarning, None, 0) in warnings.filters:
        return  # whoever wants none, as the command line after its own look, need not pay for it
    for doubt in contact_doubts(dataset, system):
        if doubt.numbers.get("distance", 0.0) > FAR_FROM_SURFACE:
            continue  # check_distance refuses the rows or warns
        warnings.warn(str(doubt), ContactWarning, stacklevel=4)


IMITATED = 0.01
"""Share of what a parameter does to the accelerations that is too small to be seen beside the forces of a prior."""
CHANGE = 1e-4
"""Of scaled parameters, for what they do."""
TAKES_PART = 0.1
"""Share of the largest part from which on an input is named."""


def warn_of_imitations(likelihood: MarginalLikelihood, learned: Learned | Sequence[Learned]) -> tuple[str, ...]:
    """Warn of inertias of a robot whose base moves that forces of the prior can stand for; returns their names.

    Where forces that are linear in inputs of the prior change all rows as a parameter does, no motion shows it: a
    heavier drone with as much more thrust moves the same. Rows with as few equations as such forces have coefficients
    show nothing of that.
    """
    links = [one for one in (learned if isinstance(learned, Sequence) else (learned,)) if isinstance(one, LinkInertia)]
    robot = likelihood.system.robot
    if robot.space.is_vector_space or not links or not likelihood.prior.latent_names(robot):
        return ()
    physical = PhysicalParameters.of(likelihood.system, links)
    in_values = torch.as_tensor(torch.autograd.functional.jacobian(physical.values, physical.zero))

    def accelerations(s: Tensor) -> Tensor:
        return likelihood.dynamics(physical.tensors(s)).acceleration_map().offset.flatten()

    with torch.no_grad():
        forces, inputs = _linear_forces(likelihood)
        steps = CHANGE * torch.eye(len(in_values), dtype=forces.dtype, device=forces.device)
        scaled = torch.stack([accelerations(step) - accelerations(-step) for step in steps], -1)
        change = scaled @ torch.linalg.inv(in_values)
        parts = torch.linalg.lstsq(forces, change, driver="gelsd").solution
        left, size = (torch.linalg.vector_norm(x, dim=0) for x in (change - forces @ parts, change))
    imitated = ((left <= IMITATED * size) & (size > INVISIBLE * size.max())).tolist()
    names = tuple(name for name, hidden in zip(physical.names, imitated, strict=True) if hidden)
    if not names or len(forces) <= forces.shape[1]:
        return ()
    share = parts[:, imitated].abs().amax(1)
    which = list(dict.fromkeys(inputs[k] for k in torch.nonzero(share >= TAKES_PART * share.max())[:, 0].tolist()))
    _warn(
        f"{', '.join(names)}: forces of the prior in proportion to {_few(which)} move the robot just as another value "
        "does (a heavier robot with as much more thrust moves the same), so no motion shows it. Where they are known, "
        "leave these inputs out (inputs=...); else keep the value."
    )
    return names


def _linear_forces(likelihood: MarginalLikelihood) -> tuple[Float[Tensor, "equations n"], list[str]]:
    """Columns of unit length: accelerations of all rows by forces that are linear in one input; their inputs.

    Constant forces belong to them, but where inputs are only scaled, since zero means something there.
    """
    prior, robot, dynamics = likelihood.prior, likelihood.system.robot, likelihood.dynamics()
    W, labels, scalings = dynamics.H @ prior.mixing(dynamics), prior.feature_names(robot), prior.scalings(robot)
    columns, inputs = [], list[str]()
    for k, z in enumerate(prior.features(dynamics)):
        ways = {scalings[k]} if isinstance(scalings[k], str) else {*scalings[k]}
        constant = [] if ways == {"scale"} and z.shape[-1] else ["a constant"]
        inputs += [*(labels[k] if labels else (f"feature {j}" for j in range(z.shape[-1]))), *constant]
        columns.append(W[:, :, k, None] * torch.cat([z, z.new_ones(len(z), len(constant))], -1)[:, None])
    forces = torch.cat(columns, -1).flatten(0, 1)
    return forces / torch.linalg.vector_norm(forces, dim=0).clamp_min(torch.finfo(forces.dtype).tiny), inputs
