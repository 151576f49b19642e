"""Rows in stretches of time."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from tests.data.samples import dataset

from forcegp.data import farthest_rows, time_blocks
from forcegp.data.views import all_motions


def test_rows_of_one_stretch_and_episode_form_a_block_in_order_of_time():
    time = np.array([5.0, 5.9, 7.1, 6.2, 5.0, 9.9])
    episode = np.array([0, 0, 0, 0, 3, 3])
    assert time_blocks(time, episode, 1.0) == ((0, 1), (3,), (2,), (4,), (5,))
    assert time_blocks(time, episode, 100.0) == ((0, 1, 3, 2), (4, 5))


@given(st.integers(2, 40), st.integers(0, 100), st.floats(0.005, 1.0))
def test_every_row_is_in_one_block_that_is_no_longer_than_said(count, seed, seconds):
    rows = farthest_rows(dataset(40, seed=seed), count)
    blocks = time_blocks(rows.time, rows.episode, seconds)
    assert sorted(row for block in blocks for row in block) == list(range(count))
    for block in blocks:
        chosen = list(block)
        assert len(set(rows.episode[chosen])) == 1
        assert np.ptp(rows.time[chosen]) <= seconds * (1.0 + 1e-12)
        assert (np.diff(rows.time[chosen]) > 0).all()


def test_motions_of_equal_steps_lie_in_one_episode_and_cross_no_gap():
    recorded, stride = all_motions(dataset(40).rows(np.delete(np.arange(40), 26)), 0.06, 0.02)
    assert recorded.rows == (0, 6, 12, 26, 32)  # of 20 rows and of 19; 20 to 26 has the gap
    assert (round(recorded.dt, 9), stride) == (0.01, 2)
