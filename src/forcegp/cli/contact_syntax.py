"""How points that touch something are written on the command line: surfaces, feet and wheels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import forcegp
import forcegp.mechanics
from forcegp.cli.command import numbers_of
from forcegp.errors import InvalidInput

SYNTAX = {"plane": "nx,ny,nz,offset", "sphere": "cx,cy,cz,radius", "cylinder": "px,py,pz,ax,ay,az,radius"}
"""Numbers of each surface in m: plane n . p = offset; a cylinder by a point on its axis, the axis and its radius."""
CONTACTS = "FRAME@x,y,z:SURFACE,..."
EXAMPLE = "lbr_iiwa_link_7@0,0,0.1:plane:0,0,1,0.055"
FEET, WHEELS = "FRAME@x,y,z,...", "FRAME=RADIUS,..."
FLAT, BALL = ":flat", ":ball="
"""Behind the frame of a foot that does not turn while it stands; of a ball that rolls, with its radius in m."""
STANDS = "{}_stands"
"""The input that switches the contact of a foot."""


def parse_contacts(texts: Sequence[str]) -> tuple[forcegp.Contact, ...]:
    """One contact per text; the single text `none` is no contact. Raises InvalidInput for anything else."""
    if "none" in texts:
        if len(texts) > 1:
            raise InvalidInput("--contact none stands alone; the other contacts contradict it.")
        return ()
    return tuple(parse_contact(text) for text in texts)


def parse_contact(text: str) -> forcegp.Contact:
    """`FRAME@x,y,z:SURFACE:numbers`, without `@x,y,z` at the frame's origin. Raises InvalidInput with an example."""
    place, kind, numbers = [*text.rsplit(":", 2), "", ""][:3]
    if kind not in SYNTAX or not place:
        forms = ", ".join(f"{name}:{form}" for name, form in SYNTAX.items())
        raise InvalidInput(
            f"--contact {text!r} is not FRAME@x,y,z:SURFACE with a SURFACE of {forms} (m); for example {EXAMPLE}"
        )
    *given, size = _numbers(text, kind, numbers, SYNTAX[kind])
    vectors = (tuple(given[start : start + 3]) for start in range(0, len(given), 3))
    frame, _, point = place.rpartition("@") if "@" in place else (place, "", "0,0,0")
    x, y, z = _numbers(text, "the point", point, "x,y,z")
    surface: Any = {"plane": forcegp.Plane, "sphere": forcegp.Sphere, "cylinder": forcegp.Cylinder}[kind]
    return forcegp.Contact(frame, (x, y, z), surface(*vectors, size))


def _numbers(text: str, what: str, given: str, form: str) -> list[float]:
    count = form.count(",") + 1
    complaint = f"--contact {text!r}: {what} needs {count} numbers {form} in m, given {given!r}; for example {EXAMPLE}"
    values = numbers_of(given, complaint)
    if len(values) != count:
        raise InvalidInput(complaint)
    return values


def parse_feet(texts: Sequence[str]) -> tuple[forcegp.Contact, ...]:
    """Points `FRAME@x,y,z`, rolling balls `FRAME@x,y,z:ball=RADIUS` or flat feet `FRAME:flat`, each with a switch.

    Raises InvalidInput.
    """
    feet: dict[str, tuple[forcegp.Contact, ...]] = {}
    for text in texts:
        flat = text.endswith(FLAT)
        named, ball, radius = text.removesuffix(FLAT).partition(BALL)
        frame, _, point = named.rpartition("@") if "@" in named else (named, "", "0,0,0")
        complaint = (
            f"--feet {text!r} is not FRAME, FRAME@x,y,z (m), FRAME{BALL}RADIUS (m) or FRAME{FLAT}; for example "
            "FL_foot@0,0,-0.02"
        )
        place = numbers_of(point, complaint)
        if not frame or len(place) != 3 or (flat and (ball or "@" in named)):
            raise InvalidInput(complaint)
        if frame in feet:
            raise InvalidInput(f"--feet names {frame} twice; a frame has one foot.")
        switch, (x, y, z) = STANDS.format(frame), place
        if flat:
            feet[frame] = forcegp.mechanics.fixed_frame(frame, switch)
        elif ball:
            size = numbers_of(radius, complaint, one=True)[0]
            feet[frame] = forcegp.mechanics.rolling(frame, size, None, (x, y, z), switch=switch)
        else:
            feet[frame] = forcegp.mechanics.fixed_point(frame, (x, y, z), switch)
    return tuple(contact for points in feet.values() for contact in points)


def parse_wheels(texts: Sequence[str]) -> tuple[forcegp.Contact, ...]:
    """Wheels `FRAME=RADIUS` that turn about the y axis of their frame on level ground. Raises InvalidInput."""
    wheels: list[forcegp.Contact] = []
    for text in texts:
        frame, _, radius = text.rpartition("=")
        complaint = f"--wheels {text!r} is not FRAME=RADIUS (m); for example left_wheel=0.1"
        if not frame:
            raise InvalidInput(complaint)
        wheels += forcegp.mechanics.rolling(frame, numbers_of(radius, complaint, one=True)[0])
    return tuple(wheels)
