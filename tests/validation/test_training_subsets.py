"""Points for every seed: far apart, from the training rows, and other ones for another seed."""

import numpy as np
import pytest
from tests.posterior.arm import arm_data

from forcegp.errors import InvalidInput
from forcegp.validation import training_subset


def rows_of(data) -> set[float]:
    return set(data.time.tolist())


def test_seeds_choose_other_rows_and_repeat_themselves():
    train = arm_data(90, seed=0)
    chosen = [training_subset(train, 30, seed) for seed in range(4)]
    for subset in chosen:
        assert len(subset) == 30
        assert rows_of(subset) <= rows_of(train)
    assert rows_of(training_subset(train, 30, 2)) == rows_of(chosen[2])
    shared = [len(rows_of(a) & rows_of(b)) for i, a in enumerate(chosen) for b in chosen[:i]]
    assert max(shared) < 27, "seeds would hardly differ"


def test_they_lie_farther_apart_than_rows_drawn_at_random():
    train = arm_data(300, seed=1)

    def nearest(data) -> float:
        x = np.hstack([data.q, data.v, data.u])
        x = x / np.hstack([train.q, train.v, train.u]).std(0)
        distance = np.linalg.norm(x[:, None] - x, axis=-1) + 1e9 * np.eye(len(x))
        return float(distance.min(axis=1).mean())

    random = train.rows(np.random.default_rng(0).choice(300, 40, replace=False))
    assert nearest(training_subset(train, 40, 0)) > 1.2 * nearest(random)


@pytest.mark.parametrize("points", [1, 61])
def test_too_many_points_are_refused(points):
    with pytest.raises(InvalidInput, match="from 2 to 60, two thirds"):
        training_subset(arm_data(90, seed=0), points, 0)
