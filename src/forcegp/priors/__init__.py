"""Priors on the forces that nobody modelled."""

from forcegp.priors.contact_friction import ContactFriction
from forcegp.priors.force_prior import ForcePrior, Scaling, SumPrior
from forcegp.priors.joint_accelerations import JointAccelerations
from forcegp.priors.joint_forces import JointForces
from forcegp.priors.joint_friction import JointFriction
from forcegp.priors.kernels import KERNELS, kernel_of
from forcegp.priors.named import NAMED_PRIORS, NamedPrior, named_prior
from forcegp.priors.no_forces import NoForces
from forcegp.priors.payload import Payload
from forcegp.priors.periodic_joint_forces import PeriodicJointForces
from forcegp.priors.stored_priors import PRIORS, prior_from_dict, prior_to_dict
from forcegp.priors.tool_forces import ToolForces

__all__ = [
    "KERNELS",
    "NAMED_PRIORS",
    "PRIORS",
    "ContactFriction",
    "ForcePrior",
    "JointAccelerations",
    "JointForces",
    "JointFriction",
    "NamedPrior",
    "NoForces",
    "Payload",
    "PeriodicJointForces",
    "Scaling",
    "SumPrior",
    "ToolForces",
    "kernel_of",
    "named_prior",
    "prior_from_dict",
    "prior_to_dict",
]
