from .actuation import Actuation as Actuation
from .base_wrench import AerodynamicForce as AerodynamicForce, BaseWrench as BaseWrench
from .contact_friction import ContactFriction as ContactFriction, foot_friction as foot_friction
from .friction import Coulomb as Coulomb, Stribeck as Stribeck, LoadFriction as LoadFriction
from .force import Force as Force, JointLaw as JointLaw, Law as Law
from .joint_forces import (
    IndependentAccelerations as IndependentAccelerations, JointAccelerations as JointAccelerations,
    JointForces as JointForces, JointFriction as JointFriction,
    JointPositionForces as JointPositionForces, PeriodicJointForces as PeriodicJointForces,
)
from .kernels import KERNELS as KERNELS, kernel_of as kernel_of
from .offset import Offset as Offset, Spring as Spring
from .parameters import (
    Body as Body, Coefficient as Coefficient, LogNormal as LogNormal, Normal as Normal, Parameter as Parameter,
)
from .registry import (
    FORCES as FORCES, force_from_dict as force_from_dict, force_to_dict as force_to_dict, parse_forces as parse_forces,
    split_outside as split_outside,
)
from .rigid_bodies import Payload as Payload, RigidBodies as RigidBodies
from .rotor import CoupledRotors as CoupledRotors, Rotor as Rotor
from .thrusters import (
    LinkForce as LinkForce, ObservedWind as ObservedWind, ObservedWrench as ObservedWrench, Thrusters as Thrusters,
)
from .tool_forces import ToolForces as ToolForces
from .unknown import (
    Scaling as Scaling, Unknown as Unknown, UnknownForces as UnknownForces, has_few_inputs as has_few_inputs,
)
from .friction import DirectionalFriction as DirectionalFriction, Viscous as Viscous
