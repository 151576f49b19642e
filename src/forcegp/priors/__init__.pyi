from .base_wrench import AerodynamicForce as AerodynamicForce, BaseWrench as BaseWrench
from .contact_friction import ContactFriction as ContactFriction, foot_friction as foot_friction
from .force_prior import (
    ForcePrior as ForcePrior, Scaling as Scaling, SumPrior as SumPrior, has_few_inputs as has_few_inputs,
)
from .joint_forces import (
    JointAccelerations as JointAccelerations, JointForces as JointForces, NoForces as NoForces,
    JointFriction as JointFriction, PeriodicJointForces as PeriodicJointForces,
)
from .kernels import KERNELS as KERNELS, kernel_of as kernel_of
from .named import (
    NAMED_PRIORS as NAMED_PRIORS, NamedPrior as NamedPrior, named_prior as named_prior, PRIORS as PRIORS,
    prior_from_dict as prior_from_dict, prior_to_dict as prior_to_dict,
)
from .tool_forces import Payload as Payload, ToolForces as ToolForces
