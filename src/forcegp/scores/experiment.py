"""What models are fitted to and scored on: rows, splits, motions, and the one mass matrix of all force errors."""

import hashlib
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from forcegp.data import Dataset, farthest_rows
from forcegp.data.dataset import require_rows
from forcegp.errors import InvalidInput, require_type
from forcegp.integration import integrator_named
from forcegp.model import Model
from forcegp.scores.candidates import Training, checked_identification, usual_identification
from forcegp.scores.motions import STARTS, HeldOutMotions, held_out_motions
from forcegp.scores.splits import Split

SHARE = 2 / 3
"""Of the training rows among which the points of one seed are chosen."""


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

    Fields are those of `score`. Raises InvalidInput for parts that do not fit, and DatasetError for splits whose sides
    overlap.
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
        checked_identification(self.identifies, self.model)
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
            train, _ = split.apply(self.rows)
            training_subset(train, self.points, 0)
            self.motions(split)

    @cached_property
    def identifies(self) -> str:
        """Forces and evidence of `identified`, and of the mass matrix."""
        return self.identification or usual_identification(self.model)

    def motions(self, split: Split) -> HeldOutMotions:
        """The motions to predict in what this split holds out."""
        return held_out_motions(self.recording, split.test_rows(self.recording), self.horizons, self.starts)

    def training(self, rows: Dataset, recording: Dataset, identified: Model | str | None, seed: int) -> Training:
        """What models of one seed are fitted to, out of these training rows."""
        subset = training_subset(rows, self.points, seed)
        return Training(subset, self.model, rows, recording, identified, seed, self.restarts, self.iterations)

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


def fingerprint(dataset: Dataset) -> str:
    """SHA-256 of the joints, times and numbers of a Dataset."""
    digest = hashlib.sha256("\n".join(dataset.joint_names).encode())
    for name in ("q", "v", "u", "a", "time", "episode", "noise_std"):
        values = getattr(dataset, name)
        digest.update(name.encode() if values is None else np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()
