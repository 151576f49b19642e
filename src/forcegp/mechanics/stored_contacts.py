"""Contacts of every kind as plain JSON values."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from forcegp.errors import ContactError
from forcegp.mechanics.gauss_principle import Contact
from forcegp.mechanics.loops import LoopClosure
from forcegp.mechanics.surfaces import SURFACES, object_from_dict, surface_to_dict
from forcegp.mechanics.wheels import RollingContact

CONTACTS: dict[str, type[Contact]] = {"contact": Contact, "loop": LoopClosure, "rolling": RollingContact}
"""By the name that files have for them."""


def contact_to_dict(contact: Contact) -> dict[str, Any]:
    """Its name in `CONTACTS` and its fields. Raises ContactError for other contacts and a surface that holds code."""
    name = next((name for name, kind in CONTACTS.items() if type(contact) is kind), None)
    if name is None:
        raise ContactError(f"a {type(contact).__name__} cannot be stored; files carry {', '.join(CONTACTS)}.")
    given = {each.name: getattr(contact, each.name) for each in fields(contact)}
    listed = {key: list(value) if isinstance(value, tuple) else value for key, value in given.items()}
    return {"type": name, **listed, "surface": surface_to_dict(contact.surface)}


def contact_from_dict(entry: Mapping[str, Any]) -> Contact:
    """The contact that `contact_to_dict` stored. Raises KeyError or TypeError for anything else."""
    given: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in entry.items()}
    given["surface"] = object_from_dict("surface", SURFACES, given["surface"])
    return CONTACTS[given.pop("type")](**given)
