from .baselines.independent_gp import IndependentGP as IndependentGP
from .baselines.independent_posterior import IndependentPosterior as IndependentPosterior
from .c_export import CExport as CExport, export_c as export_c
from .casadi_export import casadi_function as casadi_function, export_casadi as export_casadi
from .identification.identification import Identification as Identification
from .identification.physical_parameters import Coefficients as Coefficients, Learned as Learned
from .observed_wrench import observing as observing
from .prediction import Linearization as Linearization, Gaussian as Gaussian, Prediction as Prediction
from .predictor import Predictor as Predictor
from .protocol import Model as Model, Posterior as Posterior
from .rollout import Rollout as Rollout, StepLinearization as StepLinearization
from .search import ALL_ROWS as ALL_ROWS, default_options as default_options, default_restarts as default_restarts
from .storage import load_posterior as load_posterior, save_posterior as save_posterior
from .structured.friction_margin import FrictionMargins as FrictionMargins, friction_margins as friction_margins
from .structured.gp import StructuredGP as StructuredGP
from .structured.marginal_likelihood import MarginalLikelihood as MarginalLikelihood
from .structured.posterior import StructuredPosterior as StructuredPosterior
from .training_data import Noise as Noise, TrainingData as TrainingData
