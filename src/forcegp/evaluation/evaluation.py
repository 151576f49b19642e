"""`Evaluation`: how well a fitted model predicts a Dataset, as one frozen value."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

Numbers = tuple[float, ...]
PER = ("_per_joint", "_per_contact")


@dataclass(frozen=True, kw_only=True)
class Evaluation:
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

    @property
    def mae(self) -> float:
        """Mean of `mae_per_joint`."""
        return _mean(self.mae_per_joint)

    @property
    def rmse(self) -> float:
        """Mean of `rmse_per_joint`."""
        return _mean(self.rmse_per_joint)

    @property
    def coverage_95(self) -> float:
        """Mean of `coverage_95_per_joint`."""
        return _mean(self.coverage_95_per_joint)

    @property
    def noise_std(self) -> float:
        """Mean of `noise_std_per_joint`."""
        return _mean(self.noise_std_per_joint)

    @property
    def known_physics_mae(self) -> float:
        """Mean of `known_physics_mae_per_joint`."""
        return _mean(self.known_physics_mae_per_joint)

    @property
    def constraint_error(self) -> float:
        """Mean of `constraint_error_per_contact`."""
        return _mean(self.constraint_error_per_contact)

    @property
    def noise_floor(self) -> float | None:
        """Mean of `noise_floor_per_joint`."""
        return _optional_mean(self.noise_floor_per_joint)

    @property
    def mae_noise_free(self) -> float | None:
        """Mean of `mae_noise_free_per_joint`."""
        return _optional_mean(self.mae_noise_free_per_joint)

    @property
    def rmse_noise_free(self) -> float | None:
        """Mean of `rmse_noise_free_per_joint`."""
        return _optional_mean(self.rmse_noise_free_per_joint)

    @property
    def coverage_95_noise_free(self) -> float | None:
        """Mean of `coverage_95_noise_free_per_joint`."""
        return _optional_mean(self.coverage_95_noise_free_per_joint)

    @property
    def known_physics_mae_noise_free(self) -> float | None:
        """Mean of `known_physics_mae_noise_free_per_joint`."""
        return _optional_mean(self.known_physics_mae_noise_free_per_joint)

    @property
    def force_mae(self) -> float | None:
        """Mean of `force_mae_per_joint`."""
        return _optional_mean(self.force_mae_per_joint)

    @property
    def unknown_force_mae(self) -> float | None:
        """Mean of `unknown_force_mae_per_joint`."""
        return _optional_mean(self.unknown_force_mae_per_joint)

    @property
    def unknown_force_rmse(self) -> float | None:
        """Mean of `unknown_force_rmse_per_joint`."""
        return _optional_mean(self.unknown_force_rmse_per_joint)

    @property
    def unknown_force_coverage_95(self) -> float | None:
        """Mean of `unknown_force_coverage_95_per_joint`."""
        return _optional_mean(self.unknown_force_coverage_95_per_joint)

    @property
    def multiplier_mae(self) -> float | None:
        """Mean of `multiplier_mae_per_contact`."""
        return _optional_mean(self.multiplier_mae_per_contact)

    @property
    def multiplier_rmse(self) -> float | None:
        """Mean of `multiplier_rmse_per_contact`."""
        return _optional_mean(self.multiplier_rmse_per_contact)

    @property
    def multiplier_coverage_95(self) -> float | None:
        """Mean of `multiplier_coverage_95_per_contact`."""
        return _optional_mean(self.multiplier_coverage_95_per_contact)

    def to_dict(self) -> dict[str, Any]:
        """Every score, and every mean before what it is the mean of, as plain JSON values."""
        out: dict[str, Any] = {}
        for field in fields(self):
            score = field.name
            for suffix in PER:
                score = score.removesuffix(suffix)
            out.setdefault(score, _plain(getattr(self, score)))
            out[field.name] = _plain(getattr(self, field.name))
        return out


def _mean(values: Numbers) -> float:
    return sum(values) / len(values) if values else 0.0


def _optional_mean(values: Numbers | None) -> float | None:
    return None if values is None else _mean(values)


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
