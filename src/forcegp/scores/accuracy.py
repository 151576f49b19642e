"""One model against the rows of one log: a table by quantity and score, errors by stretch of time, and doubts."""

import statistics
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.special import ndtri
from scipy.stats import norm
from torch import Tensor
from torch.distributions import MultivariateNormal

from forcegp.data import Dataset, repeated_rows, thruster_columns, with_memory
from forcegp.data.views import in_blocks, tensors
from forcegp.doubts import Doubt, look
from forcegp.errors import NumericalError
from forcegp.evidence.recorded_rows import sensed_of
from forcegp.inference.memory import blas_threads
from forcegp.model import Model
from forcegp.posterior.posterior import Posterior
from forcegp.progress import tell
from forcegp.summary import listed, plain

Rows = Float[np.ndarray, "rows nv"]
Matrices = Float[np.ndarray, "rows nv nv"]
Table = dict[str, dict[str, list[float | None]]]
"""Quantity -> score -> one number per column (joint, axis or contact); None for what is not a number."""

ACCELERATION, TRUE_ACCELERATION, ALL_JOINTS = "acceleration", "true acceleration", "all joints"
FORCE, TRUE_FORCE, UNKNOWN_FORCE, TORQUE = "force", "true force", "unknown force", "torque"
CONTACT_FORCE, CONSTRAINT, AT_SENSOR = "contact force", "constraint", "force at"

LEVELS = (0.5, 0.95)  # of the central intervals whose coverage is scored, as `coverage_95`
STRETCHES = 20  # parts of the time in which models are compared by themselves
CONSTANT = 1e-6  # of the largest standard deviation: less is rounding
ROUNDING = 1e-9  # relative to the size of the truth: widths of intervals below it are none


def predict_rows(posterior: Posterior, dataset: Dataset) -> dict[str, np.ndarray]:
    """What a model predicts for every row, and the mechanics there; the constraint is that of the Dataset's own system.

    `mean` and `variance` of the acceleration without noise, `measurement_variance` with that of the model, or of the
    Dataset where that is larger; `negative_log_density` of the measured rows [nats]; `known_physics`, the acceleration
    of the known forces alone; `residual` |A a - b| of the mean; the mass matrix `mass`. Of models with forces Q_U
    (`unknown_force`), what of it is known (`carried_force`, Q_K without an analytical mean, else 0), and lambda
    (`multiplier`). `sensed` are forces at frames with a force sensor, x, y and z of each, given the accelerations that
    were measured. Variances of forces are called `unknown_force_variance` and so on.
    """
    dataset = with_memory(dataset, posterior.model)
    device, held, done = posterior.model.robot.device, list(posterior.model.held_inputs), 0
    names: list[str] = []
    frames = sensed_frames(posterior, dataset)

    def predicted(q: Tensor, v: Tensor, u: Tensor, a: Tensor) -> tuple[Tensor, ...]:
        nonlocal done, names
        prediction, dynamics = posterior.predict(q, v, u), posterior.dynamics(q, v, u)
        own, covariance, mean = dataset.model.to(device).dynamics(q, v, u), prediction.covariance, prediction.mean
        assert covariance is not None, "predict computes the covariance unless asked not to"
        noise = prediction.noise_covariance
        if dataset.noise_std is not None:  # rows may be noisier than those learned from
            missing = torch.tensor(np.square(dataset.noise_std), device=device) - noise.diagonal(dim1=-2, dim2=-1)
            noise = noise + torch.diag_embed(missing.clamp_min(0.0))
        alone = u.clone()
        alone[:, held] = 0.0  # what an observer reports is no part of the known physics
        known = (posterior.dynamics(q, v, alone) if held else dynamics).acceleration_map().offset
        found = {
            "mean": mean,
            "variance": prediction.variance,
            "measurement_variance": (covariance + noise).diagonal(dim1=-2, dim2=-1),
            "negative_log_density": negative_log_density(mean, covariance + noise, a),
            "known_physics": known,
            "residual": ((own.A @ mean[..., None])[..., 0] - own.b).abs(),
            "mass": dynamics.M,
        }
        for name in ("unknown_force", "multiplier"):
            force = getattr(prediction, name)
            found |= {} if force is None else {name: force.mean, f"{name}_variance": force.variance}
        if prediction.unknown_force is not None:
            found["carried_force"] = own.Q_K if posterior.carries_known_forces else torch.zeros_like(own.Q_K)
        if frames:
            given = posterior.predict(q, v, u, a=a)
            forces = [given.force_at(frame) for frame in frames]
            found |= {"sensed": torch.cat([x.mean for x in forces], -1)}
            found |= {"sensed_variance": torch.cat([x.variance for x in forces], -1)}
        names, done = list(found), done + len(q)
        tell(done, len(dataset))
        return tuple(found.values())

    with blas_threads(posterior.training.q.numel()):
        arrays: Any = in_blocks(dataset, predicted, device)
    return dict(zip(names, arrays, strict=True))


