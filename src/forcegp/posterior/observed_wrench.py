"""Wind, and a slow force that no feature explains: observed from the past rows of a recording, then known."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from forcegp.data import AirLaw, Dataset, find_wind, with_memory, with_wind
from forcegp.data.filters import episodes_in_order, sums_before
from forcegp.data.views import in_blocks
from forcegp.errors import InvalidInput
from forcegp.forces import AerodynamicForce, ObservedWind, ObservedWrench
from forcegp.model import Model

Posterior = Any
"""A `Posterior`, whose module imports this one."""

OBSERVERS = ObservedWind | ObservedWrench
Wrenches = Float[np.ndarray, "rows 6"]
TRIED = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # s
MEMORY, LEAST = 1.0, 0.1  # s, of how much each time missed, and of the past that the first row needs


def observing(
    posterior: Posterior, dataset: Dataset, *, seconds: float | None = None, whole: bool = False
) -> tuple[Posterior, Dataset]:
    """The posterior and the recording with an `ObservedWrench`, in six more columns of u, and observed wind.

    Row k holds the mean of the wrench left unexplained over the rows before k of its episode, with weights that fall by
    e in `seconds`: what a first-order disturbance observer reports in flight (Chen et al., IEEE TIE 2016). Rows with a
    shorter past are left out unless `whole`. By default the prior's `AerodynamicForce` gives link and time; where it
    leaves the time open, each component takes that of .02 to 1 s which missed least in the second before. What laws
    remember has its columns, too. Without such a prior both come back as they are. Calibrated intervals go along unless
    `seconds` is given. Raises InvalidInput for a time that is not positive, models that cannot carry their forces
    along, and recordings that are too short or not in order of time.
    """
    dataset = with_memory(dataset, posterior.model)
    own = next((term for term in posterior.trained.unknown_forces if isinstance(term, AerodynamicForce)), None)
    times = TRIED if seconds is None else (seconds,)
    # calibrated widths are of what is observed by default
    widths = posterior.settings.get("motion_intervals") if seconds is None else None
    if seconds is None:
        seconds = 0.0 if own is None else LEAST if own.observe is None else own.observe
        times = times if own is None or own.observe is None else (seconds,)
        if seconds == 0.0 or ObservedWrench in map(type, posterior.model.laws):
            return posterior, dataset
    if not 0.0 < seconds < 1e6:
        raise InvalidInput(f"seconds is {seconds!r}; give the time in s that an observer looks back.")
    frame = (own or AerodynamicForce()).link(posterior.model.robot)
    posterior, dataset = _in_observed_wind(posterior, dataset)

    def unexplained(q: Tensor, v: Tensor, u: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        """Accelerations less their predicted mean, and how a wrench of the world on the link changes them."""
        dynamics = posterior.dynamics(q, v, u)
        effect = dynamics.H @ dynamics.state.kinematics.frame_jacobian(frame).mT
        return a - posterior.predict(q, v, u, covariance=False).mean, effect

    missed, effect = in_blocks(dataset, unexplained, posterior.model.robot.device)
    observed = _observed(np.einsum("nij,nj->ni", np.linalg.pinv(effect, rcond=1e-9), missed), dataset, times)
    model = replace(posterior.model, forces=(*posterior.model.forces, ObservedWrench(frame)))
    truth = {name: values for name, values in dataset.truth.items() if not name.startswith("Q_U")}
    seen = replace(dataset, u=np.concatenate([dataset.u, observed], axis=1), model=model, truth=truth)
    posterior = posterior.with_model(model)
    if widths is not None:
        posterior = posterior.with_settings(motion_intervals=widths)
    return posterior, seen if whole else seen.rows(_with_past(dataset, seconds))


def in_air(model: Model, dataset: Dataset) -> tuple[Mapping[str, Any], Dataset] | None:
    """What air did in the rows, for the settings of a fit, and the rows with columns that hold it and a model for them.

    None where the model has no `AerodynamicForce` or observes nothing, observes already, or rows show no wind.
    """
    of_air = [term for term in model.unknown_forces if isinstance(term, AerodynamicForce) and term.observe != 0.0]
    observes = any(isinstance(force, OBSERVERS) for force in model.forces)
    if not of_air or observes or dataset.u.shape[1] != model.sizes[2]:
        return None
    rows = replace(dataset, model=model, truth={})
    if (found := find_wind(rows)) is None:
        return None
    law, wind = found
    windy = (replace(x, wind=law.wind) if isinstance(x, AerodynamicForce) else x for x in model.forces)
    return {"air": asdict(law)}, with_wind(replace(rows, model=replace(model, forces=tuple(windy))), wind)


def unobserved(model: Model) -> Model:
    """The system without the columns of u that :func:`in_air` gives it."""
    return replace(model, forces=tuple(x for x in model.forces if getattr(x, "names", ()) != ObservedWind.names))


def require_unobserved(posterior: Posterior, what: str) -> None:
    """Raise InvalidInput for what `observing` gave, where `what` observes by itself."""
    if len(posterior.model.inputs) > len(posterior.trained.inputs):
        seen = f"{what} include the observers of the model"
        raise InvalidInput(f"{seen}: give the posterior and the recording as they were before `observing`.")


def rows_of_own_system(posterior: Posterior, rows: Dataset) -> Dataset:
    """Rows to `update` with, as the model's own. InvalidInput after `with_model`, and for less than .1 s of past."""
    target, own = posterior.target, posterior.trained
    if target is None or not own.unknown_forces:  # laws alone learn nothing from rows but their level
        return rows
    if "air" not in posterior.settings or target.known.to_dict() != unobserved(own).known.to_dict():
        seen = "the posterior was carried to another system than the one that its rows were measured on"
        raise InvalidInput(f"{seen}; update it before it is carried there: posterior.update(rows).with_model(model).")
    return in_own_air(posterior, rows)


