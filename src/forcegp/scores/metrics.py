"""Scores of predictions as functions of arrays, rows first, one column per joint or contact."""

import numpy as np
import torch
from jaxtyping import Float
from scipy.special import ndtri
from torch.distributions import MultivariateNormal

from forcegp.errors import NumericalError

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
