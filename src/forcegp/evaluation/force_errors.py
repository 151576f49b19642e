"""Errors of every force by itself: its components, their force at the tool, and the normal force.

A Dataset holds the truth of a force by its name, `Q_U.<name>` and `force.<name>`. Where two components claim the same
truth none is compared, since only their sum is true then.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from forcegp.data import Dataset
from forcegp.data.dataset import require_rows
from forcegp.errors import InvalidInput
from forcegp.evaluation import metrics
from forcegp.evaluation.evaluation import Numbers
from forcegp.evaluation.predicted_rows import in_blocks
from forcegp.posterior.components import Curve
from forcegp.posterior.posterior import Posterior
from forcegp.posterior.prediction import Gaussian

ROUNDING = 1e-9
"""Relative to the size of the truth: widths and distances below it are none."""

AT_THE_TOOL = ("tool-friction", "tool-forces", "contact-friction", "load-friction", "friction-map")
TRUE_NAMES: dict[str, str] = dict.fromkeys(AT_THE_TOOL, "tool-friction")
"""Component of a model -> what a Dataset calls that force (`Q_U.<name>`, `force.<name>`), where it is not the same."""


@dataclass(frozen=True)
class ForceScore:
    """One force against the truth, column by column (joints, world axes or contacts), in Nm or N.

    `relative_rmse` is the root mean square of the error over all columns divided by that of the truth, None where the
    truth is zero; `coverage_95` the share of true values inside the 95 % interval of the force, without entries whose
    interval has no width (a joint that the tool cannot turn, a direction in which the prior has no force); None where
    that leaves none.
    """

    mae_per_column: Numbers
    rmse_per_column: Numbers
    coverage_95_per_column: tuple[float | None, ...]
    relative_rmse: float | None

    @classmethod
    def of(
        cls,
        mean: Float[np.ndarray, "rows k"],
        variance: Float[np.ndarray, "rows k"],
        truth: Float[np.ndarray, "rows k"],
    ) -> "ForceScore":
        """Scores of a prediction."""
        size = float(np.sqrt(np.square(truth).mean()))
        wide = variance > (ROUNDING * size) ** 2
        covered: list[float | None] = []
        for column, rows in enumerate(wide.T):
            own = mean[rows, column, None], variance[rows, column, None], truth[rows, column, None]
            covered.append(float(metrics.interval_coverage(*own)[0]) if rows.any() else None)
        return cls(
            tuple(metrics.mean_absolute_error(mean, truth).tolist()),
            tuple(metrics.root_mean_square_error(mean, truth).tolist()),
            tuple(covered),
            float(np.sqrt(np.square(mean - truth).mean())) / size if size > 0.0 else None,
        )

    @property
    def mae(self) -> float:
        """Mean of `mae_per_column`."""
        return float(np.mean(self.mae_per_column))

    @property
    def rmse(self) -> float:
        """Root of the mean square of `rmse_per_column`."""
        return float(np.sqrt(np.square(self.rmse_per_column).mean()))

    @property
    def coverage_95(self) -> float | None:
        """Mean of `coverage_95_per_column`."""
        known = [share for share in self.coverage_95_per_column if share is not None]
        return sum(known) / len(known) if known else None

    def to_dict(self) -> dict[str, Any]:
        """All scores as plain JSON values."""
        each = {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}
        return {"mae": self.mae, "rmse": self.rmse, "coverage_95": self.coverage_95, **each}


@dataclass(frozen=True)
class ForceScores:
    """Scores of every force that the truth holds.

    `joint_force` (in Nm or N) and `point_force` (in N, world axes) by component; `multiplier` of lambda, None where
    model or truth lack it.
    """

    rows: int
    joint_force: Mapping[str, ForceScore] = field(default_factory=dict)
    point_force: Mapping[str, ForceScore] = field(default_factory=dict)
    multiplier: ForceScore | None = None

    def to_dict(self) -> dict[str, Any]:
        """All scores as plain JSON values."""
        return {
            "rows": self.rows,
            "joint_force": {name: score.to_dict() for name, score in self.joint_force.items()},
            "point_force": {name: score.to_dict() for name, score in self.point_force.items()},
            "multiplier": None if self.multiplier is None else self.multiplier.to_dict(),
        }


def force_scores(posterior: Posterior, dataset: Dataset) -> ForceScores:
    """Score the components of a model, and lambda, against the truth that the Dataset holds.

    A component is compared with "Q_U.<its name>" and "force.<its name>", or with those in `TRUE_NAMES`. Not
    where two components of the model claim the same truth, since only their sum is true, and not without an analytical
    mean, where the processes hold the known forces, too. Raises InvalidInput for data of other joints.
    """
    require_rows("dataset", dataset, posterior.joint_names, "the model")
    comparable = isinstance(posterior, Posterior) and not posterior.carries_known_forces
    terms = posterior.trained.unknown.named(posterior.model.robot) if comparable else ()
    named = true_names([name for name, *_ in terms], dataset)
    if not named and "lambda" not in dataset.truth:
        return ForceScores(len(dataset))
    predicted = _predict(posterior, dataset, named)
    joint, point = {}, {}
    for name, kept in named.items():
        for scores, kind in ((joint, "Q_U"), (point, "force")):
            if f"{kind}.{kept}" in dataset.truth and f"{kind} {name}" in predicted:
                scores[name] = ForceScore.of(*predicted[f"{kind} {name}"], dataset.truth[f"{kind}.{kept}"])
    multiplier = None
    if "lambda" in predicted and "lambda" in dataset.truth:
        truth = dataset.truth["lambda"]
        if truth.shape == predicted["lambda"][0].shape and truth.shape[1]:
            multiplier = ForceScore.of(*predicted["lambda"], truth)
    return ForceScores(len(dataset), joint, point, multiplier)


def true_names(components: Sequence[str], dataset: Dataset) -> dict[str, str]:
    """Component -> what the truth of the Dataset calls it; without those that the truth does not hold alone."""
    pairs = [(name, kept) for name in components for kept in (TRUE_NAMES.get(name, name), name)]
    found = {name: kept for name, kept in pairs if {f"Q_U.{kept}", f"force.{kept}"} & set(dataset.truth)}
    claimed = list(found.values())
    return {name: kept for name, kept in found.items() if claimed.count(kept) == 1}


def curve_coverage(curve: Curve, law: Callable[[np.ndarray], np.ndarray], *, probability: float = 0.95) -> float:
    """Share of the curve's points within the visited range whose interval contains the true `law`.

    `law` maps the feature (n,), a velocity for example, to the true value (n,) in the curve's unit. For a curve with
    equal steps, as `posterior.curve(name)` makes it, that is the share of the range between the smallest and the
    largest training value. Raises InvalidInput for a curve over several features and for one outside of that range.
    """
    if curve.features.shape[-1] != 1:
        raise InvalidInput(
            f"{curve.name!r} is a function of {curve.features.shape[-1]} features; coverage of a range needs one"
        )
    at = curve.features[:, 0].cpu().numpy()
    low, high = curve.visited[:, 0].cpu().numpy()
    inside = (at >= low - ROUNDING * abs(low)) & (at <= high + ROUNDING * abs(high))
    if not inside.any():
        raise InvalidInput(
            f"no point of the curve {curve.name!r} lies in the visited range from {low:.4g} to {high:.4g}; take "
            "posterior.curve(name) without features"
        )
    truth = np.asarray(law(at), dtype=np.float64)
    if truth.shape != at.shape:
        raise InvalidInput(f"the law returned shape {truth.shape} for {len(at)} values; return one number for each")
    lower, upper = (end.cpu().numpy() for end in curve.interval(probability))
    slack = ROUNDING * float(np.abs(truth).max())  # friction at rest is exactly zero, and so is its interval's width
    return float(((truth >= lower - slack) & (truth <= upper + slack))[inside].mean())


def _predict(
    posterior: Posterior, dataset: Dataset, named: Collection[str]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Mean and variance of the named components and lambda at every row, in blocks so that memory stays bounded."""
    columns = (dataset.q, dataset.v, dataset.u)
    blocks = in_blocks(posterior, dataset, lambda rows: _forces(posterior, named, *(each[rows] for each in columns)))

    def joined(name: str, part: str) -> np.ndarray:
        return np.concatenate([getattr(block[name], part).cpu().numpy() for block in blocks])

    return {name: (joined(name, "mean"), joined(name, "variance")) for name in blocks[0]}


def _forces(
    posterior: Posterior, named: Collection[str], q: np.ndarray, v: np.ndarray, u: np.ndarray
) -> dict[str, Gaussian]:
    if not named or not isinstance(posterior, Posterior):
        multiplier = posterior.predict(q, v, u).multiplier
        return {} if multiplier is None else {"lambda": multiplier}
    components = posterior.components(q, v, u)
    forces = {"lambda": components.multiplier}
    for name in named:
        component = components[name]
        forces[f"Q_U {name}"] = component.joint_force
        if component.point_force is not None:
            forces[f"force {name}"] = component.point_force
    return forces