def in_own_air(posterior: Posterior, rows: Dataset) -> Dataset:
    """Rows with the wind that the fit has columns for; InvalidInput where all lack .1 s of past."""
    if "air" not in posterior.settings:
        return rows
    _, seen = _in_observed_wind(posterior, rows)
    return seen.rows(_with_past(rows, LEAST))


def _with_past(dataset: Dataset, seconds: float) -> Int[np.ndarray, " late"]:
    """Which rows have a past of that time in their episode. Raises InvalidInput for none."""
    first = {number: rows.time[0] for number, rows, _ in episodes_in_order(dataset)}
    late = np.flatnonzero(dataset.time - np.array([first[number] for number in dataset.episode]) >= seconds)
    if not len(late):
        raise InvalidInput(f"rows hold less than {seconds:g} s of flight, which shows no wind; give longer pieces.")
    return late


def _in_observed_wind(posterior: Posterior, dataset: Dataset) -> tuple[Posterior, Dataset]:
    """Both with the wind that the rows before each one show, where the fit found a law of air."""
    stored = posterior.settings.get("air")
    if stored is None or any(isinstance(force, OBSERVERS) for force in posterior.model.forces):
        return posterior, dataset
    rows = replace(dataset, model=posterior.model)
    seen = with_wind(rows, AirLaw(**stored).wind_before(rows))
    return posterior.with_model(seen.model), seen


def _observed(wrench: Wrenches, dataset: Dataset, times: Sequence[float]) -> Wrenches:
    """The wrench that the rows before each show, none at the first of an episode."""
    observed = np.zeros_like(wrench)
    for number, rows, _ in episodes_in_order(dataset):
        own = np.flatnonzero(dataset.episode == number)
        means = np.stack([_past_mean(wrench[own], rows.time, time) for time in times])  # (times, rows, 6)
        missed = np.stack([_past_mean(np.square(wrench[own] - mean), rows.time, MEMORY) for mean in means])
        observed[own] = np.take_along_axis(means, missed.argmin(0)[None], axis=0)[0]
    return observed


def _past_mean(values: np.ndarray, time: np.ndarray, seconds: float) -> np.ndarray:
    """Means of the rows before each, with weights exp(-age / seconds); zero for the first."""
    sums = sums_before(np.concatenate([values, np.ones((len(values), 1))], axis=1), time, seconds)
    return sums[:, :-1] / np.where(sums[:, -1:] > 0.0, sums[:, -1:], 1.0)
