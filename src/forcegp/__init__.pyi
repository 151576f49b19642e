# The whole public API, by theme; __init__.py reads this list. isort: skip_file

# the robot
from .robots import Robot as Robot

# what is known about it, and what is not
from .model import Model as Model
from .noise import Noise as Noise
from .mechanics import Contact as Contact
from .mechanics import Plane as Plane
from .mechanics import Sphere as Sphere
from .mechanics import Cylinder as Cylinder

# laws, and priors on their numbers
from .forces import RigidBodies as RigidBodies
from .forces import Payload as Payload
from .forces import Viscous as Viscous
from .forces import Coulomb as Coulomb
from .forces import Stribeck as Stribeck
from .forces import LoadFriction as LoadFriction
from .forces import Offset as Offset
from .forces import Spring as Spring
from .forces import Rotor as Rotor
from .forces import Normal as Normal
from .forces import LogNormal as LogNormal

# unknown forces
from .forces import JointForces as JointForces
from .forces import AerodynamicForce as AerodynamicForce
from .forces import JointFriction as JointFriction
from .forces import ToolForces as ToolForces
from .forces import ContactFriction as ContactFriction

# what was measured
from .data import Dataset as Dataset
from .checks import check as check
from .recordings import import_recordings as import_recordings
from .simulation import KukaSurfaceConfig as KukaSurfaceConfig
from .simulation import simulate_kuka_surface as simulate_kuka_surface

# learning from it
from .evidence import Accelerations as Accelerations
from .evidence import Torques as Torques
from .evidence import Windows as Windows
from .evidence import Motions as Motions
from .fit import fit as fit
from .posterior import Posterior as Posterior
from .posterior import save_posterior as save_posterior
from .posterior import load_posterior as load_posterior
from .posterior import casadi_function as casadi_function
from .posterior import export_c as export_c

# what is done with it
from .control import ComputedTorque as ComputedTorque
from .control import ContactMonitor as ContactMonitor
from .control import HybridForce as HybridForce
from .control import MPPI as MPPI
from .control import excitation as excitation

# how and where it is computed

# how good it is
from .scores import score as score

__version__: str
