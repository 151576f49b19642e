"""The jobs of an experiment: identify a model, or fit and score one, on one split with one seed."""

import hashlib
import json
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from forcegp.errors import FileFormatError, ForceGPError
from forcegp.jobs import Job, JobStore
from forcegp.model import Model
from forcegp.noise import Noise
from forcegp.posterior.posterior import Posterior
from forcegp.scores.accuracy import mass_matrices
from forcegp.scores.candidates import Candidate, identified_model
from forcegp.scores.experiment import Experiment
from forcegp.scores.one_model import scored
from forcegp.scores.splits import Split

IDENTIFICATION, MODEL = "identification", "model"


def jobs_of(experiment: Experiment, models: Mapping[str, Candidate], seeds: int) -> tuple[list[Job], list[Job]]:
    """Identifications, and the models, which read their results; those that use all rows with the first seed only."""
    configuration = hashlib.sha256(json.dumps(experiment.configuration(), sort_keys=True).encode()).hexdigest()
    usual = experiment.identifies
    wanted = {usual, *(each.identification for each in models.values() if each.identification is not None)}
    identifications: list[Job] = []
    fits: list[Job] = []

    def job(kind: str, name: str, split: int, seed: int, work: Candidate | str, read: Mapping[str, str]) -> Job:
        spec = {"configuration": configuration, "kind": kind, "name": name, "split": split, "seed": seed, **read}
        spec |= {} if isinstance(work, str) else {"digest": work.digest}
        place = job_name(experiment.splits[split], seed, kind, name)
        # where the function is defined, which somebody else may have added
        fit = None if isinstance(work, str) or isinstance(work.fit, Posterior) else work.fit
        modules = (__name__,) if fit is None else (_plain(fit).__module__,)
        inputs = tuple(sorted({*read.values()}))
        return Job(place, f"{__name__}:compute", spec, inputs, arguments=(experiment, work), code=modules)

    for number, split in enumerate(experiment.splits):
        places = {name: job_name(split, 0, IDENTIFICATION, name) for name in sorted(wanted)}
        identifications += [job(IDENTIFICATION, name, number, 0, name, {}) for name in places]
        for seed in range(seeds):
            for name, each in models.items():
                if each.all_rows and seed:
                    continue
                read = {"mass_matrix": places[usual]}
                if each.identification is not None:
                    read["identified"] = places[each.identification]
                fits.append(job(MODEL, name, number, seed, each, read))
    return identifications, fits


def _plain(function: Callable[..., Any]) -> Callable[..., Any]:
    return _plain(function.func) if isinstance(function, partial) else function


def job_name(split: Split, seed: int, kind: str, name: str) -> str:
    """Every character is one that all file systems take."""
    plain = re.sub(r"[^\w.+@-]+", "_", name.replace(" ", ""))
    if plain != name.replace(" ", ""):  # names that differ in other characters only
        plain += f"-{hashlib.sha256(name.encode()).hexdigest()[:6]}"
    return f"{split.name}-seed{seed}-{'' if kind == MODEL else f'{kind}-'}{plain}"


def kept(store: JobStore, name: str) -> dict[str, Any]:
    """What a finished job found, or why it failed, with its warnings. Raises FileFormatError for a damaged file."""
    stored = store.load(name)
    if not {"split", "seed", "error", "warnings"} <= set(stored["result"]):
        raise FileFormatError(f"{store.place(name)} is damaged; delete it and run the same command again.")
    warned = [*stored["result"]["warnings"], *stored["warnings"]]
    return {**stored["result"], "warnings": warned, **{key: stored[key] for key in ("machine", "wall_seconds")}}


def compute(
    store: JobStore, spec: Mapping[str, Any], folder: Path, experiment: Experiment, work: Candidate | str
) -> dict[str, Any]:
    """Identify, or fit and score; what goes wrong is kept as well, for it is a result."""
    found: dict[str, Any] = {"warnings": []}
    error: str | None = None
    with threadpool_limits(1):
        try:
            done = _identify(experiment, spec, work) if isinstance(work, str) else _score(store, experiment, spec, work)
            found |= done
        except ForceGPError as problem:
            error = " ".join(str(problem).split())
        except Exception as problem:  # a model of somebody else may fail in any way; its row names the error
            error = " ".join(f"{type(problem).__name__}: {problem}".split())
    return {"split": experiment.splits[spec["split"]].name, "seed": spec["seed"], "error": error, **found}


def _identify(experiment: Experiment, spec: Mapping[str, Any], name: str) -> dict[str, Any]:
    train, _ = experiment.splits[spec["split"]].apply(experiment.rows)
    start = time.process_time()
    model = identified_model(name, experiment.model, train)
    assert model.noise is not None, "it was found"
    return {
        "cpu_seconds": time.process_time() - start,
        "noise": model.noise.to_dict(),
        "model": model.known.to_dict(),
    }


def _score(store: JobStore, experiment: Experiment, spec: Mapping[str, Any], work: Candidate) -> dict[str, Any]:
    split = experiment.splits[spec["split"]]
    train, test = split.apply(experiment.rows)
    identified, before = identified_before(store, spec["identified"]) if "identified" in spec else (None, 0.0)
    training = experiment.training(train, split.apply(experiment.recording)[0], identified, spec["seed"])
    start = time.process_time()
    posterior = work.fit if isinstance(work.fit, Posterior) else work.fit(training)
    seconds = before + time.process_time() - start
    # one M for all models of a split: the identified one, because a URDF seldom holds rotor inertias
    model, _ = identified_before(store, spec["mass_matrix"])
    whose = f"the model identified from all training rows ({experiment.identifies})"
    if isinstance(model, str):
        whose = f"the model as given, because its identification failed ({model.rstrip('.')})"
    mass = mass_matrices(test, experiment.model if isinstance(model, str) else model)
    fitted_here = not isinstance(work.fit, Posterior)
    found = scored(posterior, test, experiment.motions(split), experiment.integrator, mass, fitted_here=fitted_here)
    return {"cpu_seconds": seconds, "mass_matrix": whose, "training_rows": len(training.rows), **found}


def identified_before(store: JobStore, name: str) -> tuple[Model | str, float]:
    """The model of a finished identification, or why there is none, and its CPU seconds."""
    found = kept(store, name)
    if found["error"] is not None:
        return str(found["error"]), 0.0
    return replace(Model.from_dict(found["model"]), noise=Noise.from_dict(found["noise"])), found["cpu_seconds"]
