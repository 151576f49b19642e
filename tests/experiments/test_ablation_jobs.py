"""The ablation: filtered training data, and test rows seen before."""

from dataclasses import replace

import numpy as np
import pytest
from tests.experiments.stored_jobs import DATA, keep

from forcegp.data import farthest_rows, zero_phase_low_pass
from forcegp.experiments import ablation_jobs
from forcegp.experiments.fits import MODEL
from forcegp.inference import OptimizerOptions
from forcegp.models import Noise, StructuredGP, save_posterior

OPTIONS = {"iterations": 3, "tolerance": 1e-6}


@pytest.mark.parametrize("cutoff", [None, 25.0])
def test_a_filter_acts_on_the_training_accelerations_alone(run, motion, tmp_path, cutoff):
    spec = {"data": DATA, "seed": 1, "train_seconds": 2, "model": "s-gp-mean", "points": 15, "cutoff": cutoff}
    found = ablation_jobs.filtered(run, {**spec, **OPTIONS}, tmp_path)["evaluation"]
    data = motion
    if cutoff is not None:
        data = replace(motion, a=zero_phase_low_pass(motion.a, 240.0, cutoff), noise_std=None)
    model = StructuredGP(motion.system, noise=Noise(0.1, learn=True))
    posterior = model.fit(farthest_rows(data, 15), restarts=1, seed=1, options=OptimizerOptions(**OPTIONS))
    test = motion.rows(slice(None, None, 4))
    mean = posterior.predict(test.q, test.v, test.u, covariance=False).mean.numpy()
    assert found["mae"] == pytest.approx(float(np.abs(mean - test.a).mean()), rel=1e-6)


def test_the_window_counts_the_rows_that_were_trained_on(run, motion, tmp_path):
    chosen = [*range(0, 60, 3), *range(1, 61, 3)]  # twenty of the window, which takes every third row, and twenty not
    train = motion.rows(chosen)
    posterior = StructuredGP(motion.system).fit(train, restarts=1, options=OptimizerOptions(iterations=0))
    keep(run, "fits/overlap", {}, {}, lambda folder: save_posterior(posterior, folder / MODEL))
    spec = {"seed": 1, "train_seconds": 2, "fit": "fits/overlap"}
    found = ablation_jobs.overlap(run, spec, tmp_path)
    assert found["shared"] == pytest.approx(20 / 160)
    window = motion.rows(slice(0, None, 3))
    mean = posterior.predict(window.q, window.v, window.u, covariance=False).mean.numpy()
    assert found["mae"] == pytest.approx(float(np.abs(mean - window.a).mean()), rel=1e-6)
    assert found["mae_noise_free"] == pytest.approx(float(np.abs(mean - window.truth["a"]).mean()), rel=1e-6)
