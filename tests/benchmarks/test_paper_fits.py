"""How settings depend on the number of points, and that a series begins where the fit before it ended."""

import json

import pytest
from benchmarks.paper.fits import MODELS, FitSettings, fit_series, fitted

from forcegp.data import farthest_rows

SETTINGS = FitSettings(restarts={"0": 4, "200": 2, "1000": 1}, iterations=50, tolerance={"0": 1e-6, "400": 1e-5})


@pytest.mark.parametrize(
    ("points", "restarts", "tolerance"),
    [(1, 4, 1e-6), (199, 4, 1e-6), (200, 2, 1e-6), (400, 2, 1e-5), (999, 2, 1e-5), (1000, 1, 1e-5), (5000, 1, 1e-5)],
)
def test_the_largest_key_that_does_not_exceed_the_points_counts(points, restarts, tolerance):
    assert SETTINGS.of(points) == {"restarts": restarts, "iterations": 50, "tolerance": tolerance}
    assert json.loads(json.dumps(SETTINGS.of(points))) == SETTINGS.of(points)


def test_a_series_begins_where_the_fit_with_fewer_points_ended():
    jobs = fit_series("s-gp", "data/seed3", 3, [400, 100, 200], SETTINGS)
    assert [job.spec["points"] for job in jobs] == [100, 200, 400]
    assert [job.spec["start"] for job in jobs] == [None, jobs[0].name, jobs[1].name]
    assert [job.spec["restarts"] for job in jobs] == [4, 2, 2]
    assert jobs[0].inputs == ("data/seed3",)
    assert all(job.inputs == ("data/seed3", job.spec["start"]) for job in jobs[1:])
    assert all(job.spec["seed"] == 3 for job in jobs)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("model", sorted(MODELS))
def test_every_model_of_the_experiments_can_be_fitted(motion, model):
    """A few steps each: once a change of `fit` stopped one without a test."""
    rows, search = farthest_rows(motion, 20), {"restarts": 1, "iterations": 2, "tolerance": 1e-2}
    posterior = fitted({"model": model, "seed": 0, **search}, rows)
    assert posterior.predict(motion.q[:2], motion.v[:2], motion.u[:2]).mean.shape == (2, 7)
