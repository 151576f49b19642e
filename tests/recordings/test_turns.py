"""Which angles wrap and which count turns: every way of logging a motion must give that motion back."""

import numpy as np
import pytest
from tests.recordings.log_files import JOINTS, motion, table, write_text

from forcegp.errors import DatasetError
from forcegp.recordings import ColumnMapping, ImportOptions, import_recordings
from forcegp.recordings.reading import TURN, turns_to_add

STEP, ROWS = 0.01, 400
TIME = STEP * np.arange(ROWS)
BEGINS = np.array([0])


def wrapped(q, turns=1):
    return (q + turns * np.pi) % (turns * TURN) - turns * np.pi


def turning(speed, start=0.3):
    """Positions and velocities [rad, rad/s] of a joint that reaches `speed` [rad per row] in the first second."""
    v = speed / STEP * np.minimum(TIME, 1.0)
    return start + np.concatenate([[0.0], np.cumsum(0.5 * STEP * (v[1:] + v[:-1]))]), v


LOGGED = {
    "slow, wraps": (turning(0.05), wrapped),
    "slow, wraps at two turns": (turning(0.15), lambda q: wrapped(q, 2)),
    "1.4 rad a row, wraps": (turning(1.4), wrapped),
    "backwards, wraps": (turning(-0.4), wrapped),
    "4 rad a row, counts": (turning(4.0), lambda q: q),
    "6 rad a row, counts": (turning(6.0), lambda q: q),
    "-5 rad a row, counts": (turning(-5.0), lambda q: q),
    "two turns lost in a row": (turning(0.05), lambda q: q - 2 * TURN * (TIME > 2.005)),
}


@pytest.mark.parametrize("with_velocity", [True, False])
@pytest.mark.parametrize("logged", LOGGED.values(), ids=LOGGED)
def test_the_motion_comes_back_whatever_was_logged(logged, with_velocity):
    (q, v), written = logged
    seen = written(q)
    turns, undecided = turns_to_add(seen, TIME, v if with_velocity else None, BEGINS)
    assert len(undecided) == 0
    np.testing.assert_allclose(seen + TURN * turns - seen[0], q - q[0], atol=1e-9)


def test_noise_where_an_angle_wraps_is_no_turn():
    q = np.pi + 0.02 * np.random.default_rng(1).standard_normal(ROWS)
    turns, undecided = turns_to_add(wrapped(q), TIME, None, BEGINS)
    assert len(undecided) == 0
    assert np.ptp(wrapped(q) + TURN * turns) < 0.2


def test_a_fast_wrapping_joint_is_found_by_its_velocity_alone():
    q, v = turning(2.5)
    turns, undecided = turns_to_add(wrapped(q), TIME, v, BEGINS)
    assert len(undecided) == 0
    np.testing.assert_allclose(np.diff(wrapped(q) + TURN * turns), np.diff(q), atol=1e-9)


def test_velocities_that_are_none_decide_nothing():
    q, v = turning(5.0)
    for useless in (np.zeros(ROWS), np.rad2deg(v), -v):
        turns, undecided = turns_to_add(q, TIME, useless, BEGINS)
        assert not turns.any()
        assert len(undecided) == 0


def test_an_outlier_is_refused_with_its_rows():
    q = 0.3 * np.sin(TIME)
    q[200] += 3.6
    turns, undecided = turns_to_add(q, TIME, None, BEGINS)
    assert not turns.any()
    np.testing.assert_array_equal(undecided, [200, 201])


def test_pauses_and_other_episodes_decide_nothing():
    """A joint that counts and moved 4 rad in a pause, and one that begins elsewhere in another episode."""
    time = TIME + 3.0 * (np.arange(ROWS) >= 200)
    q, _ = turning(4.0)
    moved = q + 2.0 * TURN * (np.arange(ROWS) >= 200) + 1.9
    turns, undecided = turns_to_add(moved, time, None, BEGINS)
    assert not turns.any()
    assert len(undecided) == 0
    q, _ = turning(0.05)
    other = np.where(np.arange(ROWS) < 200, wrapped(q), wrapped(q + 3.0))
    turns, undecided = turns_to_add(other, TIME, None, np.array([0, 200]))
    assert len(undecided) == 0
    for part in (slice(0, 200), slice(200, None)):
        np.testing.assert_allclose(np.diff((other + TURN * turns)[part]), np.diff(q[part]), atol=1e-9)


def test_import_continues_what_wraps_and_leaves_what_counts(tmp_path):
    """One log with both, whose first joint is read again from the spool and written back."""
    data = motion()
    time = data["time"]
    data["q"] = np.stack([wrapped(9.0 * time / time[-1]), 4.0 * np.arange(len(time))], axis=1)
    path = write_text(tmp_path / "log.csv", {name: x for name, x in table(data).items() if not name.startswith("v_")})
    columns = {"q": ("q_{joints}",), "v": ("derive{1..2}",), "u": ("u_{joints}",)}
    mapping = ColumnMapping(time="time", joints=JOINTS, unit={"q": ("rad",)}, **columns)
    found = import_recordings([path], mapping, options=ImportOptions(unwrap=True))
    np.testing.assert_allclose(found.q[:, 0], 9.0 * time / time[-1], atol=1e-12)
    np.testing.assert_array_equal(found.q[:, 1], data["q"][:, 1])
    [note] = found.metadata["import"]["recordings"][0]["notes"]
    assert "counts turns" in note
    data["q"][100, 1] += 20.0
    path = write_text(tmp_path / "odd.csv", {name: x for name, x in table(data).items() if not name.startswith("v_")})
    with pytest.raises(DatasetError, match=r"nothing shows whether it wraps.*`v`"):
        import_recordings([path], mapping, options=ImportOptions(unwrap=True))
