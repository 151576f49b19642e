"""Models of the forward dynamics: fit -> posterior -> predict."""

from forcegp.models.identification import Identification
from forcegp.models.marginal_likelihood import MarginalLikelihood, TrainingData
from forcegp.models.noise import Noise
from forcegp.models.physical_parameters import Coefficients
from forcegp.models.prediction import Gaussian, Prediction
from forcegp.models.storage import load_posterior, save_posterior
from forcegp.models.structured_gp import StructuredGP
from forcegp.models.structured_posterior import StructuredPosterior

__all__ = [
    "Coefficients",
    "Gaussian",
    "Identification",
    "MarginalLikelihood",
    "Noise",
    "Prediction",
    "StructuredGP",
    "StructuredPosterior",
    "TrainingData",
    "load_posterior",
    "save_posterior",
]
