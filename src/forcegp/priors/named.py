"""Priors by name, as commands and quick scripts give them, and as stored models hold them."""

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from inspect import Parameter, signature
from itertools import accumulate
from typing import Any

from forcegp.errors import FileFormatError, InvalidInput, require_known, usable_arguments
from forcegp.mechanics import MechanicalSystem
from forcegp.mechanics.surfaces import object_from_dict
from forcegp.priors.base_wrench import AerodynamicForce, BaseWrench
from forcegp.priors.contact_friction import ContactFriction, foot_friction
from forcegp.priors.force_prior import ForcePrior, SumPrior
from forcegp.priors.joint_forces import JointAccelerations, JointForces, JointFriction, NoForces, PeriodicJointForces
from forcegp.priors.kernels import KERNELS
from forcegp.priors.tool_forces import Payload, ToolForces

PRIORS: dict[str, type[ForcePrior]] = {
    "joint-forces": JointForces,
    "joint-accelerations": JointAccelerations,
    "joint-friction": JointFriction,
    "tool-forces": ToolForces,
    "contact-friction": ContactFriction,
    "periodic-joint-forces": PeriodicJointForces,
    "payload": Payload,
    "base-wrench": BaseWrench,
    "aerodynamic": AerodynamicForce,
    "no-forces": NoForces,
}
"""Priors that stored models can name, besides sums of them."""

SUM = "sum"


def prior_to_dict(prior: ForcePrior) -> dict[str, Any]:
    """Plain values that `prior_from_dict` turns back. Raises InvalidInput for a prior that is not in `PRIORS`."""
    if isinstance(prior, SumPrior):
        return {"type": SUM, "terms": [prior_to_dict(term) for term in prior.terms]}
    name = next((name for name, kind in PRIORS.items() if type(prior) is kind), None)
    if name is None:
        raise InvalidInput(
            f"a {type(prior).__name__} cannot be stored: register it first, PRIORS['my-prior'] = "
            f"{type(prior).__name__}; registered: {', '.join(PRIORS)}"
        )
    return {"type": name, **prior.to_dict()}


def described_prior(prior: ForcePrior) -> dict[str, Any]:
    """`prior_to_dict`, or the name alone of a prior that is not in `PRIORS`: only storing a model needs more."""
    try:
        return prior_to_dict(prior)
    except InvalidInput:
        return {"type": type(prior).__name__}


def prior_from_dict(stored: object) -> ForcePrior:
    """The prior that `prior_to_dict` stored. Raises FileFormatError for an unknown type or wrong fields."""
    if isinstance(stored, Mapping) and stored.get("type") == SUM:
        terms = stored.get("terms")
        if not isinstance(terms, list | tuple) or set(stored) != {"type", "terms"}:
            raise FileFormatError(f"a stored sum of priors has {sorted(map(str, stored))}; expected a list of terms")
        return SumPrior(tuple(prior_from_dict(term) for term in terms))
    return object_from_dict("prior", PRIORS, stored)


@dataclass(frozen=True)
class NamedPrior:
    """A prior under a short name: what it is for, its class, and what differs from the defaults of that class.

    The class, or any other callable, is asked for its parameters; their defaults decide how options are read.
    """

    summary: str
    prior: Callable[..., ForcePrior]
    arguments: tuple[tuple[str, Any], ...] = ()


NAMED_PRIORS: dict[str, NamedPrior] = {
    "joint": NamedPrior("a force at every joint, on (q, v, u)", JointForces),
    "joint-friction": NamedPrior("friction in every joint, on its own velocity", JointFriction),
    "joint-ripple": NamedPrior("cogging and gear ripple, periodic in every joint's position", PeriodicJointForces),
    "tool-friction": NamedPrior("two tangential forces at the contact, on its velocity", ToolForces),
    "tool-forces": NamedPrior(
        "two tangential forces at the contact, on velocity and place",
        ToolForces,
        (("inputs", ("velocity", "position")), ("kernel", "squared-exponential")),
    ),
    "contact-friction": NamedPrior("isotropic friction at the contact, on the sliding speed", ContactFriction),
    "load-friction": NamedPrior("the same, proportional to the normal force", ContactFriction, (("load", True),)),
    "foot-friction": NamedPrior("the same under several feet that slide: foot-friction:contacts=0/1", foot_friction),
    "friction-map": NamedPrior(
        "viscous friction at the contact whose coefficient depends on the place",
        ContactFriction,
        (("viscous", True), ("inputs", ("position",))),
    ),
    "payload": NamedPrior("weight and place of an unknown load: payload:frame=LINK", Payload),
    "base-wrench": NamedPrior("force and torque on a base that moves, on its motion and attitude", BaseWrench),
    "aerodynamic": NamedPrior("what air and wind do to a robot that flies", AerodynamicForce),
    "joint-accelerations": NamedPrior("accelerations without the contacts, on (q, v, u)", JointAccelerations),
    "none": NamedPrior("no unknown force at all", NoForces),
}
"""The names that `named_prior` and `forcegp fit --prior` take.

Add your own: NAMED_PRIORS["mine"] = NamedPrior(..., MyPrior).
"""


