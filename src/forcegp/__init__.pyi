# The whole public API, by theme; __init__.py reads this list. isort: skip_file

# the robot
from .robots import Robot as Robot

# what is known about it: contacts and forces
from .mechanics import MechanicalSystem as MechanicalSystem
from .mechanics import Contact as Contact
from .mechanics import Plane as Plane
from .mechanics import Sphere as Sphere
from .mechanics import Cylinder as Cylinder
from .mechanics import ImplicitSurface as ImplicitSurface
from .mechanics import Baumgarte as Baumgarte
from .mechanics import Actuation as Actuation
from .mechanics import RigidBodyBias as RigidBodyBias
from .mechanics import ViscousJointFriction as ViscousJointFriction
from .mechanics import CoulombJointFriction as CoulombJointFriction
from .mechanics import StribeckJointFriction as StribeckJointFriction
from .mechanics import LoadJointFriction as LoadJointFriction
from .mechanics import ConstantJointForce as ConstantJointForce
from .mechanics import DirectionalJointFriction as DirectionalJointFriction
from .mechanics import Armature as Armature
from .mechanics import RotorInertia as RotorInertia

# what was measured
from .data import Dataset as Dataset
from .checks import check as check
from .checks import CheckReport as CheckReport
from .data import Preparation as Preparation
from .recordings import import_recordings as import_recordings
from .recordings import ColumnMapping as ColumnMapping
from .recordings import ImportOptions as ImportOptions
from .data import WeakForm as WeakForm
from .simulation import KukaSurfaceConfig as KukaSurfaceConfig
from .simulation import simulate_kuka_surface as simulate_kuka_surface

# what is unknown, and the model that learns it
from .priors import JointForces as JointForces
from .priors import AerodynamicForce as AerodynamicForce
from .priors import BaseWrench as BaseWrench
from .priors import JointFriction as JointFriction
from .priors import PeriodicJointForces as PeriodicJointForces
from .priors import ToolForces as ToolForces
from .priors import ContactFriction as ContactFriction
from .priors import Payload as Payload
from .priors import JointAccelerations as JointAccelerations
from .priors import NoForces as NoForces
from .models import Noise as Noise
from .models import Coefficients as Coefficients
from .models import StructuredGP as StructuredGP
from .models import IndependentGP as IndependentGP
from .models import save_posterior as save_posterior
from .models import load_posterior as load_posterior
from .models import casadi_function as casadi_function
from .models import export_c as export_c

# what is done with it
from .control import ComputedTorque as ComputedTorque
from .control import PDGravity as PDGravity
from .control import ContactMonitor as ContactMonitor
from .control import HybridForce as HybridForce
from .control import MPPI as MPPI
from .control import excitation as excitation
from .control import Excitation as Excitation

# the same without Gaussian processes
from .analytical import identify_analytical as identify_analytical
from .analytical import AnalyticalIdentification as AnalyticalIdentification

# how and where it is computed
from .inference import Exact as Exact
from .inference import Inducing as Inducing
from .parallel import Serial as Serial
from .parallel import Joblib as Joblib

# how good it is
from .evaluation import evaluate as evaluate
from .evaluation import Evaluation as Evaluation
from .evaluation import compare_priors as compare_priors
from .evaluation import PriorComparison as PriorComparison
from .validation import validate as validate
from .validation import Comparison as Comparison
from .validation import Validation as Validation
from .validation import split_named as split_named

__version__: str
