"""What models are fitted to and scored on, and the jobs of it: identify a model, or fit and score one, on one split.

All models of a split share one mass matrix for force errors, that of the identified model: a URDF seldom holds rotors.
"""

import hashlib
import json
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from forcegp.data import Dataset, contact_doubts, farthest_rows, with_strokes
from forcegp.data.dataset import require_rows
from forcegp.data.views import decided
from forcegp.errors import ForceGPError, InvalidInput, require_type
from forcegp.fit import fit
from forcegp.integration import integrator_named
from forcegp.jobs import Job, JobStore
from forcegp.model import Model
from forcegp.noise import Noise
from forcegp.posterior import observing
from forcegp.posterior.posterior import Posterior
from forcegp.scores import accuracy
from forcegp.scores import models as learners
from forcegp.scores.held_out import STARTS, HeldOutMotions, Split, held_out_motions, motion_scores
from forcegp.scores.models import Candidate, checked_identification, few_inputs, identified_model, learn

SHARE = 2 / 3  # of the training rows among which the points of one seed are chosen
IDENTIFICATION, MODEL = "identification", "model"
OBSERVED = "wind, and the force that stays unexplained, were observed from the rows before each."


def training_subset(train: Dataset, points: int, seed: int) -> Dataset:
    """`points` rows that lie far apart in (q, v, u) among two thirds of the rows, which `seed` draws at random.

    Farthest-point sampling of all rows begins with the same extremes whatever row it starts at, so seeds would hardly
    differ. Among a random two thirds they do, and each choice still covers the states.
    Raises InvalidInput where two thirds of the rows are fewer than `points`.
    """
    among = int(np.ceil(SHARE * len(train)))
    if not 2 <= points <= among:
        raise InvalidInput(
            f"points is {points}; with {len(train)} training rows it must be from 2 to {among}, two thirds of them."
        )
    generator = np.random.default_rng(seed)
    drawn = np.sort(generator.choice(len(train), size=among, replace=False))
    return farthest_rows(train.rows(drawn), points, start=int(generator.integers(among)))


