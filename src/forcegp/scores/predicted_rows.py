"""Predictions for every row of a Dataset as numpy arrays, made in blocks so that memory stays bounded."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from scipy.special import ndtri
from torch import Tensor
from torch.distributions import MultivariateNormal

from forcegp.data import Dataset, with_memory
from forcegp.errors import NumericalError
from forcegp.inference.memory import blas_threads
from forcegp.posterior.posterior import Posterior
from forcegp.posterior.prediction import Prediction

ROWS_PER_BLOCK = 1024
Block = TypeVar("Block")


@dataclass(frozen=True, eq=False)
class PredictedRows:
    """What a model predicts for every row, and the mechanics there.

    `mean`, `variance` of the acceleration without noise, `measurement_variance` with the noise of the model, or of
    the Dataset where it states a larger one or that of every row; `negative_log_density` of the measured rows under
    that noise; `known_physics` the acceleration of the known forces alone; `unknown_force` Q_U and
    `carried_known_force` what of it is known (Q_K without an analytical mean, else 0); `multiplier` lambda, all
    three None for a model without forces; `residual` |A a - b| of the mean; the mass matrix `mass`.
    """

    mean: Float[np.ndarray, "rows nv"]
    variance: Float[np.ndarray, "rows nv"]
    measurement_variance: Float[np.ndarray, "rows nv"]
    negative_log_density: Float[np.ndarray, " rows"]
    unknown_force: Float[np.ndarray, "rows nv"] | None
    unknown_force_variance: Float[np.ndarray, "rows nv"] | None
    multiplier: Float[np.ndarray, "rows m"] | None
    multiplier_variance: Float[np.ndarray, "rows m"] | None
    known_physics: Float[np.ndarray, "rows nv"]
    carried_known_force: Float[np.ndarray, "rows nv"] | None
    residual: Float[np.ndarray, "rows c"]
    mass: Float[np.ndarray, "rows nv nv"]

    @property
    def std(self) -> Float[np.ndarray, "rows nv"]:
        """Standard deviation of the acceleration, without noise."""
        return np.sqrt(self.variance)

    @property
    def measurement_std(self) -> Float[np.ndarray, "rows nv"]:
        """Standard deviation of a measurement."""
        return np.sqrt(self.measurement_variance)


def predict_rows(
    posterior: Posterior, dataset: Dataset, progress: Callable[[int, int], None] | None = None
) -> PredictedRows:
    """Predict all rows. The constraint is that of the Dataset's own system if it has one, else the model's."""
    dataset = with_memory(dataset, posterior.model)
    blocks = in_blocks(posterior, dataset, lambda block: _predict_block(posterior, dataset, block), progress)
    joined: dict[str, Any] = {}
    for field in fields(PredictedRows):
        parts = [getattr(block, field.name) for block in blocks]
        joined[field.name] = None if parts[0] is None else np.concatenate(parts)
    return PredictedRows(**joined)


def in_blocks(
    posterior: Posterior,
    dataset: Dataset,
    predict: Callable[[slice], Block],
    progress: Callable[[int, int], None] | None = None,
) -> list[Block]:
    """What `predict` returns for all rows, some at a time so that memory stays bounded, without gradients."""
    blocks = []
    with torch.no_grad(), blas_threads(posterior.training.q.numel()):
        for start in range(0, len(dataset), ROWS_PER_BLOCK):
            block = slice(start, min(start + ROWS_PER_BLOCK, len(dataset)))
            blocks.append(predict(block))
            if progress is not None:
                progress(block.stop, len(dataset))
    return blocks


def _predict_block(posterior: Posterior, dataset: Dataset, block: slice) -> PredictedRows:
    device = posterior.model.robot.device
    q, v, u = (torch.tensor(values[block], device=device) for values in (dataset.q, dataset.v, dataset.u))
    prediction = posterior.predict(q, v, u)
    dynamics = posterior.dynamics(q, v, u)
    own = dynamics if dataset.model is None else dataset.model.to(device).dynamics(q, v, u)
    covariance, force, multiplier = prediction.covariance, prediction.unknown_force, prediction.multiplier
    assert covariance is not None, "predict computes the covariance unless asked not to"
    covariance = _array(covariance)
    measurement = covariance + _noise_covariance(prediction, dataset)
    mean, mass = _array(prediction.mean), _array(dynamics.M)
    alone = u.clone()
    alone[:, list(posterior.model.held_inputs)] = 0.0  # what an observer reports is no part of the known physics
    by_itself = posterior.dynamics(q, v, alone) if posterior.model.held_inputs else dynamics
    known = _array(by_itself.acceleration_map().offset)
    carried = own.Q_K if posterior.carries_known_forces else torch.zeros_like(own.Q_K)
    return PredictedRows(
        mean=mean,
        variance=_array(prediction.variance),
        measurement_variance=np.diagonal(measurement, axis1=-2, axis2=-1),
        negative_log_density=negative_log_density(mean, measurement, np.asarray(dataset.a[block])),
        unknown_force=None if force is None else _array(force.mean),
        unknown_force_variance=None if force is None else _array(force.variance),
        multiplier=None if multiplier is None else _array(multiplier.mean),
        multiplier_variance=None if multiplier is None else _array(multiplier.variance),
        known_physics=known,
        carried_known_force=None if force is None else _array(carried),
        residual=_array(((own.A @ prediction.mean[..., None])[..., 0] - own.b).abs()),
        mass=mass,
    )


def _noise_covariance(prediction: Prediction, dataset: Dataset) -> Float[np.ndarray, "*rows nv nv"]:
    """Of the measurements compared with: the model's, or the Dataset's where that is larger.

    The measurements may be noisier than those learned from; and a model that has learned a level of noise counts to it
    what it cannot explain otherwise.
    """
    noise = _array(prediction.noise_covariance)
    if dataset.noise_std is None:
        return noise
    missing = np.square(dataset.noise_std) - np.diagonal(noise, axis1=-2, axis2=-1)
    return noise + np.maximum(missing, 0.0)[..., None] * np.eye(noise.shape[-1])


def _array(values: Tensor) -> np.ndarray:
    return values.detach().cpu().numpy()


Columns = Float[np.ndarray, "rows k"]


def negative_log_density(
    mean: Columns, covariance: Float[np.ndarray, "rows k k"], target: Columns
) -> Float[np.ndarray, " rows"]:
    """-log N(target; mean, covariance) of every row, all columns jointly, in nats.

    Its mean over test rows is the negative log predictive density (Rasmussen & Williams 2006, eq. A.23). Raises
    NumericalError, naming the row, for a covariance that is not positive definite: that of a measurement always is.
    """
    lower, failed = torch.linalg.cholesky_ex(torch.from_numpy(covariance))
    if bool(failed.any()):
        raise NumericalError(
            f"the predicted covariance of row {int(failed.argmax())} is not positive definite, so it has no density; "
            "add the covariance of the measurement noise."
        )
    normal = MultivariateNormal(torch.from_numpy(mean), scale_tril=lower, validate_args=False)
    return -normal.log_prob(torch.tensor(target)).numpy()


def interval_coverage(
    mean: Columns, variance: Columns, target: Columns, level: float = 0.95
) -> Float[np.ndarray, " k"]:
    """Share of targets inside the central `level` interval of each column: about `level` if the variance is right.

    `variance` must be that of `target`: with measurement noise for measured values, without for noise-free ones.
    """
    return (np.abs(target - mean) <= ndtri(0.5 + 0.5 * level) * np.sqrt(variance)).mean(axis=0)
