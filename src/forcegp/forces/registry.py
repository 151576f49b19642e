"""Forces by name, as files and commands have them: names out of `FORCES`, unknown forces behind "gp:".

Options are FIELD=VALUE, as in viscous, stribeck:level=1.2, payload:tool0, gp:joint-friction:kernel=matern-3/2.
"""

import difflib
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from inspect import Parameter, signature
from typing import Any

from forcegp.errors import InvalidInput, require_known, usable_arguments
from forcegp.forces.force import Body, Force, Law, LogNormal, Normal
from forcegp.mechanics.surfaces import from_stored

FORCES: dict[str, str | type[Force]] = {
    "actuation": "actuation.Actuation",
    "thrusters": "actuation.Thrusters",
    "pull": "actuation.Pull",
    "observed-wrench": "actuation.ObservedWrench",
    "observed-wind": "actuation.ObservedWind",
    "rigid-bodies": "rigid_bodies.RigidBodies",
    "payload": "rigid_bodies.Payload",
    "viscous": "joint_laws.Viscous",
    "direction": "joint_laws.DirectionalFriction",
    "coulomb": "joint_laws.Coulomb",
    "stribeck": "joint_laws.Stribeck",
    "load": "joint_laws.LoadFriction",
    "gear": "joint_laws.GearFriction",
    "offset": "joint_laws.Offset",
    "spring": "joint_laws.Spring",
    "rotor": "joint_laws.Rotor",
    "joint-forces": "joint_forces.JointForces",
    "joint-accelerations": "joint_forces.JointAccelerations",
    "independent": "joint_forces.IndependentAccelerations",
    "joint-friction": "joint_forces.JointFriction",
    "joint-position": "joint_forces.JointPositionForces",
    "tool-forces": "link_forces.ToolForces",
    "contact-friction": "contact_friction.ContactFriction",
    "aerodynamic": "link_forces.AerodynamicForce",
}
"""Name -> class, or where in this package it is, so that only what is used is imported. Add yours."""

UNKNOWN, MEMORY = "gp:", "memory"
SHORT: dict[str, tuple[str, Mapping[str, Any]]] = {
    "bodies": ("rigid-bodies", {"learn": "all"}),
    "gain": ("actuation", {"gain": None}),
    "joint": ("joint-forces", {}),
    "tool-friction": ("tool-forces", {}),
    "tool-forces": ("tool-forces", {"inputs": ("velocity", "position"), "kernel": "squared-exponential"}),
    "load-friction": ("contact-friction", {"load": True}),
}
"""Names that `parse_forces` takes besides, with fields that differ from their defaults."""


def dry_laws() -> tuple[str, ...]:
    """Names of the laws with a `level`: dry friction."""
    return tuple(name for name in FORCES if "level" in getattr(force_class(name), "coefficients", ()))


def force_class(name: str) -> Any:
    """The class of this name, or the function that makes several. Raises InvalidInput."""
    found = FORCES.get(name, name)
    if not isinstance(found, str):
        return found
    module, dot, attribute = found.partition(".")
    if not dot:
        require_known("force", name, "the registry", [*FORCES, *SHORT])
    return getattr(import_module(f"forcegp.forces.{module}"), attribute)


def force_name(force: Force) -> str:
    """The name of a force in `FORCES`. Raises InvalidInput for one that has none, which no file can carry."""
    kind = type(force)
    for name, entry in FORCES.items():
        if entry is kind or f"{kind.__module__}.{kind.__name__}" == f"forcegp.forces.{entry}":
            return name
    seen = f"a {kind.__name__} cannot be stored: register it first, FORCES['my-force'] = {kind.__name__}"
    raise InvalidInput(f"{seen}; registered: {', '.join(FORCES)}")


def force_to_dict(force: Force) -> dict[str, Any]:
    """Plain values that `force_from_dict` turns back. Raises InvalidInput for a force that is not in `FORCES`."""
    return {"type": force_name(force), **force.to_dict()}


def force_from_dict(stored: object) -> Force:
    """The force that `force_to_dict` stored. Raises FileFormatError for an unknown type or wrong fields."""
    fields = {key: _read(x) for key, x in stored.items()} if isinstance(stored, Mapping) else stored
    return from_stored("force", fields, FORCES, force_class, "import the module of a force of your own first. Known")


PRIORS = {kind.__name__: kind for kind in (Normal, LogNormal, Body)}


def _read(value: Any) -> Any:
    if isinstance(value, Mapping):
        if len(value) == 1 and (name := next(iter(value))) in PRIORS and isinstance(value[name], Mapping):
            return PRIORS[name](**{key: _read(entry) for key, entry in value[name].items()})
        return {key: _read(entry) for key, entry in value.items()}
    return tuple(value) if isinstance(value, list) else value


