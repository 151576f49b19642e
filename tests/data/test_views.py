"""Views of a log."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from tests.data.samples import dataset

from forcegp.data import views
from forcegp.data.views import postures, rests
from forcegp.errors import InvalidInput


def test_motions_of_equal_steps_lie_in_one_episode_and_cross_no_gap():
    recorded, stride = views.all_motions(dataset(40).rows(np.delete(np.arange(40), 26)), 0.06, 0.02)
    assert recorded.rows == (0, 6, 12, 26, 32)  # of 20 rows and of 19; 20 to 26 has the gap
    assert (round(recorded.dt, 9), stride) == (0.01, 2)


def test_rows_in_both_are_found_whatever_the_sign_of_a_zero():
    data = dataset(16)
    known = data.rows(slice(0, 8))
    assert views.repeated_rows((known.q, known.v, known.u), data.rows([12, 13, 5])).tolist() == [2]
    zeros = {name: np.zeros((1, 2)) for name in ("q", "v", "u", "a")}
    one, other = dataset(1, **zeros), dataset(1, **{name: -values for name, values in zeros.items()})
    assert views.repeated_rows((one.q, one.v, one.u), other).tolist() == [0]


def test_recorded_motions_are_spread_over_the_log_and_hold_u_of_each_row():
    log = dataset(40)
    for starts in (5, (0, 7, 14, 27, 34)):  # motions of 5 steps begin at rows 0 to 14 and 20 to 34
        found = views.recorded_motions(log, starts, 0.05)
        assert found.rows == (0, 7, 14, 27, 34)
        for k, row in enumerate(found.rows):
            for name, end in (("q", 6), ("v", 6), ("u", 5)):
                assert_array_equal(getattr(found, name)[k], getattr(log, name)[row : row + end])
    assert views.recorded_motions(log.rows(np.delete(np.arange(40), 26)), 20, 0.1).rows[-4:] == (9, 26, 27, 28)
    late = 3e-3 * (np.arange(40) > 9)
    for starts, seconds, changed, words in (
        ((15,), 0.05, log, "no motion of 0.05 s begins at row 15 of the 40 rows"),
        (5, 0.004, log, "at least one step of the recording, 0.01 s"),
        (5, 0.2, log, "no episode lasts 0.2 s: the longest has 0.19 s"),
        ((8,), 0.05, replace(log, time=log.time + late), r"0.013 s after row 9, 0.01 s elsewhere"),
        (5, 0.05, replace(log, time_ordered=False), "not in the order of time"),
    ):
        with pytest.raises(InvalidInput, match=words):
            views.recorded_motions(changed, starts, seconds)


@pytest.mark.parametrize(
    ("lasts", "creeps", "found"),
    [(0.25, 0.0, 0), (0.35, 0.0, 4), (0.35, 0.02, 4), (0.35, 0.04, 0), (5.0, 0.015, 4), (5.0, 0.025, 0)],
)
def test_joints_rest_for_a_third_of_a_second_within_a_thousandth_of_their_range(lasts, creeps, found):
    """The second joint idles: a tenth of the largest range counts for it. Rows of motion belong to the next rest."""
    time = np.arange(0.0, 4.0 * (lasts + 0.5), 0.01)
    place, since = np.divmod(time, lasts + 0.5)
    q = 2.5 * (place + np.clip((since - lasts) / 0.5, 0.0, 1.0)) + creeps * (lasts * place + np.minimum(since, lasts))
    log = dataset(len(time), q=np.stack([q, 1e-4 * np.sin(time)], axis=1), episode=np.zeros(len(time), int), time=time)
    assert len(rests(log)) == found
    for k, rows in enumerate(rests(log)):
        begins = k * (lasts + 0.5)
        assert time[rows[[0, -1]]] == pytest.approx([begins, begins + lasts], abs=0.02)
    numbers = postures(log)
    if found:
        assert_array_equal(numbers, np.minimum(np.searchsorted([r[-1] for r in rests(log)], np.arange(len(q))), 3))
    assert (numbers is None) == (not found)
    assert views.rests_alone(log) is None  # of .5 s of motion between two rests each


@pytest.mark.parametrize("width", [1, 4])
def test_white_noise_is_seen_beside_motion_and_not_in_it(width):
    time, rng = 0.01 * np.arange(4000), np.random.default_rng(0)
    smooth = np.stack([np.sin(3.0 * time), np.cos(2.0 * time)], axis=1)
    log = dataset(4000, a=smooth + [0.2, 0.05] * rng.standard_normal((4000, 2)), u=smooth, episode=np.zeros(4000, int))
    np.testing.assert_allclose(views.white_noise(log, width), np.array([0.2, 0.05]) / width**0.5, rtol=0.08)
    assert np.isnan(views.white_noise(log, width, "u")).all()
    few = 30 + 5 * width - 1
    assert views.white_noise(log.rows(slice(0, few)), width) is not None
    assert views.white_noise(log.rows(slice(0, few - 1)), width) is None


@pytest.mark.parametrize(("postures", "moves"), [(3, 0.0), (2, 0.0), (3, 0.05)])
def test_a_log_of_postures_alone_becomes_the_median_of_each(postures, moves):
    rng, episode = np.random.default_rng(0), np.repeat(np.arange(postures), 9)
    q = np.array([[0.0, 1.0], [0.5, -1.0], [1.0, 0.2]])[episode] + moves * rng.standard_normal((len(episode), 2))
    log = dataset(len(episode), q=q, u=rng.standard_normal((len(episode), 2)), episode=episode)
    found = views.one_row_per_rest(log)
    assert len(found) == (3 if postures == 3 and not moves else len(log))
    if len(found) == 3:
        assert_array_equal(np.c_[found.q, found.v], np.c_[q[::9], 0.0 * q[::9]])
        assert_array_equal(found.u, np.median(log.u.reshape(3, 9, 2), axis=1))
