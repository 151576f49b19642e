"""A slow force that no feature explains, such as wind: observed from the past rows of a recording, then known."""

from dataclasses import replace

import numpy as np
import torch

from forcegp.data import Dataset
from forcegp.data.filtering import episodes_in_order
from forcegp.errors import InvalidInput
from forcegp.mechanics import ObservedWrench
from forcegp.models.protocol import AnyPosterior
from forcegp.priors import AerodynamicForce, ForcePrior

USUAL, TRIED = 0.1, (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # s
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
    seeing, seen = _observed(posterior, dataset, seconds, frame)
    first = {number: rows.time[0] for number, rows, _ in episodes_in_order(dataset)}
    begun = np.array([first[number] for number in dataset.episode])
    return seeing, seen.rows(np.flatnonzero(dataset.time - begun >= seconds))


def _observed(posterior: AnyPosterior, dataset: Dataset, seconds: float, frame: str) -> tuple[AnyPosterior, Dataset]:
    """Both with all rows; the first of an episode observes nothing."""
    robot = posterior.system.robot
    q, v, u = (torch.tensor(x, device=robot.device) for x in (dataset.q, dataset.v, dataset.u))
    with torch.no_grad():
        dynamics = posterior.dynamics(q, v, u)
        unexplained = torch.tensor(dataset.a, device=robot.device) - posterior.predict(q, v, u, covariance=False).mean
        effect = dynamics.H @ dynamics.state.kinematics.frame_jacobian(frame).mT
        wrench = (torch.linalg.pinv(effect, rtol=1e-9) @ unexplained[..., None])[..., 0].cpu().numpy()
    observed = np.zeros((len(dataset), 6))
    for number, rows, _ in episodes_in_order(dataset):
        own_rows = np.flatnonzero(dataset.episode == number)
        observed[own_rows] = _past_mean(wrench[own_rows], rows.time, seconds)
    system = replace(posterior.system, known_forces=(*posterior.system.known_forces, ObservedWrench(frame, NAMES)))
    truth = {name: values for name, values in dataset.truth.items() if not name.startswith("Q_U")}
    return posterior.with_system(system), replace(
        dataset, u=np.concatenate([dataset.u, observed], axis=1), system=system, truth=truth
    )


def with_observer(posterior: AnyPosterior, dataset: Dataset) -> AnyPosterior:
    """The posterior with the time in `settings` at which an observer predicts the rows of this recording best.

    Only where the prior leaves it open (`AerodynamicForce(observe=None)`) and rows are in order of time.
    """
    prior: ForcePrior = posterior.model.prior
    open_ones = [term for term in prior.summands() if isinstance(term, AerodynamicForce) and term.observe is None]
    if not open_ones or not dataset.time_ordered or len(dataset) < 100:
        return posterior

    def error(seconds: float) -> float:
        seeing, seen = _observed(posterior, dataset, seconds, open_ones[0].link(posterior.system.robot))
        wrong = dataset.a - seeing.predict(seen.q, seen.v, seen.u, covariance=False).mean.cpu().numpy()
        return float(np.log(np.square(wrong).mean(0)).sum())

    return posterior.with_settings(observe_seconds=min(TRIED, key=error))


def _past_mean(values: np.ndarray, time: np.ndarray, seconds: float) -> np.ndarray:
    """Means of the rows before each, with weights exp(-age / seconds); zero for the first."""
    means, total, weight = np.zeros_like(values), np.zeros(values.shape[1]), 0.0
    keep = np.exp(-np.diff(time) / seconds)
    for row in range(1, len(values)):
        total, weight = keep[row - 1] * (total + values[row - 1]), keep[row - 1] * (weight + 1.0)
        means[row] = total / weight
    return means
