"""Contacts on the command line: `FRAME@x,y,z:plane:0,0,1,0.055`."""

from __future__ import annotations

from collections.abc import Sequence

import forcegp
from forcegp.errors import InvalidInput

SYNTAX = {
    "plane": ("nx,ny,nz,offset", 4),
    "sphere": ("cx,cy,cz,radius", 4),
    "cylinder": ("px,py,pz,ax,ay,az,radius", 7),
}
"""Numbers of each surface in m: plane n . p = offset; a cylinder by a point on its axis, the axis and its radius."""

EXAMPLE = "lbr_iiwa_link_7@0,0,0.1:plane:0,0,1,0.055"


def parse_contacts(texts: Sequence[str]) -> tuple[forcegp.Contact, ...]:
    """One contact per text; the single text `none` is no contact. Raises InvalidInput for anything else."""
    if "none" in texts:
        if len(texts) > 1:
            raise InvalidInput("--contact none stands alone; the other contacts contradict it.")
        return ()
    return tuple(parse_contact(text) for text in texts)


def parse_contact(text: str) -> forcegp.Contact:
    """`FRAME@x,y,z:SURFACE:numbers` as a contact; without `@x,y,z` the point is the origin of the frame.

    Raises InvalidInput saying what is wrong with the text, and what is right.
    """
    place, kind, numbers = [*text.rsplit(":", 2), "", ""][:3]
    if kind not in SYNTAX or not place:
        forms = ", ".join(f"{name}:{form}" for name, (form, _) in SYNTAX.items())
        raise InvalidInput(
            f"--contact {text!r} is not FRAME@x,y,z:SURFACE with a SURFACE of {forms} (m); for example {EXAMPLE}"
        )
    form, count = SYNTAX[kind]
    values = _numbers(text, kind, numbers, form, count)
    frame, _, point = place.rpartition("@") if "@" in place else (place, "", "0,0,0")
    x, y, z = _numbers(text, "the point", point, "x,y,z", 3)
    if kind == "plane":
        surface = forcegp.Plane((values[0], values[1], values[2]), values[3])
    elif kind == "sphere":
        surface = forcegp.Sphere((values[0], values[1], values[2]), values[3])
    else:
        surface = forcegp.Cylinder((values[0], values[1], values[2]), (values[3], values[4], values[5]), values[6])
    return forcegp.Contact(frame, (x, y, z), surface)


def _numbers(text: str, what: str, given: str, form: str, count: int) -> list[float]:
    try:
        values = [float(entry) for entry in given.split(",")]
    except ValueError:
        values = []
    if len(values) != count:
        raise InvalidInput(
            f"--contact {text!r}: {what} needs {count} numbers {form} in m, given {given!r}; for example {EXAMPLE}"
        )
    return values
