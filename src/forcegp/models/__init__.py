"""Models of the forward dynamics: fit -> posterior -> predict."""

from forcegp.models.baselines.independent_gp import IndependentGP
from forcegp.models.baselines.independent_posterior import IndependentPosterior
from forcegp.models.baselines.network_ensemble import NetworkEnsemble
from forcegp.models.baselines.network_posterior import NetworkPosterior
from forcegp.models.baselines.neural_network import NeuralNetwork
from forcegp.models.identification.identification import Identification
from forcegp.models.identification.physical_parameters import Coefficients
from forcegp.models.noise import Noise
from forcegp.models.prediction import Gaussian, Prediction
from forcegp.models.predictor import Linearization, Predictor
from forcegp.models.protocol import Model, Posterior
from forcegp.models.rollout import Rollout
from forcegp.models.storage import load_posterior, save_posterior
from forcegp.models.structured.gp import StructuredGP
from forcegp.models.structured.marginal_likelihood import MarginalLikelihood
from forcegp.models.structured.posterior import StructuredPosterior
from forcegp.models.training_data import TrainingData

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
