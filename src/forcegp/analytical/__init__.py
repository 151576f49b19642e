"""What classical identification offers: linear regression of joint torques and its physically consistent relatives."""

from forcegp.analytical.regressor import body_names, parameter_names, standard_parameters, torque_regressor

__all__ = ["body_names", "parameter_names", "standard_parameters", "torque_regressor"]
