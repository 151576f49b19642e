"""Regions of the extrapolation: where the tool is and how fast, by Pinocchio and by differences along the motion."""

from dataclasses import replace

import numpy as np
import pytest
from tests.experiments.oracle import Tool

from forcegp.errors import InvalidInput
from forcegp.experiments.extrapolation_jobs import REGIONS, TEST_X, TRAIN_X, split_by_region, tool_motion


@pytest.fixture(scope="module")
def both_sides(motion):
    """The motion, every third row turned about the base's vertical axis, so that the tool is everywhere on the table.

    Two datasets as from two trajectories: neither speeds nor contact change under the turn.
    """
    turn = np.where(np.arange(len(motion)) % 3 == 0, 1.2, np.where(np.arange(len(motion)) % 3 == 1, -0.8, 0.0))
    q = motion.q.copy()
    q[:, 0] += turn
    turned = replace(motion, q=q, truth={})
    return turned.rows(slice(0, None, 2)), turned.rows(slice(1, None, 2))


def test_position_and_speed_are_those_of_the_contact_point(motion):
    tool = Tool(motion.system)
    x, speed = tool_motion(motion)
    rows = range(0, len(motion), 7)
    np.testing.assert_allclose(x[::7], [tool.position(motion.q[k])[0] for k in rows], rtol=0, atol=1e-12)
    np.testing.assert_allclose(speed[::7], [tool.speed(motion.q[k], motion.v[k]) for k in rows], rtol=0, atol=1e-8)


def test_the_speed_is_that_of_the_recorded_motion(motion):
    tool = Tool(motion.system)
    path = np.array([tool.position(q) for q in motion.q])
    _, speed = tool_motion(motion)
    moved = np.linalg.norm(np.diff(path, axis=0), axis=1) / np.diff(motion.time)
    # Row k + 1 is reached with the velocity of row k + 1, over a step in which the Jacobian changes a little.
    np.testing.assert_allclose(moved, speed[1:], rtol=0.02, atol=1e-3)
    assert speed.max() > 0.5


@pytest.mark.parametrize("region", REGIONS)
def test_regions_are_disjoint_and_as_they_say(both_sides, region):
    train, test = both_sides
    parts = split_by_region(train, test, region)
    tool = Tool(train.system)

    def measured(dataset):
        x = np.array([tool.position(q)[0] for q in dataset.q])
        return x, np.array([tool.speed(q, v) for q, v in zip(dataset.q, dataset.v, strict=True)])

    (train_x, train_speed), (test_x, test_speed) = measured(train), measured(test)
    limit = np.median(train_speed) if region == "place-and-speed" else np.inf
    wanted = {
        "train": (train, (train_x < TRAIN_X) & (train_speed <= limit)),
        "inside": (test, (test_x < TRAIN_X) & (test_speed <= limit)),
        "outside": (test, (test_x > TEST_X) & ((test_speed > limit) | np.isinf(limit))),
    }
    assert set(parts) == set(wanted)
    for name, (dataset, where) in wanted.items():
        assert 0 < where.sum() < len(dataset)
        np.testing.assert_array_equal(parts[name].time, dataset.time[where])
        np.testing.assert_array_equal(parts[name].q, dataset.q[where])
    assert not set(parts["inside"].time) & set(parts["outside"].time)
    assert measured(parts["train"])[0].max() + TEST_X <= measured(parts["outside"])[0].min() + TRAIN_X
    if region == "place-and-speed":
        assert measured(parts["train"])[1].max() <= limit < measured(parts["outside"])[1].min()


def test_an_empty_region_is_named(both_sides, motion):
    train, _ = both_sides
    with pytest.raises(InvalidInput, match=r"'place'.*longer"):
        split_by_region(train, motion, "place")


def test_a_dataset_without_contact_has_no_tool(motion):
    with pytest.raises(InvalidInput, match="no contact, so there is no tool"):
        tool_motion(replace(motion, system=motion.system.with_contacts([]), truth={}))
