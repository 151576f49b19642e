"""`evaluate`: predict every row of a Dataset with a fitted model and score it; the scores are an `Evaluation`."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Generic, TypeVar

import numpy as np
from typing_extensions import override

from forcegp.data import Dataset, contact_doubts
from forcegp.data.dataset import require_rows
from forcegp.errors import require_type
from forcegp.evaluation import metrics
from forcegp.evaluation.doubts import doubts, overlap_warnings
from forcegp.evaluation.predicted_rows import PredictedRows, predict_rows, stated_noise_level
from forcegp.posterior.posterior import Posterior
from forcegp.summary import Summary, listed

Numbers = tuple[float, ...]
Mean = TypeVar("Mean", float, float | None)


class _Mean(Generic[Mean]):
    """An attribute that is the mean of the numbers in a field, 0 of none; None where the field is None."""

    def __init__(self, field: str) -> None:
        self.field = field

    def __get__(self, owner: Any, kind: type | None = None) -> Mean:
        values = None if owner is None else getattr(owner, self.field)
        mean: Any = None if values is None else sum(values) / len(values) if values else 0.0
        return mean


@dataclass(frozen=True, kw_only=True, repr=False)
class Evaluation(Summary):
    """Scores on one Dataset. Every `<score>_per_joint` (or `_per_contact`) has its mean as attribute `<score>`.

    Errors are in the units of what is compared: rad/s^2 (m/s^2 for prismatic joints) for accelerations, Nm (N) for
    joint forces, N for multipliers. Scores against the truth are None where the Dataset does not hold it.

    Fields
    ------
    rows: number of rows.
    mae, rmse: of the mean against the measured acceleration, noise included; so `mae` cannot fall below `noise_floor`.
    nlpd: negative log predictive density of a measurement, all joints jointly, nats per row; `nlpd_per_joint` of each
        joint alone, which does not sum to it where joints are correlated.
    coverage_95: share of measurements inside the 95 % interval of a measurement. Here and in `nlpd` the variance is
        that of the prediction plus that of the noise: the model's, or the Dataset's where it states a larger one. A
        Dataset that states the noise of every row is scored with that of each.
    mae_noise_free, rmse_noise_free, coverage_95_noise_free: against the true acceleration, with the variance of the
        acceleration itself (no noise added).
    noise_floor: MAE of a perfect prediction, `noise_std sqrt(2/pi)`, from the noise that the Dataset states.
    noise_std: the noise that the model assumes or has learned.
    known_physics_mae: MAE of the known forces alone against the measurement, to see what learning adds.
    constraint_error: mean |A a - b| of the mean prediction, on the constraint of the Dataset's own system if it has one
        (else the model's), 0 without contacts; `_max` the largest, `_per_joint` mean |A^+ (A a - b)|, the smallest
        change of each joint's acceleration that would repair it.
    force_mae: |M (a - a_true)|, the error as a joint force.
    unknown_force_*: against the true Q_U (without an analytical mean: Q_K + Q_U, which the processes then carry). The
        part along A^T presses on the surface and moves nothing, so accelerations cannot show it: prefer `force_mae`.
    multiplier_*: against the true lambda. Both are None for models without forces.
    warnings: sentences for people, for example that test rows are training rows.
    """

    rows: int
    joint_names: tuple[str, ...]
    mae_per_joint: Numbers
    rmse_per_joint: Numbers
    nlpd: float
    nlpd_per_joint: Numbers
    coverage_95_per_joint: Numbers
    noise_std_per_joint: Numbers
    known_physics_mae_per_joint: Numbers
    constraint_error_per_contact: Numbers
    constraint_error_per_joint: Numbers
    constraint_error_max: float
    noise_floor_per_joint: Numbers | None = None
    mae_noise_free_per_joint: Numbers | None = None
    rmse_noise_free_per_joint: Numbers | None = None
    coverage_95_noise_free_per_joint: Numbers | None = None
    known_physics_mae_noise_free_per_joint: Numbers | None = None
    force_mae_per_joint: Numbers | None = None
    unknown_force_mae_per_joint: Numbers | None = None
    unknown_force_rmse_per_joint: Numbers | None = None
    unknown_force_coverage_95_per_joint: Numbers | None = None
    multiplier_mae_per_contact: Numbers | None = None
    multiplier_rmse_per_contact: Numbers | None = None
    multiplier_coverage_95_per_contact: Numbers | None = None
    warnings: tuple[str, ...] = ()

    mae = _Mean[float]("mae_per_joint")
    rmse = _Mean[float]("rmse_per_joint")
    coverage_95 = _Mean[float]("coverage_95_per_joint")
    noise_std = _Mean[float]("noise_std_per_joint")
    known_physics_mae = _Mean[float]("known_physics_mae_per_joint")
    constraint_error = _Mean[float]("constraint_error_per_contact")
    noise_floor = _Mean[float | None]("noise_floor_per_joint")
    mae_noise_free = _Mean[float | None]("mae_noise_free_per_joint")
    rmse_noise_free = _Mean[float | None]("rmse_noise_free_per_joint")
    coverage_95_noise_free = _Mean[float | None]("coverage_95_noise_free_per_joint")
    known_physics_mae_noise_free = _Mean[float | None]("known_physics_mae_noise_free_per_joint")
    force_mae = _Mean[float | None]("force_mae_per_joint")
    unknown_force_mae = _Mean[float | None]("unknown_force_mae_per_joint")
    unknown_force_rmse = _Mean[float | None]("unknown_force_rmse_per_joint")
    unknown_force_coverage_95 = _Mean[float | None]("unknown_force_coverage_95_per_joint")
    multiplier_mae = _Mean[float | None]("multiplier_mae_per_contact")
    multiplier_rmse = _Mean[float | None]("multiplier_rmse_per_contact")
    multiplier_coverage_95 = _Mean[float | None]("multiplier_coverage_95_per_contact")

    @override
    def facts(self) -> dict[str, object]:
        """The scores that say most; all are in `to_dict()`."""
        floor = "" if self.noise_floor is None else f", noise floor {self.noise_floor:.3g}"
        free, warned = self.mae_noise_free, listed(self.warnings, most=1)
        facts: dict[str, object] = {"rows": self.rows, "joints": len(self.joint_names)}
        facts |= {"mae": f"{self.mae:.3g}{floor}", "known physics mae": f"{self.known_physics_mae:.3g}"}
        facts |= {"nlpd": f"{self.nlpd:.3g} nats per row", "coverage 95": f"{self.coverage_95:.3g}"}
        return facts | ({} if free is None else {"mae noise-free": f"{free:.3g}"}) | {"warnings": warned}

    def to_dict(self) -> dict[str, Any]:
        """Every score, and every mean before what it is the mean of, as plain JSON values."""
        out: dict[str, Any] = {}
        for field in fields(self):
            score = field.name.removesuffix("_per_joint").removesuffix("_per_contact")
            out |= {name: getattr(self, name) for name in (score, field.name)}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in out.items()}


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
    found = _against_measurements(predicted, dataset) | _against_truth(predicted, dataset)
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
            *(str(doubt) for doubt in contact_doubts(dataset, posterior.model)),
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
    a, measurement = dataset.a, predicted.measurement_variance
    residual = metrics.constraint_residual(predicted.A, predicted.b, predicted.mean)
    return {
        "known_physics_mae_per_joint": metrics.mean_absolute_error(predicted.known_physics, a),
        "nlpd": float(predicted.negative_log_density.mean()),
        "nlpd_per_joint": metrics.marginal_negative_log_density(predicted.mean, measurement, a),
        **_errors("{}_per_joint", predicted.mean, measurement, a),
        "constraint_error_per_contact": np.abs(residual).mean(axis=0),
        "constraint_error_per_joint": np.abs(metrics.joint_space_residual(predicted.A, residual)).mean(axis=0),
        "constraint_error_max": float(np.abs(residual).max(initial=0.0)),
    }


def _against_truth(predicted: PredictedRows, dataset: Dataset) -> dict[str, Any]:
    out: dict[str, Any] = {}
    if "a" in dataset.truth:
        a = dataset.truth["a"]
        force_error = (predicted.mass @ (predicted.mean - a)[..., None])[..., 0]
        out |= _errors("{}_noise_free_per_joint", predicted.mean, predicted.variance, a)
        out["known_physics_mae_noise_free_per_joint"] = metrics.mean_absolute_error(predicted.known_physics, a)
        out["force_mae_per_joint"] = np.abs(force_error).mean(axis=0)
    if "Q_U" in dataset.truth and predicted.carried_known_force is not None:
        truth = dataset.truth["Q_U"] + predicted.carried_known_force
        out |= _errors("unknown_force_{}_per_joint", predicted.unknown_force, predicted.unknown_force_variance, truth)
    if "lambda" in dataset.truth:
        truth = dataset.truth["lambda"]
        out |= _errors("multiplier_{}_per_contact", predicted.multiplier, predicted.multiplier_variance, truth)
    return out


def _errors(name: str, mean: np.ndarray | None, variance: np.ndarray | None, truth: np.ndarray) -> dict[str, Any]:
    """Three scores; none of forces that the model lacks, or of another number of contacts."""
    if mean is None or variance is None or mean.shape != truth.shape:
        return {}
    return {
        name.format("mae"): metrics.mean_absolute_error(mean, truth),
        name.format("rmse"): metrics.root_mean_square_error(mean, truth),
        name.format("coverage_95"): metrics.interval_coverage(mean, variance, truth),
    }


def _numbers(values: np.ndarray) -> Numbers:
    return tuple(float(value) for value in values)
