from .contact_friction import ContactFriction as ContactFriction
from .force_prior import ForcePrior as ForcePrior, Scaling as Scaling, SumPrior as SumPrior
from .joint_accelerations import JointAccelerations as JointAccelerations
from .joint_forces import JointForces as JointForces
from .joint_friction import JointFriction as JointFriction
from .kernels import KERNELS as KERNELS, kernel_of as kernel_of
from .named import NAMED_PRIORS as NAMED_PRIORS, NamedPrior as NamedPrior, named_prior as named_prior
from .no_forces import NoForces as NoForces
from .payload import Payload as Payload
from .periodic_joint_forces import PeriodicJointForces as PeriodicJointForces
from .stored_priors import PRIORS as PRIORS, prior_from_dict as prior_from_dict, prior_to_dict as prior_to_dict
from .tool_forces import ToolForces as ToolForces
