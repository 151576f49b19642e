"""The jobs of a comparison: identify a system, or fit and score a model, on one split with one seed."""

import hashlib
import json
import re
import time
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from forcegp.analytical import NoiseLevels
from forcegp.data import Dataset
from forcegp.errors import DataWarning, FileFormatError, ForceGPError
from forcegp.jobs import Job, JobStore
from forcegp.mechanics import MechanicalSystem
from forcegp.validation.candidates import Candidate, Training
from forcegp.validation.comparison import Comparison, Identification, identification_named, training_subset
from forcegp.validation.scores import acceleration_scores, mass_matrices, motion_scores, outside_range
from forcegp.validation.splits import Split

IDENTIFICATION, MODEL = "identification", "model"


def jobs_of(comparison: Comparison, models: Mapping[str, Candidate], seeds: int) -> tuple[list[Job], list[Job]]:
    """Identifications, and the models, which read their results; those that use all rows with the first seed only."""
    configuration = hashlib.sha256(json.dumps(comparison.configuration(), sort_keys=True).encode()).hexdigest()
    wanted = {each.identification for each in models.values() if each.identification is not None}
    identifications: dict[str, Job] = {}
    fits: list[Job] = []

    def job(
        kind: str, name: str, split: int, seed: int, work: Candidate | Identification, read: Mapping[str, str]
    ) -> Job:
        spec = {"configuration": configuration, "kind": kind, "name": name, "split": split, "seed": seed, **read}
        inputs = tuple(sorted({*read.values()}))
        place = job_name(comparison.splits[split], seed, kind, name)
        cost = work.cost if isinstance(work, Candidate) else 1.0
        functions = (work.fit,) if isinstance(work, Candidate) else (work.identify, work.noise)
        # where the functions are defined, which somebody else may have added
        modules = tuple(sorted({_plain(function).__module__ for function in functions if function is not None}))
        return Job(place, f"{__name__}:compute", spec, inputs, cost, (comparison, work), modules)

    for seed in range(seeds):
        for split in range(len(comparison.splits)):
            for name in sorted({*wanted, comparison.identification}):
                work = identification_named(name)
                # seeds choose rows: one of all rows, and that of the mass matrix, is done once
                if seed == 0 or (name in wanted and not work.all_rows):
                    found = job(IDENTIFICATION, name, split, seed, work, {})
                    identifications[found.name] = found
            for name, each in models.items():
                if each.all_rows and seed:
                    continue
                read = {"mass_matrix": _identification_name(comparison, comparison.identification, split, 0)}
                if each.identification is not None:
                    read["mean"] = _identification_name(comparison, each.identification, split, seed)
                fits.append(job(MODEL, name, split, seed, each, read))
    return list(identifications.values()), fits


def _identification_name(comparison: Comparison, name: str, split: int, seed: int) -> str:
    seed = 0 if identification_named(name).all_rows else seed
    return job_name(comparison.splits[split], seed, IDENTIFICATION, name)


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
    store: JobStore, spec: Mapping[str, Any], folder: Path, comparison: Comparison, work: Candidate | Identification
) -> dict[str, Any]:
    """Identify, or fit and score; what goes wrong is kept as well, for it is a result."""
    result: dict[str, Any] | None = None
    error: str | None = None
    with threadpool_limits(1):
        try:
            if isinstance(work, Identification):
                result = _identify(comparison, spec, work)
            else:
                result = _score(store, comparison, spec, work)
        except ForceGPError as problem:
            error = " ".join(str(problem).split())
        except Exception as problem:  # a model of somebody else may fail in any way; its row names the error
            error = " ".join(f"{type(problem).__name__}: {problem}".split())
    split = comparison.splits[spec["split"]].name
    return {**{key: spec[key] for key in ("kind", "name", "seed")}, "split": split, "result": result, "error": error}


def _identify(comparison: Comparison, spec: Mapping[str, Any], work: Identification) -> dict[str, Any]:
    train, _ = comparison.splits[spec["split"]].apply(comparison.rows)
    rows = train if work.all_rows else training_subset(train, comparison.points, spec["seed"])
    start = time.process_time()
    system = work.identify(comparison.system, rows, comparison.friction)
    found: dict[str, Any] = {"how": work.summary, "training_rows": len(rows)}
    if work.noise is not None:
        noise = work.noise(comparison.system, rows, comparison.friction)
        found["noise"] = {"acceleration": noise.acceleration.tolist(), "force": noise.force.tolist()}
    return {"cpu_seconds": time.process_time() - start, **found, "system": system.to_dict()}


def _score(store: JobStore, comparison: Comparison, spec: Mapping[str, Any], work: Candidate) -> dict[str, Any]:
    split = comparison.splits[spec["split"]]
    train, test = split.apply(comparison.rows)
    rows = training_subset(train, comparison.points, spec["seed"])
    motions = comparison.motions(split)
    identified: dict[str, MechanicalSystem | str] = {}
    before, noise = 0.0, None
    if work.identification is not None:
        identified[work.identification], before, noise = identified_system(store, spec["mean"])
    whole = train, split.apply(comparison.recording)[0], max(motions.horizons, default=1.0)
    training = Training(rows, comparison.system, identified, spec["seed"], *comparison.search, noise, *whole)
    start = time.process_time()
    posterior = work.fit(training)
    seconds = before + time.process_time() - start
    mass, whose = reference_mass(store, comparison, spec["mass_matrix"], test)
    scores, doubted = acceleration_scores(posterior, test, mass, outside_range(train, test))
    for sentence in doubted:
        warnings.warn(sentence, DataWarning, stacklevel=1)  # the page shows what was warned of in a job
    scores["motions"] = motion_scores(posterior, motions, comparison.integrator)
    return {"cpu_seconds": seconds, "mass_matrix": whose, "training_rows": len(rows), "test_rows": len(test), **scores}


def identified_system(store: JobStore, name: str) -> tuple[MechanicalSystem | str, float, NoiseLevels | None]:
    """The system of a finished identification, or why there is none, its CPU seconds and its noise if it has one."""
    found = kept(store, name)
    result = found["result"]
    if result is None:
        return str(found["error"]), 0.0, None
    noise = result.get("noise")
    levels = None if noise is None else NoiseLevels(*(np.array(noise[kind]) for kind in ("acceleration", "force")))
    return MechanicalSystem.from_dict(result["system"]), result["cpu_seconds"], levels


def reference_mass(
    store: JobStore, comparison: Comparison, name: str, test: Dataset
) -> tuple[Float[np.ndarray, "rows nv nv"], str]:
    """The mass matrices that turn errors of every model into forces, and whose they are, as part of a sentence.

    One and the same for all models and seeds of a split: of the system identified with the first seed, because a URDF
    seldom holds rotor inertias; of the system as given where that identification failed.
    """
    found = kept(store, name)
    if found["result"] is None:
        whose = f"the system as given, because its identification failed ({found['error'].rstrip('.')})"
        return mass_matrices(test, comparison.system), whose
    system = MechanicalSystem.from_dict(found["result"]["system"])
    return mass_matrices(test, system), f"the system identified with seed 0 by {found['result']['how']}"
