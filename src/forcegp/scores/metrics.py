"""Scores of predictions as functions of arrays, rows first, one column per joint or contact."""

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular
from scipy.special import ndtri

from forcegp.errors import InvalidInput, NumericalError

Columns = Float[np.ndarray, "rows k"]
PerColumn = Float[np.ndarray, " k"]

LOG_2_PI = float(np.log(2.0 * np.pi))


def negative_log_density(
    mean: Columns, covariance: Float[np.ndarray, "rows k k"], target: Columns
) -> Float[np.ndarray, " rows"]:
    """-log N(target; mean, covariance) of every row, all columns jointly, in nats.

    1/2 r^T S^-1 r + 1/2 log|S| + k/2 log 2 pi (Rasmussen & Williams 2006, eq. A.23). Its mean over test rows is the
    negative log predictive density. Raises NumericalError, naming the row, for a covariance that is not positive
    definite: that of a measurement always is, that of a constrained acceleration without noise never.
    """
    try:
        lower = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        row = int(np.argmin(np.linalg.eigvalsh(covariance)[:, 0]))
        raise NumericalError(
            f"the predicted covariance of row {row} is not positive definite, so it has no density; "
            "add the covariance of the measurement noise."
        ) from None
    white = solve_triangular(lower, (target - mean)[..., None], lower=True)[..., 0]
    log_determinant = 2.0 * np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=-1)
    return 0.5 * (np.square(white).sum(axis=-1) + log_determinant + mean.shape[-1] * LOG_2_PI)


def marginal_negative_log_density(mean: Columns, variance: Columns, target: Columns) -> PerColumn:
    """Mean over the rows of -log N(target; mean, variance) of each column alone, in nats."""
    if not (variance > 0).all():
        raise NumericalError("a predicted variance is not positive, so it has no density; add that of the noise.")
    return (0.5 * (np.square(target - mean) / variance + np.log(variance) + LOG_2_PI)).mean(axis=0)


def interval_coverage(mean: Columns, variance: Columns, target: Columns, level: float = 0.95) -> PerColumn:
    """Share of targets inside the central `level` interval of each column: about `level` if the variance is right.

    `variance` must be that of `target`: with measurement noise for measured values, without for noise-free ones.
    """
    if not 0.0 < level < 1.0:
        raise InvalidInput(f"level is {level}; it must be between 0 and 1, for example 0.95.")
    return (np.abs(target - mean) <= ndtri(0.5 + 0.5 * level) * np.sqrt(variance)).mean(axis=0)
