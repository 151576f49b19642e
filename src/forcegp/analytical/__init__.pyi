from .identifiability import (
    BaseParameters as BaseParameters, base_parameters as base_parameters, excitation as excitation,
    body_names as body_names, parameter_names as parameter_names, standard_parameters as standard_parameters,
    torque_regressor as torque_regressor,
)
from .identification import identify_analytical as identify_analytical, held_out_noise as held_out_noise
from .least_squares import ROUNDS as ROUNDS, NoiseLevels as NoiseLevels
from .result import AnalyticalIdentification as AnalyticalIdentification
from .recorded_rows import motion_residuals as motion_residuals, residual_scores as residual_scores
from .payload import LAWS as LAWS, PayloadEstimate as PayloadEstimate, identify_payload as identify_payload
