"""Objects that files carry as `{"type": name, field: value, ...}`, looked up in a registry of known types."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from forcegp.errors import FileFormatError

Kind = TypeVar("Kind")


def object_from_dict(what: str, registry: Mapping[str, type[Kind]], stored: object) -> Kind:
    """The object that `stored` describes, its lists as tuples; `what` names its kind in messages.

    Raises FileFormatError for anything but a mapping, an unknown type or wrong fields.
    """
    if not isinstance(stored, Mapping):
        raise FileFormatError(f"a stored {what} is {stored!r}; expected an object with a type")
    values = {key: tuple(value) if isinstance(value, list) else value for key, value in stored.items()}
    name = values.pop("type", None)
    if not isinstance(name, str) or name not in registry:
        raise FileFormatError(f"unknown {what} {name!r}; known: {', '.join(registry)}")
    try:
        return registry[name](**values)
    except TypeError as error:
        raise FileFormatError(f"{what} {name!r} has wrong fields {sorted(map(str, values))}: {error}") from None