def negative_log_density(
    mean: Float[Tensor, "rows k"], covariance: Float[Tensor, "rows k k"], target: Float[Tensor, "rows k"]
) -> Float[Tensor, " rows"]:
    """-log N(target; mean, covariance) of every row, all columns jointly, in nats.

    Its mean over test rows is the negative log predictive density (Rasmussen & Williams 2006, eq. A.23). Raises
    NumericalError, naming the row, for a covariance that is not positive definite: that of a measurement always is.
    """
    lower, failed = torch.linalg.cholesky_ex(covariance)
    if bool(failed.any()):
        raise NumericalError(
            f"the predicted covariance of row {int(failed.argmax())} is not positive definite, so it has no density; "
            "add the covariance of the measurement noise."
        )
    return -MultivariateNormal(mean, scale_tril=lower, validate_args=False).log_prob(target)


def row_scores(
    posterior: Posterior, test: Dataset, mass: Matrices | None = None, whole: Dataset | None = None
) -> tuple[Table, list[float | None]]:
    """The table, and mean squared errors of torques, else forces, in about `STRETCHES` stretches, over all joints.

    Quantities are those of `_pairs`, each with `mae`, `rmse`, `relative_rmse` (over the size of what was there, all
    columns together) and `largest` error, and with `coverage_95` and `coverage_50` of intervals. That of a measurement
    is with the noise of the model, or of the Dataset where that is larger. Accelerations also have the mean negative
    log density `nlpd` [nats], `known_physics_mae` of the known forces alone, and as measured `nrmse` over their
    standard deviation, `noise_std` of the model, and `noise_floor`, the `mae` of a perfect prediction. All joints
    together have one `nlpd`. `whole` is the recording to whose deviations errors are related, so that a slow stretch is
    no fault; None takes `test`. `mass` (rows of kg m^2, kg m or kg) turns errors of accelerations into those of forces;
    it is the same for every model that is compared, None takes the model's own.
    """
    rows = predict_rows(posterior, test)
    mass = rows["mass"] if mass is None else mass
    pairs = _pairs(rows, test, mass, sensed_frames(posterior, test))
    table = {name: metrics(*each) for name, each in pairs.items() if each[0].shape == each[2].shape and each[2].size}
    table[ALL_JOINTS] = {"nlpd": [float(rows["negative_log_density"].mean())]}
    measured = table[ACCELERATION]
    whole = test if whole is None else whole
    measured["nrmse"] = plain(np.array(measured["rmse"], dtype=float) / _spread(whole.a))
    if test.model.actuation.names and not thruster_columns(test.model) and not posterior.is_black_box:
        # of the torques that the model needs for the measured motion; a share of 1 is no better than their mean
        mass = rows["mass"]  # its own: u is there to compare with
        rms = np.sqrt(np.square(force_errors(rows["mean"], test.a, mass)).mean(axis=0))
        delivered = whole.model.state(*tensors(whole, whole.model.robot.device)[:3]).delivered.cpu().numpy()
        table[TORQUE] = {"rmse": plain(rms), "share": plain(rms / _spread(delivered))}
    density = norm.logpdf(test.a, rows["mean"], np.sqrt(rows["measurement_variance"]))
    measured["nlpd"] = plain(-np.asarray(density).mean(axis=0))
    measured["noise_std"] = plain(posterior.noise_std.detach().cpu().numpy())
    if test.noise_std is not None:
        measured["noise_floor"] = plain(test.noise_std * np.sqrt(2.0 / np.pi))
    for name in {ACCELERATION, TRUE_ACCELERATION} & set(table):
        table[name]["known_physics_mae"] = plain(np.abs(rows["known_physics"] - pairs[name][2]).mean(axis=0))
    return table, by_stretch(np.square(force_errors(rows["mean"], test.a, mass)).mean(axis=1), test)


