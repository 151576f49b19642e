"""The data of the experiments: trajectories of `kuka-surface`, thinned by farthest-point sampling, kept as jobs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from forcegp.data import Dataset, farthest_rows
from forcegp.errors import InvalidInput
from forcegp.jobs import JobStore
from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface

TRAIN, TEST = "train.h5", "test.h5"
TEST_SEED = 1000  # the test trajectory of seed k has seed k + 1000: other way-points, another noise


def simulated(seed: int, seconds: float, **scenario: Any) -> Dataset:
    """One trajectory of `kuka-surface`."""
    return simulate_kuka_surface(KukaSurfaceConfig(seconds=seconds, seed=seed, **scenario))


def farthest(usable: Dataset, rows: int, seconds: float) -> Dataset:
    """So many rows that lie far apart. Raises InvalidInput where there are fewer."""
    if rows > len(usable):
        raise InvalidInput(
            f"{rows} training points are asked for, but {seconds:g} s of motion have {len(usable)} rows; ask for fewer "
            "points or a longer recording."
        )
    return farthest_rows(usable, rows)


def simulate(results: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Simulate both trajectories and keep them. Raises InvalidInput where more rows are wanted than there are."""
    everything = simulated(spec["seed"], spec["train_seconds"])
    train = farthest(everything, spec["rows"], spec["train_seconds"])
    test = simulated(TEST_SEED + spec["seed"], spec["test_seconds"])
    train.save(folder / TRAIN)
    test.save(folder / TEST)
    return {"train_rows_available": len(everything), "train_rows": len(train), "test_rows": len(test)}


def training_rows(results: JobStore, data: str, points: int | None) -> Dataset:
    """The first `points` rows of a data job, or all. Raises InvalidInput if there are fewer."""
    train = Dataset.load(results.place(data) / TRAIN)
    if points is None:
        return train
    if points > len(train):
        raise InvalidInput(f"{points} training points are asked for, but {data} has {len(train)}.")
    return train.rows(slice(points))


def test_trajectory(results: JobStore, data: str) -> Dataset:
    """The whole test trajectory of a data job, in the order of time."""
    return Dataset.load(results.place(data) / TEST)


def scored_rows(results: JobStore, data: str) -> Dataset:
    """The rows of the test trajectory that scores are computed from."""
    return test_trajectory(results, data).rows(slice(None, None, results.load(data)["spec"]["every"]))
