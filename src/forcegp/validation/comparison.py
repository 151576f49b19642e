"""One comparison: what is compared on what, and the pieces of work that it consists of."""

from __future__ import annotations

import hashlib
import re
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from forcegp import __version__
from forcegp.analytical import NoiseLevels
from forcegp.data import Dataset
from forcegp.errors import FitError, ForceGPError, InvalidInput
from forcegp.evaluation.machine import machine
from forcegp.integration import integrator_named
from forcegp.mechanics import MechanicalSystem
from forcegp.validation.candidates import Candidate, Training
from forcegp.validation.horizons import HORIZONS, STARTS, HeldOutMotions, held_out_motions, motion_scores
from forcegp.validation.identified_systems import (
    DEFAULT_IDENTIFICATION,
    FRICTION,
    IDENTIFICATIONS,
    Identification,
    learned_noise,
)
from forcegp.validation.kept_cells import KeptCells
from forcegp.validation.scores import acceleration_scores, mass_matrices
from forcegp.validation.splits import Split
from forcegp.validation.training_subsets import training_subset

IDENTIFICATION, MODEL = "identification", "model"


@dataclass(frozen=True, eq=False)
class Comparison:
    """What is compared, apart from the models and the number of seeds, which may grow later.

    Fields
    ------
    rows: the prepared rows that models are trained and scored on.
    recording: the same time at the full rate, for predictions of motions; may be `rows`.
    system: the robot as given.
    splits: what is held out; with several of them everything is done for each.
    points: training rows of every model.
    horizons, starts, integrator: of the predicted motions.
    identification: what `@identified` and the mass matrix of force errors take, a key of `IDENTIFICATIONS`.
    restarts, iterations: of searches for hyper-parameters; None leaves them to the model.
    force_noise: where a learned noise of the joint forces begins; None is none.
    measured_torque: whether predictions account for the noise of their u (`Noise`); needs `force_noise`, or models that
        rest on an identification that estimates its noise.
    friction: laws that identifications estimate, as in `forcegp.analytical.identify_analytical`.

    Raises InvalidInput for parts that do not fit, and DatasetError for splits whose sides overlap.
    """

    rows: Dataset
    recording: Dataset
    system: MechanicalSystem
    splits: tuple[Split, ...]
    points: int = 100
    horizons: tuple[float, ...] = HORIZONS
    starts: int = STARTS
    integrator: str = "rk4"
    identification: str = DEFAULT_IDENTIFICATION
    restarts: int | None = None
    iterations: int | None = None
    force_noise: float | None = None
    measured_torque: bool = False
    friction: tuple[str, ...] = FRICTION

    def __post_init__(self) -> None:
        names = tuple(self.system.robot.joint_names)
        for what, dataset in (("rows", self.rows), ("recording", self.recording)):
            if tuple(dataset.joint_names) != names:
                raise InvalidInput(
                    f"the {what} have joints {', '.join(dataset.joint_names)}; the robot {', '.join(names)}"
                )
        for name in ("restarts", "iterations"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InvalidInput(f"{name} is {value}; it must be at least 1.")
        learned_noise(self.rows, self.force_noise)
        integrator_named(self.integrator, self.system)
        if self.identification not in IDENTIFICATIONS:
            given, allowed = self.identification, ", ".join(IDENTIFICATIONS)
            raise InvalidInput(f"no identification is called {given!r}; there are {allowed}.")
        if self.measured_torque and self.force_noise is None and IDENTIFICATIONS[self.identification].noise is None:
            raise InvalidInput(
                "measured_torque needs a noise of the forces; give force_noise (--force-noise SIGMA), or an "
                "identification of all training rows, which finds it (--identification acceleration-all or torque-all)."
            )
        if len({split.name for split in self.splits}) < len(self.splits) or not self.splits:
            raise InvalidInput("give one split or more, each of its own name.")
        for split in self.splits:  # refused now, not after an hour
            train, _ = split.apply(self.rows)
            training_subset(train, self.points, 0)
            self.motions(split)

    def motions(self, split: Split) -> HeldOutMotions:
        """The motions to predict in what this split holds out."""
        return held_out_motions(self.recording, split.test_rows(self.recording), self.horizons, self.starts)

    def configuration(self) -> dict[str, Any]:
        """Everything that decides the numbers, as plain JSON values."""
        options = (
            "points",
            "starts",
            "integrator",
            "identification",
            "restarts",
            "iterations",
            "force_noise",
            "measured_torque",
            "friction",
        )
        given = {name: getattr(self, name) for name in options}
        return {
            "forcegp": __version__,
            "rows_sha256": fingerprint(self.rows),
            "recording_sha256": fingerprint(self.recording),
            "system_sha256": hashlib.sha256(self.system.to_json().encode()).hexdigest(),
            "splits": [split.to_dict() for split in self.splits],
            "horizons": list(self.horizons),
            **{name: list(value) if isinstance(value, tuple) else value for name, value in given.items()},
        }


@dataclass(frozen=True)
class Cell:
    """One piece of work: an identification, or a model, on one split with one seed."""

    kind: str
    name: str
    work: Candidate | Identification
    split: int
    seed: int

    @property
    def cost(self) -> float:
        """CPU time relative to others, for the remaining time alone."""
        return self.work.cost if isinstance(self.work, Candidate) else 1.0

    def file_name(self, comparison: Comparison) -> str:
        """Without ending."""
        return file_name(comparison.splits[self.split], self.seed, self.kind, self.name)


def file_name(split: Split, seed: int, kind: str, name: str) -> str:
    """Of a cell, without ending; every character is one that all file systems take."""
    plain = re.sub(r"[^\w.+@-]+", "_", name.replace(" ", ""))
    if plain != name.replace(" ", ""):  # names that differ in other characters only
        plain += f"-{hashlib.sha256(name.encode()).hexdigest()[:6]}"
    return f"{split.name}-seed{seed}-{'' if kind == MODEL else f'{kind}-'}{plain}"


def cells_of(comparison: Comparison, models: Mapping[str, Candidate], seeds: int) -> tuple[list[Cell], list[Cell]]:
    """Identifications, which come first, and models."""
    wanted = {each.identification for each in models.values() if each.identification is not None}
    places = [(split, seed) for seed in range(seeds) for split in range(len(comparison.splits))]
    first = [
        Cell(IDENTIFICATION, name, each, *place)
        for place in places
        for name, each in IDENTIFICATIONS.items()
        if (name in wanted and (place[1] == 0 or not each.all_rows))  # seeds choose rows: what takes all is done once
        or (name == comparison.identification and place[1] == 0)
    ]
    return first, [Cell(MODEL, name, each, *place) for place in places for name, each in models.items()]


def compute(comparison: Comparison, kept: KeptCells, cell: Cell) -> None:
    """Compute one cell and keep it; what goes wrong is kept as well, for it is a result."""
    start = time.monotonic()
    result: dict[str, Any] | None = None
    error: str | None = None
    with warnings.catch_warnings(record=True) as caught, threadpool_limits(1):
        warnings.simplefilter("always")
        try:
            work = _identify if cell.kind == IDENTIFICATION else _score
            result = work(comparison, kept, cell)
        except ForceGPError as problem:
            error = " ".join(str(problem).split())
        except Exception as problem:  # a model of somebody else may fail in any way; its row will say how
            error = " ".join(f"{type(problem).__name__}: {problem}".split())
    kept.write(
        cell.file_name(comparison),
        {
            "kind": cell.kind,
            "name": cell.name,
            "split": comparison.splits[cell.split].name,
            "seed": cell.seed,
            "machine": machine(),
            "wall_seconds": time.monotonic() - start,
            "warnings": sorted({" ".join(str(warning.message).split()) for warning in caught}),
            "result": result,
            "error": error,
        },
    )


def _training_rows(comparison: Comparison, cell: Cell) -> tuple[Dataset, Dataset]:
    train, test = comparison.splits[cell.split].apply(comparison.rows)
    return training_subset(train, comparison.points, cell.seed), test


def _identify(comparison: Comparison, kept: KeptCells, cell: Cell) -> dict[str, Any]:
    assert isinstance(cell.work, Identification), "the cell is that of an identification"
    rows, _ = _training_rows(comparison, cell)
    if cell.work.all_rows:
        rows, _ = comparison.splits[cell.split].apply(comparison.rows)
    start = time.process_time()
    system = cell.work.identify(comparison.system, rows, comparison.friction)
    content: dict[str, Any] = {"how": cell.work.summary, "training_rows": len(rows)}
    if cell.work.noise is not None:
        noise = cell.work.noise(comparison.system, rows, comparison.friction)
        content["noise"] = {"acceleration": noise.acceleration.tolist(), "force": noise.force.tolist()}
    seconds = time.process_time() - start
    return {"cpu_seconds": seconds, **content, "system": system.to_dict()}


def _score(comparison: Comparison, kept: KeptCells, cell: Cell) -> dict[str, Any]:
    assert isinstance(cell.work, Candidate), "a cell of a model has its candidate"
    rows, test = _training_rows(comparison, cell)
    name = cell.work.identification
    identified: dict[str, MechanicalSystem | str] = {}
    before, noise = 0.0, None
    if name is not None:
        identified[name], before, noise = identified_system(comparison, kept, name, cell.split, cell.seed)
    training = Training(
        rows,
        comparison.system,
        identified,
        cell.seed,
        comparison.restarts,
        comparison.iterations,
        comparison.force_noise,
        comparison.measured_torque,
        noise,
    )
    start = time.process_time()
    posterior = cell.work.fit(training)
    seconds = before + time.process_time() - start
    mass, whose = reference_mass(comparison, kept, cell.split, test)
    scores = acceleration_scores(posterior, test, mass)
    scores["motions"] = motion_scores(
        posterior, comparison.motions(comparison.splits[cell.split]), comparison.integrator
    )
    return {"cpu_seconds": seconds, "mass_matrix": whose, "training_rows": len(rows), "test_rows": len(test), **scores}


def identified_system(
    comparison: Comparison, kept: KeptCells, name: str, split: int, seed: int
) -> tuple[MechanicalSystem | str, float, NoiseLevels | None]:
    """The system of a finished identification, or why there is none, its CPU seconds and, if estimated, its noise."""
    found = _identification(comparison, kept, name, split, seed)
    result = found["result"]
    if result is None:
        return str(found["error"]), 0.0, None
    noise = result.get("noise")
    levels = None if noise is None else NoiseLevels(*(np.array(noise[kind]) for kind in ("acceleration", "force")))
    return MechanicalSystem.from_dict(result["system"]), result["cpu_seconds"], levels


def _identification(comparison: Comparison, kept: KeptCells, name: str, split: int, seed: int) -> dict[str, Any]:
    """What was kept for this seed, or for the first where the identification takes all rows.

    Asked of the files, for another process may lack a method of identification that the user has added.
    """
    names = [file_name(comparison.splits[split], each, IDENTIFICATION, name) for each in (seed, 0)]
    stored = kept.read(names[0]) or kept.read(names[1])
    if stored is None:
        raise FitError(f"the identification {name!r} with seed {seed} was not done")
    return stored


def reference_mass(
    comparison: Comparison, kept: KeptCells, split: int, test: Dataset
) -> tuple[Float[np.ndarray, "rows nv nv"], str]:
    """The mass matrices that turn errors of every model into forces, and whose they are, as part of a sentence.

    One and the same for all models and seeds of a split: of the system identified with the first seed, because a URDF
    seldom holds rotor inertias; of the system as given where that identification failed.
    """
    found = _identification(comparison, kept, comparison.identification, split, 0)
    if found["result"] is None:
        why = f"the system as given, because its identification failed ({found['error'].rstrip('.')})"
        return mass_matrices(comparison.system, test), why
    system = MechanicalSystem.from_dict(found["result"]["system"])
    return mass_matrices(system, test), f"the system identified with seed 0 by {found['result']['how']}"


def fingerprint(dataset: Dataset) -> str:
    """SHA-256 of the joints, times and numbers of a Dataset."""
    digest = hashlib.sha256("\n".join(dataset.joint_names).encode())
    for name in ("q", "v", "u", "a", "time", "episode", "noise_std"):
        values = getattr(dataset, name)
        digest.update(name.encode() if values is None else np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()