Predicted = Mapping[str, np.ndarray]
Pair = tuple[np.ndarray, np.ndarray | None, np.ndarray]
"""Mean and variance of a prediction, and what was there; all (rows, columns)."""


def sensed_frames(posterior: Posterior, dataset: Dataset) -> list[str]:
    """Frames of contacts at which a force was measured, of a model that predicts forces."""
    own = {contact.frame for contact in posterior.model.contacts}
    return [] if posterior.is_black_box else [name for name in sensed_of(dataset) if name in own]


def _pairs(rows: Predicted, test: Dataset, mass: Matrices, frames: Sequence[str]) -> dict[str, Pair]:
    """What is compared: measured accelerations, what their errors are as joint forces, A a with b; and known truth.

    And forces at each of the frames by axis, which sensors measured.
    """
    truth, mean = test.truth, rows["mean"]
    zero, still = np.zeros_like(mean), np.zeros_like(rows["residual"])
    pairs: dict[str, Pair] = {
        ACCELERATION: (mean, rows["measurement_variance"], test.a),
        FORCE: (force_errors(mean, test.a, mass), None, zero),
        CONSTRAINT: (rows["residual"], None, still),
    }
    if "a" in truth:
        pairs[TRUE_ACCELERATION] = mean, rows["variance"], truth["a"]
        pairs[TRUE_FORCE] = force_errors(mean, truth["a"], rows["mass"]), None, zero
    if "Q_U" in truth and "unknown_force" in rows:
        there = truth["Q_U"] + rows["carried_force"]
        pairs[UNKNOWN_FORCE] = rows["unknown_force"], rows["unknown_force_variance"], there
    if "lambda" in truth and "multiplier" in rows:
        pairs[CONTACT_FORCE] = rows["multiplier"], rows["multiplier_variance"], truth["lambda"]
    for number, frame in enumerate(frames):
        for k, axis in enumerate("xyz", 3 * number):
            own = rows["sensed"][:, [k]], rows["sensed_variance"][:, [k]], sensed_of(test)[frame][:, [k % 3]]
            if own[1].max() > CONSTANT**2 * np.square(own[2]).mean():  # no motion pushes along the others
                pairs[f"{AT_SENSOR} {frame}, {axis}"] = own
    return pairs


def metrics(mean: np.ndarray, variance: np.ndarray | None, truth: np.ndarray) -> dict[str, list[float | None]]:
    """Errors by column, and the coverage of entries whose interval has a width."""
    error, size = np.abs(mean - truth), float(np.sqrt(np.square(truth).mean()))
    means = {"mae": plain(error.mean(axis=0)), "rmse": plain(np.sqrt(np.square(error).mean(axis=0)))}
    found = {**means, "largest": plain(error.max(axis=0))}
    if size > 0.0:
        found["relative_rmse"] = [float(np.sqrt(np.square(error).mean())) / size]
    if variance is not None:
        wide = np.where(variance > (ROUNDING * size) ** 2, variance, np.nan)
        for level in LEVELS:
            inside = np.where(np.isnan(wide), np.nan, error <= ndtri(0.5 + 0.5 * level) * np.sqrt(wide))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # of columns without any
                found[f"coverage_{100 * level:.0f}"] = plain(np.nanmean(inside, axis=0))
    return found


