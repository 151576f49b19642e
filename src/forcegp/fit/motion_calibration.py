"""Calibration of the intervals of motions on stretches of training time that are left out in turn."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch

from forcegp.data import Dataset, farthest_rows, with_memory
from forcegp.data.views import RecordedMotions, decided, recorded_motions, require_order_of_time, stretches_without_gap
from forcegp.errors import InvalidInput, require_type
from forcegp.evidence.likelihood import TrainingData
from forcegp.fit.motion_fit import refine_on_motions
from forcegp.forces import has_few_inputs
from forcegp.forces.joint_laws import DryFriction, Viscous
from forcegp.posterior import Posterior
from forcegp.posterior.drift import scaled
from forcegp.posterior.fitted import DEVIATIONS, HORIZONS, MotionIntervals
from forcegp.posterior.observed_wrench import in_own_air, observing, require_unobserved
from forcegp.posterior.rollout import predicted
from forcegp.progress import part

FOLDS = 4
SAMPLES, STARTS = (16, 8), (4, 2)
"""Of functions, and motions that begin within one longest horizon: of few inputs, and of many, 50 times as slow."""
STEP = 0.005  # s, the longest; of several rows where the recording has shorter ones
LEVEL = 0.95


def calibrated(
    posterior: Posterior, dataset: Dataset, horizons: Sequence[float] | None = None, *, integrator: str = "rk4"
) -> Posterior:
    """The same model with intervals of motions that hold: of records left out in turn, or of stretches of the only one.

    Each is predicted by the model made again from the other rows at the same hyper-parameters. Widths from one record
    are wider by what another level of dry friction would change. `rollout(...).interval()` uses them.

    dataset: the recording that the model learned from, in equal steps of time.
    horizons: lengths of the motions in s, at which widths are found; None: .1, .25, .5 and 1 s, if stretches without a
        gap last so long. Beyond, widths go on as they grew.
    integrator: of these motions.

    Raises InvalidInput for models without physics, and where fewer than two stretches last for the longest horizon.
    """
    require_type("posterior", posterior, Posterior, ", as in calibrated(posterior, log)")
    require_type("dataset", dataset, Dataset)
    require_unobserved(posterior, "intervals of motions")
    require_order_of_time(dataset)
    dataset = decided(with_memory(dataset, posterior.model))
    wanted = sorted(set(HORIZONS if horizons is None else horizons))
    if not wanted or not all(math.isfinite(h) and h > 0.0 for h in wanted):
        raise InvalidInput(f"horizons are {wanted}; give one or more positive numbers of seconds.")
    while len(parts := _folds(dataset, wanted[-1])) < 2 and horizons is None and len(wanted) > 1:
        wanted = wanted[:-1]
    if len(parts) < 2:
        seen = f"intervals need two stretches of {wanted[-1]:g} s at least, of which one is left out in turn"
        raise InvalidInput(f"{seen}; give shorter horizons, or a longer recording.")
    errors, spreads, shifts, kept, inputs = [], [], [], tuple(wanted), posterior.model.inputs
    slow = bool(posterior.latent_names) and not has_few_inputs(posterior.trained.unknown, posterior.model.robot)
    drift = posterior.settings.get("drift") if _records(dataset, wanted[-1]) == 1 else None
    for other, motions in _left_out(posterior, dataset, parts, wanted[-1], STARTS[slow]):
        kept = tuple(h for h in wanted if h >= motions.dt)
        start = motions.q[:, 0], motions.v[:, 0], motions.u, motions.dt
        rollout = predicted(other, *start, integrator, samples=SAMPLES[slow] * bool(other.latent_names))
        at = [min(round(h / motions.dt), motions.u.shape[1]) for h in kept]
        inputs, sampled = other.model.inputs, rollout.samples is not None
        true_q, true_v = (torch.tensor(x[:, at], device=rollout.q.device) for x in (motions.q, motions.v))
        away = rollout.space.difference(rollout.q[:, at], true_q), true_v - rollout.v[:, at]
        error = [each.abs().cpu().numpy() for each in away]
        stds = (rollout.std("q"), rollout.std("v")) if sampled else ()
        spread = [std[:, at].cpu().numpy() for std in stds] or [np.zeros_like(each) for each in error]
        if drift is not None:  # as if all joints warm up together
            for kind in (DryFriction, Viscous):
                louder = replace(other, target=scaled(other.model, 1.0 + torch.as_tensor(drift["between"]), kind))
                moved = louder.rollout(*start, integrator=rollout.integrator)
                shifts.append(torch.stack([moved.q - rollout.q, moved.v - rollout.v], dim=2)[:, at].cpu().numpy())
                del louder, moved
        errors.append(np.stack(error, axis=2))
        spreads.append(np.stack(spread, axis=2))
        del other, rollout
    error, spread = np.concatenate(errors), np.concatenate(spreads)  # (motions, H, 2, nv)
    lasting = np.isfinite(error + spread).all(axis=(1, 2, 3))
    if not lasting.any():
        raise InvalidInput(f"no motion of {wanted[-1]:g} s could be predicted to its end; give shorter horizons.")
    error, spread = error[lasting], spread[lasting]
    rms = np.sqrt(np.square(error).mean(0)).clip(np.finfo(float).tiny)
    level = min(1.0, LEVEL * (1.0 + 1.0 / len(error)))
    scores = [error / np.sqrt(np.square(s) + np.square(rms)) for s in (spread, np.zeros_like(spread))]
    factors = np.stack([np.quantile(each, level, axis=0) / DEVIATIONS for each in scores])
    pairs = [np.concatenate(shifts[kind::2]) for kind in (0, 1)] if shifts else []
    shift = np.sqrt(np.nanmean(np.square(pairs), axis=1)) if shifts else ()
    intervals = MotionIntervals(np.array(kept), rms, factors, inputs, shift)
    return posterior.with_settings(motion_intervals=intervals.to_dict())


def _left_out(
    posterior: Posterior, dataset: Dataset, parts: Sequence[np.ndarray], seconds: float, starts: int
) -> Iterator[tuple[Posterior, RecordedMotions]]:
    """Models without each part of the rows, and motions in it; in one where no row changes a model, which is faster."""
    found = list[tuple[Posterior, RecordedMotions]]()
    for number, inside in enumerate(parts):
        with part(number, len(parts)):
            other, rows = observing(_without(posterior, dataset.rows(~inside)), dataset.rows(inside))
        found.append((other, _motions(rows, seconds, starts)))
        if posterior.latent_names or posterior.settings.get("motions"):
            yield found.pop()
            del other  # of which two would need twice the memory
    alike = len({(round(x.dt, 9), x.u.shape[1]) for _, x in found}) == 1
    yield from [(found[0][0], RecordedMotions.joined([x for _, x in found]))] if alike else found


def _records(dataset: Dataset, seconds: float) -> int:  # episodes that last so long
    return sum(_lasts(dataset, dataset.episode == episode, seconds) for episode in dataset.episodes)


def _folds(dataset: Dataset, seconds: float) -> list[np.ndarray]:
    """Rows that are left out in turn: episodes, where several last so long, else quarters of the only one."""
    numbers, long, several = np.zeros(len(dataset), dtype=int), 0, _records(dataset, seconds) > 1
    for episode in dataset.episodes:
        rows = np.flatnonzero(dataset.episode == episode)
        lasting = float(np.ptp(dataset.time[rows]))
        if lasting >= FOLDS * seconds and not several:
            numbers[rows] = np.minimum((np.arange(len(rows)) * FOLDS) // len(rows), FOLDS - 1)
        else:
            numbers[rows], long = long % FOLDS, long + (lasting >= seconds)
    return [part for part in [numbers == fold for fold in range(FOLDS)] if _lasts(dataset, part, seconds)]


def _lasts(dataset: Dataset, part: np.ndarray, seconds: float) -> bool:
    return any(np.ptp(dataset.time[rows]) >= seconds for rows in stretches_without_gap(dataset, part))


def _motions(part: Dataset, seconds: float, starts: int) -> RecordedMotions:
    """Motions of that length all over the rows, so many in the time of one."""
    count = max(1, int(starts * sum(np.ptp(part.time[part.episode == e]) for e in part.episodes) / seconds))
    found = recorded_motions(part, count, seconds)
    stride = max(1, int(STEP / found.dt))
    steps = found.u.shape[1] // stride
    u = found.u[:, : steps * stride].reshape(len(found.u), steps, stride, -1).mean(axis=2)
    ends = slice(0, steps * stride + 1, stride)
    return RecordedMotions(found.rows, stride * found.dt, found.q[:, ends], found.v[:, ends], u)


def _without(posterior: Posterior, rest: Dataset) -> Posterior:
    """The model from the other rows: as many of them, at the same hyper-parameters; refined on motions if it was."""
    if (refined := posterior.settings.get("motions")) is not None:
        return refine_on_motions(posterior, rest, refined["seconds"], refined["bodies"])
    own, rest = posterior.training, in_own_air(posterior, rest)
    rows = farthest_rows(rest, len(own)) if len(own) < len(rest) else rest
    given = replace(TrainingData.of(rows, own.q.device, own.sensed), reference=own.reference or own)
    how = posterior.hyperparameters, posterior.result, posterior.settings, posterior.engine, None, posterior.latent
    return replace(posterior.conditioned(posterior.trained, given, *how), target=posterior.target)