@dataclass(frozen=True, eq=False)
class Experiment:
    """Everything that decides the scores, apart from the models and the number of seeds, which may grow later.

    Fields are those of `score`. InvalidInput for parts that do not fit, DatasetError for splits whose sides overlap.
    """

    rows: Dataset
    recording: Dataset
    model: Model
    splits: tuple[Split, ...]
    points: int = 100
    horizons: tuple[float, ...] | None = None
    starts: int = STARTS
    integrator: str = "rk4"
    identification: str | None = None
    restarts: int | None = None
    iterations: int | None = None

    def __post_init__(self) -> None:
        require_type("model", self.model, Model)
        checked_identification(self.identifies, self.model, self.rows)
        for what, dataset in (("log", self.rows), ("recording", self.recording)):
            require_rows(what, dataset, tuple(self.model.robot.joint_names), "the robot")
        for name in ("restarts", "iterations"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InvalidInput(f"{name} is {value}; it must be at least 1.")
        integrator_named(self.integrator, self.model)
        if len({split.name for split in self.splits}) < len(self.splits) or not self.splits:
            raise InvalidInput("give one split or more, each of its own name.")
        for split in self.splits:  # refused now, not after an hour
            training_subset(decided(split.apply(self.rows)[0]), self.points, 0)
            self.motions(split)

    @cached_property
    def identifies(self) -> str:
        """Forces and evidence of `identified`, and of the mass matrix."""
        return self.identification or learners.usual_identification(self.model)

    def motions(self, split: Split) -> HeldOutMotions:
        """The motions to predict in what this split holds out."""
        recording = decided(self.recording)
        return held_out_motions(recording, split.test_rows(recording), self.horizons, self.starts)

    def rows_for(self, identified: Model | str | None) -> Dataset:
        """All rows, which know the strokes of the motors that an identified model has found, also those of a split."""
        return with_strokes(self.rows, identified.memory.transmission) if isinstance(identified, Model) else self.rows

    def fitted(
        self, work: Candidate, rows: Dataset, recording: Dataset, identified: Model | str | None, seed: int = 0
    ) -> Posterior:
        """Functions of few inputs and laws from all these rows, others from `points`; motions from the recording."""
        if isinstance(work.given, Posterior):
            return work.given
        model = work.model(self.model, identified)
        few, how = few_inputs(model), {"seed": seed, "restarts": self.restarts}
        if not few:
            how |= {"iterations": self.iterations, "points": self.points}
        if not few and (model.unknown_forces or not model.is_open):
            rows = training_subset(decided(rows), self.points, seed)
        posterior: Any = learn(model, rows, work.evidence, **how)[0]
        return fit(posterior.model, recording, work.motions, start=posterior) if work.motions else posterior

    @cached_property
    def configuration(self) -> dict[str, Any]:
        """Everything that decides the numbers, as plain JSON values."""
        digested = ("rows", "recording", "model", "splits", "identification")
        given = {item.name: getattr(self, item.name) for item in fields(self) if item.name not in digested}
        return {
            "rows_sha256": fingerprint(self.rows),
            "recording_sha256": fingerprint(self.recording),
            "model_sha256": hashlib.sha256(self.model.to_json().encode()).hexdigest(),
            "splits": [split.to_dict() for split in self.splits],
            "identification": self.identifies,
            **{name: list(value) if isinstance(value, tuple) else value for name, value in given.items()},
        }

    def jobs(self, models: Mapping[str, Candidate], seeds: int) -> tuple[list[Job], list[Job]]:
        """Identifications, and the models, which read their results; those that use all rows with one seed only."""
        common = {"configuration": hashlib.sha256(json.dumps(self.configuration, sort_keys=True).encode()).hexdigest()}
        wanted = sorted({self.identifies, *(each.identification for each in models.values() if each.identification)})
        identifications, fits = list[Job](), list[Job]()

        def job(split: int, seed: int, kind: str, name: str, work: Candidate | str, **read: str) -> Job:
            spec = {**common, "kind": kind, "name": name, "split": split, "seed": seed, **read}
            spec |= {"digest": work.digest} if isinstance(work, Candidate) else {}
            bare = name.replace(" ", "")
            plain = re.sub(r"[^\w.+@-]+", "_", bare)  # every character is one that all file systems take
            plain += f"-{hashlib.sha256(name.encode()).hexdigest()[:6]}" if plain != bare else ""
            place = f"{self.splits[split].name}-seed{seed}-{'' if kind == MODEL else f'{kind}-'}{plain}"
            return Job(place, f"{__name__}:compute", spec, tuple(sorted({*read.values()})), arguments=(self, work))

        for split in range(len(self.splits)):
            own = {name: job(split, 0, IDENTIFICATION, name, name) for name in wanted}
            identifications += own.values()
            for seed in range(seeds):
                for name, each in models.items():
                    if not (each.all_rows and seed):
                        read = {"mass_matrix": own[self.identifies].name}
                        read |= {"identified": own[each.identification].name} if each.identification else {}
                        fits.append(job(split, seed, MODEL, name, each, **read))
        return identifications, fits


def fingerprint(dataset: Dataset) -> str:
    """SHA-256 of the joints, times and numbers of a Dataset."""
    digest = hashlib.sha256("\n".join(dataset.joint_names).encode())
    for name in ("q", "v", "u", "a", "time", "episode", "noise_std"):
        values = getattr(dataset, name)
        digest.update(name.encode() if values is None else np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def kept(store: JobStore, name: str) -> dict[str, Any]:
    """What a finished job found, or why it failed, with its warnings. Raises as `JobStore.load`."""
    stored = store.load(name)
    warned = [*stored["result"]["warnings"], *stored["warnings"]]
    return {**stored["result"], "warnings": warned, **{key: stored[key] for key in ("machine", "wall_seconds")}}


def compute(
    store: JobStore, spec: Mapping[str, Any], folder: Path, experiment: Experiment, work: Candidate | str
) -> dict[str, Any]:
    """Identify, or fit and score; what goes wrong is kept as well, for it is a result."""
    found: dict[str, Any] = {"warnings": [], "error": None}
    split = experiment.splits[spec["split"]]
    with threadpool_limits(1):
        try:
            if isinstance(work, str):
                start = time.process_time()
                model = identified_model(work, experiment.model, split.apply(experiment.rows)[0])
                assert model.noise is not None, "it was found"
                found |= {"noise": model.noise.to_dict(), "model": model.known.to_dict()}
                found |= {"cpu_seconds": time.process_time() - start}
            else:
                found |= _score(store, experiment, split, spec, work)
        except Exception as problem:  # a model of somebody else may fail in any way; its row names the error
            name = "" if isinstance(problem, ForceGPError) else f"{type(problem).__name__}: "
            found["error"] = " ".join(f"{name}{problem}".split())
    return {"split": split.name, "seed": spec["seed"], **found}


def _score(
    store: JobStore, experiment: Experiment, split: Split, spec: Mapping[str, Any], work: Candidate
) -> dict[str, Any]:
    identified, before = identified_before(store, spec["identified"]) if "identified" in spec else (None, 0.0)
    train, test = split.apply(experiment.rows_for(identified))
    test, start = decided(test), time.process_time()
    posterior = experiment.fitted(work, train, split.apply(experiment.recording)[0], identified, spec["seed"])
    seconds = before + time.process_time() - start
    model, _ = identified_before(store, spec["mass_matrix"])
    mass = accuracy.mass_matrices(test, experiment.model if isinstance(model, str) else model)
    known = isinstance(work.given, Posterior)
    how: dict[str, Any] = {"fitted_here": not known, "whole": experiment.rows}
    found = scored(posterior, test, experiment.motions(split), experiment.integrator, mass, **how)
    return {"cpu_seconds": seconds, "training_rows": experiment.points, **found}


def identified_before(store: JobStore, name: str) -> tuple[Model | str, float]:
    """The model of a finished identification, or why there is none, and its CPU seconds."""
    found = kept(store, name)
    if found["error"] is not None:
        return str(found["error"]), 0.0
    return replace(Model.from_dict(found["model"]), noise=Noise.from_dict(found["noise"])), found["cpu_seconds"]


def scored(
    posterior: Posterior,
    test: Dataset,
    motions: HeldOutMotions,
    integrator: str = "rk4",
    mass: accuracy.Matrices | None = None,
    *,
    fitted_here: bool = False,
    whole: Dataset | None = None,
) -> dict[str, Any]:
    """One model on one log as JSON: table, errors, warnings; also of shared rows unless `fitted_here`."""
    alone, recorded = posterior, test
    if test.time_ordered:
        posterior, test = observing(posterior, test, whole=True)
    table, stretches = accuracy.row_scores(posterior, test, mass, whole)
    moving, facts = motion_scores(alone, motions, integrator)
    doubts = [] if fitted_here else [*accuracy.overlaps(alone, recorded), *contact_doubts(test, posterior.model)]
    doubts += [
        *accuracy.unfinished_search(posterior),
        *accuracy.rows_outside(posterior, test),
        *accuracy.poor_scores(posterior, test, table),
    ]
    told = [*map(str, doubts), *([] if posterior is alone else [OBSERVED])]
    return {"table": table | moving, "stretches": stretches, "motions": facts, "warnings": told, "test_rows": len(test)}
