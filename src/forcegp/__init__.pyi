# The whole public API, by theme; __init__.py reads this list. isort: skip_file

# the robot
from .robots import Robot as Robot

# what is known about it, and what is not
from .model import Model as Model
from .noise import Noise as Noise
from .mechanics import Contact as Contact, Plane as Plane, Sphere as Sphere

# laws, and priors on their numbers
from .forces import (
    RigidBodies as RigidBodies, Payload as Payload, Viscous as Viscous, Coulomb as Coulomb, Stribeck as Stribeck,
    LoadFriction as LoadFriction, Offset as Offset, Spring as Spring, Rotor as Rotor, Normal as Normal,
    LogNormal as LogNormal,
)

# unknown forces
from .forces import (
    JointForces as JointForces, AerodynamicForce as AerodynamicForce, JointFriction as JointFriction,
    ToolForces as ToolForces, ContactFriction as ContactFriction,
)

# what was measured
from .data import Dataset as Dataset
from .checks import check as check
from .recordings import import_recordings as import_recordings
from .simulation import KukaSurfaceConfig as KukaSurfaceConfig, simulate_kuka_surface as simulate_kuka_surface

# learning from it
from .evidence import (
    Accelerations as Accelerations, ContactForces as ContactForces, FrameAcceleration as FrameAcceleration,
    JointTorques as JointTorques, Motions as Motions, Torques as Torques,
)
from .fit import fit as fit
from .posterior import (
    Posterior as Posterior, save_posterior as save_posterior, load_posterior as load_posterior,
    casadi_function as casadi_function, export_c as export_c,
)

# what is done with it
from .control import (
    ComputedTorque as ComputedTorque, ContactMonitor as ContactMonitor, HybridForce as HybridForce, MPPI as MPPI,
    excitation as excitation,
)

# how good it is
from .scores import score as score

__version__: str
