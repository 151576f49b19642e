"""Priors by name, as commands and quick scripts give them: "tool-friction + joint-friction:joints=joint_1"."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from typing import Any

from forcegp.errors import InvalidInput, unknown_name_message
from forcegp.mechanics import MechanicalSystem
from forcegp.priors.contact_friction import ContactFriction
from forcegp.priors.force_prior import ForcePrior, SumPrior
from forcegp.priors.joint_accelerations import JointAccelerations
from forcegp.priors.joint_forces import JointForces
from forcegp.priors.joint_friction import JointFriction
from forcegp.priors.no_forces import NoForces
from forcegp.priors.payload import Payload
from forcegp.priors.periodic_joint_forces import PeriodicJointForces
from forcegp.priors.tool_forces import ToolForces


@dataclass(frozen=True)
class NamedPrior:
    """A prior under a short name: what it is for, its class, and what differs from the defaults of that class."""

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
    "payload": NamedPrior("weight and place of an unknown load: payload:frame=LINK", Payload),
    "joint-accelerations": NamedPrior("accelerations without the contacts, on (q, v, u)", JointAccelerations),
    "none": NamedPrior("no unknown force at all", NoForces),
}
"""What `named_prior` and `forcegp fit --prior` know. Add your own: NAMED_PRIORS["mine"] = NamedPrior(..., MyPrior)."""


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
    if name not in NAMED_PRIORS:
        raise InvalidInput(unknown_name_message("prior", name, f"{expression!r}", NAMED_PRIORS))
    named = NAMED_PRIORS[name]
    given = dict(named.arguments)
    allowed = {field.name: field for field in fields(named.prior)}  # type: ignore[arg-type]  # priors are dataclasses
    for option in _split(options, ",") if colon else ():
        key, equals, value = (part.strip() for part in option.partition("="))
        if not equals or key not in allowed:
            known = ", ".join(allowed) or "no options at all"
            raise InvalidInput(f"prior {name!r} cannot take {option.strip()!r}; write FIELD=VALUE with one of: {known}")
        given[key] = _value(name, key, value, allowed[key].default)
    missing = [key for key, field in allowed.items() if field.default is MISSING and key not in given]
    if missing:
        raise InvalidInput(f"prior {name!r} needs {', '.join(missing)}: write {name}:{missing[0]}=...")
    return named.prior(**given)


def _value(name: str, key: str, text: str, default: Any) -> Any:
    """The text as what the field is by default."""
    if isinstance(default, bool):
        if text not in ("true", "false"):
            raise InvalidInput(f"prior {name!r} has {key}={text}; give true or false")
        return text == "true"
    try:
        if isinstance(default, int | float):
            return type(default)(text)
        if key == "point":
            return tuple(float(part) for part in text.split("/"))
    except ValueError:
        raise InvalidInput(f"prior {name!r} has {key}={text}; give a number (a point as x/y/z)") from None
    if isinstance(default, tuple) or key == "joints":
        return tuple(part.strip() for part in text.split("/"))
    return text[1:-1].strip() if text.startswith("(") and text.endswith(")") else text


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
