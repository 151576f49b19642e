from .identifiability import (
    BaseParameters as BaseParameters, base_parameters as base_parameters, excitation as excitation,
)
from .identification import identify_analytical as identify_analytical
from .least_squares import ROUNDS as ROUNDS
from .noise_cross_validation import held_out_noise as held_out_noise
from .noise_levels import NoiseLevels as NoiseLevels
from .regressor import (
    body_names as body_names, parameter_names as parameter_names, standard_parameters as standard_parameters,
    torque_regressor as torque_regressor,
)
from .result import AnalyticalIdentification as AnalyticalIdentification
from .scores import motion_residuals as motion_residuals, residual_scores as residual_scores
