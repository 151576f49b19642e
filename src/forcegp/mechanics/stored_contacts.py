"""Contacts of every kind as plain JSON values."""

from collections.abc import Mapping
from typing import Any

from forcegp.mechanics.gauss_principle import Contact
from forcegp.mechanics.loops import SECOND, LoopClosure
from forcegp.mechanics.surfaces import SURFACES, object_from_dict, surface_to_dict
from forcegp.mechanics.wheels import WHEEL, RollingContact


def contact_to_dict(contact: Contact) -> dict[str, Any]:
    """Raises ContactError for a surface that holds code."""
    return {
        **{"frame": contact.frame, "point": list(contact.point)},
        **({} if contact.switch is None else {"switch": contact.switch}),
        "surface": surface_to_dict(contact.surface),
        **contact.more(),
    }


def contact_from_dict(entry: Mapping[str, Any]) -> Contact:
    """The contact that `contact_to_dict` stored. Raises KeyError or TypeError for anything else."""
    entry = {name: tuple(value) if isinstance(value, list) else value for name, value in entry.items()}
    place, switch = (entry["frame"], tuple(entry["point"])), entry.get("switch")
    surface = object_from_dict("surface", SURFACES, entry["surface"])
    for kind, names in ((LoopClosure, SECOND), (RollingContact, WHEEL)):
        if names[0] in entry:
            return kind(*place, surface, switch, **{name: entry[name] for name in names if name in entry})  # type: ignore[arg-type]  # the constructors check
    return Contact(*place, surface, switch)