@usable_arguments("parse_forces")
def parse_forces(expression: str | Sequence[str]) -> tuple[Force, ...]:
    """The forces of a text, or of its parts: `NAME[:VALUE][:FIELD=VALUE...]` with commas between them, "/" in lists.

    Raises InvalidInput for unknown names, fields and values.
    """
    words = split_outside(expression, ",") if isinstance(expression, str) else list(expression)
    joined: list[str] = []
    for word in (word.strip() for word in words):
        # a comma may stand between options as well: gp:tool-forces:contact=1,kernel=linear
        if joined and "=" in word.partition(":")[0]:
            joined[-1] += f":{word}"
        else:
            joined.append(word)
    made: list[Force] = []
    for word in joined:
        unknown = word.startswith(UNKNOWN)
        name, *options = split_outside(word.removeprefix(UNKNOWN), ":")
        name = name.strip()
        if name not in (*SHORT, *FORCES) or is_unknown(name) != unknown:
            _refuse(name, unknown, expression)
        kind, given = SHORT.get(name, (name, {}))
        several = called(f"force {name!r}", force_class(kind), options, given)
        made += several if isinstance(several, tuple) else (several,)
    return tuple(made)


def is_unknown(name: str) -> bool:
    """Whether a name without "gp:" is that of an unknown force."""
    kind = force_class(SHORT.get(name, (name, {}))[0])
    return not (isinstance(kind, type) and issubclass(kind, Law))


def called(what: str, make: Callable[..., Any], options: Sequence[str], fixed: Mapping[str, Any] | None = None) -> Any:
    """`make` with options FIELD=VALUE; the first may leave its field out. Raises InvalidInput, naming `what`."""
    given, allowed = dict(fixed or {}), signature(make).parameters
    for option in options:
        key, equals, value = (part.strip() for part in option.partition("="))
        if not equals and key in allowed and (key == MEMORY or allowed[key].default is False):
            value = "true"
        elif not equals and option is options[0]:
            key, value = next(iter(allowed), ""), option.strip()
        if key not in allowed or not value:
            close = difflib.get_close_matches(key, allowed, n=1)
            hint = f" (did you mean {close[0]!r}?)" if close and close[0] != key else ""
            remedy = f"write FIELD=VALUE with one of: {', '.join(allowed)}" if allowed else "it has no options"
            raise InvalidInput(f"{what} cannot take {option.strip()!r}{hint}; {remedy}")
        given[key] = _value(what, key, value, make, allowed[key])
    missing = [key for key, field in allowed.items() if field.default is Parameter.empty and key not in given]
    if missing:
        raise InvalidInput(f"{what} needs {', '.join(missing)}: write {missing[0]}=...")
    return make(**given)


def _refuse(name: str, unknown: bool, expression: Any) -> None:
    from forcegp.forces.kernels import KERNELS  # gpytorch, which only a mistake needs

    whole = repr(expression if isinstance(expression, str) else ",".join(expression))
    if name in KERNELS and name not in FORCES:
        seen = f"{name!r} in {whole} is a kernel, not a force"
        raise InvalidInput(f"{seen}; write it as an option, gp:tool-friction:kernel={name}")
    if name in FORCES or name in SHORT:
        other = name if unknown else f"{UNKNOWN}{name}"
        kind = "a law with coefficients" if unknown else "an unknown force"
        raise InvalidInput(f"{name!r} in {whole} is {kind}; write {other}")
    require_known("force", name, whole, [each for each in (*SHORT, *FORCES) if is_unknown(each) == unknown])


def _value(what: str, key: str, text: str, make: Callable[..., Any], field: Parameter) -> Any:
    """The text as what the option is by default: truth, number, numbers, names, or text."""
    if key == MEMORY and text not in ("true", "false"):
        return tuple(part.strip() for part in text.split("/"))
    number_by_default = key in getattr(make, "coefficients", {}) or field.annotation in (float | None, "float | None")
    default = False if key == MEMORY else 0.0 if number_by_default else field.default
    if isinstance(default, bool):
        if text not in ("true", "false"):
            raise InvalidInput(f"{what} has {key}={text}; give true or false")
        return text == "true"
    several = default if isinstance(default, tuple) else ()
    numbers = bool(several) and all(isinstance(entry, int | float) for entry in several)
    number = int if all(isinstance(entry, int) for entry in several) else float
    try:
        if isinstance(default, int | float) and "/" not in text:
            return type(default)(text)
        if numbers or isinstance(default, int | float):
            return tuple((number if numbers else float)(part) for part in text.split("/"))
    except ValueError:
        example = "/".join(map(str, several))
        whole = "whole " if (number if numbers else type(default)) is int else ""
        kind = f"{whole}numbers as in {example}" if numbers else f"a {whole}number"
        raise InvalidInput(f"{what} has {key}={text}; give {kind}") from None
    if key == "learn":
        return "all" if text == "all" else tuple(part.strip() for part in text.split("/"))
    if isinstance(default, tuple) or key == "joints":
        return tuple(part.strip() for part in text.split("/"))
    return text[1:-1].strip() if text.startswith("(") and text.endswith(")") else text


def split_outside(text: str, separator: str) -> list[str]:
    """The parts between separators outside of parentheses."""
    parts, depth = [""], 0
    for character in text:
        depth += (character == "(") - (character == ")")
        if character == separator and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return parts
