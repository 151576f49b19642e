"""Models of the forward dynamics: fit -> posterior -> predict."""

from forcegp.models.identification import Identification
from forcegp.models.independent_gp import IndependentGP
from forcegp.models.independent_posterior import IndependentPosterior
from forcegp.models.marginal_likelihood import MarginalLikelihood, TrainingData
from forcegp.models.network_ensemble import NetworkEnsemble
from forcegp.models.network_posterior import NetworkPosterior
from forcegp.models.neural_network import NeuralNetwork
from forcegp.models.noise import Noise
from forcegp.models.physical_parameters import Coefficients
from forcegp.models.prediction import Gaussian, Prediction
from forcegp.models.predictor import Linearization, Predictor
from forcegp.models.protocol import Model, Posterior
from forcegp.models.rollout import Rollout
from forcegp.models.storage import load_posterior, save_posterior
from forcegp.models.structured_gp import StructuredGP
from forcegp.models.structured_posterior import StructuredPosterior

__all__ = [
    "Coefficients",
    "Gaussian",
    "Identification",
    "IndependentGP",
    "IndependentPosterior",
    "Linearization",
    "MarginalLikelihood",
    "Model",
    "NetworkEnsemble",
    "NetworkPosterior",
    "NeuralNetwork",
    "Noise",
    "Posterior",
    "Prediction",
    "Predictor",
    "Rollout",
    "StructuredGP",
    "StructuredPosterior",
    "TrainingData",
    "load_posterior",
    "save_posterior",
]
