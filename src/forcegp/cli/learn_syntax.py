"""`--learn`: which physical parameters to estimate, as words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from forcegp.errors import InvalidInput

if TYPE_CHECKING:
    from forcegp.mechanics import MechanicalSystem
    from forcegp.models.identification.physical_parameters import Learned


def parse_learn(words: Sequence[str]) -> tuple[Learned, ...]:
    """`LINK:mass,com,inertia`, or `FORCE`, `FORCE:joint,joint`, either with `=START`. Raises InvalidInput."""
    from forcegp.mechanics.known_forces import KNOWN_FORCES
    from forcegp.models.identification.physical_parameters import Coefficients
    from forcegp.robots import LinkInertia

    if not words:
        raise InvalidInput("nothing to estimate; add --learn LINK:mass,com, or another that --help names.")
    forces = [name for name, kind in KNOWN_FORCES.items() if kind.learned is not None]
    learned: list[Learned] = []
    for word in words:
        what, _, start = word.partition("=")
        name, _, listed = what.rpartition(":") if ":" in what else (what, "", "")
        entries = tuple(entry for entry in listed.split(",") if entry)
        if name in forces:
            learned.append(Coefficients(name, entries or None, _number(word, start) if start else None))
        elif entries and not start:
            learned.append(LinkInertia(name, entries))
        else:
            raise InvalidInput(
                f"--learn {word} is not LINK:PARTS, with parts out of mass,com,inertia, nor one of {', '.join(forces)} "
                "with :JOINTS or =START as you wish."
            )
    return tuple(learned)


def with_learned_forces(system: MechanicalSystem, learn: Sequence[Learned]) -> tuple[MechanicalSystem, list[str]]:
    """The system with every learned force in its list, from the URDF's coefficients, and the names that were added."""
    from dataclasses import replace

    from forcegp.mechanics import Armature, CoulombJointFriction, LoadJointFriction, RotorInertia, ViscousJointFriction
    from forcegp.models.identification.physical_parameters import Coefficients

    make = {
        "viscous-joint-friction": (ViscousJointFriction, lambda: ViscousJointFriction.from_robot(system.robot)),
        "coulomb-joint-friction": (CoulombJointFriction, lambda: CoulombJointFriction.from_robot(system.robot)),
        "load-joint-friction": (LoadJointFriction, lambda: LoadJointFriction(0.0, 0.0, 0.1)),
        "armature": (Armature, lambda: Armature(0.0)),
        "rotor-inertia": (RotorInertia, lambda: RotorInertia(0.0)),
    }
    added: dict[str, None] = {}
    for entry in learn:
        if isinstance(entry, Coefficients) and not any(type(f) is make[entry.force][0] for f in system.known_forces):
            system = replace(system, known_forces=(*system.known_forces, make[entry.force][1]()))
            added[entry.force] = None
    return system, list(added)


def _number(word: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InvalidInput(f"--learn {word}: {text!r} is not a number; give a start value such as =0.1.") from None
