"""One comparison: what is compared on what."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np

from forcegp.analytical import NoiseLevels, held_out_noise, identify_analytical
from forcegp.analytical.joint_terms import LAWS
from forcegp.data import Dataset, farthest_rows
from forcegp.data.dataset_arguments import require_rows
from forcegp.errors import InvalidInput, require_type
from forcegp.integration import integrator_named
from forcegp.mechanics import MechanicalSystem
from forcegp.models import Noise
from forcegp.validation.scores import HORIZONS, STARTS, HeldOutMotions, held_out_motions
from forcegp.validation.splits import Split

SHARE = 2 / 3
"""Of the training rows among which the points of one seed are chosen."""


def training_subset(train: Dataset, points: int, seed: int) -> Dataset:
    """`points` rows that lie far apart in (q, v, u) among two thirds of the rows, which `seed` draws at random.

    Farthest-point sampling of all rows begins with the same extremes whatever row it starts at, so seeds would hardly
    differ. Among a random two thirds they do, and each choice still covers the states.
    Raises InvalidInput where two thirds of the rows are fewer than `points`.
    """
    if seed < 0:
        raise InvalidInput(f"seed is {seed}; it must be at least 0.")
    among = int(np.ceil(SHARE * len(train)))
    if not 2 <= points <= among:
        raise InvalidInput(
            f"points is {points}; with {len(train)} training rows it must be from 2 to {among}, two thirds of them."
        )
    generator = np.random.default_rng(seed)
    drawn = np.sort(generator.choice(len(train), size=among, replace=False))
    return farthest_rows(train.rows(drawn), points, start=int(generator.integers(among)))


@dataclass(frozen=True)
class Identification:
    """One way to identify a system.

    Fields
    ------
    summary: how, as a part of a sentence.
    identify: (given system, training rows, friction laws) -> identified system.
    all_rows: from all training rows, not from those few that every model learns from.
    noise: (given system, training rows, friction laws) -> the noise about it, for models that rest on it; None where
        these learn theirs.
    """

    summary: str
    identify: Callable[[MechanicalSystem, Dataset, Sequence[str]], MechanicalSystem]
    all_rows: bool = False
    noise: Callable[[MechanicalSystem, Dataset, Sequence[str]], NoiseLevels] | None = None


def _identified(system: MechanicalSystem, rows: Dataset, friction: Sequence[str], **how: Any) -> MechanicalSystem:
    return identify_analytical(rows, system, friction=friction, **how).system


def _noise(system: MechanicalSystem, rows: Dataset, friction: Sequence[str], **how: Any) -> NoiseLevels:
    return held_out_noise(rows, system, friction=friction, **how)


def _consistent(likelihood: str, rows: str, all_rows: bool) -> Identification:
    how = {"inertias": "consistent", "likelihood": likelihood}
    method = {
        "torque": "least squares of joint forces",
        "acceleration": "maximum likelihood of accelerations",
        "both": "regression with noise of forces and of accelerations",
    }
    summary = f"{method[likelihood]}{rows}, physically consistent"
    noise = partial(_noise, **how) if all_rows else None
    return Identification(summary, partial(_identified, **how), all_rows, noise)


IDENTIFICATIONS: dict[str, Identification] = {
    "least-squares": Identification(
        "ordinary least squares of joint forces, whose inertias need not belong to a body",
        partial(_identified, inertias="free", likelihood="torque"),
    ),
    "torque": _consistent("torque", "", False),
    "acceleration": _consistent("acceleration", "", False),
    "both": _consistent("both", "", False),
    "torque-all": _consistent("torque", " of ALL training rows", True),
    "acceleration-all": _consistent("acceleration", " of ALL training rows", True),
    "both-all": _consistent("both", " of ALL training rows", True),
}
"""By name. Add your own: IDENTIFICATIONS["mine"] = Identification("how", identify_mine)."""

LAWS_AFTER = ":"  # between the name of an identification and laws of its own, in the place of those of the comparison


def identification_named(name: str) -> Identification:
    """The entry of `IDENTIFICATIONS` with that name; `acceleration-all:viscous,load` with friction laws of its own.

    Raises InvalidInput for names and laws that do not exist.
    """
    base, colon, words = name.partition(LAWS_AFTER)
    found, laws = IDENTIFICATIONS.get(base), tuple(words.split(","))
    if found is None or (colon and not set(laws) <= set(LAWS)):
        raise InvalidInput(
            f"no identification is called {name!r}; there are {', '.join(IDENTIFICATIONS)}, each with friction laws of "
            f"its own as in acceleration-all:viscous,coulomb (out of {', '.join(LAWS)})."
        )
    if not colon:
        return found
    noise = None if found.noise is None else partial(_with_laws, found.noise, laws)
    summary = f"{found.summary} (friction {', '.join(laws)})"
    return replace(found, summary=summary, identify=partial(_with_laws, found.identify, laws), noise=noise)


def _with_laws(
    function: Callable[..., Any], laws: Sequence[str], system: MechanicalSystem, rows: Dataset, _: Sequence[str]
) -> Any:
    return function(system, rows, laws)


FRICTION = ("viscous", "coulomb")
"""Laws that are identified where nothing else is asked for."""

DEFAULT_IDENTIFICATION = "auto"
"""What `@identified` and the mass matrix of force errors take: acceleration-all, or both-all where the base moves."""


def resolved_identification(name: str, system: MechanicalSystem) -> str:
    """The name, or that of this robot for "auto"."""
    if name != DEFAULT_IDENTIFICATION:
        return name
    return "acceleration-all" if system.robot.space.is_vector_space else "both-all"


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
    identification: what `@identified` and the mass matrix of force errors take, see `identification_named` and
        `resolved_identification`.
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
        object.__setattr__(self, "identification", resolved_identification(self.identification, self.system))
        names = tuple(self.system.robot.joint_names)
        for what, dataset in (("rows", self.rows), ("recording", self.recording)):
            require_rows(what, dataset, names, "the robot")
        for name in ("restarts", "iterations"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InvalidInput(f"{name} is {value}; it must be at least 1.")
        Noise(None, self.force_noise)
        integrator_named(self.integrator, self.system)
        chosen = identification_named(self.identification)
        if self.measured_torque and self.force_noise is None and chosen.noise is None:
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

    @property
    def search(self) -> tuple[int | None, int | None, float | None, bool]:
        """What `Training` takes of the search and the noise of forces, in its order."""
        return self.restarts, self.iterations, self.force_noise, self.measured_torque

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
