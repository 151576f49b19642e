from .c_export import CExport as CExport, export_c as export_c
from .casadi_export import casadi_function as casadi_function, export_casadi as export_casadi
from .prediction import Curve as Curve, ForceComponent as ForceComponent
from .fitted import (
    HORIZONS as HORIZONS, Estimate as Estimate, Estimates as Estimates, MotionIntervals as MotionIntervals,
)
from .observed_wrench import observing as observing
from .posterior import Posterior as Posterior
from .prediction import Linearization as Linearization, Gaussian as Gaussian, Prediction as Prediction
from .predictor import Predictor as Predictor
from .rollout import Rollout as Rollout, StepLinearization as StepLinearization
from .storage import load_posterior as load_posterior, save_posterior as save_posterior
