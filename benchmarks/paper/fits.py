"""Models by name, and jobs that fit one of them to one training set and score it: what most figures are made of.

Fits to more points begin where the fit to fewer ended, because the training sets are nested.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from benchmarks.paper.data import scored_rows, training_rows
from benchmarks.scores import scores_of
from forcegp.data import Dataset
from forcegp.evidence import Accelerations
from forcegp.fit import fit as fit_model
from forcegp.forces import JointAccelerations, JointForces, ToolForces
from forcegp.inference import OptimizerOptions
from forcegp.jobs import Job, JobStore
from forcegp.model import Model
from forcegp.noise import Noise
from forcegp.posterior import load_posterior, save_posterior


@dataclass(frozen=True)
class ModelKind:
    """A model's label in the paper's figures, and how it is made of a simulated one."""

    label: str
    make: Callable[[Model], Model]


MODELS = {
    "gp": ModelKind("GP", Model.black_box),
    "s-gp-38": ModelKind("S-GP [38]", lambda model: model.with_forces(JointAccelerations()).without_mean()),
    "s-gp": ModelKind("S-GP", lambda model: model.with_forces(JointForces()).without_mean()),
    "s-gp-mean": ModelKind("S-GP + analytical mean", lambda model: model.with_forces(JointForces())),
    "s-gp-tool": ModelKind("S-GP, tool friction", lambda model: model.with_forces(ToolForces())),
    "analytical": ModelKind("analytical model", lambda model: model.with_forces(noise=Noise(0.1, learn=True))),
}
"""The analytical model has the true parameters; the level of its noise is learned."""

GAUSSIAN_PROCESSES = ("gp", "s-gp-38", "s-gp", "s-gp-mean")
ANALYTICAL = ("analytical",)
MODEL = "model"  # the folder of the fitted model inside its job


@dataclass(frozen=True)
class FitSettings:
    """How hyper-parameters are searched for.

    `restarts` and `tolerance` by number of points: the largest key that does not exceed the points counts. Every fit
    but the first of a series begins where the one with fewer points ended, as restart 0; the others begin around
    moments.
    """

    restarts: Mapping[str, int]
    iterations: int
    tolerance: Mapping[str, float]

    def of(self, points: int) -> dict[str, Any]:
        """The settings for this many points, as a job's spec holds them."""
        by_points = {"restarts": self.restarts, "tolerance": self.tolerance}  # JSON turns the keys into text
        last = {name: str(max(int(key) for key in each if int(key) <= points)) for name, each in by_points.items()}
        return {name: each[last[name]] for name, each in by_points.items()} | {"iterations": self.iterations}


# Model, points and seed -> where the fit to the first rows of a trajectory lies; model and seed: that to all rows.
fit_name, all_name = "fits/{0}/seed{2}/n{1}".format, "fits/{}/seed{}/all".format


def fit_series(model: str, data: str, seed: int, points: Iterable[int], settings: FitSettings) -> list[Job]:
    """One job per number of points, each beginning from the hyper-parameters of the one before."""
    jobs: list[Job] = []
    for count in sorted(points):
        before = jobs[-1].name if jobs else None
        spec = {"model": model, "data": data, "points": count, "seed": seed, "start": before, **settings.of(count)}
        after = (data,) if before is None else (data, before)
        jobs.append(
            Job(fit_name(model, count, seed), "benchmarks.paper.fits:fit", spec, after, fit_cost(model, count, spec))
        )
    return jobs


def fit_to_all(model: str, data: str, seed: int) -> Job:
    """An analytical model on all training rows of the data job."""
    spec = {"model": model, "data": data, "points": None, "seed": seed, "start": None}
    return Job(all_name(model, seed), "benchmarks.paper.fits:fit", spec, (data,), 60.0)


def fit_cost(model: str, points: int, settings: Mapping[str, Any]) -> float:
    """CPU seconds of a fit, about, from measurements on one core."""
    per_evaluation = 0.7 * (points / 1000) ** 2.7 if model == "gp" else 5.6 * (points / 1000) ** 2.6
    return 2.0 + settings["restarts"] * min(settings["iterations"], 120) * per_evaluation


def fit(results: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Fit, keep the model, and score it on the test trajectory of the same data job."""
    train = training_rows(results, spec["data"], spec["points"])
    start = None
    if spec["start"] is not None:
        start = load_posterior(results.place(spec["start"]) / MODEL).hyperparameters
    posterior = fitted(spec, train, start)
    save_posterior(posterior, folder / MODEL)
    scores = scores_of(posterior, scored_rows(results, spec["data"]))
    return {"evaluation": scores, "search": search_report(posterior)}


def fitted(spec: Mapping[str, Any], train: Dataset, start: Mapping[str, Tensor] | None = None) -> Any:
    """The model of `spec` fitted to these rows; "restarts", "iterations" and "tolerance" where its search has them."""
    kind = MODELS[spec["model"]]
    assert train.model is not None
    more: dict[str, Any] = {}
    if "iterations" in spec:
        more["options"] = OptimizerOptions(iterations=spec["iterations"], tolerance=spec["tolerance"])
        more |= {"restarts": spec["restarts"], "start": start}
    return fit_model(kind.make(train.model), train, Accelerations(), seed=spec["seed"], **more)


def search_report(posterior: Any) -> dict[str, Any]:
    """How the search for hyper-parameters went."""
    search = posterior.result
    same = {name: getattr(search, name) for name in ("evaluations", "converged", "status", "cpu_seconds")}
    return {"objective": search.value, "iterations": len(search.history) - 1, **same}
