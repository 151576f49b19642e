"""Probabilistic forward dynamics of robots: Gaussian processes on the forces that nobody modelled.

This page is the whole public API. A name is imported from its room at first use, so that `import forcegp` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from forcegp.data import Dataset
    from forcegp.mechanics import (
        Actuation,
        Armature,
        Baumgarte,
        Contact,
        CoulombJointFriction,
        Cylinder,
        ImplicitSurface,
        MechanicalSystem,
        Plane,
        RigidBodyBias,
        Sphere,
        ViscousJointFriction,
    )
    from forcegp.models import Noise, StructuredGP
    from forcegp.priors import JointForces
    from forcegp.robots import Robot

__version__ = "0.1.0"

__all__ = [
    # the robot
    "Robot",
    # what is known: what it touches and which forces act
    "MechanicalSystem",
    "Contact",
    "Plane",
    "Sphere",
    "Cylinder",
    "ImplicitSurface",
    "Baumgarte",
    "Actuation",
    "RigidBodyBias",
    "ViscousJointFriction",
    "CoulombJointFriction",
    "Armature",
    # what was measured
    "Dataset",
    # what is unknown, and the model that learns it
    "JointForces",
    "Noise",
    "StructuredGP",
]

_ROOM_OF = {
    "Robot": "robots",
    "MechanicalSystem": "mechanics",
    "Contact": "mechanics",
    "Plane": "mechanics",
    "Sphere": "mechanics",
    "Cylinder": "mechanics",
    "ImplicitSurface": "mechanics",
    "Baumgarte": "mechanics",
    "Actuation": "mechanics",
    "RigidBodyBias": "mechanics",
    "ViscousJointFriction": "mechanics",
    "CoulombJointFriction": "mechanics",
    "Armature": "mechanics",
    "Dataset": "data",
    "JointForces": "priors",
    "Noise": "models",
    "StructuredGP": "models",
}


def __getattr__(name: str) -> object:
    """Import a public name at first use (PEP 562)."""
    if name not in _ROOM_OF:
        raise AttributeError(f"module 'forcegp' has no attribute {name!r}; public names: {', '.join(__all__)}")
    value = getattr(import_module(f"forcegp.{_ROOM_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*globals(), *__all__]
