"""One comparison: what is compared on what."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from forcegp.data import Dataset
from forcegp.data.dataset_arguments import require_rows
from forcegp.errors import InvalidInput, require_type
from forcegp.integration import integrator_named
from forcegp.mechanics import MechanicalSystem
from forcegp.models import Noise
from forcegp.validation.horizons import HORIZONS, STARTS, HeldOutMotions, held_out_motions
from forcegp.validation.identified_systems import DEFAULT_IDENTIFICATION, FRICTION, IDENTIFICATIONS
from forcegp.validation.splits import Split
from forcegp.validation.training_subsets import training_subset


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
    measured_torque: whether predictions account for a u that is as noisy (`Noise`); needs `force_noise`, or models that
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
        require_type("system", self.system, MechanicalSystem)
        names = tuple(self.system.robot.joint_names)
        for what, dataset in (("rows", self.rows), ("recording", self.recording)):
            require_rows(what, dataset, names, "the robot")
        for name in ("restarts", "iterations"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InvalidInput(f"{name} is {value}; it must be at least 1.")
        Noise(None, self.force_noise)
        integrator_named(self.integrator, self.system)
        if self.identification not in IDENTIFICATIONS:
            given, allowed = self.identification, ", ".join(IDENTIFICATIONS)
            raise InvalidInput(f"no identification is called {given!r}; there are {allowed}.")
        if self.measured_torque and self.force_noise is None and IDENTIFICATIONS[self.identification].noise is None:
            raise InvalidInput(
                "measured_torque needs a noise of the forces; give `force_noise`, or an `identification` of "
                "all training rows, which finds it: acceleration-all or torque-all."
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
        digested = ("rows", "recording", "system", "splits")
        given = {item.name: getattr(self, item.name) for item in fields(self) if item.name not in digested}
        return {
            "rows_sha256": fingerprint(self.rows),
            "recording_sha256": fingerprint(self.recording),
            "system_sha256": hashlib.sha256(self.system.to_json().encode()).hexdigest(),
            "splits": [split.to_dict() for split in self.splits],
            **{name: list(value) if isinstance(value, tuple) else value for name, value in given.items()},
        }


def fingerprint(dataset: Dataset) -> str:
    """SHA-256 of the joints, times and numbers of a Dataset."""
    digest = hashlib.sha256("\n".join(dataset.joint_names).encode())
    for name in ("q", "v", "u", "a", "time", "episode", "noise_std"):
        values = getattr(dataset, name)
        digest.update(name.encode() if values is None else np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()
