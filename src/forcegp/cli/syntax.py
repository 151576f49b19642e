"""What options say in short: contacts, `FRAME@x,y,z:plane:0,0,1,0.055`, friction laws, and parameters to estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import forcegp
import forcegp.mechanics
import forcegp.models
import forcegp.robots
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


def parse_learn(words: Sequence[str]) -> tuple[forcegp.models.Learned, ...]:
    """`LINK:mass,com,inertia`, or `FORCE`, `FORCE:joint,joint`, either with `=START`. Raises InvalidInput."""
    if not words:
        raise InvalidInput("nothing to estimate; add --learn LINK:mass,com, or another that --help names.")
    forces = [name for name, kind in forcegp.mechanics.KNOWN_FORCES.items() if kind.learned is not None]
    learned: list[forcegp.models.Learned] = []
    for word in words:
        what, _, start = word.partition("=")
        name, _, listed = what.rpartition(":") if ":" in what else (what, "", "")
        entries = tuple(entry for entry in listed.split(",") if entry)
        if name in forces:
            learned.append(forcegp.Coefficients(name, entries or None, _number(word, start) if start else None))
        elif entries and not start:
            learned.append(forcegp.robots.LinkInertia(name, entries))
        else:
            raise InvalidInput(
                f"--learn {word} is not LINK:PARTS, with parts out of mass,com,inertia, nor one of {', '.join(forces)} "
                "with :JOINTS or =START as you wish."
            )
    return tuple(learned)


def with_learned_forces(
    system: forcegp.MechanicalSystem, learn: Sequence[forcegp.models.Learned]
) -> tuple[forcegp.MechanicalSystem, list[str]]:
    """The system with every learned force in its list, from the URDF's coefficients, and the names that were added."""
    make = {
        "viscous-joint-friction": (
            forcegp.ViscousJointFriction,
            lambda: forcegp.ViscousJointFriction.from_robot(system.robot),
        ),
        "coulomb-joint-friction": (
            forcegp.CoulombJointFriction,
            lambda: forcegp.CoulombJointFriction.from_robot(system.robot),
        ),
        "load-joint-friction": (forcegp.LoadJointFriction, lambda: forcegp.LoadJointFriction(0.0, 0.0, 0.1)),
        "armature": (forcegp.Armature, lambda: forcegp.Armature(0.0)),
        "rotor-inertia": (forcegp.RotorInertia, lambda: forcegp.RotorInertia(0.0)),
    }
    added: dict[str, None] = {}
    for entry in learn:
        if isinstance(entry, forcegp.Coefficients) and not any(
            type(f) is make[entry.force][0] for f in system.known_forces
        ):
            system = replace(system, known_forces=(*system.known_forces, make[entry.force][1]()))
            added[entry.force] = None
    return system, list(added)


def _number(word: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InvalidInput(f"--learn {word}: {text!r} is not a number; give a start value such as =0.1.") from None


def friction_laws(words: str) -> tuple[str, ...]:
    """`viscous,coulomb` as a tuple; `none` is no friction. Names are checked by `forcegp.analytical`."""
    return tuple(word for word in (part.strip() for part in words.split(",")) if word and word != "none")
