"""`evaluate`: predict every row of a Dataset with a fitted model and score it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from forcegp.data import Dataset, contact_doubts
from forcegp.data.dataset_arguments import require_rows
from forcegp.errors import require_type
from forcegp.evaluation import metrics
from forcegp.evaluation.doubts import doubts
from forcegp.evaluation.evaluation import Evaluation, Numbers
from forcegp.evaluation.overlap import overlap_warnings
from forcegp.evaluation.predicted_rows import PredictedRows, predict_rows, stated_noise_level
from forcegp.models.protocol import Posterior

NOISE_FACTOR = 1.5
"""Noise levels of model and Dataset that differ by more than this factor are named in a warning."""


def evaluate(
    posterior: Posterior, dataset: Dataset, *, progress: Callable[[int, int], None] | None = None
) -> Evaluation:
    """Predict every row of `dataset` and compare; `progress(rows done, rows in total)` is called now and then.

    Raises InvalidInput if the joints of model and Dataset differ.
    """
    require_type("posterior", posterior, Posterior, " of a fit, and the dataset after it")
    require_rows("dataset", dataset, posterior.joint_names, "the model")
    predicted = predict_rows(posterior, dataset, progress)
    found = _against_measurements(predicted, dataset) | _against_truth(predicted, dataset) | _constraint(predicted)
    scores: dict[str, Any] = {name: _numbers(x) if isinstance(x, np.ndarray) else x for name, x in found.items()}
    return Evaluation(
        rows=len(dataset),
        joint_names=posterior.joint_names,
        noise_std_per_joint=_numbers(posterior.noise_std.detach().cpu().numpy()),
        noise_floor_per_joint=None
        if dataset.noise_std is None
        else _numbers(metrics.noise_floor(np.atleast_2d(dataset.noise_std).mean(axis=0))),
        warnings=(
            *overlap_warnings(posterior, dataset),
            *_noise_warnings(posterior, dataset),
            *(str(doubt) for doubt in contact_doubts(dataset, posterior.system)),
            *doubts(posterior, dataset, scores),
        ),
        **scores,
    )


def _noise_warnings(posterior: Posterior, dataset: Dataset) -> tuple[str, ...]:
    """A sentence if model and Dataset disagree about the noise of some joint by more than NOISE_FACTOR."""
    stated = stated_noise_level(posterior, dataset)
    if stated is None:
        return ()
    model = posterior.noise_std.detach().cpu().numpy()
    ratio = np.maximum(model / stated, stated / model)
    joint = int(ratio.argmax())
    if ratio[joint] <= NOISE_FACTOR:
        return ()
    return (
        f"the noise std of the model is {model[joint]:.3g}, that of the data {stated[joint]:.3g} "
        f"(joint {dataset.joint_names[joint]}, where they differ most); coverage and NLPD use the larger one.",
    )


def _against_measurements(predicted: PredictedRows, dataset: Dataset) -> dict[str, Any]:
    measurement = predicted.measurement_variance
    return {
        "known_physics_mae_per_joint": metrics.mean_absolute_error(predicted.known_physics, dataset.a),
        "mae_per_joint": metrics.mean_absolute_error(predicted.mean, dataset.a),
        "rmse_per_joint": metrics.root_mean_square_error(predicted.mean, dataset.a),
        "nlpd": float(predicted.negative_log_density.mean()),
        "nlpd_per_joint": metrics.marginal_negative_log_density(predicted.mean, measurement, dataset.a),
        "coverage_95_per_joint": metrics.interval_coverage(predicted.mean, measurement, dataset.a),
    }


def _against_truth(predicted: PredictedRows, dataset: Dataset) -> dict[str, Any]:
    out: dict[str, Any] = {}
    if "a" in dataset.truth:
        a = dataset.truth["a"]
        force_error = (predicted.mass @ (predicted.mean - a)[..., None])[..., 0]
        out["mae_noise_free_per_joint"] = metrics.mean_absolute_error(predicted.mean, a)
        out["rmse_noise_free_per_joint"] = metrics.root_mean_square_error(predicted.mean, a)
        out["coverage_95_noise_free_per_joint"] = metrics.interval_coverage(predicted.mean, predicted.variance, a)
        out["known_physics_mae_noise_free_per_joint"] = metrics.mean_absolute_error(predicted.known_physics, a)
        out["force_mae_per_joint"] = np.abs(force_error).mean(axis=0)
    if "Q_U" in dataset.truth and predicted.carried_known_force is not None:
        truth = dataset.truth["Q_U"] + predicted.carried_known_force
        out |= _forces("unknown_force", "_per_joint", predicted.unknown_force, predicted.unknown_force_variance, truth)
    if "lambda" in dataset.truth:
        truth = dataset.truth["lambda"]
        out |= _forces("multiplier", "_per_contact", predicted.multiplier, predicted.multiplier_variance, truth)
    return out


def _forces(
    name: str, per: str, mean: np.ndarray | None, variance: np.ndarray | None, truth: np.ndarray
) -> dict[str, np.ndarray]:
    """Scores of a force; none where the model lacks it, or of another number of contacts."""
    if mean is None or variance is None or mean.shape != truth.shape:
        return {}
    return {
        f"{name}_mae{per}": metrics.mean_absolute_error(mean, truth),
        f"{name}_rmse{per}": metrics.root_mean_square_error(mean, truth),
        f"{name}_coverage_95{per}": metrics.interval_coverage(mean, variance, truth),
    }


def _constraint(predicted: PredictedRows) -> dict[str, Any]:
    residual = metrics.constraint_residual(predicted.A, predicted.b, predicted.mean)
    per_joint = metrics.joint_space_residual(predicted.A, residual)
    return {
        "constraint_error_per_contact": np.abs(residual).mean(axis=0),
        "constraint_error_per_joint": np.abs(per_joint).mean(axis=0),
        "constraint_error_max": float(np.abs(residual).max(initial=0.0)),
    }


def _numbers(values: np.ndarray) -> Numbers:
    return tuple(float(value) for value in values)
