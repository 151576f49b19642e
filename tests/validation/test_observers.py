"""Models with observers are scored with what the held-out rows before each one show, rows and motions alike."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.data.test_wind import pushed

from forcegp import AerodynamicForce, fit
from forcegp.posterior import observing
from forcegp.validation.scores import OBSERVED, acceleration_scores, held_out_motions, mass_matrices, motion_scores


@pytest.fixture(scope="module")
def posterior():
    train = pushed([(0.0, 0.0, 0.0)], rows=200, noise=0.02)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return fit(train.model.with_forces(AerodynamicForce(kernel="linear"), noise=0.02), train, points=60, restarts=1)


@pytest.fixture(scope="module")
def log():
    """Two stretches, each pushed another way."""
    return pushed([(0.0, 5.0, 0.0), (4.0, 0.0, 0.0)], rows=150, seed=5, noise=0.02)


def unobserved(posterior):
    blind = AerodynamicForce(kernel="linear", observe=0.0)
    return replace(posterior, trained=replace(posterior.trained, forces=(*posterior.trained.laws, blind)))


def test_rows_are_predicted_with_what_was_observed_before_them(posterior, log):
    mass = mass_matrices(log, log.model)
    (seen, notes), (blind, without) = (
        acceleration_scores(each, log, mass) for each in (posterior, unobserved(posterior))
    )
    assert OBSERVED in notes
    assert OBSERVED not in without
    assert max(seen["nrmse"][:2]) < 0.3 * max(blind["nrmse"][:2])
    assert len(seen["stretches"]["nlpd"]) == len(blind["stretches"]["nlpd"])  # no row is left out: models stay paired


def test_motions_begin_with_what_was_observed_before_them(posterior, log):
    held_out = held_out_motions(log, np.ones(len(log), dtype=bool), (0.1, 0.3), starts=4)
    seeing, motions = held_out.of(posterior)
    assert len(motions.q) == 8
    part = log.select_episodes([1])
    _, seen = observing(posterior, part, whole=True)
    np.testing.assert_allclose(motions.u[4:, 0], seen.u[list(motions.rows[4:])], rtol=1e-12, atol=1e-12)
    assert seeing.model.inputs == seen.model.inputs
    assert held_out.of(unobserved(posterior))[1] is held_out.motions
    rollout = seeing.rollout(motions.q[:, 0], motions.v[:, 0], motions.u, motions.dt, integrator="rk4")
    away = log.model.robot.difference(torch.tensor(motions.q[:, -1]), rollout.q[:, -1]).square().mean(-1)
    np.testing.assert_allclose(motion_scores(posterior, held_out)["squared"][1], away, rtol=1e-9)
