from .monitor import ContactMonitor as ContactMonitor
from .informative_motions import Excitation as Excitation, excitation as excitation
from .tracking import MPPI as MPPI, ComputedTorque as ComputedTorque, HybridForce as HybridForce
