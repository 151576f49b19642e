from .monitor import ContactMonitor as ContactMonitor
from .informative_motions import Excitation as Excitation, excitation as excitation
from .mppi import MPPI as MPPI
from .tracking import ComputedTorque as ComputedTorque, HybridForce as HybridForce, PDGravity as PDGravity
