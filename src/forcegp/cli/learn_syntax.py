"""`--learn`: which physical parameters to estimate, as words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import forcegp
import forcegp.mechanics
import forcegp.models
import forcegp.robots
from forcegp.errors import InvalidInput


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
