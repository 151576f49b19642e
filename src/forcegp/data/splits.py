"""Training and test data that share no trajectory.

Neighbouring rows of one motion are nearly equal: a random split of rows tests memory, not prediction. Splits are
therefore by episode, and `require_disjoint` refuses a pair that overlaps.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from forcegp.data.dataset import Dataset
from forcegp.errors import DatasetError, InvalidInput


def train_test_split(
    dataset: Dataset,
    *,
    test_episodes: Iterable[int] | None = None,
    test_fraction: float | None = None,
    seed: int | None = None,
) -> tuple[Dataset, Dataset]:
    """`(train, test)` of whole episodes: the ones named, or a fraction of them drawn by `seed`.

    A fraction is of the number of episodes, rounded, at least one on either side. Raises InvalidInput if not exactly
    one of `test_episodes` and `test_fraction` is given, if the fraction comes without a seed, or with fewer than two
    episodes.
    """
    if (test_episodes is None) == (test_fraction is None):
        raise InvalidInput("give either test_episodes or test_fraction.")
    if len(dataset.episodes) < 2:
        raise InvalidInput(
            "this Dataset has one episode; splitting inside it would test on the training trajectory. "
            "Record or simulate another one (another seed)."
        )
    if test_episodes is not None:
        return dataset.split_by_episode(test_episodes)
    if seed is None:
        raise InvalidInput("test_fraction draws episodes at random; give a seed.")
    assert test_fraction is not None
    if not 0 < test_fraction < 1:
        raise InvalidInput(f"test_fraction is {test_fraction}; it must be between 0 and 1, both excluded.")
    total = len(dataset.episodes)
    count = min(max(round(test_fraction * total), 1), total - 1)
    chosen = np.random.default_rng(seed).choice(dataset.episodes, size=count, replace=False)
    return dataset.split_by_episode(chosen.tolist())


def require_disjoint(train: Dataset, test: Dataset) -> None:
    """Refuse a pair of Datasets in which the test repeats the training.

    Raises DatasetError if a row `(q, v, u)` of `test` is also in `train`, or if both were simulated or recorded with
    the same `metadata` (same seed, same configuration) and share an episode: two samples of one trajectory.
    """
    if train.nv == test.nv:
        repeated = _common_rows(train, test)
        if repeated.size:
            raise DatasetError(
                f"{repeated.size} of {len(test)} test rows are also training rows (the first: test row {repeated[0]}). "
                "Test on another trajectory: another episode, recording or seed."
            )
    shared = sorted(set(train.episodes) & set(test.episodes))
    if train.metadata and train.metadata == test.metadata and shared:
        raise DatasetError(
            f"training and test rows come from the same trajectory: equal metadata, episodes {shared} in both. "
            "Test on another episode, recording or seed."
        )


def _common_rows(train: Dataset, test: Dataset) -> np.ndarray:
    def keys(data: Dataset) -> np.ndarray:
        inputs = (
            np.hstack([data.q, data.v, data.u]) + 0.0
        )  # + 0.0 turns -0.0 into 0.0, so that equal numbers have equal bytes
        return np.ascontiguousarray(inputs).view(np.dtype((np.void, inputs.itemsize * inputs.shape[1]))).ravel()

    return np.flatnonzero(np.isin(keys(test), keys(train)))