@usable_arguments("named_prior")
def named_prior(expression: str, system: MechanicalSystem | None = None) -> ForcePrior:
    """The prior of an expression: names from `NAMED_PRIORS`, added by "+", each with options NAME:FIELD=VALUE,...

    Lists are written with "/", for example "joint:inputs=q/v", and so are points: "tool-forces:frame=link_7,
    point=0/0/0.1,axes=world". A "+" inside of a kernel needs parentheses: "tool-friction:kernel=(linear + deep)".
    With `system` the prior is also checked against it.
    Raises InvalidInput for unknown names, fields and values, and as `ForcePrior.check`.
    """
    terms = [_one(text.strip(), expression) for text in _split(expression, "+")]
    prior = terms[0] if len(terms) == 1 else SumPrior(tuple(terms))
    if system is not None:
        prior.check(system)
    return prior


def _one(text: str, expression: str) -> ForcePrior:
    name, colon, options = text.partition(":")
    name = name.strip()
    if name not in NAMED_PRIORS and name in KERNELS:
        raise InvalidInput(
            f"{name!r} in {expression!r} is a kernel, not a prior; a '+' inside of a kernel needs parentheses, as in "
            f"tool-friction:kernel=(linear + {name})"
        )
    require_known("prior", name, f"{expression!r}", NAMED_PRIORS)
    named = NAMED_PRIORS[name]
    given = dict(named.arguments)
    allowed = signature(named.prior).parameters
    for option in _split(options, ",") if colon else ():
        key, equals, value = (part.strip() for part in option.partition("="))
        if not equals or key not in allowed:
            close = difflib.get_close_matches(key, allowed, n=1)
            hint = f" (did you mean {close[0]!r}?)" if close and close[0] != key else ""
            what = f"write FIELD=VALUE with one of: {', '.join(allowed)}" if allowed else "it has no options"
            raise InvalidInput(f"prior {name!r} cannot take {option.strip()!r}{hint}; {what}")
        given[key] = _value(name, key, value, allowed[key].default)
    missing = [key for key, field in allowed.items() if field.default is Parameter.empty and key not in given]
    if missing:
        raise InvalidInput(f"prior {name!r} needs {', '.join(missing)}: write {name}:{missing[0]}=...")
    return named.prior(**given)


def _value(name: str, key: str, text: str, default: Any) -> Any:
    """The text as what the option is by default: truth, number, numbers, names, or text."""
    if isinstance(default, bool):
        if text not in ("true", "false"):
            raise InvalidInput(f"prior {name!r} has {key}={text}; give true or false")
        return text == "true"
    several = default if isinstance(default, tuple) else ()
    numbers = bool(several) and all(isinstance(entry, int | float) for entry in several)
    number = int if all(isinstance(entry, int) for entry in several) else float
    try:
        if isinstance(default, int | float):
            return type(default)(text)
        if numbers:
            return tuple(number(part) for part in text.split("/"))
    except ValueError:
        example = "/".join(map(str, several))
        whole = "whole " if (number if numbers else type(default)) is int else ""
        kind = f"{whole}numbers as in {example}" if numbers else f"a {whole}number"
        raise InvalidInput(f"prior {name!r} has {key}={text}; give {kind}") from None
    if isinstance(default, tuple) or key == "joints":
        return tuple(part.strip() for part in text.split("/"))
    return _without_parentheses(text)


def _without_parentheses(text: str) -> str:
    """Without the one pair that encloses the whole text; "(a) + (b)" stays as it is."""
    depths = list(accumulate((character == "(") - (character == ")") for character in text))
    enclosed = text.startswith("(") and 0 in depths and depths.index(0) == len(text) - 1
    return text[1:-1].strip() if enclosed else text


def _split(text: str, separator: str) -> list[str]:
    """The parts between separators outside of parentheses."""
    parts, depth = [""], 0
    for character in text:
        depth += (character == "(") - (character == ")")
        if character == separator and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return parts
