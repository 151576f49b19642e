"""Views of a log."""

import numpy as np
from tests.data.samples import dataset

from forcegp.data.views import all_motions


def test_motions_of_equal_steps_lie_in_one_episode_and_cross_no_gap():
    recorded, stride = all_motions(dataset(40).rows(np.delete(np.arange(40), 26)), 0.06, 0.02)
    assert recorded.rows == (0, 6, 12, 26, 32)  # of 20 rows and of 19; 20 to 26 has the gap
    assert (round(recorded.dt, 9), stride) == (0.01, 2)
