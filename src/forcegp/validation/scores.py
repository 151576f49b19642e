"""Scores of one model on held-out rows, and of the motions that it predicts from held-out states."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from forcegp.data import Dataset, time_blocks
from forcegp.data.configurations import space_of
from forcegp.data.motion_records import EVEN_STEPS, RecordedMotions, recorded_motions
from forcegp.errors import InvalidInput
from forcegp.evaluation import metrics
from forcegp.evaluation.doubts import doubts
from forcegp.evaluation.predicted_rows import PredictedRows, predict_rows
from forcegp.model import Model
from forcegp.posterior import Posterior, observing
from forcegp.robots.manifold import ConfigurationSpace
from forcegp.summary import plain

Rows = Float[np.ndarray, "rows nv"]
Matrices = Float[np.ndarray, "rows nv nv"]

LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
"""Of the central intervals whose coverage is reported."""

STRETCHES = 20
"""Parts of the held-out time in which models are compared by themselves."""

ROWS_PER_BLOCK = 4096
CONSTANT = 1e-6  # of the largest standard deviation: less is rounding


def mass_matrices(dataset: Dataset, model: Model) -> Float[np.ndarray, "_ nv nv"]:
    """M of every row [kg m^2, kg m or kg], rotors and armature included."""
    blocks = []
    with torch.no_grad():
        for start in range(0, len(dataset), ROWS_PER_BLOCK):
            q = torch.tensor(dataset.q[start : start + ROWS_PER_BLOCK])
            blocks.append(model.mass_matrix_at(model.loaded_robot.kinematics(q)).cpu().numpy())
    return np.concatenate(blocks)


def normalized_error(predicted: Rows, target: Rows) -> Float[np.ndarray, " nv"]:
    """Root mean square error over the standard deviation of the target, per joint; NaN where the target is constant.

    1 is what predicting the mean of the held-out rows would give.
    """
    return metrics.root_mean_square_error(predicted, target) / _spread(target)


def _spread(a: Rows) -> Float[np.ndarray, " nv"]:
    """Standard deviations of the acceleration; NaN where rounding is all there is, as of a cart across its wheels."""
    spread = a.std(axis=0)
    return np.where(spread > CONSTANT * spread.max(initial=0.0), spread, np.nan)


def force_errors(predicted: Rows, target: Rows, mass: Matrices) -> Rows:
    """M (predicted - target): the joint forces [Nm or N] that the errors of the acceleration amount to."""
    return (mass @ (predicted - target)[..., None])[..., 0]


def acceleration_scores(
    posterior: Posterior, test: Dataset, mass: Matrices, outside: Bool[np.ndarray, " rows"] | None = None
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """All scores of the held-out rows, and what a reader has to know beside them (`evaluation.doubts`).

    Where the model has observers (`forcegp.posterior.observing`), they see the held-out rows before each one.
    `mass` is the same for every model (`mass_matrices`); rows `outside` of the training range are scored apart, too.

    Intervals and densities are those of a measurement: with the noise of the model, or of the Dataset where that is
    larger. What is not a number (a constant target) is None.
    """
    alone = posterior
    if test.time_ordered:
        posterior, test = observing(posterior, test, whole=True)
    predicted = predict_rows(posterior, test)
    a, variance = test.a, predicted.measurement_variance
    forces = force_errors(predicted.mean, a, mass)
    covered = [metrics.interval_coverage(predicted.mean, variance, a, level) for level in LEVELS]
    known = metrics.mean_absolute_error(predicted.known_physics, a)
    scores = {
        "rmse": plain(metrics.root_mean_square_error(predicted.mean, a)),
        "mae": plain(metrics.mean_absolute_error(predicted.mean, a)),
        "nrmse": plain(normalized_error(predicted.mean, a)),
        "force_rms": plain(np.sqrt(np.square(forces).mean(axis=0))),
        "force_mae": plain(np.abs(forces).mean(axis=0)),
        # a light joint under a noisy torque is predicted well by not moving at all: a score has to beat this
        "force_rms_at_rest": plain(np.sqrt(np.square(force_errors(np.zeros_like(a), a, mass)).mean(axis=0))),
        "nlpd": float(predicted.negative_log_density.mean()),
        "nlpd_per_joint": plain(metrics.marginal_negative_log_density(predicted.mean, variance, a)),
        "levels": list(LEVELS),
        "coverage": [plain(each) for each in covered],
        "stretches": _by_stretch(predicted, test, forces),
        "range": {} if outside is None else _apart(predicted, test, outside),
        "noise_std": plain(posterior.noise_std.detach().cpu().numpy()),
    }
    shared = {
        "mae_per_joint": scores["mae"],
        "known_physics_mae_per_joint": known,
        "coverage_95_per_joint": covered[LEVELS.index(0.95)],
    }
    return scores, (*doubts(posterior, test, shared), *(() if posterior is alone else (OBSERVED,)))


def _by_stretch(predicted: PredictedRows, test: Dataset, forces: Rows) -> dict[str, list[float | None] | float]:
    """The same in each of about `STRETCHES` stretches of time, over all joints, where lower is better.

    "nrmse" with the standard deviations of all held-out rows, "force_rms" and "nlpd"; "seconds" is their length.
    """
    lasting = sum(float(np.ptp(test.time[test.episode == episode])) for episode in test.episodes)
    seconds = lasting / STRETCHES if lasting > 0.0 else 1.0
    spread = _spread(test.a)
    relative = (((predicted.mean - test.a) / spread) ** 2)[:, np.isfinite(spread)]
    blocks = [list(block) for block in time_blocks(test.time, test.episode, seconds)]
    return {
        "seconds": seconds,
        "nrmse": plain(np.array([np.sqrt(relative[block].mean()) if relative.size else np.nan for block in blocks])),
        "force_rms": plain(np.array([np.sqrt((forces[block] ** 2).mean()) for block in blocks])),
        "nlpd": plain(np.array([predicted.negative_log_density[block].mean() for block in blocks])),
    }


def outside_range(train: Dataset, test: Dataset) -> Bool[np.ndarray, " rows"]:
    """Rows of `test` in which a joint's position or velocity lies beyond all of `train`.

    Of a base that moves, its height and how it leans count as positions (`Robot.posture`).
    """
    out = np.zeros(len(test), dtype=bool)
    for seen, here in ((_postures(train), _postures(test)), (train.v, test.v)):
        out |= ((here < seen.min(axis=0)) | (here > seen.max(axis=0))).any(axis=-1)
    return out


def _postures(dataset: Dataset) -> np.ndarray:
    if dataset.model is None:
        return dataset.q
    robot = dataset.model.robot
    return robot.posture(torch.tensor(dataset.q, device=robot.device)).cpu().numpy()


def _apart(predicted: PredictedRows, test: Dataset, outside: Bool[np.ndarray, " rows"]) -> dict[str, Any]:
    """Rows, normalised error and coverage over all joints, `inside` and `outside` of the training range."""
    spread, found = _spread(test.a), {}
    for name, rows in (("inside", ~outside), ("outside", outside)):
        if rows.any():
            mean, variance, a = predicted.mean[rows], predicted.measurement_variance[rows], test.a[rows]
            error = (metrics.root_mean_square_error(mean, a) / spread)[np.isfinite(spread)]
            covered = metrics.interval_coverage(mean, variance, a, 0.95)
            found[name] = {"rows": int(rows.sum()), "nrmse": float(error.mean()), "coverage_95": float(covered.mean())}
    return found


def over_joints(score: str, values: Sequence[float | None]) -> float | None:
    """One number for all joints: the mean, for scores of forces the root of the mean of squares.

    Joints of which nothing is known (one that never moves has no normalised error) do not count; None where none is.
    """
    known = [value for value in values if value is not None]
    if not known:
        return None
    return float(np.sqrt(np.square(known).mean())) if score.startswith("force") else float(np.mean(known))


HORIZONS = (0.1, 0.2, 0.5, 1.0)
STARTS = 10
OBSERVED = "wind, and the force that stays unexplained, were observed from the held-out rows before each."
GAP = 1.5
"""A pause of more than this many median steps is a gap, over which no motion goes."""


@dataclass(frozen=True, eq=False)
class HeldOutMotions:
    """The motions to predict, and the horizons [s] that they last for; `notes` report what is missing.

    `space` holds the positions, None for vectors; `stretches` the rows that each motion is part of, for observers.
    """

    motions: RecordedMotions | None
    horizons: tuple[float, ...]
    notes: tuple[str, ...] = field(default=())
    space: ConfigurationSpace | None = None
    stretches: tuple[tuple[Dataset, tuple[int, ...]], ...] = ()

    def of(self, posterior: Posterior) -> tuple[Posterior, RecordedMotions]:
        """The posterior, and the motions with what its observers have seen before each of them."""
        assert self.motions is not None, "there are motions"
        pairs = [observing(posterior, rows, whole=True) for rows, _ in self.stretches]
        if not pairs or pairs[0][0] is posterior:
            return posterior, self.motions
        seconds = self.horizons[-1]
        u = [recorded_motions(seen, at, seconds).u for (_, seen), (_, at) in zip(pairs, self.stretches, strict=True)]
        return pairs[0][0], replace(self.motions, u=np.concatenate(u))


def held_out_motions(
    recording: Dataset, held_out: Bool[np.ndarray, " rows"], horizons: Sequence[float] = HORIZONS, starts: int = STARTS
) -> HeldOutMotions:
    """`starts` motions in every held-out stretch without gaps that lasts as long as the longest horizon.

    Horizons that no stretch lasts for are left out with a note, and so is everything where time steps are uneven.
    Raises InvalidInput for horizons that are not positive and for no starts.
    """
    wanted = tuple(sorted(set(horizons)))
    if not wanted or not all(np.isfinite(h) and h > 0.0 for h in wanted):
        raise InvalidInput(f"horizons are {list(horizons)}; give one or more positive numbers of seconds.")
    if starts < 1:
        raise InvalidInput(f"the number of starts is {starts}; it must be at least 1.")
    if not recording.time_ordered:
        return HeldOutMotions(None, (), ("no motion was predicted: the rows are not in the order of time.",))
    stretches = _stretches(recording, held_out)
    longest = max((float(np.ptp(recording.time[rows])) for rows in stretches), default=0.0)
    step = _step(recording)
    possible = tuple(h for h in wanted if step <= h <= longest * (1.0 + EVEN_STEPS))
    notes = []
    if len(possible) < len(wanted):
        left_out = ", ".join(f"{h:g} s" for h in wanted if h not in possible)
        notes.append(f"not predicted: {left_out}; held-out stretches last {longest:.3g} s at most, steps {step:.3g} s.")
    if not possible:
        return HeldOutMotions(None, (), tuple(notes))
    found, parts = [], []
    for rows in stretches:
        if np.ptp(recording.time[rows]) < possible[-1] * (1.0 - EVEN_STEPS):
            continue
        try:
            found.append(recorded_motions(recording.rows(rows), starts, possible[-1]))
            parts.append((recording.rows(rows), found[-1].rows))
        except InvalidInput as error:
            notes.append(f"motions of one stretch were left out: {error}")
    if not found:
        return HeldOutMotions(None, (), tuple(dict.fromkeys(notes)))
    joined = {name: np.concatenate([getattr(each, name) for each in found]) for name in ("q", "v", "u")}
    rows = tuple(row for each in found for row in each.rows)
    motions = RecordedMotions(rows, found[0].dt, **joined)
    return HeldOutMotions(motions, possible, tuple(dict.fromkeys(notes)), space_of(recording), tuple(parts))


def motion_scores(posterior: Posterior, held_out: HeldOutMotions, integrator: str = "rk4") -> dict[str, Any] | None:
    """Errors of q at every horizon [s], as plain JSON values; None where there are no motions.

    `rms_per_joint` (horizons, nv) is the root mean square over the motions of |q - q_recorded|, of a base in its own
    axes, `rms` over joints as well, in rad or m; both over the motions that had not diverged by then (None where all
    had), and `diverged` (horizons,) counts the others. `squared` (horizons, motions) is the mean over joints of the
    squared error of each.
    """
    if held_out.motions is None:
        return None
    posterior, motions = held_out.of(posterior)
    rollout = posterior.rollout(
        motions.q[:, 0], motions.v[:, 0], motions.u, motions.dt, integrator=integrator, baumgarte=None
    )
    space = held_out.space or ConfigurationSpace(motions.q.shape[-1])
    squared = np.square(space.difference(torch.tensor(motions.q), rollout.q.cpu()).numpy())
    scores: dict[str, Any] = {"horizons": list(held_out.horizons), "motions": len(motions.q), "integrator": integrator}
    scores |= {"dt": motions.dt, "rms_per_joint": [], "rms": [], "diverged": [], "squared": []}
    for horizon in held_out.horizons:
        here = squared[:, round(horizon / motions.dt)]
        lasting = np.isfinite(here).all(axis=-1)
        per_joint = np.sqrt(here[lasting].mean(axis=0)) if lasting.any() else np.full(here.shape[-1], np.nan)
        scores["rms_per_joint"].append(plain(per_joint))
        scores["rms"] += plain(np.sqrt(np.square(per_joint).mean(keepdims=True)))
        scores["diverged"].append(int((~lasting).sum()))
        scores["squared"].append(plain(np.where(lasting, here.mean(axis=-1), np.nan)))
    return scores


def _step(recording: Dataset) -> float:
    pauses = np.diff(recording.time)[np.diff(recording.episode) == 0]
    return float(np.median(pauses)) if pauses.size else float("inf")


def _stretches(recording: Dataset, held_out: Bool[np.ndarray, " rows"]) -> list[np.ndarray]:
    """Numbers of held-out rows that follow each other in one episode without a gap."""
    rows = np.flatnonzero(held_out)
    apart = (np.diff(rows) > 1) | (np.diff(recording.episode[rows]) != 0)
    apart |= np.diff(recording.time[rows]) > GAP * _step(recording)
    return [part for part in np.split(rows, np.flatnonzero(apart) + 1) if len(part) > 1]