def over_columns(quantity: str, score: str, values: Sequence[float | None]) -> float | None:
    """One number for all joints that have one: the mean, of `rmse` of forces and motions that of squares."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    squares = score.startswith("rmse") and not quantity.endswith(ACCELERATION)
    return float(np.sqrt(np.square(known).mean()) if squares else np.mean(known))


def median_and_range(values: Iterable[float | None]) -> dict[str, Any] | None:
    """Median and range over seeds, with the values; None where there are none (or not for every seed)."""
    given = list(values)
    if not given or any(value is None for value in given):
        return None
    numbers = [float(value) for value in given if value is not None]
    return {"median": statistics.median(numbers), "min": min(numbers), "max": max(numbers), "values": numbers}


def mass_matrices(dataset: Dataset, model: Model) -> Float[np.ndarray, "_ nv nv"]:
    """M of every row [kg m^2, kg m or kg], rotors and armature included."""
    robot = model.loaded_robot
    return in_blocks(dataset, lambda q, *_: (model.mass_matrix_at(robot.kinematics(q)),), robot.device)[0]


def force_errors(predicted: Rows, target: Rows, mass: Matrices) -> Rows:
    """M (predicted - target): the joint forces [Nm or N] that the errors of the acceleration amount to."""
    return (mass @ (predicted - target)[..., None])[..., 0]


def _spread(a: Rows) -> Float[np.ndarray, " nv"]:
    """Standard deviations of the acceleration; NaN where rounding is all there is, as of a cart across its wheels."""
    spread = a.std(axis=0)
    return np.where(spread > CONSTANT * spread.max(initial=0.0), spread, np.nan)


def by_stretch(values: Float[np.ndarray, " rows"], test: Dataset) -> list[float | None]:
    """Means in stretches of equal time, counted from the first row of every episode."""
    since, lasting = test.time.copy(), 0.0
    for episode in test.episodes:
        own = test.episode == episode
        since[own] -= since[own].min()
        lasting += float(since[own].max())
    stretch = np.floor(since / (lasting / STRETCHES if lasting > 0.0 else 1.0))
    _, label = np.unique(np.stack([test.episode, stretch]), axis=1, return_inverse=True)
    return plain(np.bincount(label.ravel(), values) / np.bincount(label.ravel()))


WORSE = 1.01  # error of the model over that of its known forces alone, from which it is pointed out
WORSE_JOINT, LEAST_WORSE = 1.2, 0.1
"""The same of one joint, and by how much its error must be larger, in standard deviations of the noise."""

FEWEST_INSIDE = 0.9  # least coverage of 95 % intervals, over all joints, about which nothing is said
MISSED, CHANCE = 0.15, 4.0
"""How much less than 95 % intervals of one joint may hold: this share, or if more, so many deviations by chance."""

MARGIN, POSTURE = 0.25, 0.1
"""How far beyond the training range of a joint a value may lie: a fraction of that range, and of the widest range of
all joints (a joint that is held in its posture moves little, and a little more of it is nothing new).
"""

MOST_OUTSIDE = 0.01  # share of the rows that may lie further outside


def unfinished_search(posterior: Posterior) -> Iterator[Doubt]:
    """A sentence where the search for the parameters did not converge."""
    if "optimizer" in posterior.settings and not posterior.result.converged:
        yield look(
            about="search",
            what=f"the search for the parameters of this model did not converge ({posterior.result.status}); its "
            "mean and its intervals may be far from those at the optimum",
        )


def rows_outside(posterior: Posterior, dataset: Dataset) -> Iterator[Doubt]:
    """A sentence where many rows lie outside of the range of q and v that the model was trained in."""
    found, outside = [], np.zeros(len(dataset), dtype=bool)
    for quantity in ("q", "v"):
        trained, given = getattr(posterior.training, quantity).cpu().numpy(), getattr(dataset, quantity)
        low, high = trained.min(axis=0), trained.max(axis=0)
        beyond = np.maximum(low - given, given - high) - (MARGIN * (high - low) + POSTURE * float((high - low).max()))
        outside |= (beyond > 0.0).any(axis=1)
        for k, (name, share) in enumerate(zip(posterior.joint_names, (beyond > 0.0).mean(axis=0), strict=False)):
            here, there = (f"{x.min():.3g} to {x.max():.3g}" for x in (given[:, k], trained[:, k]))
            found.append((share, f"{quantity} of {name} is {here} here and was {there} in training"))
    if outside.mean() > MOST_OUTSIDE:
        yield look(
            about="rows outside",
            what=f"{outside.mean():.0%} of the rows lie outside of the range that the model was trained in (worst: "
            f"{max(found)[1]}); errors may be larger there, and intervals rest on the prior",
        )


def poor_scores(posterior: Posterior, dataset: Dataset, table: Table) -> Iterator[Doubt]:
    """Worse than the known forces alone, and intervals that miss: on average, or at joints, which are named."""
    names, noise = np.array(posterior.joint_names), posterior.noise_std.detach().cpu().numpy()
    # against the truth where it is known, for noise hides the difference
    quantity, what = (TRUE_ACCELERATION, "noise-free MAE") if TRUE_ACCELERATION in table else (ACCELERATION, "MAE")
    mine, alone = (np.array(table[quantity][score], dtype=float) for score in ("mae", "known_physics_mae"))
    worse = mine > np.maximum(WORSE_JOINT * alone, alone + LEAST_WORSE * noise)
    ranked = sorted(np.flatnonzero(worse), key=lambda joint: alone[joint] / mine[joint])
    places = [f"{names[joint]} {mine[joint]:.3g} against {alone[joint]:.3g}" for joint in ranked]
    if places or mine.mean() > WORSE * alone.mean():
        where = f" at {len(places)} of {len(names)} joints, {listed(places)}" if places else ""
        yield look(
            about="error",
            what=f"the model is worse here than its known forces alone{where} ({what} {mine.mean():.3g} against "
            f"{alone.mean():.3g} on average): do not use it for motions like these",
        )
    least = 0.95 - max(MISSED, CHANCE * (0.95 * 0.05 / len(dataset)) ** 0.5)
    for quantity, what in ((ACCELERATION, "measurements"), (TRUE_ACCELERATION, "true accelerations")):
        inside = np.array(table.get(quantity, {}).get("coverage_95", [1.0]), dtype=float)
        if not (inside.mean() < FEWEST_INSIDE or inside.min() < least):
            continue
        places = [f"{names[joint]} {inside[joint]:.0%}" for joint in np.argsort(inside) if inside[joint] < least]
        hidden = inside.mean() >= FEWEST_INSIDE
        of = f"{', but fewer at some joints' if hidden else ''} ({listed(places)})" if places else ""
        there = " at these" if hidden else ""
        yield look(
            about="coverage",
            what=f"the 95 % intervals hold {inside.mean():.0%} of the {what}{of}: the model is overconfident{there}; "
            "a force is missing, the noise is larger than stated, or these motions are new to it",
        )


def overlaps(posterior: Posterior, dataset: Dataset) -> Iterator[Doubt]:
    """Rows that training and test share, and contacts that differ."""
    repeated = repeated_rows(tuple(getattr(posterior.training, name).cpu().numpy() for name in "qvu"), dataset)
    if repeated.size:
        yield look(
            about="equal rows",
            what=f"{repeated.size} of {len(dataset)} test rows have the very (q, v, u) of training rows (the first: "
            f"row {repeated[0]}); where they are the same rows, these scores flatter the model: test on another one.",
        )
    own, model = dataset.model, posterior.model
    differ = (own.contacts, own.baumgarte) != (model.contacts, model.baumgarte)
    if differ and not posterior.is_black_box:  # which has no contacts, and can be carried nowhere
        yield look(
            about="contacts",
            what="the contacts of the model are not those of the data, on which the constraint error is measured; "
            "predict under them with `posterior.with_model(dataset.model)`",
        )
