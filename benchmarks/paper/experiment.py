"""What every experiment is: a typed configuration with its jobs, its summary, its figures and its text."""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from matplotlib.figure import Figure

from forcegp.errors import InvalidInput
from forcegp.jobs import Job, JobStore
from forcegp.scores.accuracy import median_and_range

Row = dict[str, str | int | float | None]
SIMULATION_COST = 0.1  # CPU seconds per simulated second, about


@dataclass(frozen=True)
class DataSettings:
    """Trajectories of `kuka-surface`: `rows` training rows, in the order of farthest-point sampling, and a test one.

    A model that is trained on N points takes the first N rows, as in the paper. The test trajectory is kept whole (for
    roll-outs); of its rows every `every`-th is scored.
    """

    train_seconds: float
    rows: int
    test_seconds: float
    every: int

    def job(self, seed: int) -> Job:
        """The job with the trajectories of this seed."""
        seconds = self.train_seconds + self.test_seconds
        cost = SIMULATION_COST * seconds + 2e-5 * self.rows * self.train_seconds
        spec = {"seed": seed, **dataclasses.asdict(self)}
        return Job(f"data/seed{seed}", "benchmarks.paper.data:simulate", spec, cost=cost)


@dataclass(frozen=True)
class Experiment(ABC):
    """A frozen dataclass whose fields are the configuration; among them `data` and `points`, one number or several."""

    name: ClassVar[str]
    title: ClassVar[str]

    data: DataSettings
    points: Any

    def with_points(self, points: Sequence[int]) -> "Experiment":
        """The same with other numbers of training points; an experiment at one number takes the largest."""
        given = tuple(sorted(set(points)))
        return dataclasses.replace(self, points=given[-1] if isinstance(self.points, int) else given)

    def with_seeds(self, seeds: Sequence[int]) -> "Experiment":
        """The same on other trajectories."""
        given = tuple(dict.fromkeys(seeds))
        changed = {"seed": given[0], "seeds": given, "seeds_many_points": given}
        names = {field.name for field in dataclasses.fields(self)}
        return dataclasses.replace(self, **{name: value for name, value in changed.items() if name in names})

    def require_possible(self) -> None:
        """Raise InvalidInput for numbers of points that the data do not have."""
        points = (self.points,) if isinstance(self.points, int) else self.points
        for count in points:
            if not 2 <= count <= self.data.rows:
                raise InvalidInput(
                    f"{self.name} is asked for {count} training points; its data have {self.data.rows} rows, so give "
                    f"2 to {self.data.rows}."
                )

    @abstractmethod
    def jobs(self) -> list[Job]:
        """Everything that has to be computed, with the jobs that several experiments share."""

    @abstractmethod
    def summary(self, results: JobStore) -> dict[str, Any]:
        """The results of the finished jobs, as plain JSON values."""

    @abstractmethod
    def rows(self, summary: Mapping[str, Any]) -> list[Row]:
        """The summary as a flat table, for CSV."""

    def figures(self, summary: Mapping[str, Any], results: JobStore) -> dict[str, Figure]:
        """File name without ending -> figure; none by default."""
        return {}

    @abstractmethod
    def section(self, summary: Mapping[str, Any]) -> str:
        """Markdown for docs/paper/reproduction.md, without title and pictures; every number comes from the summary."""


def medians(results: Sequence[Mapping[str, Any]], names: Iterable[str]) -> dict[str, Any]:
    """`median_and_range` of these entries over results; None for an entry that a result lacks."""
    return {name: median_and_range(each.get(name) for each in results) for name in names}


def in_columns(scores: Mapping[str, Mapping[str, Any] | None]) -> dict[str, float | None]:
    """`NAME_median`, `NAME_min` and `NAME_max` of every score, for a flat table."""
    return {
        f"{name}_{part}": None if score is None else score[part]
        for name, score in scores.items()
        for part in ("median", "min", "max")
    }


def stored_arrays(results: JobStore, job: str, file: str) -> dict[str, np.ndarray]:
    """The arrays that a job kept in an npz file."""
    with np.load(results.place(job) / file) as stored:
        return dict(stored)
