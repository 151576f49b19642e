from .actuation import (
    Actuation as Actuation, LinkForce as LinkForce, ObservedWind as ObservedWind, ObservedWrench as ObservedWrench,
    Pull as Pull, Thrusters as Thrusters,
)
from .contact_friction import ContactFriction as ContactFriction
from .joint_law import JointLaw as JointLaw
from .joint_forces import (
    IndependentAccelerations as IndependentAccelerations, JointAccelerations as JointAccelerations,
    JointForces as JointForces, JointFriction as JointFriction, JointPositionForces as JointPositionForces,
)
from .kernels import KERNELS as KERNELS, kernel_of as kernel_of
from .joint_laws import (
    Coulomb as Coulomb, DirectionalFriction as DirectionalFriction, DryFriction as DryFriction,
    GearFriction as GearFriction, LoadFriction as LoadFriction, Offset as Offset, Rotor as Rotor, Spring as Spring,
    Stribeck as Stribeck, Viscous as Viscous,
)
from .force import (
    Body as Body, Coefficient as Coefficient, Force as Force, Law as Law, LogNormal as LogNormal, Normal as Normal,
    Parameter as Parameter,
)
from .registry import (
    FORCES as FORCES, force_from_dict as force_from_dict, force_to_dict as force_to_dict, parse_forces as parse_forces,
    split_outside as split_outside,
)
from .rigid_bodies import Payload as Payload, RigidBodies as RigidBodies
from .link_forces import AerodynamicForce as AerodynamicForce, ToolForces as ToolForces
from .unknown import (
    Scaling as Scaling, Unknown as Unknown, UnknownForces as UnknownForces, has_few_inputs as has_few_inputs,
)
