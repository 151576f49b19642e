from .arguments import usable_device as usable_device
from .kinematics import Kinematics as Kinematics
from .urdf import Joint as Joint, Link as Link
from .robot import Robot as Robot
