"""Rows of filtered logs repeat their neighbours: noise is learned from those that do not."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d
from tests.posterior.arm import arm_model
from torch import tensor

from forcegp import Dataset, JointForces, fit
from forcegp.data import LowPass
from forcegp.errors import DataWarning
from forcegp.fit.refinement import independent_rows
from forcegp.inference import OptimizerOptions
from forcegp.noise import Noise

QUICK = OptimizerOptions(iterations=2)
SAID = pytest.mark.filterwarnings("ignore::forcegp.errors.DataWarning")
CUTOFF = 4.0  # Hz, so that rows within .081 s are alike


def filtered(rows: int = 480, seed: int = 0, cutoff: float | None = CUTOFF) -> Dataset:
    """An arm without unknown forces whose accelerations have errors of .5 rad/s^2 that a filter has made smooth."""
    model, time, draw = arm_model(0), 0.01 * np.arange(rows), np.random.default_rng(seed)
    q, v, u = (gaussian_filter1d(draw.normal(size=(rows, 3)), 12.0, axis=0) * size for size in (3.0, 4.0, 8.0))
    a = model.dynamics(tensor(q), tensor(v), tensor(u)).acceleration(tensor(0.0 * q)).numpy()
    errors = gaussian_filter1d(draw.normal(size=(rows, 3)), 5.0, axis=0)
    metadata = {} if cutoff is None else {"preparation": {"cutoff": cutoff, "why": {}, "rows": {}}}
    return Dataset(q=q, v=v, u=u, a=a + 0.5 * errors / errors.std(axis=0), time=time, model=model, metadata=metadata)


@SAID
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 3))
def test_kept_rows_lie_apart_and_every_other_row_is_near_an_earlier_one(seed, episodes):
    draw, whole = np.random.default_rng(seed), filtered(200)
    some = replace(whole, time_ordered=False).rows(draw.permutation(200))
    log = replace(some, episode=draw.integers(0, episodes, 200))
    kept, apart = independent_rows(log), LowPass(CUTOFF).memory - 1e-9
    rows = [int(np.flatnonzero(log.time == time)[0]) for time in kept.time]
    near = (np.abs(log.time[:, None] - log.time) < apart) & (log.episode[:, None] == log.episode)
    assert near[np.ix_(rows, rows)].sum() == len(rows)
    for row in set(range(200)) - set(rows):
        assert any(near[row, other] and other < row for other in rows)
    assert independent_rows(filtered(200, cutoff=None)).time.tolist() == whole.time.tolist()


@SAID
def test_learned_noise_is_not_lost_in_smooth_errors():
    """Of the same rows, taken for independent, the functions interpolate the errors."""
    model = arm_model(0).with_forces(JointForces())
    found, alike = (fit(model, filtered(cutoff=each), points=120, restarts=1) for each in (CUTOFF, None))
    assert float(found.noise_std.min()) > 0.2
    assert float(alike.noise_std.max()) < 0.1
    assert len(found.training) == found.settings["points"] < 80
    assert len(alike.training) == 120


def test_rows_that_are_left_out_are_warned_of():
    model = arm_model(0).with_forces(JointForces(), noise=Noise(None, learn=True))
    quick = {"restarts": 1, "options": QUICK}
    with pytest.warns(DataWarning, match=r"0\.081 s away: .* of 200 rows are .*noise is learned from these"):
        fit(model, filtered(), points=200, **quick)
    with warnings.catch_warnings(action="error"):
        assert len(independent_rows(filtered(1000))) > 100
    with pytest.warns(DataWarning, match="too few, so all are taken, and learned noise may be none"):
        few = fit(model, filtered(60), points=50, **quick)
    assert few.settings["points"] == 50


@SAID
def test_all_rows_are_taken_where_no_number_is_given():
    """Hyper-parameters come from rows that lie apart; as many of these as are asked for."""
    posterior = fit(arm_model(0).with_forces(JointForces()), filtered(), restarts=1, options=QUICK, learning_points=25)
    assert posterior.settings["points"] == 480
    assert posterior.settings["learning_points"] == 25
