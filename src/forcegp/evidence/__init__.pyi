from .evidence import (
    Accelerations as Accelerations, ContactForces as ContactForces, Evidence as Evidence,
    FrameAcceleration as FrameAcceleration, JointTorques as JointTorques, Motions as Motions, Sensor as Sensor,
    Torques as Torques, EVIDENCE as EVIDENCE, parse_evidence as parse_evidence,
)
from .bodies import (
    base_parameters as base_parameters, body_names as body_names, standard_parameters as standard_parameters,
    torque_regressor as torque_regressor,
)
from .least_squares import ROUNDS as ROUNDS, NoiseLevels as NoiseLevels
from .likelihood import MarginalLikelihood as MarginalLikelihood, TrainingData as TrainingData
from .recorded_rows import motion_residuals as motion_residuals
