"""Views of a log."""

import numpy as np
from tests.data.samples import dataset

from forcegp.data.views import all_motions, repeated_rows


def test_motions_of_equal_steps_lie_in_one_episode_and_cross_no_gap():
    recorded, stride = all_motions(dataset(40).rows(np.delete(np.arange(40), 26)), 0.06, 0.02)
    assert recorded.rows == (0, 6, 12, 26, 32)  # of 20 rows and of 19; 20 to 26 has the gap
    assert (round(recorded.dt, 9), stride) == (0.01, 2)


def test_rows_in_both_are_found_whatever_the_sign_of_a_zero():
    data = dataset(16)
    known = data.rows(slice(0, 8))
    assert repeated_rows((known.q, known.v, known.u), data.rows([12, 13, 5])).tolist() == [2]
    zeros = {name: np.zeros((1, 2)) for name in ("q", "v", "u", "a")}
    one, other = dataset(1, **zeros), dataset(1, **{name: -values for name, values in zeros.items()})
    assert repeated_rows((one.q, one.v, one.u), other).tolist() == [0]
