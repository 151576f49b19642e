"""What classical identification offers: linear regression of joint torques and its physically consistent relatives."""

from forcegp.analytical.base_parameters import BaseParameters, base_parameters, excitation
from forcegp.analytical.held_out_noise import held_out_noise
from forcegp.analytical.identification import identify_analytical
from forcegp.analytical.noise_levels import NoiseLevels
from forcegp.analytical.regressor import body_names, parameter_names, standard_parameters, torque_regressor
from forcegp.analytical.result import AnalyticalIdentification
from forcegp.analytical.scores import motion_residuals, residual_scores

__all__ = [
    "AnalyticalIdentification",
    "BaseParameters",
    "NoiseLevels",
    "base_parameters",
    "body_names",
    "excitation",
    "held_out_noise",
    "identify_analytical",
    "motion_residuals",
    "parameter_names",
    "residual_scores",
    "standard_parameters",
    "torque_regressor",
]
