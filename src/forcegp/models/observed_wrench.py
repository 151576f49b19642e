"""A slow force that no feature explains, such as wind: observed from the past rows of a recording, then known."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from forcegp.data import Dataset
from forcegp.data.filtering import episodes_in_order
from forcegp.errors import InvalidInput
from forcegp.mechanics import ObservedWrench
from forcegp.models.protocol import ROWS_PER_BLOCK, AnyPosterior, Posterior
from forcegp.priors import AerodynamicForce, ForcePrior

USUAL, TRIED = 0.1, (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # s
FEWEST_ROWS, TINY = 100, 1e-300
NAMES = tuple(f"observed_{what}_{axis}" for what in ("force", "torque") for axis in "xyz")


def observing(
    posterior: AnyPosterior, dataset: Dataset, *, seconds: float | None = None, frame: str | None = None
) -> tuple[AnyPosterior, Dataset]:
    """The posterior and the recording with an `ObservedWrench` on link `frame`, in six more columns of u.

    Row k holds the mean of the wrench that the posterior's mean leaves unexplained, over the rows before k of its
    episode, with weights that fall by e in `seconds`: what a first-order disturbance observer reports in flight (Chen
    et al., "Disturbance-observer-based control and related methods", IEEE TIE 2016). No row sees itself or
    what follows, and rows with a past shorter than that time are left out. By default the prior's `AerodynamicForce`
    gives frame and time, or the fit chose the time (`with_observer`); without one, or where its time is 0, both come
    back as they are.

    Raises InvalidInput for a time that is not positive, for a model that cannot carry its forces to another system, and
    for a recording whose rows are not in order of time.
    """
    prior: ForcePrior | None = getattr(posterior.model, "prior", None)
    own = next((term for term in prior.summands() if isinstance(term, AerodynamicForce)), None) if prior else None
    if seconds is None:
        chosen = posterior.settings.get("observe_seconds", USUAL)
        seconds = 0.0 if own is None else float(chosen if own.observe is None else own.observe)
        if seconds == 0.0 or ObservedWrench in map(type, posterior.system.known_forces):
            return posterior, dataset
    if not 0.0 < seconds < 1e6:
        raise InvalidInput(f"seconds is {seconds!r}; give the time in s that an observer looks back.")
    frame = frame or (own or AerodynamicForce()).link(posterior.system.robot)
    unexplained, effect = _unexplained(posterior, dataset, frame)
    observed = _observed(unexplained, effect, dataset, seconds)
    system = replace(posterior.system, known_forces=(*posterior.system.known_forces, ObservedWrench(frame, NAMES)))
    truth = {name: values for name, values in dataset.truth.items() if not name.startswith("Q_U")}
    seen = replace(dataset, u=np.concatenate([dataset.u, observed], axis=1), system=system, truth=truth)
    first = {number: rows.time[0] for number, rows, _ in episodes_in_order(dataset)}
    age = dataset.time - np.array([first[number] for number in dataset.episode])
    return posterior.with_system(system), seen.rows(np.flatnonzero(age >= seconds))


def with_observer(posterior: AnyPosterior, dataset: Dataset) -> AnyPosterior:
    """The posterior with the time in `settings` at which an observer predicts the rows of this recording best.

    Only where the prior leaves it open (`AerodynamicForce(observe=None)`) and rows are in order of time.
    """
    prior: ForcePrior = posterior.model.prior
    open_ones = [term for term in prior.summands() if isinstance(term, AerodynamicForce) and term.observe is None]
    if not open_ones or not dataset.time_ordered or len(dataset) < FEWEST_ROWS:
        return posterior
    unexplained, effect = _unexplained(posterior, dataset, open_ones[0].link(posterior.system.robot))

    def error(seconds: float) -> float:
        left = unexplained - np.einsum("nij,nj->ni", effect, _observed(unexplained, effect, dataset, seconds))
        return float(np.log(np.square(left).mean(0) + TINY).sum())

    return posterior.with_settings(observe_seconds=min(TRIED, key=error))


def _unexplained(
    posterior: Posterior, dataset: Dataset, frame: str
) -> tuple[Float[np.ndarray, "rows nv"], Float[np.ndarray, "rows nv 6"]]:
    """Accelerations less their predicted mean, and how a wrench of the world on the link changes them."""
    device, parts = posterior.system.robot.device, []
    for start in range(0, len(dataset), ROWS_PER_BLOCK):
        block = slice(start, start + ROWS_PER_BLOCK)
        q, v, u, a = (torch.tensor(x[block], device=device) for x in (dataset.q, dataset.v, dataset.u, dataset.a))
        with torch.no_grad():
            dynamics = posterior.dynamics(q, v, u)
            effect = dynamics.H @ dynamics.state.kinematics.frame_jacobian(frame).mT
            parts.append((a - posterior.predict(q, v, u, covariance=False).mean, effect))
    unexplained, effects = (torch.cat(part).cpu().numpy() for part in zip(*parts, strict=True))
    return unexplained, effects


def _observed(
    unexplained: Float[np.ndarray, "rows nv"], effect: Float[np.ndarray, "rows nv 6"], dataset: Dataset, seconds: float
) -> Float[np.ndarray, "rows 6"]:
    """The wrench that the rows before each show; none at the first of an episode."""
    wrench = np.einsum("nij,nj->ni", np.linalg.pinv(effect, rcond=1e-9), unexplained)
    observed = np.zeros_like(wrench)
    for number, rows, _ in episodes_in_order(dataset):
        own = np.flatnonzero(dataset.episode == number)
        observed[own] = _past_mean(wrench[own], rows.time, seconds)
    return observed


def _past_mean(values: np.ndarray, time: np.ndarray, seconds: float) -> np.ndarray:
    """Means of the rows before each, with weights exp(-age / seconds); zero for the first."""
    means, total, weight = np.zeros_like(values), np.zeros(values.shape[1]), 0.0
    keep = np.exp(-np.diff(time) / seconds)
    for row in range(1, len(values)):
        total, weight = keep[row - 1] * (total + values[row - 1]), keep[row - 1] * (weight + 1.0)
        means[row] = total / weight
    return means
