from .contacts import Baumgarte as Baumgarte, Contact as Contact
from .gauss_principle import AffineMap as AffineMap, ConstrainedDynamics as ConstrainedDynamics
from .known_forces import (
    KNOWN_FORCES as KNOWN_FORCES, Actuation as Actuation, Armature as Armature, ConstantJointForce as
    ConstantJointForce, CoulombJointFriction as CoulombJointFriction, KnownForce as KnownForce, LoadJointFriction as
    LoadJointFriction, RigidBodyBias as RigidBodyBias, RotorInertia as RotorInertia, StribeckJointFriction as
    StribeckJointFriction, ViscousJointFriction as ViscousJointFriction,
)
from .state import State as State
from .surfaces import (
    Cylinder as Cylinder, ImplicitSurface as ImplicitSurface, Plane as Plane, Sphere as Sphere, Surface as Surface,
)
from .system import MechanicalSystem as MechanicalSystem
from .tangent_frame import surface_axes as surface_axes
