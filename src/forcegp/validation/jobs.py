"""The jobs of a comparison: identify a system, or fit and score a model, on one split with one seed."""

import hashlib
import json
import re
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from forcegp.data import Dataset
from forcegp.errors import DataWarning, FileFormatError, ForceGPError
from forcegp.jobs import Job, JobStore
from forcegp.model import Model
from forcegp.noise import Noise
from forcegp.validation.candidates import Candidate, identified_model
from forcegp.validation.comparison import Comparison
from forcegp.validation.scores import acceleration_scores, mass_matrices, motion_scores, outside_range
from forcegp.validation.splits import Split

IDENTIFICATION, MODEL = "identification", "model"


def jobs_of(comparison: Comparison, models: Mapping[str, Candidate], seeds: int) -> tuple[list[Job], list[Job]]:
    """Identifications, and the models, which read their results; those that use all rows with the first seed only."""
    configuration = hashlib.sha256(json.dumps(comparison.configuration(), sort_keys=True).encode()).hexdigest()
    usual = comparison.identification
    assert usual is not None, "it is resolved"
    wanted = {usual, *(each.identification for each in models.values() if each.identification is not None)}
    identifications: list[Job] = []
    fits: list[Job] = []

    def job(kind: str, name: str, split: int, seed: int, work: Candidate | str, read: Mapping[str, str]) -> Job:
        spec = {"configuration": configuration, "kind": kind, "name": name, "split": split, "seed": seed, **read}
        place = job_name(comparison.splits[split], seed, kind, name)
        cost = 1.0 if isinstance(work, str) else work.cost
        # where the function is defined, which somebody else may have added
        modules = (__name__,) if isinstance(work, str) else (_plain(work.fit).__module__,)
        inputs = tuple(sorted({*read.values()}))
        return Job(place, f"{__name__}:compute", spec, inputs, cost, (comparison, work), modules)

    for number, split in enumerate(comparison.splits):
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
    if not {"kind", "name", "split", "seed", "result", "error"} <= set(stored["result"]):
        raise FileFormatError(f"{store.place(name)} is damaged; delete it and run the same command again.")
    return {**stored["result"], **{key: stored[key] for key in ("machine", "wall_seconds", "warnings")}}


def compute(
    store: JobStore, spec: Mapping[str, Any], folder: Path, comparison: Comparison, work: Candidate | str
) -> dict[str, Any]:
    """Identify, or fit and score; what goes wrong is kept as well, for it is a result."""
    result: dict[str, Any] | None = None
    error: str | None = None
    with threadpool_limits(1):
        try:
            if isinstance(work, str):
                result = _identify(comparison, spec, work)
            else:
                result = _score(store, comparison, spec, work)
        except ForceGPError as problem:
            error = " ".join(str(problem).split())
        except Exception as problem:  # a model of somebody else may fail in any way; its row names the error
            error = " ".join(f"{type(problem).__name__}: {problem}".split())
    split = comparison.splits[spec["split"]].name
    return {**{key: spec[key] for key in ("kind", "name", "seed")}, "split": split, "result": result, "error": error}


def _identify(comparison: Comparison, spec: Mapping[str, Any], name: str) -> dict[str, Any]:
    train, _ = comparison.splits[spec["split"]].apply(comparison.rows)
    start = time.process_time()
    model = identified_model(name, comparison.model, train)
    assert model.noise is not None, "it was found"
    found: dict[str, Any] = {"how": name, "training_rows": len(train), "noise": model.noise.to_dict()}
    return {"cpu_seconds": time.process_time() - start, **found, "model": model.known.to_dict()}


def _score(store: JobStore, comparison: Comparison, spec: Mapping[str, Any], work: Candidate) -> dict[str, Any]:
    split = comparison.splits[spec["split"]]
    train, test = split.apply(comparison.rows)
    motions = comparison.motions(split)
    identified, before = identified_before(store, spec["identified"]) if "identified" in spec else (None, 0.0)
    training = comparison.training(train, split.apply(comparison.recording)[0], identified, spec["seed"])
    start = time.process_time()
    posterior = work.fit(training)
    seconds = before + time.process_time() - start
    mass, whose = reference_mass(store, comparison, spec["mass_matrix"], test)
    scores, doubted = acceleration_scores(posterior, test, mass, outside_range(train, test))
    for sentence in doubted:
        warnings.warn(sentence, DataWarning, stacklevel=1)  # the page shows what was warned of in a job
    scores["motions"] = motion_scores(posterior, motions, comparison.integrator)
    rows = {"training_rows": len(training.rows), "test_rows": len(test)}
    return {"cpu_seconds": seconds, "mass_matrix": whose, **rows, **scores}


def identified_before(store: JobStore, name: str) -> tuple[Model | str, float]:
    """The model of a finished identification, or why there is none, and its CPU seconds."""
    found = kept(store, name)
    result = found["result"]
    if result is None:
        return str(found["error"]), 0.0
    model = replace(Model.from_dict(result["model"]), noise=Noise.from_dict(result["noise"]))
    return model, result["cpu_seconds"]


def reference_mass(
    store: JobStore, comparison: Comparison, name: str, test: Dataset
) -> tuple[Float[np.ndarray, "rows nv nv"], str]:
    """The mass matrices that turn errors of every model into forces, and whose they are, as part of a sentence.

    One and the same for all models and seeds of a split: of the identified model, because a URDF seldom holds rotor
    inertias; of the model as given where that identification failed.
    """
    model, _ = identified_before(store, name)
    if isinstance(model, str):
        whose = f"the model as given, because its identification failed ({model.rstrip('.')})"
        return mass_matrices(test, comparison.model), whose
    return mass_matrices(test, model), f"the model identified from all training rows ({comparison.identification})"
