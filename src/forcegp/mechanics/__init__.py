"""What is known about the mechanics: surfaces, contacts, known forces, and Gauss' principle that joins them."""

from forcegp.mechanics.contacts import Baumgarte, Contact
from forcegp.mechanics.gauss_principle import AffineMap, ConstrainedDynamics
from forcegp.mechanics.known_forces import (
    Actuation,
    Armature,
    ConstantJointForce,
    CoulombJointFriction,
    KnownForce,
    LoadJointFriction,
    RigidBodyBias,
    RotorInertia,
    StribeckJointFriction,
    ViscousJointFriction,
)
from forcegp.mechanics.state import State
from forcegp.mechanics.surface_axes import surface_axes
from forcegp.mechanics.surfaces import Cylinder, ImplicitSurface, Plane, Sphere, Surface
from forcegp.mechanics.system import MechanicalSystem

__all__ = [
    "Actuation",
    "AffineMap",
    "Armature",
    "Baumgarte",
    "ConstrainedDynamics",
    "ConstantJointForce",
    "Contact",
    "CoulombJointFriction",
    "Cylinder",
    "ImplicitSurface",
    "KnownForce",
    "LoadJointFriction",
    "MechanicalSystem",
    "Plane",
    "RigidBodyBias",
    "RotorInertia",
    "Sphere",
    "State",
    "StribeckJointFriction",
    "Surface",
    "ViscousJointFriction",
    "surface_axes",
]
