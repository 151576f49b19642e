"""One model against the rows of one log: a table by quantity and score, and errors by stretch of time.

A Dataset holds the truth of a force by its name, `Q_U.<name>` and `force.<name>`. Where two components of a model claim
the same truth none is compared, since only their sum is true then.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.stats import norm

from forcegp.data import Dataset, time_blocks
from forcegp.model import Model
from forcegp.posterior.posterior import Posterior
from forcegp.posterior.prediction import Gaussian
from forcegp.scores.predicted_rows import PredictedRows, in_blocks, interval_coverage, predict_rows
from forcegp.summary import plain

Rows = Float[np.ndarray, "rows nv"]
Matrices = Float[np.ndarray, "rows nv nv"]
Table = dict[str, dict[str, list[float | None]]]
"""Quantity -> score -> one number per column (joint, axis or contact); None for what is not a number."""

ACCELERATION, TRUE_ACCELERATION, ALL_JOINTS = "acceleration", "true acceleration", "all joints"
FORCE, TRUE_FORCE, UNKNOWN_FORCE = "force", "true force", "unknown force"
CONTACT_FORCE, CONSTRAINT = "contact force", "constraint"

LEVELS = (0.5, 0.95)
"""Of the central intervals whose coverage is scored, as `coverage_95`."""
STRETCHES = 20
"""Parts of the time in which models are compared by themselves."""
CONSTANT = 1e-6  # of the largest standard deviation: less is rounding
ROUNDING = 1e-9
"""Relative to the size of the truth: widths of intervals below it are none."""
ROWS_PER_BLOCK = 4096

AT_THE_TOOL = ("tool-friction", "tool-forces", "contact-friction", "load-friction")
TRUE_NAMES: dict[str, str] = dict.fromkeys(AT_THE_TOOL, "tool-friction")
"""Component of a model -> what a Dataset calls that force (`Q_U.<name>`, `force.<name>`), where it is not the same."""


def row_scores(
    posterior: Posterior,
    test: Dataset,
    mass: Matrices | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Table, dict[str, list[float | None]]]:
    """The table, and errors in about `STRETCHES` stretches of time, over all joints, where lower is better.

    acceleration: `mae`, `rmse` and, over the standard deviation of the measured one, `nrmse`; `nlpd` in nats and
        `coverage_95` of a measurement, with the noise of the model, or of the Dataset where that is larger;
        `known_physics_mae` of the known forces alone; `noise_std` of the model, and `noise_floor`, the `mae` of a
        perfect prediction. All joints together have one `nlpd`.
    force: M (predicted - measured acceleration) in Nm or N; `rmse_at_rest` is that of no acceleration. `mass` (rows of
        kg m^2, kg m or kg) is the same for every model that is compared, None takes the model's own.
    constraint: |A a - b| of the mean by contact, of the Dataset's own system if it has one.
    true acceleration, true force (M times its error), unknown force, contact force, `<component> at the joints` and
        `... at its point`: against the truth, as far as the Dataset holds it and the model has them. Coverage is that
        of entries whose interval has a width.
    """
    predicted = predict_rows(posterior, test, progress)
    mass = predicted.mass if mass is None else mass
    forces = force_errors(predicted.mean, test.a, mass)
    table = _against_measurements(posterior, predicted, test, forces, mass) | _against_truth(predicted, test)
    return table | _components(posterior, test), _by_stretch(predicted, test, forces)


def over_columns(quantity: str, score: str, values: Sequence[float | None]) -> float | None:
    """One number for all joints: the mean, of `rmse` of forces and motions the root of the mean of squares.

    Columns of which nothing is known (a joint that never moves has no `nrmse`) do not count; None where none is known.
    """
    known = [value for value in values if value is not None]
    if not known:
        return None
    squares = score.startswith("rmse") and not quantity.endswith(ACCELERATION)
    return float(np.sqrt(np.square(known).mean()) if squares else np.mean(known))


def mass_matrices(dataset: Dataset, model: Model) -> Float[np.ndarray, "_ nv nv"]:
    """M of every row [kg m^2, kg m or kg], rotors and armature included."""
    blocks = []
    with torch.no_grad():
        for start in range(0, len(dataset), ROWS_PER_BLOCK):
            q = torch.tensor(dataset.q[start : start + ROWS_PER_BLOCK])
            blocks.append(model.mass_matrix_at(model.loaded_robot.kinematics(q)).cpu().numpy())
    return np.concatenate(blocks)


def force_errors(predicted: Rows, target: Rows, mass: Matrices) -> Rows:
    """M (predicted - target): the joint forces [Nm or N] that the errors of the acceleration amount to."""
    return (mass @ (predicted - target)[..., None])[..., 0]


def _spread(a: Rows) -> Float[np.ndarray, " nv"]:
    """Standard deviations of the acceleration; NaN where rounding is all there is, as of a cart across its wheels."""
    spread = a.std(axis=0)
    return np.where(spread > CONSTANT * spread.max(initial=0.0), spread, np.nan)


def _against_measurements(
    posterior: Posterior, predicted: PredictedRows, test: Dataset, forces: Rows, mass: Matrices
) -> Table:
    a, mean, variance = test.a, predicted.mean, predicted.measurement_variance
    rmse = np.sqrt(np.square(mean - a).mean(axis=0))
    at_rest = force_errors(np.zeros_like(a), a, mass)
    acceleration = {
        "mae": np.abs(mean - a).mean(axis=0),
        "rmse": rmse,
        "nrmse": rmse / _spread(a),
        "nlpd": -np.asarray(norm.logpdf(a, mean, np.sqrt(variance))).mean(axis=0),
        **{f"coverage_{100 * at:.0f}": interval_coverage(mean, variance, a, at) for at in LEVELS},
        "known_physics_mae": np.abs(predicted.known_physics - a).mean(axis=0),
        "noise_std": posterior.noise_std.detach().cpu().numpy(),
    }
    if test.noise_std is not None:
        acceleration["noise_floor"] = test.noise_std * np.sqrt(2.0 / np.pi)
    return {
        ACCELERATION: {name: plain(values) for name, values in acceleration.items()},
        ALL_JOINTS: {"nlpd": [float(predicted.negative_log_density.mean())]},
        FORCE: {
            "mae": plain(np.abs(forces).mean(axis=0)),
            "rmse": plain(np.sqrt(np.square(forces).mean(axis=0))),
            "rmse_at_rest": plain(np.sqrt(np.square(at_rest).mean(axis=0))),
        },
        CONSTRAINT: {"mae": plain(predicted.residual.mean(axis=0)), "largest": plain(predicted.residual.max(axis=0))},
    }


def _against_truth(predicted: PredictedRows, test: Dataset) -> Table:
    table, truth = {}, test.truth
    if "a" in truth:
        a, mean = truth["a"], predicted.mean
        free = {"mae": np.abs(mean - a).mean(axis=0), "rmse": np.sqrt(np.square(mean - a).mean(axis=0))}
        free["coverage_95"] = interval_coverage(mean, predicted.variance, a)
        free["known_physics_mae"] = np.abs(predicted.known_physics - a).mean(axis=0)
        table[TRUE_ACCELERATION] = {name: plain(values) for name, values in free.items()}
        table[TRUE_FORCE] = {"mae": plain(np.abs(force_errors(mean, a, predicted.mass)).mean(axis=0))}
    if "Q_U" in truth and predicted.unknown_force is not None:
        assert predicted.carried_known_force is not None, "it comes with the force"
        carried = truth["Q_U"] + predicted.carried_known_force
        table |= _errors(UNKNOWN_FORCE, predicted.unknown_force, predicted.unknown_force_variance, carried)
    if "lambda" in truth:
        table |= _errors(CONTACT_FORCE, predicted.multiplier, predicted.multiplier_variance, truth["lambda"])
    return table


def _errors(quantity: str, mean: np.ndarray | None, variance: np.ndarray | None, truth: np.ndarray) -> Table:
    """Scores of one force; none of what the model lacks, or of another number of contacts."""
    if mean is None or variance is None or mean.shape != truth.shape or not truth.shape[1]:
        return {}
    size = float(np.sqrt(np.square(truth).mean()))
    wide = variance > (ROUNDING * size) ** 2
    covered = []
    for column, rows in enumerate(wide.T):
        own = mean[rows, column, None], variance[rows, column, None], truth[rows, column, None]
        covered.append(float(interval_coverage(*own)[0]) if rows.any() else None)
    scores: dict[str, list[float | None]] = {
        "mae": plain(np.abs(mean - truth).mean(axis=0)),
        "rmse": plain(np.sqrt(np.square(mean - truth).mean(axis=0))),
        "coverage_95": covered,
    }
    if size > 0.0:
        scores["relative_rmse"] = [float(np.sqrt(np.square(mean - truth).mean())) / size]
    return {quantity: scores}


def _components(posterior: Posterior, test: Dataset) -> Table:
    """Scores of every component of the unknown force whose truth is known.

    Not without an analytical mean, where the processes hold the known forces, too.
    """
    if posterior.is_black_box or posterior.carries_known_forces:
        return {}
    named = true_names([name for name, *_ in posterior.trained.unknown.named(posterior.model.robot)], test)
    if not named:
        return {}

    def forces(rows: slice) -> dict[tuple[str, str], Gaussian]:
        found = posterior.components(test.q[rows], test.v[rows], test.u[rows])
        joint = {(name, "Q_U"): found[name].joint_force for name in named}
        return joint | {(name, "force"): force for name in named if (force := found[name].point_force) is not None}

    blocks, table = in_blocks(posterior, test, forces), {}
    for name, kind in blocks[0]:
        truth = test.truth.get(f"{kind}.{named[name]}")
        if truth is not None:
            each = [block[name, kind] for block in blocks]
            mean = np.concatenate([force.mean.cpu().numpy() for force in each])
            variance = np.concatenate([force.variance.cpu().numpy() for force in each])
            table |= _errors(f"{name} at {'the joints' if kind == 'Q_U' else 'its point'}", mean, variance, truth)
    return table


def true_names(components: Sequence[str], dataset: Dataset) -> dict[str, str]:
    """Component -> what the truth of the Dataset calls it; without those that the truth does not hold alone."""
    pairs = [(name, kept) for name in components for kept in (TRUE_NAMES.get(name, name), name)]
    found = {name: kept for name, kept in pairs if {f"Q_U.{kept}", f"force.{kept}"} & set(dataset.truth)}
    claimed = list(found.values())
    return {name: kept for name, kept in found.items() if claimed.count(kept) == 1}


def _by_stretch(predicted: PredictedRows, test: Dataset, forces: Rows) -> dict[str, list[float | None]]:
    """By criterion: squared errors of accelerations over their variance, of forces, and densities in nats."""
    lasting = sum(float(np.ptp(test.time[test.episode == episode])) for episode in test.episodes)
    seconds = lasting / STRETCHES if lasting > 0.0 else 1.0
    spread = _spread(test.a)
    relative = (((predicted.mean - test.a) / spread) ** 2)[:, np.isfinite(spread)]
    blocks = [list(block) for block in time_blocks(test.time, test.episode, seconds)]
    found: dict[str, Any] = {"force": forces**2, "acceleration": relative, "density": predicted.negative_log_density}
    return {
        name: plain(np.array([values[block].mean() if values.size else np.nan for block in blocks]))
        for name, values in found.items()
    }
