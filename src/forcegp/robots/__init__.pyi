from .arguments import usable_device as usable_device
from .inertia import (
    parameters_from_physical as parameters_from_physical, physical_from_parameters as physical_from_parameters,
    pseudo_inertia_from_parameters as pseudo_inertia_from_parameters,
)
from .kinematics import Kinematics as Kinematics
from .urdf import Joint as Joint
from .structure import Link as Link
from .robot import Robot as Robot
